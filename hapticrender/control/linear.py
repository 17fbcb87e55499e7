"""Transfer functions of the closed loop at sample rate: a device, the error observer, and its law.

With eps = E e^(j phi) and nu = v e^(j phi) the turning bands are linear and time-invariant (docs/theory.md, "Error
observer" and "Dynamic-stiffness law").  All bands, their images, the DC estimate, all coordinates, the delay and the
hold are inside; no envelope is averaged.  Assumed: carriers of fixed frequency (for a moving finger: its speed frozen),
a frozen finger estimate, a drive inside its limits, no rounding.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hapticrender.control.margins import NARROWEST, SLOWEST, Margins, carrier_grid, margins_of, unstable_poles
from hapticrender.control.records import LEAK
from hapticrender.mathx import state_space, zoh
from hapticrender.protocols import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class DiscretePlant:
    """A device at sample rate (Hz), its force held over each sample: x[n+1] = a x[n] + b f[n], q[n] = c x[n]."""

    rate: float
    a: Array
    b: Array
    c: Array

    @classmethod
    def free(cls, mass: Array, damping: Array, stiffness: Array, rate: float) -> "DiscretePlant":
        """Discretise M q'' + C q' + K q = f (kg, N s/m, N/m) exactly."""
        n = len(mass)
        a, b = zoh(*state_space(mass, damping, stiffness, np.eye(n)), 1.0 / rate)
        return cls(rate=rate, a=a, b=b, c=np.eye(n, 2 * n))

    @cached_property
    def _modal(self) -> tuple[Array, Array, Array]:
        poles, shapes = np.linalg.eig(self.a)
        return poles, self.c @ shapes, np.linalg.solve(shapes, self.b.astype(complex))

    def modes(self) -> Array:
        """Frequencies (Hz, > 0) of the oscillating modes."""
        angle = np.angle(self._modal[0])
        return np.unique(angle[angle > 1e-9]) * self.rate / (2 * np.pi)

    def response(self, z: Array) -> Array:
        """Coordinates per force (m/N, shape (..., c, c)) at complex `z`."""
        poles, out, into = self._modal
        return np.einsum("ip,...p,pj->...ij", out, 1.0 / (np.asarray(z)[..., None] - poles), into)


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorLoop:
    """Linear loop of the error observer with K bands and its law on a device of c coordinates."""

    plant: DiscretePlant
    delay: int  # samples from a sensed sample to its force taking effect, >= 1
    frequency: Array  # (K,), Hz
    observer: float  # gain g per sample
    integral: float  # 1/s
    dc: float  # of the DC estimate, per sample, as the next
    dc_drift: float
    inner: float  # factor on the inner damper, 0..1
    taps: Array  # (c, t), N/m, of the inner damper
    law: Array  # complex (K, c, c), N/m: rho D of every band as the law has it
    slope: Array  # complex (K, c, c), N s/m: rho D'
    share: Array  # (K,): factor on the observer's gain of each band, less than 1 where it fades out

    @cached_property
    def recursion(self) -> tuple[Array, Array, Array, Array]:
        """Turn a sample, observer's gain, decay (1/s) and what a sample leaves of the states, each (K,)."""
        fading = LEAK * (1.0 - self.share)
        turn = np.exp(2j * np.pi * self.frequency / self.plant.rate)
        return turn, self.observer * self.share, fading, 1.0 - fading / self.plant.rate

    def controller(self, z: Array) -> tuple[Array, Array]:
        """Force per deviation, F = -K y (N/m, shape (N, c, c)), and the observer's return difference y/e (N,).

        `z` is complex, shape (N,).
        """
        turn, gain, fading, kept = self.recursion

        def sums(z: Array, law: Array, slope: Array) -> tuple[Array, Array, Array]:
            """Sums of eps and nu (N,) and force (N, c, c) per innovation, without the images."""
            back = turn / z[:, None]
            envelope = gain / (1.0 - kept * back)  # eps'
            command = -self.integral / self.plant.rate * envelope / (1.0 - kept * back)  # nu'
            rate = -self.integral * envelope - fading * back * command
            force = np.tensordot(command, law, 1) + np.tensordot(rate, slope, 1)
            return (back * envelope).sum(axis=1), (back * command).sum(axis=1), force

        lines, images = sums(z, self.law, self.slope), sums(z.conj(), self.law, self.slope)
        observed, commanded, force = (0.5 * (line + image.conj()) for line, image in zip(lines, images, strict=True))
        rest = 1.0 + (self.dc + self.dc_drift / (z - 1.0)) / (z - 1.0) + observed
        damping = self.inner * z[:, None] ** -np.arange(self.taps.shape[1]) @ self.taps.T
        damping = damping * ((rest - commanded) / rest)[:, None]
        return damping[..., None] * np.eye(len(self.taps)) - force / rest[:, None, None], rest

    def loop(self, z: Array) -> Array:
        """L = G z^-delay K, broken at the coordinates, shape (N, c, c); S = (I + L)^-1."""
        return self.plant.response(z) @ self.controller(z)[0] * z[:, None, None] ** -self.delay

    def difference(self, z: Array) -> Array:
        """Closed-loop over open-loop characteristic polynomial, shape (N,); 1 at infinity."""
        gain, rest = self.controller(z)
        loop = self.plant.response(z) @ gain * z[:, None, None] ** -self.delay
        return rest ** len(self.taps) * np.linalg.det(np.eye(len(self.taps)) + loop)

    def margins(self) -> Margins:
        """Margins of the loop, of all its bands and coordinates together."""
        rate, carriers = self.plant.rate, self.frequency
        rates = np.array([self.observer * rate / 2, self.integral]) / (2 * np.pi)
        widths = np.unique(rates[rates > 1e-3]) * np.array([[0.5], [1.0], [2.0]])
        grid = carrier_grid(np.concatenate([carriers, self.plant.modes(), [0.0]]), widths.ravel(), rate)
        close = np.append(carriers, 0.0)[:, None] + np.linspace(-NARROWEST, NARROWEST, 9)
        contour = np.unique(np.concatenate([grid, close.ravel(), [0.0, rate / 2]]))
        contour = contour[(contour >= 0.0) & (contour <= rate / 2)]
        outside = math.exp(SLOWEST / rate)

        def by_parts(response: Callable[[Array], Array], radius: float) -> Callable[[Array], Array]:
            """`response` over frequency (Hz), some 1e5 numbers an array: in one, a thousand bands need gigabytes."""
            return lambda f: np.concatenate(
                [
                    response(radius * np.exp(2j * np.pi * part / rate))
                    for part in np.array_split(f, 1 + len(f) * len(carriers) // 100_000)
                ]
            )

        if unstable_poles(by_parts(self.difference, outside), contour):
            return Margins.unstable()
        return margins_of(by_parts(self.loop, 1.0), grid)
