"""Figures and numbers of the paper that follow from its equations alone, without a run in closed loop.

References
----------
Grigorii, Li, Peshkin and Colgate: Comparison of wide-band vibrotactile and friction modulation surface gratings, 2021.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
from scipy.signal import butter, freqz, lfilter
from scipy.special import stdtr

from examples.grigorii2021.claims import Array, Claim, Curve, Item, Panel
from examples.grigorii2021.shaping import (
    TransferFunction,
    analyse,
    butterworth,
    exact_controller,
    second_order_controller,
)
from hapticrender.plants.plate import PlateParameters

LOOP, FILTER, LOWEST = 5.0, 10.0, 20.0  # Hz: bandwidths of T and L, and the lowest carrier
FREQUENCIES = np.array([20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0])  # Hz, of both experiments
GRID = np.arange(20.0, 400.5, 0.5)  # Hz
CEILING = 0.06  # m/s: end of the slider in the matching task
FREQUENCY = "frequency (Hz)"


def decibel(values: Array) -> Array:
    """Magnitude in dB, not below -120."""
    return 20 * np.log10(np.maximum(np.abs(values), 1e-6))


def controller() -> Item:
    """Compare the controller C and the closed loop T, exact and reduced to second order."""
    laws = {"exact": exact_controller(LOOP, FILTER), "2nd order": second_order_controller(LOOP, FILTER)}
    desired, low_pass = butterworth(LOOP), butterworth(FILTER)
    exact, reduced = laws.values()
    plain, cancelled = _polynomial_controller(desired, low_pass)
    slow = 1e-3  # Hz: as good as 0, where C has a pole
    measured = low_pass.frequency_response(slow)
    claims = [
        Claim("order of the exact C", 6, len(exact.poles()), 0.5, check=len(plain.poles()) - cancelled,
              why=f"polynomial arithmetic on T/(1 - L T) gives order {len(plain.poles())}, of which {cancelled} poles "
              "lie on zeros; check: the order that is left"),
        Claim("“sensitivity function” at 0 Hz", abs(desired(0)),
              abs(1 / (1 + measured * exact.frequency_response(slow))), 0.05,
              check=abs(1 - measured * desired.frequency_response(slow)),
              why="T is the response to the reference, 1 at 0 Hz; a sensitivity, S = 1/(1 + L C), is 0 there; "
              "check: 1 - L T"),
    ]  # fmt: skip
    frequency = np.geomspace(0.1, 100.0, 301)
    magnitude, phase = [], []
    for name, law in laws.items():
        loop = analyse(law, low_pass, lowest_frequency=LOWEST)
        claims += [
            Claim(f"bandwidth of T, C {name}", LOOP, loop.bandwidth, 0.5, "Hz"),
            Claim(f"sensing error in the drive at 20 Hz, C {name}", 0.5, 100 * loop.ripple, 0, "%", "<="),
        ]
        forward = law.frequency_response(frequency)
        sensitivity = 1 / (1 + low_pass.frequency_response(frequency) * forward)
        style = "-" if name == "exact" else ":"
        for symbol, response in (("C", forward), ("T", forward * sensitivity), ("S", sensitivity)):
            magnitude.append(Curve(f"{symbol} {name}", frequency, decibel(response), style))
            phase.append(Curve(f"{symbol} {name}", frequency, np.degrees(np.unwrap(np.angle(response))), style))
    magnitude.append(Curve("paper: T is -3 dB at 5 Hz", [0.1, 5, 5], [-3, -3, -60], "printed"))
    return Item(
        "controller", "Controller C and closed loop T", "Fig. 3 B, and “Computing filter and control dynamics”",
        tuple(claims),
        (Panel("Magnitude", FREQUENCY, "magnitude (dB)", tuple(magnitude), "x", (-60, 35)),
         Panel("Phase", FREQUENCY, "phase (deg)", tuple(phase), "x")),
        "The exact C needs order 4. Its second-order reduction has a closed form, ki p/(s (s + p)) with "
        f"ki = {reduced.numerator[0] / reduced.denominator[1]:.3f} 1/s and p = {reduced.denominator[1]:.3f} 1/s.",
    )  # fmt: skip


def _polynomial_controller(desired: TransferFunction, low_pass: TransferFunction) -> tuple[TransferFunction, int]:
    """Return T/(1 - L T) by polynomial arithmetic, and the number of its poles that lie on zeros."""
    both = np.polymul(desired.denominator, low_pass.denominator)
    rest = np.polysub(both, np.polymul(desired.numerator, low_pass.numerator))
    plain = TransferFunction(tuple(np.polymul(desired.numerator, both)), tuple(np.polymul(desired.denominator, rest)))
    zeros = np.roots(plain.numerator)
    return plain, int(sum(np.abs(zeros - pole).min() < 1e-6 * abs(pole) for pole in plain.poles() if pole != 0))


def transform() -> Item:
    """Compare the rise time of STDFT and STDFT* where both suppress the image of every carrier equally."""
    rate = PlateParameters().rate
    star = butter(2, FILTER, fs=rate)

    def response(kind: tuple[Array, Array], frequency: Array | float) -> Array:
        return np.abs(freqz(*kind, worN=np.atleast_1d(frequency), fs=rate)[1])

    def boxcar(frequency: Array | float, most: float) -> tuple[Array, Array]:
        """Shortest moving average whose gain at these frequencies is at most `most`."""
        n = next(m for m in range(2, 5000) if _dirichlet(m, frequency, rate).max() <= most)
        return np.full(n, 1 / n), np.ones(1)

    image = float(response(star, 2 * LOWEST)[0])
    quiet = boxcar(np.arange(2 * LOWEST, 800.5, 0.5), image)  # images of carriers from 20 to 400 Hz
    wide = boxcar(FILTER, sqrt(0.5))
    kinds = {"STDFT*": star, "STDFT, equally quiet": quiet, "STDFT, equally wide": wide}
    time, frequency = np.arange(round(0.2 * rate)) / rate, np.arange(0.0, 100.25, 0.25)
    steps = {name: lfilter(*kind, np.ones(time.size)) for name, kind in kinds.items()}
    rise = {name: 1e3 * (_first(time, step, 0.9) - _first(time, step, 0.1)) for name, step in steps.items()}
    return Item(
        "transform", "STDFT and STDFT*", "“STDFT of sensed signal”",
        (Claim("rise time of the STDFT*, faster than the STDFT", rise["STDFT, equally quiet"], rise["STDFT*"], 0, "ms",
               "<=", why=f"against the {quiet[0].size} samples that keep every image from 40 Hz on below "
               f"{100 * image:.1f} %, as the STDFT* does"),
         Claim("operations a sample of the STDFT*, fewer than the STDFT", quiet[0].size, 9, 0, relation="<=",
               why="M additions as printed, against 5 products and 4 sums; a running sum needs 2"),
         Claim("STDFT* at its cut-off of 10 Hz", -3, 20 * np.log10(float(response(star, FILTER)[0])), 0.5, "dB")),
        (Panel("Gain beside the carrier", "offset from the carrier (Hz)", "gain (dB)",
               (*(Curve(name, frequency, decibel(response(kind, frequency))) for name, kind in kinds.items()),
                Curve("paper: cut-off 10 Hz", [0, 10, 10], [-3, -3, -45], "printed")), ylim=(-45, 3)),
         Panel("An amplitude switched on", "time (ms)", "estimated amplitude",
               tuple(Curve(name, 1e3 * time, step) for name, step in steps.items()))),
        f"With the same cut-off of 10 Hz ({wide[0].size} samples) the two are equally fast: "
        f"{rise['STDFT, equally wide']:.1f} and {rise['STDFT*']:.1f} ms. The STDFT* gains suppression of images.",
    )  # fmt: skip


def _dirichlet(length: int, frequency: Array | float, rate: float) -> Array:
    """Gain of a moving average of so many samples."""
    half = pi * np.asarray(frequency) / rate
    return np.abs(np.sin(length * half) / (length * np.sin(half)))


def _first(time: Array, values: Array, level: float) -> float:
    """Return when `values` reach `level`, interpolated between two samples."""
    at = int(np.argmax(values >= level))
    return float(np.interp(level, values[at - 1 : at + 1], time[at - 1 : at + 1]))


def plate() -> Item:
    """Compare the plate's modes by the printed equations of force and by the corrected ones."""
    parameters = PlateParameters()
    half, spacing = parameters.mass / 2, parameters.coil_spacing
    apart = np.array([[1.0, -1.0], [-1.0, 1.0]])
    printed = half * np.eye(2) + parameters.inertia / (2 * spacing) * apart
    right = half / 2 * np.ones((2, 2)) + parameters.inertia / spacing**2 * apart
    rocking, heave = (float(value) for value in parameters.modes()[0])
    print_modes, right_modes = _modes(printed, parameters), _modes(right, parameters)
    drive = parameters.force_from_drive @ np.array([[1.0, 1.0], [1.0, -1.0]])
    lever = parameters.glass_length / 2 / parameters.half_spacing  # of an end, in the coordinates of the coils
    motion = 1e6 * np.linalg.solve(parameters.dynamic_stiffness(GRID), drive)
    s, (damping, stiffness) = 2j * pi * GRID[:, None, None], _sides(parameters)
    opposed = parameters.force_constant * np.array([[1.0], [-1.0]])
    coils = 1e6 * np.linalg.solve(printed * s**2 + damping * s + stiffness, opposed[None])[..., 0]
    stray = np.abs(
        (coils[:, 0] + coils[:, 1]) / 2 + parameters.glass_length / 2 * (coils[:, 1] - coils[:, 0]) / spacing
    )
    unit = "displacement per coil current (µm/A)"
    return Item(
        "plate", "The plate's own modes", "Equations of F1 and F2, and Fig. 2",
        (Claim("resonance (heave)", 190, heave, 5, "Hz"),
         Claim("rocking mode by the equations of F1, F2", print_modes[0], rocking, 0.05, "Hz", check=right_modes[0],
               why="printed (m/2) x_i'' -+ (I/2) theta'', a torque in a force; corrected (m/2) x_c'' -+ (I/d) theta'' "
               "in the check; ours from the moments about the middle"),
         Claim("heave mode by the equations of F1, F2", print_modes[1], heave, 0.05, "Hz", check=right_modes[1],
               why="the same"),
         Claim("inertia in F1 + F2, and so in F_f and Z_f, off by", 0,
               100 * float(np.abs(printed.sum(axis=0) / right.sum(axis=0) - 1).max()), 0.05, "%"),
         Claim("command per coil current, R1/(1 - R2/Rp)", -5, 10e3 / (1 - 2e3 / 1.0), 0.5, "V/A")),
        (Panel("Coils together: heave", FREQUENCY, unit,
               (Curve("centre", GRID, np.abs(motion[:, 0, 0])),
                Curve("end 2", GRID, np.abs(motion[:, 0, 0] + lever * motion[:, 1, 0])),
                Curve("paper: resonance 190 Hz", [190, 190], [10, 3000], "printed")), "xy"),
         Panel("Coils opposed: rocking", FREQUENCY, unit,
               (Curve("end 2, by its moments", GRID, np.abs(motion[:, 0, 1] + lever * motion[:, 1, 1])),
                Curve("end 2, equations as printed", GRID, stray, "printed")), "xy")),
        "Also: the amplifier inverts, so from command to displacement the phase runs from +180 to 0 degrees, not "
        "from 0 to -180; commands leave through the 12-bit DAC and readings enter by the 14-bit ADC, printed the other "
        "way round; b is in N s/m, printed Nm/s.",
    )  # fmt: skip


