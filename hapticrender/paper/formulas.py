"""The paper's figures and numbers that follow from its equations alone, without a run in closed loop.

References
----------
Grigorii, Li, Peshkin and Colgate: Comparison of wide-band vibrotactile and friction modulation surface gratings, 2021.
Figures are counted in the order in which they stand there.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from hapticrender.control.loopshape import exact_controller, margins, reduced_controller
from hapticrender.control.stdft import BoxcarSTDFT, StarSTDFT
from hapticrender.control.transfer import TransferFunction, butterworth
from hapticrender.paper.claims import Claim, Item, Table
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array

LOOP, FILTER, LOWEST = 5.0, 10.0, 20.0  # Hz: bandwidths of T and L, and the lowest carrier
FREQUENCIES = np.array([20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0])  # Hz, of both experiments
GRID = np.arange(20.0, 400.5, 0.5)  # Hz
CEILING = 0.06  # m/s: end of the slider in the matching task


def controller() -> Item:
    """Controller C and the closed loop T, exact and of second order."""
    exact, reduced = exact_controller(LOOP, FILTER), reduced_controller(LOOP, FILTER)
    wanted, low_pass = butterworth(LOOP), butterworth(FILTER)
    plain, cancelled = _polynomial_controller(wanted, low_pass)
    loops = {
        "exact": margins(exact, low_pass, lowest_frequency=LOWEST),
        "2nd order": margins(reduced, low_pass, lowest_frequency=LOWEST),
    }
    slow = 1e-3  # Hz: as good as 0, where C has a pole
    listened = low_pass.frequency_response(slow)
    rest = abs(1 / (1 + listened * exact.frequency_response(slow)))
    claims = [
        Claim(
            what="order of the exact C", paper=6, ours=exact.order, within=0.5, check=plain.order - cancelled,
            why=f"polynomial arithmetic on T/(1 - L T) gives order {plain.order}, of which {cancelled} poles "
            "lie on zeros; check: what is left of them",
        ),
        Claim(
            what='"sensitivity function" at 0 Hz', paper=abs(wanted(0)), ours=rest, within=0.05,
            check=abs(1 - listened * wanted.frequency_response(slow)),
            why="T answers the reference, with 1 at 0 Hz; a sensitivity, S = 1/(1 + L C), is 0 there; check: 1 - L T",
        ),
    ]  # fmt: skip
    for name, loop in loops.items():
        claims += [
            Claim(what=f"bandwidth of T, C {name}", paper=LOOP, ours=loop.bandwidth, within=0.5, unit="Hz"),
            Claim(
                what=f"sensing error in the drive at 20 Hz, C {name}", paper=0.5, ours=100 * loop.ripple, within=0,
                unit="%", relation="<=",
            ),
        ]  # fmt: skip
    return Item(
        name="controller",
        title="Controller C and closed loop T",
        where="Fig. 3 B, and “Computing filter and control dynamics”",
        claims=tuple(claims),
        tables={"response": _loop_table(exact, reduced, low_pass)},
        note="The exact C needs order 4. Its second-order reduction has a closed form, ki p/(s (s + p)) with "
        f"ki = {reduced.numerator[0] / reduced.denominator[1]:.3f} 1/s and p = {reduced.denominator[1]:.3f} 1/s.",
    )


def _polynomial_controller(wanted: TransferFunction, low_pass: TransferFunction) -> tuple[TransferFunction, int]:
    """T/(1 - L T) as polynomials give it, and how many of its poles lie on zeros."""
    both = np.polymul(wanted.denominator, low_pass.denominator)
    rest = np.polysub(both, np.polymul(wanted.numerator, low_pass.numerator))
    plain = TransferFunction(
        tuple(np.polymul(wanted.numerator, both)), tuple(np.polymul(wanted.denominator, rest))
    )  # fmt: skip
    zeros = np.roots(plain.numerator)
    return plain, int(sum(np.abs(zeros - pole).min() < 1e-6 * abs(pole) for pole in plain.poles() if pole != 0))


def _loop_table(exact: TransferFunction, reduced: TransferFunction, low_pass: TransferFunction) -> Table:
    """C, T and S over frequency, of both controllers."""
    frequency = np.geomspace(0.1, 100.0, 301)
    listened = low_pass.frequency_response(frequency)
    columns = {"frequency (Hz)": frequency}
    for name, law in (("exact", exact), ("2nd order", reduced)):
        forward = law.frequency_response(frequency)
        for symbol, response in (("C", forward), ("T", forward / (1 + listened * forward))):
            columns[f"{symbol} {name} (dB)"] = 20 * np.log10(np.abs(response))
            columns[f"{symbol} {name} (deg)"] = np.degrees(np.unwrap(np.angle(response)))
        columns[f"S {name} (dB)"] = -20 * np.log10(np.abs(1 + listened * forward))
    return columns


def transform() -> Item:
    """STDFT and STDFT*: how fast they are where both keep the image of every carrier out alike."""
    rate = PlateParameters().rate
    star = StarSTDFT(bandwidth=FILTER, rate=rate)
    image = float(abs(star.frequency_response(2 * LOWEST)))
    offset = np.arange(2 * LOWEST, 800.5, 0.5)  # Hz: images of carriers from 20 to 400 Hz
    alike = next(
        each for m in range(2, 5000)
        if np.abs((each := BoxcarSTDFT(length=m, rate=rate)).frequency_response(offset)).max() <= image
    )  # fmt: skip
    as_wide = next(
        each for m in range(2, 5000)
        if abs((each := BoxcarSTDFT(length=m, rate=rate)).frequency_response(FILTER)) <= sqrt(0.5)
    )  # fmt: skip
    kinds: dict[str, BoxcarSTDFT | StarSTDFT] = {"STDFT*": star, "STDFT, as quiet": alike, "STDFT, as wide": as_wide}
    time = np.arange(round(0.2 * rate)) / rate
    steps = {name: _step(kind, time) for name, kind in kinds.items()}
    rise = {name: 1e3 * (_first(time, step, 0.9) - _first(time, step, 0.1)) for name, step in steps.items()}
    frequency = np.arange(0.0, 100.25, 0.25)
    return Item(
        name="transform",
        title="STDFT and STDFT*",
        where="“STDFT of sensed signal”",
        claims=(
            Claim(
                what="rise time of the STDFT*, faster than the STDFT", paper=rise["STDFT, as quiet"],
                ours=rise["STDFT*"], within=0, unit="ms", relation="<=",
                why=f"against the {alike.length} samples that keep every image from 40 Hz on below "
                f"{100 * image:.1f} %, as the STDFT* does",
            ),
            Claim(
                what="operations a sample of the STDFT*, fewer than the STDFT", paper=alike.length, ours=9, within=0,
                relation="<=", why="M additions as printed, against 5 products and 4 sums; a running sum needs 2",
            ),
            Claim(
                what="STDFT* at its cut-off of 10 Hz", paper=-3, within=0.5, unit="dB",
                ours=20 * np.log10(abs(star.frequency_response(FILTER))),
            ),
        ),
        tables={
            "response": {"offset (Hz)": frequency}
            | {f"{name} (dB)": _decibel(kind.frequency_response(frequency)) for name, kind in kinds.items()},
            "step": {"time (s)": time} | steps,
        },
        note=f"With the same cut-off of 10 Hz ({as_wide.length} samples) the two are equally fast: "
        f"{rise['STDFT, as wide']:.1f} and {rise['STDFT*']:.1f} ms. What the STDFT* gains is quiet.",
    )  # fmt: skip


def _step(kind: BoxcarSTDFT | StarSTDFT, time: Array) -> Array:
    """What an estimator makes of the amplitude of a carrier at 0 Hz, where there is no image, switched on at once."""
    envelopes = kind.start(channels=1, bands=1).run(np.ones((time.size, 1)), np.zeros((time.size, 1)))
    return abs(envelopes[:, 0, 0]) / 2


def _first(time: Array, values: Array, level: float) -> float:
    """When `values` reach `level`, between two samples."""
    at = int(np.argmax(values >= level))
    return float(np.interp(level, values[at - 1 : at + 1], time[at - 1 : at + 1]))


def _decibel(values: Array) -> Array:
    return 20 * np.log10(np.maximum(np.abs(values), 1e-6))


def plate() -> Item:
    """Modes and frequency response of the plate, by its printed equations of force and by the right ones."""
    parameters = PlateParameters()
    half, spacing = parameters.mass / 2, parameters.coil_spacing
    together, apart = np.ones((2, 2)), np.array([[1.0, -1.0], [-1.0, 1.0]])
    printed = half * np.eye(2) + parameters.inertia / (2 * spacing) * apart
    right = half / 2 * together + parameters.inertia / spacing**2 * apart
    rocking, heave = (float(value) for value in parameters.modes()[0])
    print_modes, right_modes = _modes(printed, parameters), _modes(right, parameters)
    return Item(
        name="plate",
        title="The plate's own modes",
        where="Equations of F1 and F2, and Fig. 2",
        claims=(
            Claim(what="resonance (heave)", paper=190, ours=heave, within=5, unit="Hz"),
            Claim(
                what="rocking mode by the equations of F1, F2", paper=print_modes[0], ours=rocking, within=0.05,
                unit="Hz", check=right_modes[0],
                why="printed (m/2) x_i'' -+ (I/2) theta'', a torque in a force; right is (m/2) x_c'' -+ (I/d) theta'', "
                "as the check has it; ours from the moments about the middle",
            ),
            Claim(
                what="heave mode by the equations of F1, F2", paper=print_modes[1], ours=heave, within=0.05, unit="Hz",
                check=right_modes[1], why="the same",
            ),
            Claim(
                what="inertia in F1 + F2, and so in F_f and Z_f, off by", paper=0, within=0.05, unit="%",
                ours=100 * float(np.abs(printed.sum(axis=0) / right.sum(axis=0) - 1).max()),
            ),
            Claim(
                what="command per coil current", paper=-5, ours=1 / parameters.amplifier_gain, within=0.5, unit="V/A"
            ),
        ),
        tables={
            "response": _plate_table(parameters, printed),
            "modes": {
                "mode": np.array(["rocking", "heave"]),
                "frequency (Hz)": parameters.modes()[0],
                "as printed (Hz)": np.array(print_modes),
            },
        },
        note="Also: the amplifier inverts, so from command to displacement the phase runs from +180 to 0 degrees, not "
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


def _plate_table(parameters: PlateParameters, printed: Array) -> Table:
    """Motion per ampere in both coils (centre, end) and in opposite coils (end), right and as printed."""
    drive = parameters.force_from_drive @ np.array([[1.0, 1.0], [1.0, -1.0]])
    model = parameters.band_model(parameters.rate, parameters.delay)
    motion = 1e6 * np.abs(model.place_from_coordinate @ np.linalg.solve(parameters.dynamic_stiffness(GRID), drive))
    s = 2j * pi * GRID[:, None, None]
    damping, stiffness = _sides(parameters)
    opposed = parameters.force_constant * np.array([[1.0], [-1.0]])
    coils = np.linalg.solve(printed * s**2 + damping * s + stiffness, opposed)
    tilt = (coils[:, 1, 0] - coils[:, 0, 0]) / parameters.coil_spacing
    end = (coils[:, 0, 0] + coils[:, 1, 0]) / 2 + parameters.glass_length / 2 * tilt
    return {
        "frequency (Hz)": GRID,
        "centre, coils together (um/A)": motion[:, 0, 0],
        "end 2, coils together (um/A)": motion[:, 2, 0],
        "end 2, coils opposed (um/A)": motion[:, 2, 1],
        "end 2, coils opposed, as printed (um/A)": 1e6 * np.abs(end),
    }


def stimuli() -> Item:
    """Frequencies and velocity ceiling of the matching task, and the drive that the ceiling takes."""
    parameters = PlateParameters()
    spaced = np.geomspace(FREQUENCIES[0], FREQUENCIES[-1], FREQUENCIES.size)
    ceiling = 1e3 * CEILING / (2 * pi * FREQUENCIES)
    force = np.linalg.inv(np.linalg.inv(parameters.dynamic_stiffness(GRID))[:, :1, :1])[:, 0, 0]
    current = np.abs(force) * CEILING / (2 * pi * GRID) / (2 * parameters.force_constant)
    return Item(
        name="stimuli",
        title="Stimuli of the matching task",
        where="“Psychophysical experiments”",
        claims=(
            Claim(
                what="distance of the eight frequencies from logarithmic spacing", paper=0, within=0.5, unit="Hz",
                ours=float(np.abs(spaced - FREQUENCIES).max()),
            ),
            Claim(what="0.06 m/s at 20 Hz", paper=0.48, ours=ceiling[0], within=0.005, unit="mm"),
            Claim(what="0.06 m/s at 400 Hz", paper=0.024, ours=ceiling[-1], within=0.0005, unit="mm"),
            Claim(
                what="range of the linear sensor that it takes", paper=0.5, ours=float(ceiling.max()), within=0,
                unit="mm", relation="<=",
            ),
        ),
        tables={
            "ceiling": {
                "frequency (Hz)": GRID,
                "displacement (mm)": 1e3 * CEILING / (2 * pi * GRID),
                "current a coil (A)": current,
            },
            "frequencies": {"frequency (Hz)": FREQUENCIES, "log-spaced (Hz)": spaced, "displacement (mm)": ceiling},
        },
        note=f"The ceiling takes at most {current.max():.2g} A a coil, without a finger and with equal currents.",
    )  # fmt: skip


def electroadhesion() -> Item:
    """Envelope of the electroadhesion current, and the force that goes with its square."""
    turn = np.arange(256) / 256
    sine = (np.sin(2 * pi * turn) + 1) / 2
    forces = {"with the root": np.sqrt(sine) ** 2, "without": sine**2}
    lines = {name: np.abs(np.fft.rfft(force)) for name, force in forces.items()}
    second = {name: 100 * float(line[2] / line[1]) for name, line in lines.items()}
    return Item(
        name="electroadhesion",
        title="Drive of the electroadhesion",
        where="“Apparatus”, m(t)",
        claims=(
            Claim(
                what="second harmonic of the force, current with the root", paper=0, ours=second["with the root"],
                within=0.5, unit="%", why=f"the root is needed: without it {second['without']:.0f} %",
            ),
        ),
        tables={
            "period": {"time (periods)": turn, "current with the root (mA)": 6 * np.sqrt(sine)}
            | {"current without (mA)": 6 * sine}
            | {f"force {name} (of its peak)": force for name, force in forces.items()}
        },
        note="The envelope has a cusp at no current, which carries lines far above 400 Hz into the amplifier.",
    )  # fmt: skip


def statistics() -> Item:
    """The paper's p values from its own t, r and sample sizes, two-sided."""
    t_of_r = 0.85 * sqrt((13 - 2) / (1 - 0.85**2))
    tests = (
        ("similarity over frequency, t(104) = 4.03", 4.03, 104, 1e-4),
        ("time on the electroadhesion surface, t(104) = 3.5", 3.5, 104, 1e-3),
        ("time on the plate, t(104) = 6", 6.0, 104, 1e-7),
        ("CV of force over velocity, t(180) = 2.57", 2.57, 180, 1e-1),
    )
    claims = [
        Claim(
            what=f"log10 p of {what}", paper=float(np.log10(bound)), ours=float(np.log10(_tail(t, degrees))),
            within=0.005, relation="<=", check=float(np.log10(_integrated_tail(t, degrees))),
            why=f"p = {_tail(t, degrees):.2g} two-sided, {_tail(t, degrees) / 2:.2g} one-sided; "
            "check: the density integrated",
        )
        for what, t, degrees, bound in tests
    ]  # fmt: skip
    return Item(
        name="statistics",
        title="The printed statistics against each other",
        where="“Results”",
        claims=(
            *claims,
            Claim(
                what="p of impedance over load, r = 0.85 of 13 subjects", paper=2e-4, ours=_tail(t_of_r, 11),
                within=0.5e-4,
            ),
            Claim(what="median CV of force over that of velocity", paper=30, ours=100 * (0.275 / 0.205 - 1), within=5,
                  unit="% more"),
            Claim(what="inverse of 0.64 m/(N s)", paper=1.6, ours=1 / 0.64, within=0.05, unit="N s/m"),
        ),
        tables={
            "p": {
                "t": np.array([t for _, t, _, _ in tests]),
                "degrees of freedom": np.array([float(degrees) for _, _, degrees, _ in tests]),
                "p below, printed": np.array([bound for *_, bound in tests]),
                "p two-sided": np.array([_tail(t, degrees) for _, t, degrees, _ in tests]),
                "p one-sided": np.array([_tail(t, degrees) / 2 for _, t, degrees, _ in tests]),
            }
        },
        note="Only what is printed with its degrees of freedom can be recomputed; the rest needs the data.",
    )  # fmt: skip


def _tail(t: float, degrees: int) -> float:
    """Two-sided p of Student's t."""
    from scipy.special import stdtr

    return 2 * float(stdtr(degrees, -abs(t)))


def _integrated_tail(t: float, degrees: int) -> float:
    """The same by sums over the density, whose mass beyond t is compared with all of it."""
    nodes = np.linspace(0.0, 60.0, 60_001)
    density = (1 + nodes**2 / degrees) ** (-(degrees + 1) / 2)
    beyond = np.interp(nodes, [t, t + 1e-3], [0.0, 1.0])
    return float(np.sum(beyond * density) / np.sum(density[1:]))
