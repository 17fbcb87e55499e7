"""Simulated subjects: a finger of known mechanics touches a plate that is 2 % off its profile, slides and lifts.

And impedances of known truth, made without any recording.
"""

import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
from strangers_plate import StrangersPlate

import hapticrender as hr
from hapticrender.analysis.records import LOADED, Impedance
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, LIGHT_SECOND

FREQUENCIES = np.array([20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0])  # Hz, of the paper
SPEED, LEAST = 10e-3, 6e-6  # m/s and m: amplitude of each band
NAMES = ("mass", "inertia", "stiffness_1", "stiffness_2", "damping_1", "damping_2")
ON, OFF, DURATION = 1.0, 4.0, 5.0  # s
TABLE_1 = (LIGHT, HEAVY, LIGHT_SECOND, HEAVY_SECOND)


@dataclass(frozen=True)
class Subject:
    """A finger: mechanics, load at the touch (N; it grows by a quarter), peak speed (m/s), and a seed of the plate."""

    mechanics: hr.FingerMechanics
    load: float
    speed: float
    seed: int
    frequencies: tuple = tuple(FREQUENCIES)
    off: float = 0.02  # of the plate from its profile

    @property
    def amplitudes(self):
        return np.maximum(SPEED / (2 * np.pi * np.array(self.frequencies)), LEAST)

    @property
    def scene(self):
        pairs = zip(self.frequencies, self.amplitudes.tolist(), strict=True)
        bands = [hr.Grating(frequency=float(f), amplitude=a) for f, a in pairs]
        texture = bands[0] if len(bands) == 1 else sum(bands[1:], bands[0])
        load = ([0.0, ON, OFF], [self.load, self.load, 1.25 * self.load])
        touch = {"normal_load": load, "touches": [(ON, OFF)], "mechanics": self.mechanics, "load_scaling": True}
        stroke = 0.03
        finger = (
            hr.Finger.swiping(frequency=self.speed / (np.pi * stroke), stroke=stroke, **touch)
            if self.speed
            else hr.Finger.still(position=0.005, **touch)
        )
        return hr.Scene(
            texture=texture,
            finger=finger,
            simulation=self.plate,
            duration=DURATION,
            seed=self.seed,
            keep_unfelt=True,
            name=f"subject-{self.seed}",
        )

    @property
    def plate(self):
        """Parameters of the true plate."""
        off = np.random.default_rng(self.seed).standard_normal(len(NAMES))
        return dict(zip(NAMES, (PLATE * (1 + self.off * off)).tolist(), strict=True))

    def record(self, **rendering):
        """Render the subject in closed loop; the controller may say that the plate is not its model's."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hr.PlateMismatch)
            return hr.render(rendering.pop("scene", self.scene), **rendering)

    def record_elsewhere(self, bending=None, block=1):
        """Render on a third party's plate, whose finger keeps the mechanics that it has at the touch.

        `bending` is that of `StrangersPlate`; contact is reported 5 ms late.
        """
        scene, size = replace(self.scene, simulation={}), self.mechanics.load_factor(self.load)
        names = ("mass", "damping", "stiffness", "phalanx_mass", "phalanx_damping", "phalanx_stiffness")
        plate = StrangersPlate(
            finger=[size * getattr(self.mechanics, name) for name in names[: 3 * self.mechanics.order // 2]],
            position=lambda time: scene.finger.position(np.clip(time, ON, OFF - 1e-6)),
            load=lambda time: np.interp(time, [ON, OFF], [self.load, 1.25 * self.load]),
            contact=lambda time: 1.0 * ((time >= ON) & (time < OFF)),
            bending=bending, block=block, drive_bits=12, report_lag=5e-3, seed=self.seed, **self.plate,
        )  # fmt: skip
        return self.record(scene=scene, driver=plate)

    def impedance(self, frequency, load):
        """True impedance (N s/m) at frequencies (n, bands) under loads (n,)."""
        return self.mechanics.impedance(frequency) * self.mechanics.load_factor(load)[:, None]

    def errors(self, recording, found, grows=True):
        """Errors of what is found in a recording, 10 Hz having settled 0.1 s from the edges of the touch.

        `grows` says whether the finger's impedance grew with the load.
        """
        at = np.flatnonzero((found.time > ON + 0.1) & (found.time < OFF - 0.1))
        place, load = recording.position[at], recording.normal_load[at]
        middle, touches, z = (np.abs(place) <= 15e-3) & (load > 0.15), found.of_kind(LOADED), found.impedance
        truth = self.impedance(z.frequency, z.normal_load if grows else np.full(len(z.time), self.load))
        speed = (np.gradient(recording.position[: len(found.time)]) * recording.rate)[at]
        return SimpleNamespace(
            touches=len(touches),
            edge=max(abs(touches[0].start - ON), abs(touches[-1].stop - OFF)) if touches else np.inf,  # s
            load=np.abs(found.normal_load.value[at] - load) / np.maximum(0.05 * load, 0.02),  # of its bound
            position=np.abs(found.position.value[at] - place)[middle],  # m, where it is bounded
            velocity=found.velocity.value[at] - speed,  # m/s
            impedance=(z.value - truth) / z.standard_error,  # in standard errors
            relative=z.standard_error / np.abs(truth),
            ratio=z.value / truth,
        )


PLATE = np.array([32e-3, 4e-5, 22.4e3, 22.9e3, 0.85, 0.85])  # the default profile's


def random_mechanics(rng):
    """A finger of 2nd or 4th order, within a factor of about 2 of Table 1."""
    m, b, k = rng.uniform(2e-3, 6e-3), rng.uniform(0.7, 2.0), rng.uniform(150.0, 400.0)
    if rng.random() < 0.3:
        return hr.FingerMechanics(order=2, mass=m, damping=b, stiffness=k, reference_load=0.5)
    hard = rng.uniform(1.0, 8.0)
    return hr.FingerMechanics(
        order=4, mass=rng.uniform(1e-4, 4e-4), damping=1.5 * hard**0.8, stiffness=1e3 * hard,
        phalanx_mass=m, phalanx_damping=b, phalanx_stiffness=k, reference_load=0.5,
    )  # fmt: skip


def population(count, seed=1):
    """Subjects over loads of 0.1 to 1.2 N and speeds of 0 to 150 mm/s: Table 1, then random fingers."""
    rng = np.random.default_rng(seed)
    loads = np.geomspace(0.1, 1.2, count)[rng.permutation(count)]
    speeds = np.linspace(0.0, 0.15, count)[rng.permutation(count)]
    mechanics = [TABLE_1[i] if i < 4 else random_mechanics(rng) for i in range(count)]
    seeds = range(seed, seed + count)
    each = zip(mechanics, loads.tolist(), speeds.tolist(), seeds, strict=True)
    return [Subject(*values) for values in each]


def make_impedance(rng, finger, windows, loads, *, noise=0.05, exponent=1 / 3, masked=0.0, frequency=FREQUENCIES):
    """Windows under loads (N) spread evenly over their logarithm; errors of `noise`/2 to 2 `noise` of |Z|."""
    load = np.exp(rng.uniform(*np.log(loads), windows))
    growth = np.exp(exponent * np.log(load / finger.reference_load))
    truth = finger.impedance(frequency) * growth[:, None]
    error = noise * np.abs(truth) * 2 ** rng.uniform(-1, 1, truth.shape)
    value = truth + error * (rng.standard_normal(truth.shape) + 1j * rng.standard_normal(truth.shape))
    hidden = rng.random(truth.shape) < masked
    value[hidden], error[hidden] = np.nan, np.nan
    return Impedance(0.2 * np.arange(windows), np.broadcast_to(frequency, truth.shape), value, error, load, 0 * load)