def _sides(parameters: PlateParameters) -> tuple[Array, Array]:
    """Damping (N s/m) and stiffness (N/m) at the two coils."""
    return (
        np.diag([parameters.damping_1, parameters.damping_2]),
        np.diag([parameters.stiffness_1, parameters.stiffness_2]),
    )


def _modes(mass: Array, parameters: PlateParameters) -> list[float]:
    """Mode frequencies (Hz, ascending) in the coordinates of the coils."""
    stiffness = _sides(parameters)[1]
    return (np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)) / (2 * pi)).tolist()


def stimuli() -> Item:
    """Compare frequencies and velocity ceiling of the matching task, and compute the drive of the ceiling."""
    parameters = PlateParameters()
    spaced = np.geomspace(FREQUENCIES[0], FREQUENCIES[-1], FREQUENCIES.size)
    ceiling = 1e3 * CEILING / (2 * pi * FREQUENCIES)
    force = 1 / np.linalg.inv(parameters.dynamic_stiffness(GRID))[:, 0, 0]
    current = np.abs(force) * CEILING / (2 * pi * GRID) / (2 * parameters.force_constant)
    return Item(
        "stimuli", "Stimuli of the matching task", "“Psychophysical experiments”",
        (Claim("distance of the eight frequencies from logarithmic spacing", 0,
               float(np.abs(spaced - FREQUENCIES).max()), 0.5, "Hz"),
         Claim("0.06 m/s at 20 Hz", 0.48, ceiling[0], 0.005, "mm"),
         Claim("0.06 m/s at 400 Hz", 0.024, ceiling[-1], 0.0005, "mm"),
         Claim("range of the linear sensor that it takes", 0.5, float(ceiling.max()), 0, "mm", "<=")),
        (Panel("Ceiling of the slider", FREQUENCY, "displacement (mm, peak)",
               (Curve("0.06 m/s", GRID, 1e3 * CEILING / (2 * pi * GRID)),
                Curve("the eight frequencies", FREQUENCIES, ceiling, "o"),
                Curve("paper: sensor linear to 0.5 mm", [20, 400], [0.5, 0.5], "printed")), "xy"),
         Panel("Current at the ceiling, without a finger", FREQUENCY, "current in each coil (A, peak)",
               (Curve("each coil", GRID, current),), "x", (0, 1.1 * float(current.max())))),
        f"The ceiling takes at most {current.max():.2g} A a coil, without a finger and with equal currents.",
    )  # fmt: skip


