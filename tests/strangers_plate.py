"""A third party's plate with a finger, behind a driver of its own; of the library it knows `Sensed` alone.

With q = [x_c, theta, e, x_p] (heave m, rocking rad, bending at the sensors m, phalanx m), h = [1, p, phi(p)] at the
finger's position p and s its contact (0: lifted, 1: whole)::

    m x_c'' = sum_i K i - k_i x_i - b_i x_i' - F,   I theta'' likewise with the levers -+ d/2 and p F
    m_b (e'' + 2 zeta w e' + w^2 e) = phi_coil K (i_1 + i_2) - phi(p) F
    F = s (W + m_f y'' + b_f (y' - x_p') + k_f (y - x_p)),   y = h q
    m_p x_p'' = s (b_f (y' - x_p') + k_f (y - x_p)) - b_p x_p' - k_p x_p

phi is the first symmetric shape of a free bar, 1 at its ends; the finger moves slowly (p' is neglected).  Integrated
by Runge and Kutta's rule of fourth order, with contact, load and position linear between two samples.
"""

import sys

import numba
import numpy as np

import hapticrender as hr

sys.modules.setdefault("strangers_plate", sys.modules[__name__])  # kernels cached under this name are found under both

TRUTH = {  # Grigorii et al. 2021; the bending mode is that of `bending`
    "mass": 32e-3,
    "inertia": 4e-5,
    "stiffness_1": 22.4e3,
    "stiffness_2": 22.9e3,
    "damping_1": 0.85,
    "damping_2": 0.85,
    "gain_1": 1.0,
    "gain_2": 1.0,
    "delay": 1,
}
WRONG = {  # beside the plate that a controller is designed for
    "mass": 0.95 * 32e-3,
    "inertia": 0.95 * 4e-5,
    "stiffness_1": 1.05 * 22.4e3,
    "stiffness_2": 1.05 * 22.9e3,
    "damping_1": 0.8 * 0.85,
    "damping_2": 0.8 * 0.85,
    "gain_1": 1.02,
    "gain_2": 0.98,
    "delay": 2,
}
FORCE_CONSTANT, ARM, REACH, MODAL_MASS = 7.4, 27.5e-3, 55e-3, 9.5e-3  # N/A, m, m, kg
DRAWN = 1000  # blocks of noise at once
BAR = 2.365020372431352  # half the first root of cos(x) cosh(x) = 1


@numba.njit(cache=True)
def bar(x):
    """Shape of the bending mode at x (m from the middle)."""
    b = BAR / REACH
    return 0.5 * (np.cosh(b * x) / np.cosh(BAR) + np.cos(b * x) / np.cos(BAR))


@numba.njit(cache=True)
def slope(z, i1, i2, p, w, s, plate, finger, out):
    """Derivative of z = [q, q'] into `out`; p, w, s: position, load, contact."""
    m, inertia, k1, k2, b1, b2, omega, zeta, coil = plate
    mf, bf, kf, mp, bp, kp = finger
    h2 = bar(p) if omega > 0.0 else 0.0
    f1 = FORCE_CONSTANT * i1 - k1 * (z[0] - ARM * z[1]) - b1 * (z[4] - ARM * z[5])
    f2 = FORCE_CONSTANT * i2 - k2 * (z[0] + ARM * z[1]) - b2 * (z[4] + ARM * z[5])
    fe = coil * FORCE_CONSTANT * (i1 + i2) - MODAL_MASS * (omega * omega * z[2] + 2 * zeta * omega * z[6])
    tissue = s * (bf * (z[4] + p * z[5] + h2 * z[6] - z[7]) + kf * (z[0] + p * z[1] + h2 * z[2] - z[3]))
    v0, v1, v2 = (f1 + f2) / m, ARM * (f2 - f1) / inertia, fe / MODAL_MASS  # accelerations without the finger
    mobility = 1 / m + p * p / inertia + h2 * h2 / MODAL_MASS
    force = (s * w + tissue + s * mf * (v0 + p * v1 + h2 * v2)) / (1 + s * mf * mobility)
    out[:4] = z[4:]
    out[4], out[5], out[6] = v0 - force / m, v1 - p * force / inertia, v2 - h2 * force / MODAL_MASS
    out[7] = (tissue - bp * z[7] - kp * z[3]) / mp if mp > 0.0 else 0.0


