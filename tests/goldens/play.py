"""Play a case with the library of today: the only file here that knows it, replaced along with its interface."""

import warnings
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np

import hapticrender as hr
from goldens.cases import Case
from goldens.figures import Played
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.plate import Plate

RANDOM = np.random.default_rng
STEP = 2e-4  # s: of the path of a swept carrier
LEVEL = {"level"}  # of the cases' parameters: those that say how finely a device is modelled


def play(case: Case) -> Played:
    """Render a case and return its signals."""
    believed = case.simulated if case.believed is None else case.believed
    differing = {} if case.believed is None else case.simulated
    scene = hr.Scene(
        texture=_texture(case.texture),
        finger=_finger(case.finger, case.duration),
        device=case.device,
        profile={key: value for key, value in believed.items() if key not in LEVEL},
        simulation={**{key: value for key, value in believed.items() if key in LEVEL}, **differing},
        duration=case.duration,
        keep_unfelt=True,
        method=case.method,
        seed=case.seed,
    )
    as_recorded = patch("numpy.random.default_rng", lambda seed: RANDOM(seed[0] if isinstance(seed, list) else seed))
    with as_recorded, warnings.catch_warnings():  # the seed of the noise was the scene's alone
        warnings.simplefilter("ignore", hr.PlateMismatch)
        rendering = hr.prepare(scene, driver=_driver(case, scene))
        if case.fault is not None:  # of the controller itself, which a supervisor would stop
            supervised = rendering.controller
            rendering = replace(rendering, controller=lambda: supervised().controller)
        recording = hr.run(rendering)
    bands, flags = recording.bands, recording.flags
    return Played(
        rate=recording.rate,
        frequency=bands.frequency,
        wavenumber=bands.wavenumber,
        phase=bands.phase,
        drive=np.array(recording.drive),
        motion=np.array(recording.motion),
        position=np.array(recording.position),
        target=np.array(recording.target),
        flags={str(flag.name).lower(): (flags & flag) != 0 for flag in hr.Flag},
    )


def _driver(case: Case, scene: hr.Scene) -> SimulatedDriver | None:
    """Driver of a device that takes blocks or has a faulty sensor; else None."""
    if case.fault is None and case.block == 1:
        return None
    plant = hr.prepare(scene).plant
    if case.block > 1:
        plant = Plate(plant.parameters, plant.finger, case.seed, case.block)
    return SimulatedDriver(plant) if case.fault is None else FaultySensor(plant, case.fault)


class FaultySensor(SimulatedDriver):
    """Simulated device of which a sensor shows NaN, or stands still, for some time."""

    def __init__(self, plant: hr.Plant, fault: dict) -> None:
        super().__init__(plant)
        self.fault, self.samples, self.last = fault, 0, np.zeros(plant.sensed_channels)

    def _play(self, drive: np.ndarray) -> hr.Sensed:
        sensed = super()._play(drive)
        if self.fault["start"] <= self.samples / self.rate < self.fault["stop"]:
            channel = self.fault["channel"]
            sensed.sensed[:, channel] = np.nan if self.fault["kind"] == "nan" else self.last[channel]
        else:
            self.last = sensed.sensed[-1].copy()
        self.samples += len(drive)
        return sensed


@dataclass(frozen=True)
class Waveform:
    """Sum of components (frequency, amplitude, phase, swell, depth), to be analysed by the controller."""

    components: tuple[tuple[float, ...], ...]

    def bands(self, rate: float) -> hr.Bands:
        frequency = np.array([each[0] for each in self.components])
        return hr.Bands(frequency=frequency, wavenumber=0 * frequency, phase=0 * frequency)

    def waveform(self, time: np.ndarray, position: np.ndarray) -> np.ndarray:
        turn = 2 * np.pi * time
        return sum(a * (1 + d * np.cos(s * turn)) * np.cos(f * turn + p) for f, a, p, s, d in self.components)


def _texture(table: dict) -> hr.Texture:
    kind, rest = table["kind"], {key: value for key, value in table.items() if key != "kind"}
    return Waveform(**rest) if kind == "waveform" else hr.Grating(**rest)


def _finger(table: dict, duration: float) -> hr.Finger:
    touch = {key: table[key] for key in ("normal_load", "touches", "mechanics") if key in table}
    own = {key: value for key, value in table.items() if key not in (*touch, "motion")}
    kinds = {"still": hr.Still, "sliding": hr.TriangleMotion, "swiping": hr.SineMotion}
    if table["motion"] == "none":
        return hr.Finger.absent()
    motion = _sweep(**own, duration=duration) if table["motion"] == "sweep" else kinds[table["motion"]](**own)
    return hr.Finger(motion, **touch)


def _sweep(at: float, wavelength: float, start: float, rise: float, slope: float, duration: float) -> hr.Sampled:
    time = np.arange(0.0, duration + 2 * STEP, STEP)
    turns = start * time + 0.5 * slope * np.maximum(time - rise, 0.0) ** 2
    return hr.Sampled(tuple(at + wavelength * turns), 1 / STEP)