def electroadhesion() -> Item:
    """Compute the envelope of the electroadhesion current, and the force as its square."""
    turn = np.arange(256) / 256
    sine = (np.sin(2 * pi * turn) + 1) / 2
    forces = {"with the root": sine, "without": sine**2}
    lines = {name: np.abs(np.fft.rfft(force)) for name, force in forces.items()}
    second = {name: 100 * float(line[2] / line[1]) for name, line in lines.items()}
    period = "time (periods of the grating)"
    return Item(
        "electroadhesion", "Drive of the electroadhesion", "“Apparatus”, m(t)",
        (Claim("second harmonic of the force, current with the root", 0, second["with the root"], 0.5, "%",
               why=f"the root is needed: without it {second['without']:.0f} %"),),
        (Panel("Envelope of the 20 kHz current", period, "current (mA)",
               (Curve("6 mA sqrt((sin + 1)/2)", turn, 6 * np.sqrt(sine)), Curve("without the root", turn, 6 * sine),
                Curve("paper: 6 mA", [0, 1], [6, 6], "printed")), ylim=(0, 7.6)),
         Panel("Force, as the square of the current", period, "force (of its peak)",
               (*(Curve(name, turn, force) for name, force in forces.items()),
                Curve("paper: a sine", turn, sine, "printed")), ylim=(0, 1.28))),
        "The envelope has a cusp at no current, which carries lines far above 400 Hz into the amplifier.",
    )  # fmt: skip


