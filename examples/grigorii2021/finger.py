"""Figures of the paper about the finger: impedance, velocities per force, and its effect on the plate.

References
----------
Grigorii et al. 2021, Table 1, Figs. 9 and 10, and the appendix; Israr et al. 2006 for the just noticeable difference.
"""

from __future__ import annotations

from math import pi

import numpy as np

from examples.grigorii2021.claims import Array, Claim, Curve, Item, Panel
from examples.grigorii2021.formulas import FILTER, FREQUENCIES, FREQUENCY, GRID, LOOP
from examples.grigorii2021.shaping import TransferFunction, analyse, butterworth, second_order_controller
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, LIGHT_SECOND, FingerMechanics

MATCH = 0.64  # m/(N s): plate velocity per friction force at equal intensity
JND = 2.2  # dB: just noticeable difference of an amplitude
NEAR = 100 * (10 ** (JND / 20) - 1)  # the same, %
FINGERS = {"light, 4th": LIGHT, "light, 2nd": LIGHT_SECOND, "heavy, 4th": HEAVY, "heavy, 2nd": HEAVY_SECOND}


def loaded() -> Item:
    """Compute the plate's gain under a finger, and the loop bandwidth that an equal load takes."""
    parameters = PlateParameters()
    bare = np.abs(np.linalg.inv(parameters.dynamic_stiffness(GRID))[:, 0, 0])
    gains = {
        name: np.abs(np.linalg.inv(parameters.dynamic_stiffness(GRID, finger.impedance(GRID)))[:, 0, 0]) / bare
        for name, finger in FINGERS.items()
    }
    most = gains["light, 2nd"]
    heave = float(parameters.modes()[0][1])
    at_mode, at_20 = (_bandwidth_lost(parameters, frequency) for frequency in (heave, 20.0))
    return Item(
        "loaded", "A finger on the plate: gain and bandwidth", "“Computing filter and control dynamics”",
        (Claim("largest gain under a finger over that without", 1, float(most.max()), 0.05, relation="<=",
               check=float(_one_mass(parameters, GRID, LIGHT_SECOND.impedance(GRID)).max()),
               why="“the finger always adds impedance”, but it also lowers the resonance; light, 2nd order, "
               f"{GRID[most.argmax()]:.0f} Hz; check: one mass alone"),
         Claim("the same at the resonance, heavy", 1, float(np.interp(heave, GRID, gains["heavy, 4th"])), 0.05,
               relation="<=", why="there the table does underestimate the effort"),
         Claim("bandwidth lost to an equal load, at the resonance", 50, at_mode[0], 5, "%",
               why="a damper like the plate's own"),
         Claim("bandwidth lost to an equal load, at 20 Hz", 50, at_20[0], 5, "%", check=at_20[1],
               why="the same damper; away from the resonance it is small beside the stiffness; check: the gain lost")),
        (Panel("Gain of the plate at its centre, a finger in the middle", FREQUENCY, "gain, loaded over free",
               (*(Curve(name, GRID, gain, ":" if "2nd" in name else "-") for name, gain in gains.items()),
                Curve("paper: the gain is below 1", [20, 400], [1, 1], "printed")), "xy", (0.2, 2.5)),),
        "A table fitted to the loaded plate is no cure: near the heave mode a lift then raises the loop "
        f"gain {1 / gains['heavy, 4th'].min():.1f} times.",
    )  # fmt: skip


def _one_mass(parameters: PlateParameters, frequency: Array | float, impedance: Array | float) -> Array:
    """Gain loaded over free of the plate as one mass that cannot rock."""
    w = 2 * pi * np.asarray(frequency)
    damping = parameters.damping_1 + parameters.damping_2
    bare = parameters.stiffness_1 + parameters.stiffness_2 - parameters.mass * w**2 + 1j * w * damping
    return np.abs(bare / (bare + 1j * w * impedance))


