"""What must not change: scenes in plain tables, independent of how the library reads them.

A case is data only.  `goldens.play` turns it into signals with today's library, `goldens.figures` judges the signals
without the library, and `goldens.record` stores both.  All units are SI.

Tables
------
texture
    ``kind = "grating"``: keys of a grating (frequency or wavelength, amplitude or velocity, partials).
    ``kind = "waveform"``: a sum of ``components`` (frequency Hz, amplitude m, phase rad, swell Hz, depth), each
    ``amplitude (1 + depth cos(2 pi swell t)) cos(2 pi frequency t + phase)``; the controller has to analyse it.
finger
    ``motion = "none" | "still" (at) | "sliding" (speed, span) | "swiping" (frequency, speed)`` or
    ``"sweep"`` (at, wavelength, start, rise, slope): a carrier of that wavelength has `start` Hz until `rise` (s), then
    gains `slope` Hz/s.  Further: normal_load (N, or times and loads), touches (on, off), mechanics.
simulated, believed
    Parameters of the simulated device, and of the one that the controller is designed for, that are not defaults;
    without ``believed`` the controller is designed for what is simulated.
fault
    ``kind = "nan" | "frozen"``, channel, start, stop (s).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Table = Mapping[str, Any]
DEFAULT_METHOD = "h2"


@dataclass(frozen=True, kw_only=True)
class Case:
    """One scene, by one method, on one simulated device; the tables are those above."""

    name: str
    device: str = "vt-plate"  # kind
    method: str = DEFAULT_METHOD
    texture: Table
    finger: Table = field(default_factory=lambda: {"motion": "none"})
    simulated: Table = field(default_factory=dict)
    believed: Table | None = None
    fault: Table | None = None
    duration: float = 1.0
    settle: float = 0.3  # s: figures are taken from here on
    window: float = 0.02  # s: length of the consecutive windows in which envelopes are fitted
    block: int = 1  # samples that the device takes and gives at a time
    seed: int = 0  # of the sensor noise


def tone(frequency: float, amplitude: float) -> Table:
    """One fixed carrier (Hz) of one amplitude (m)."""
    return {"kind": "grating", "frequency": frequency, "amplitude": amplitude}


def partials(lowest: float, orders: tuple[float, ...], **stated: float) -> Table:
    """Carriers at multiples of `lowest` (Hz), 1 rad apart; equal in velocity where `stated` says ``velocity``."""
    falls = "velocity" in stated
    rows = tuple((order, 1 / order if falls else 1.0, 1.0 * n) for n, order in enumerate(orders))
    return {"kind": "grating", "frequency": lowest, "partials": rows, **stated}


IDEAL = {"sensor_bits": 0, "current_bits": 0}  # where drive is rounded, the last bit of a sum decides a step of drive
HEAVY = {"normal_load": 0.8, "mechanics": "heavy"}
LIGHT = {"normal_load": 0.3, "mechanics": "light"}
SLIDING = {"motion": "sliding", "speed": 0.1, "span": 0.05, "touches": ((0.2, 10.0),), **HEAVY}
PRESSING = {  # full load 1 ms after 0.4 s, gone within a sample at 0.8 s
    "motion": "still",
    "at": 15e-3,
    "normal_load": ((0.0, 0.4, 0.401), (1e-4, 1e-4, 0.8)),
    "touches": ((0.4, 0.8),),
    "mechanics": "heavy",
}
SWIPING = {"motion": "swiping", "frequency": 3.0, "speed": 0.05, "normal_load": 0.4, "mechanics": "light"}
STROKING = {"motion": "sliding", "speed": 0.08, "span": 0.03, "normal_load": 0.4, "mechanics": "light"}
COMB = {
    "kind": "grating",
    "frequency": 20.0,
    "amplitude": 10e-6,
    "partials": tuple((float(n), 1.0, 2.4 * n * n) for n in range(1, 21)),  # phases that keep the peak low
}
WRONG = {  # the plate that is simulated where the default one is believed
    "stiffness_1": 1.05 * 22.4e3,
    "stiffness_2": 1.05 * 22.9e3,
    "mass": 0.95 * 32e-3,
    "inertia": 0.95 * 4e-5,
    "damping_1": 0.8 * 0.85,
    "damping_2": 0.8 * 0.85,
    "sensor_gain_1": 1.02,
    "sensor_gain_2": 0.98,
    "delay": 2,
}
RECORDED = {
    "kind": "waveform",
    "components": ((43.0, 4e-6, 0.3, 0.7, 0.5), (151.0, 5e-6, 1.9, 1.3, 0.5), (322.0, 3e-6, 4.0, 2.1, 0.5)),
}
MODULATED = {"kind": "waveform", "components": ((111.0, 50e-6, 0.0, 5.0, 0.3),)}
SWEEP = {"motion": "sweep", "at": 10e-3, "wavelength": 1e-6, "start": 30.0, "rise": 0.3, "slope": 800.0, **HEAVY}
SPATIAL = {"kind": "grating", "wavelength": 0.5e-3, "velocity": 10e-3, "speed": 0.08}

PLATE = (
    Case(name="plate-free", texture=tone(189.0, 50e-6), simulated=IDEAL, duration=0.6),
    Case(name="plate-touch-lift", texture=tone(143.0, 50e-6), finger=PRESSING, simulated=IDEAL, duration=1.2),
    Case(name="plate-slide", texture=tone(178.0, 50e-6), finger=SLIDING, simulated=IDEAL, duration=1.4, settle=0.1),
    Case(name="plate-reversal", texture={"kind": "grating", "wavelength": 0.5e-3, "amplitude": 10e-6}, finger=SWIPING,
         simulated=IDEAL, duration=1.2),
    Case(name="plate-sweep", texture={"kind": "grating", "wavelength": 1e-6, "amplitude": 50e-6}, finger=SWEEP,
         simulated=IDEAL, duration=0.75),
    Case(name="plate-comb", texture=COMB, finger=SLIDING, duration=1.5, settle=0.7, window=0.1),
    Case(name="plate-press", texture=tone(60.0, 5e-6),
         finger={**HEAVY, "motion": "still", "at": -1e-2, "normal_load": ((0.0, 0.5, 0.501), (0.1, 0.1, 0.6))},
         simulated=IDEAL, window=0.04),
    Case(name="plate-saturation", texture=tone(250.0, 100e-6), finger=PRESSING,
         simulated={**IDEAL, "current_limit": 0.36}, duration=1.2),
    Case(name="plate-nan-sensor", texture=tone(111.0, 50e-6), finger={**SLIDING, **LIGHT}, simulated=IDEAL,
         fault={"kind": "nan", "channel": 0, "start": 0.5, "stop": 0.52}),
    Case(name="plate-frozen-sensor", texture=tone(111.0, 50e-6), simulated=IDEAL,
         fault={"kind": "frozen", "channel": 1, "start": 0.5, "stop": 0.56}),
    Case(name="plate-wrong", texture=tone(170.0, 50e-6), finger=SLIDING, simulated=WRONG, believed={}, duration=1.4,
         settle=0.1),
    Case(name="plate-block-25", texture=tone(143.0, 50e-6), finger=SLIDING, simulated={**IDEAL, "delay": 25},
         block=25, duration=1.4, settle=0.1),
    Case(name="plate-block-64", texture=tone(178.0, 50e-6), finger=PRESSING,
         simulated={**IDEAL, "rate": 48e3, "delay": 64}, block=64, duration=1.2),
    Case(name="plate-waveform", texture=RECORDED, finger=SLIDING, simulated=IDEAL, duration=1.4, window=0.05),
    Case(name="plate-modulated", texture=MODULATED, simulated=IDEAL),
    Case(name="plate-one-coil", texture=tone(111.0, 50e-6),
         finger={**LIGHT, "motion": "still", "touches": ((0.4, 0.8),)}, simulated={**IDEAL, "coils": 1}),
)  # fmt: skip
OTHER_DEVICES = (
    Case(name="electroadhesion-slide", device="electroadhesion",
         texture=partials(50.0, (1.0, 2.4, 5.0), velocity=5e-3),
         finger={**STROKING, "touches": ((0.0, 0.6), (0.7, 10.0))},
         simulated={"area_scale": 1.2, "gap_thickness": 1e-6}, window=0.04),
    Case(name="electroadhesion-impedance", device="electroadhesion", texture=SPATIAL, finger=SWIPING,
         simulated={"sensor": "impedance", "level": "carrier"}),
    Case(name="ultrasonic-touch", device="ultrasonic", texture=partials(50.0, (1.0, 2.4, 5.0), velocity=5e-3),
         finger={**STROKING, "touches": ((0.0, 0.4), (0.5, 10.0))},
         simulated={"temperature_rise": 10.0, "temperature_time": 0.5, "sensor_bits": 0, "drive_bits": 0},
         window=0.04),
    Case(name="hybrid-slide", device="hybrid", texture=partials(50.0, (1.0, 2.4, 5.0), velocity=5e-3),
         finger=STROKING, simulated=IDEAL, window=0.04),
)  # fmt: skip
BASELINES = (
    Case(name="paper-free", method="paper", texture=tone(47.0, 50e-6), simulated=IDEAL, duration=1.2, window=0.05,
         settle=0.6),
    Case(name="paper-slide", method="paper", texture=tone(178.0, 50e-6), finger=SLIDING, simulated=IDEAL, duration=1.4,
         settle=0.1),
    Case(name="paper-common-touch-lift", method="paper-common", texture=tone(189.0, 50e-6), finger=PRESSING,
         simulated=IDEAL, duration=1.2),
    Case(name="boxcar-slide", method="boxcar", texture=tone(143.0, 50e-6), finger=SLIDING, simulated=IDEAL,
         duration=1.4, settle=0.1),
    Case(name="resonant-touch-lift", method="resonant", texture=tone(72.0, 50e-6), finger=PRESSING, simulated=IDEAL,
         duration=1.2, window=0.04),
    Case(name="h-touch-lift", method="h", texture=tone(189.0, 50e-6), finger=PRESSING, simulated=IDEAL, duration=1.2),
)  # fmt: skip
CASES = {case.name: case for case in (*PLATE, *OTHER_DEVICES, *BASELINES)}