def statistics() -> Item:
    """Recompute the paper's p values from its own t, r and sample sizes, two-sided."""
    t_of_r = 0.85 * sqrt((13 - 2) / (1 - 0.85**2))
    tests = (
        ("similarity over frequency, t(104) = 4.03", 4.03, 104, 1e-4),
        ("time on the electroadhesion surface, t(104) = 3.5", 3.5, 104, 1e-3),
        ("time on the plate, t(104) = 6", 6.0, 104, 1e-7),
        ("CV of force over velocity, t(180) = 2.57", 2.57, 180, 1e-1),
    )
    claims = [
        Claim(f"log10 p of {what}", float(np.log10(bound)), float(np.log10(_tail(t, degrees))), 0.005, relation="<=",
              check=float(np.log10(_integrated_tail(t, degrees))), why=f"p = {_tail(t, degrees):.2g} two-sided, "
              f"{_tail(t, degrees) / 2:.2g} one-sided; check: the density integrated")
        for what, t, degrees, bound in tests
    ]  # fmt: skip
    row, p = np.arange(len(tests)) + 1.0, np.array([_tail(t, degrees) for _, t, degrees, _ in tests])
    return Item(
        "statistics", "The printed statistics against each other", "“Results”",
        (*claims,
         Claim("p of impedance over load, r = 0.85 of 13 subjects", 2e-4, _tail(t_of_r, 11), 0.5e-4),
         Claim("median CV of force over that of velocity", 30, 100 * (0.275 / 0.205 - 1), 5, "% more"),
         Claim("inverse of 0.64 m/(N s)", 1.6, 1 / 0.64, 0.05, "N s/m")),
        (Panel("p of the printed t", "number of the claim in the table", "p",
               (Curve("two-sided", row, p, "o"), Curve("one-sided", row, p / 2, "o"),
                *(Curve("paper: p below", [at - 0.2, at + 0.2], [bound] * 2, "printed")
                  for at, (*_, bound) in zip(row, tests, strict=True))), "y"),),
        "Only what is printed with its degrees of freedom can be recomputed; the rest needs the data.",
    )  # fmt: skip


def _tail(t: float, degrees: int) -> float:
    """Two-sided p of Student's t."""
    return 2 * float(stdtr(degrees, -abs(t)))


def _integrated_tail(t: float, degrees: int) -> float:
    """The same by sums over the density: its mass beyond t over all of it."""
    nodes = np.linspace(0.0, 60.0, 60_001)
    density = (1 + nodes**2 / degrees) ** (-(degrees + 1) / 2)
    beyond = np.interp(nodes, [t, t + 1e-3], [0.0, 1.0])
    return float(np.sum(beyond * density) / np.sum(density[1:]))