def _bandwidth_lost(parameters: PlateParameters, frequency: float) -> tuple[float, float]:
    """Share (%) of the loop's bandwidth, and of the gain, that a damper like the plate's own takes.

    Within reach of the heave mode its half width is a pole of the amplitude, which the damper doubles.
    """
    gain = float(_one_mass(parameters, frequency, parameters.damping_1 + parameters.damping_2))
    mode, ratio = (float(values[1]) for values in parameters.modes())
    resonant = abs(frequency - mode) < mode * ratio
    law, low_pass = second_order_controller(LOOP, FILTER), butterworth(FILTER)
    weak = TransferFunction(tuple(gain * each for each in law.numerator), law.denominator)
    free, held = (
        analyse(each, low_pass, amplitude_pole=width * mode * ratio if resonant else None).bandwidth
        for each, width in ((law, 1), (weak, 2))
    )
    return 100 * (1 - held / free), 100 * (1 - gain)


def impedance() -> Item:
    """Compute the impedance of the finger over frequency from Table 1."""
    size = {name: np.abs(finger.impedance(GRID)) for name, finger in FINGERS.items()}
    beyond = {kind: 100 * np.abs(size[f"{kind}, 2nd"] / size[f"{kind}, 4th"] - 1) for kind in ("light", "heavy")}
    apart = max(
        float(np.abs(1 / _printed_admittances(finger, GRID)[0] / finger.impedance(GRID) - 1).max())
        for finger in (LIGHT, HEAVY)
    )
    ratios = {"stiffness": HEAVY.stiffness / LIGHT.stiffness, "damping": HEAVY.damping / LIGHT.damping}
    return Item(
        "impedance", "Impedance of the finger", "Table 1, Fig. 9 A and B (the model's lines), and the appendix",
        (Claim("printed Z_s against ours, largest difference", 0, 100 * apart, 0.05, "%"),
         Claim("2nd order for 4th, heavy, worst to 261 Hz", NEAR, beyond["heavy"][GRID <= 261].max(), 0, "%", "<=",
               why=f"“well predicted” read as: nearer than a just noticeable difference, {JND} dB"),
         Claim("2nd order for 4th, light, at 400 Hz", NEAR, beyond["light"][-1], 0, "%", ">=",
               why="“could not be fit well”, read likewise"),
         *(Claim(f"{what} of the heavy skin over the light", bound, ratio, 0, relation=sign)
           for what, ratio in ratios.items() for bound, sign in ((2, ">="), (8, "<=")))),
        tuple(Panel(f"{kind.capitalize()} touch, {load}", FREQUENCY, "|Z_f| (N s/m)",
                    tuple(Curve(f"{order} order", GRID, size[f"{kind}, {order}"], style)
                          for order, style in (("4th", "-"), ("2nd", ":"))), "xy", (0.5, 20))
              for kind, load in (("light", "W < 0.5 N"), ("heavy", "W > 0.5 N"))),
        "For points see the simulated subjects.",
    )  # fmt: skip


def _printed_admittances(finger: FingerMechanics, frequency: Array) -> tuple[Array, Array, Array]:
    """V_s/F, V_p/F and V_t/F (m/(N s)) by the ratios of polynomials at the end of the appendix."""
    m, b, k = finger.mass, finger.damping, finger.stiffness
    mp, bp, kp = finger.phalanx_mass, finger.phalanx_damping, finger.phalanx_stiffness
    s = 2j * pi * frequency
    below = np.polyval([m * mp, m * (bp + b) + mp * b, m * (k + kp) + mp * k + b * bp, b * kp + bp * k, k * kp], s)
    above = ([mp, bp + b, kp + k, 0.0], [b, k, 0.0], [mp, bp, kp, 0.0])
    skin, phalanx, tissue = (np.polyval(each, s) / below for each in above)
    return skin, phalanx, tissue


def _balance(finger: FingerMechanics, frequency: Array) -> Array:
    """V_s/F (m/(N s)) from the phalanx's force balance as printed, with b_p x_s' in it instead of b_p x_p'."""
    s = 2j * pi * frequency
    tissue = finger.damping * s + finger.stiffness
    phalanx = finger.phalanx_mass * s**2 + finger.phalanx_stiffness + tissue
    follows = (tissue - finger.phalanx_damping * s) / phalanx
    return np.abs(s / (finger.mass * s**2 + tissue * (1 - follows)))