@numba.njit(cache=True)
def advance(z, drive, touch, plate, finger, step, substeps, truth):
    """Write the displacement under the finger, at both ends and in the middle (n, 4), and advance z over the block.

    `touch` (n + 1, 3) holds position, load and contact at the samples.
    """
    k, w, at = np.empty((4, 8)), np.empty(8), np.empty(3)
    for n in range(len(drive)):
        p = touch[n, 0]
        truth[n] = z[0] + p * z[1] + bar(p) * z[2], z[0] - REACH * z[1] + z[2], z[0] + REACH * z[1] + z[2], 0.0
        truth[n, 3] = z[0] + bar(0.0) * z[2]
        for j in range(substeps):
            for i in range(4):
                for m in range(8):  # loops: an expression of arrays takes new memory for each of its parts
                    w[m] = z[m] + (step if i == 3 else step / 2) * k[i - 1, m] if i else z[m]
                for m in range(3):
                    at[m] = touch[n, m] + (touch[n + 1, m] - touch[n, m]) * ((j + (0.0, 0.5, 0.5, 1.0)[i]) / substeps)
                slope(w, drive[n, 0], drive[n, 1], at[0], at[1], at[2], plate, finger, k[i])
            for m in range(8):
                z[m] += step / 6 * (k[0, m] + 2 * k[1, m] + 2 * k[2, m] + k[3, m])


@numba.njit(cache=True)
def sense(truth, noise, sensors):
    """What is sensed (n, 2) of the `truth`, with `noise`; `sensors`: gains and step (m, 0: ideal), over 2 mm."""
    sensed = np.empty(noise.shape)
    for n in range(len(noise)):
        for i in range(2):
            shown = truth[n, 1 + i] * sensors[i] + noise[n, i]
            if sensors[2] > 0.0:
                shown = min(max(sensors[2] * np.rint(shown / sensors[2]), -1e-3), 1e-3)
            sensed[n, i] = shown
    return sensed


@numba.njit(cache=True)
def report(touch, late):
    """Positions and loads as they are told, (n,) each, of `touch` at n samples and of what was `late` before."""
    position, load = np.full(len(touch), np.nan), np.zeros(len(touch))
    for n in range(len(touch)):
        if late[n, 2] > 0.0:
            position[n], load[n] = touch[n, 0], touch[n, 1]
    return position, load