def admittance() -> Item:
    """Compare velocity of skin, phalanx and tissue per force with the ratio at equal intensity."""
    s, whole = 2j * pi * GRID, LIGHT.skin_velocity_per_force(GRID)
    between = LIGHT.damping + LIGHT.stiffness / s
    hand = LIGHT.phalanx_mass * s + LIGHT.phalanx_damping + LIGHT.phalanx_stiffness / s
    complex_parts = (whole, whole * between / (hand + between), whole * hand / (hand + between))
    skin, phalanx, tissue = (np.abs(each) for each in complex_parts)
    eight = np.abs(LIGHT.skin_velocity_per_force(FREQUENCIES))
    off = _balance(LIGHT, FREQUENCIES) / eight - 1
    worst = int(np.abs(off).argmax())
    lowest, highest = (20 * np.log10(each / MATCH) for each in (eight.min(), eight.max()))
    unit = "velocity per force (m/(N s))"
    return Item(
        "admittance", "Velocity per force of skin, phalanx and tissue", "Fig. 10 A (black) and B, and the appendix",
        (Claim("mean |V_s/F| at the eight frequencies, beside the perceptual match", MATCH, float(eight.mean()),
               MATCH * NEAR / 100, "m/(N s)", why=f"equal read as: within a just noticeable difference, {JND} dB; at "
               f"single frequencies it is {lowest:+.1f} to {highest:+.1f} dB off"),
         Claim("|V_s/F| from 20 to 31 Hz, growing", 1, float(eight[1] / eight[0]), 0, relation=">=",
               why="“positive slope at the far left”"),
         *(Claim("stiffness w/|V_s/F| at 20 Hz", bound, 2 * pi * 20 / eight[0], 0, "N/m", sign,
                 why="“consistent with 100-250 N/m”") for bound, sign in ((100, ">="), (250, "<="))),
         Claim("|V_p|/|V_t| at 20 Hz, mostly phalanx", 1, phalanx[0] / tissue[0], 0, relation=">="),
         Claim("|V_p|/|V_t| at 400 Hz, mostly skin", 1, phalanx[-1] / tissue[-1], 0, relation="<=",
               why=f"equal at {GRID[np.argmax(tissue > phalanx)]:.0f} Hz"),
         Claim("V_p + V_t against V_s", 0,
               100 * float(np.abs((complex_parts[1] + complex_parts[2]) / complex_parts[0] - 1).max()), 0.05, "%"),
         Claim(f"|V_s/F| at {FREQUENCIES[worst]:.0f} Hz by the force balance",
               float(_balance(LIGHT, FREQUENCIES[worst])), float(eight[worst]), 0.0005, "m/(N s)",
               check=float(np.abs(_printed_admittances(LIGHT, FREQUENCIES[worst])[0])),
               why=f"printed b_p x_s' instead of b_p x_p', {100 * off[worst]:+.0f} %; check: the paper's own V_s/F")),
        (Panel("Light touch, 4th order", FREQUENCY, unit,
               (Curve("V_s: skin", GRID, skin), Curve("V_p: phalanx", GRID, phalanx, ":"),
                Curve("V_t: skin against phalanx", GRID, tissue, ":"),
                Curve("paper: equal intensity, 0.64", [20, 400], [MATCH, MATCH], "printed")), "x", (0, 1.25)),
         Panel("The force balance of the phalanx", FREQUENCY, unit,
               (Curve("V_s/F, with b_p x_p'", GRID, skin), Curve("V_s/F at the eight frequencies", FREQUENCIES, eight,
                "o"), Curve("as printed, with b_p x_s'", GRID, _balance(LIGHT, GRID), "printed")), "x", (0, 1.25))),
        "Light touch. The grey curve of Fig. 10 A needs the participants; its mean is the line at 0.64.",
    )  # fmt: skip