class StrangersPlate:
    """Two coils, a sensor at each end of the glass, and a finger; open the same object once.

    Parameters
    ----------
    finger : (m, b, k) or (m, b, k, m_p, b_p, k_p), kg, N s/m, N/m
        A whole finger on the glass, or skin on a phalanx.
    position, load, contact : number, array (a value a sample) or callable of time in s; m, N, 0 to 1
        Without a contact there is no finger.
    bending : (frequency, Q, shape at the coils)
    rate, block, told : Hz, samples, samples
        `told` is the delay that the controller is told; the true one is ``delay`` of `TRUTH`, but at least `block`.
    noise, sensor_bits, drive_bits : m rms, over 2 mm, over +-3 A; 0 is ideal
    report_lag : s, by which position and load are reported late when contact begins and ends
    substeps : of the integration, in a sample; more for modes above 1.5 kHz
    truth : changes of `TRUTH`
    """

    drive_channels = sensed_channels = 2
    probe = False  # the clock of its finger starts with the first sample

    def __init__(
        self, *, finger=(0, 0, 0), position=0.0, load=0.0, contact=0.0, bending=None, rate=5000.0, block=1, told=None,
        noise=1e-6, sensor_bits=14, drive_bits=0, report_lag=0.0, substeps=None, seed=0, **truth,
    ):  # fmt: skip
        self.true = {**TRUTH, **truth}
        if unknown := set(truth) - set(TRUTH):
            raise TypeError(f"unknown {unknown}")
        self.rate, self.block = float(rate), block
        late = self.true["delay"] - 1  # beside what the block takes
        self.delay = block if told is None else told
        self.noise, self.sensor_step = noise, 2e-3 / 2**sensor_bits if sensor_bits else 0.0
        self.drive_step = 6.0 / 2**drive_bits if drive_bits else 0.0
        frequency, quality, coil = bending or (0.0, 1.0, 0.0)
        names = ("mass", "inertia", "stiffness_1", "stiffness_2", "damping_1", "damping_2")
        mode = (2 * np.pi * frequency, 0.5 / quality, coil)
        self._plate = tuple(float(each) for each in (*(self.true[name] for name in names), *mode))
        self._finger = tuple(float(each) for each in (*finger, 0, 0, 0)[:6])
        self._touch = [self._course(each) for each in (position, load, contact)]
        self._lag, self._substeps = round(report_lag * rate), substeps or (6 if rate < 20e3 else 2)
        self._queue, self._at, self._courses = np.zeros((late, 2)), 0, np.empty((0, 3))  # courses: from -lag on
        self._rng, self._noise = np.random.default_rng(seed), []
        self._z, self._truth, self._contact = self._equilibrium(), [], []

    @classmethod
    def of(cls, parameters, finger, *, seed=0, block=1, delay=1):
        """Make a plate for a case of the accuracy suite; contact is reported 5 ms late."""
        p, bends = parameters, parameters.bending_frequency > 0.0
        truth = {name: getattr(p, name) for name in TRUTH if not name.startswith("gain")}
        truth |= {"gain_1": p.sensor_gain_1, "gain_2": p.sensor_gain_2, "delay": p.delay - block + 1}
        parts = ("mass", "damping", "stiffness")
        return cls(
            finger=[getattr(finger.mechanics, prefix + part) for prefix in ("", "phalanx_") for part in parts],
            position=lambda time: np.nan_to_num(finger.motion.position(time)),
            load=lambda time: finger.touch(time)[:, 1] / np.maximum(finger.touch(time)[:, 2], 1e-9),
            contact=lambda time: finger.touch(time)[:, 2],
            bending=(p.bending_frequency, 0.5 / p.bending_damping, p.bending_coil) if bends else None,
            substeps=12 if bends and p.rate < 20e3 else None,
            rate=p.rate,
            block=block,
            told=delay,
            report_lag=5e-3,
            seed=seed,
            **truth,
        )

    def _course(self, given):
        """Values at sample numbers."""
        if callable(given):
            return lambda n: np.asarray(given(n / self.rate), float)
        values = np.atleast_1d(np.asarray(given, float))
        return lambda n: values[np.clip(n, 0, len(values) - 1)]

    def _equilibrium(self):
        """State in which nothing moves before the first sample."""
        touch, rest, z = self._touched(0)[self._lag], np.zeros(8), np.zeros(8)
        if not touch[2]:
            return z
        slope(z, 0.0, 0.0, *touch, self._plate, self._finger, rest)
        jacobian = np.zeros((4, 4))
        for i in range(4):
            unit, out = np.zeros(8), np.zeros(8)
            unit[i] = 1.0
            slope(unit, 0.0, 0.0, *touch, self._plate, self._finger, out)
            jacobian[:, i] = out[4:] - rest[4:]
        free = np.flatnonzero(jacobian.any(axis=1))  # without bending or phalanx their rows are zero
        z[free] = np.linalg.solve(jacobian[np.ix_(free, free)], -rest[4 + free])
        return z

    def _touched(self, last):
        """Position, load and contact at the samples from -lag to `last` and beyond."""
        while last + self._lag >= len(self._courses):  # a second and more at a time
            n = len(self._courses) - self._lag + np.arange(round(self.rate) + self.block)
            more = np.stack([np.broadcast_to(each(n), n.shape) for each in self._touch], axis=1)
            self._courses = np.concatenate([self._courses, more])
        return self._courses

    @property
    def truth(self):
        """Displacement (m, (n, 4)) under the finger (where it would touch, while lifted), at both ends, in the middle.

        Of every sample played, as it was when that sample was sensed.
        """
        return np.concatenate(self._truth).reshape(-1, 4)[: self._at]

    @property
    def contact(self):
        """Contact at every sample played, 0 to 1."""
        return np.concatenate(self._contact).ravel()[: self._at]

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def play(self, drive):
        """Hold a block of drive (A), each row over a sample, and return what is sensed as each begins."""
        if np.shape(drive) != (self.block, 2):
            raise ValueError(f"drive of shape {np.shape(drive)}: must be {(self.block, 2)}")
        if self.drive_step:
            drive = np.clip(self.drive_step * np.round(drive / self.drive_step), -3.0, 3.0)
        if len(self._queue):
            drive = np.concatenate([self._queue, drive])
            drive, self._queue = drive[: self.block], drive[self.block :]
        first, self._at = self._at, self._at + self.block
        if not len(self._noise):  # a block at a time takes as long as the plate
            shape = (DRAWN, self.block)
            self._noise = list(self.noise * self._rng.standard_normal((*shape, 2)))[::-1]
            self._truth.append(np.empty((*shape, 4)))
            self._contact.append(np.empty(shape))
        noise = self._noise.pop()
        at, courses = DRAWN - 1 - len(self._noise), self._touched(self._at)
        touch, truth = courses[first + self._lag :], self._truth[-1][at]
        step = 1 / (self.rate * self._substeps)
        advance(self._z, drive, touch, self._plate, self._finger, step, self._substeps, truth)
        self._contact[-1][at] = touch[: self.block, 2]
        sensed = sense(truth, noise, (self.true["gain_1"], self.true["gain_2"], self.sensor_step))
        position, load = report(touch[: self.block], courses[first:])
        return hr.Sensed(sensed, position, normal_load=load)


plate = StrangersPlate.of
