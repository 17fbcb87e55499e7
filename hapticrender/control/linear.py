"""Linear models of the closed loop at sample rate: a structure, the error observer with its law, and their poles.

The error observer's bands turn with their carriers, E[n+1] = E[n] + g e[n] e^(-j phi[n]), yet their output,
Re(E e^(j phi)), is that of a linear time-invariant resonator driven by the residual e.  With eps = E e^(j phi),
nu = v e^(j phi), a = e^(j w T) and T the sampling period, a carrier is (docs/theory.md, "Error observer" and "Law")::

    eps' = eps + g e,    nu' = nu - T ki eps'                             (observer, integral)
    F = Re sum_k rho (D nu' - ki D' eps') - inner sum_i c_i dev[n - i]    (law, damper)
    e = y - dc - Re sum_k eps,    dev = y - Re sum_k nu,    next eps = a eps',  next nu = a nu'

with rho = e^(j w lead)/sinc(w T/2).  `ErrorLoop` builds these matrices once for each carrier; its frequency response
and its closed-loop matrix both follow from them, so that all bands, their images, the DC estimate, all coordinates,
the delay and the hold are inside and no envelope is averaged.  Assumed: carriers of fixed frequency (for a moving
finger: its speed frozen), a frozen finger estimate, drive inside its limits, no rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.control.margins import NARROWEST, SLOWEST, Margins, carrier_grid, margins_of, unstable_poles
from hapticrender.mathx import zoh
from hapticrender.protocols import Array

FORGET = 50.0  # 1/s: decay of the states of a carrier that is faded out
LEAST_POLE = 1e-300  # stands for a pole at z = 0, whose logarithm is not finite
OBSERVED, COMMANDED, ENVELOPE, RATE = range(4)  # outputs of a carrier: Re eps and Re nu are summed; nu' and its slope


@dataclass(frozen=True, kw_only=True, eq=False)
class Structure:
    """Linear mechanics behind the loop: M x'' + C x' + K x = B f, measured as q = C_out x.

    Parameters
    ----------
    mass, damping, stiffness : ndarray, shape (n, n), kg, N s/m, N/m
        Of the device's coordinates and of whatever else moves (a finger's phalanx, glass that bends); mass regular.
    input : ndarray, shape (n, c)
        Where the forces of the c controlled coordinates act.
    output : ndarray, shape (c, n)
        What the sensors show as the controlled coordinates.
    """

    mass: Array
    damping: Array
    stiffness: Array
    input: Array
    output: Array

    @classmethod
    def free(cls, mass: Array, damping: Array, stiffness: Array) -> Structure:
        """Return a device without anything else on it."""
        same = np.eye(len(mass))
        return cls(mass=mass, damping=damping, stiffness=stiffness, input=same, output=same)

    @classmethod
    def of(cls, model: DeviceModel) -> Structure:
        """Return the free device that a controller is designed for."""
        return cls.free(model.mass, model.damping, model.stiffness)

    def stronger(self, gain: float) -> Structure:
        """Return the same structure with `gain` times the force."""
        return replace(self, input=gain * self.input)

    def sampled(self, rate: float) -> Sampled:
        """Discretise exactly with the force held over each sample at `rate` (Hz)."""
        n, c = self.input.shape
        inverse = np.linalg.inv(self.mass)
        a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ self.stiffness, -inverse @ self.damping]])
        ad, bd = zoh(a, np.vstack([np.zeros((n, c)), inverse @ self.input]), 1.0 / rate)
        return Sampled(rate=rate, a=ad, b=bd, c=np.pad(self.output, ((0, 0), (0, n))))


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """A structure at sample rate: x[n+1] = a x[n] + b f[n], q[n] = c x[n]."""

    rate: float
    a: Array
    b: Array
    c: Array

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


class StateSpace(NamedTuple):
    """Matrices of x[n+1] = a x[n] + b u[n], y[n] = c x[n] + d u[n]; a stack of them along leading axes."""

    a: Array
    b: Array
    c: Array
    d: Array


def delayed(plant: StateSpace, delay: int) -> StateSpace:
    """Put `delay` >= 1 samples before the input of a plant without feedthrough; its outputs stay."""
    n, m = plant.b.shape[-2:]
    states = n + delay * m
    shape = plant.a.shape[:-2]
    a, b = np.zeros((*shape, states, states), plant.a.dtype), np.zeros((*shape, states, m), plant.a.dtype)
    a[..., :n, :n], a[..., :n, -m:] = plant.a, plant.b
    a[..., n + m :, n:-m] = np.eye((delay - 1) * m)
    b[..., n : n + m, :] = np.eye(m)
    c = np.concatenate([plant.c, np.zeros((*plant.c.shape[:-1], delay * m))], axis=-1)
    return StateSpace(a, b, c, plant.d)


def closed_loop(plant: StateSpace, controller: StateSpace) -> Array:
    """State matrix of a plant (without feedthrough) whose input is the controller's output, shape (..., s, s)."""
    return np.concatenate(
        [
            np.concatenate([plant.a + plant.b @ controller.d @ plant.c, plant.b @ controller.c], axis=-1),
            np.concatenate([controller.b @ plant.c, controller.a], axis=-1),
        ],
        axis=-2,
    )


def continuous_poles(matrix: Array, rate: float) -> Array:
    """Poles (1/s, complex: growth and angular frequency) of a sampled state matrix, shape (..., s)."""
    z = np.linalg.eigvals(matrix).astype(complex)
    return rate * np.log(np.where(z == 0, LEAST_POLE, z))


class FingerEstimate(NamedTuple):
    """The finger as the law has it: kg, N s/m, N/m, numbers or arrays (B, 1, 1, 1), and its lever arm p/a."""

    mass: Any
    damping: Any
    stiffness: Any
    lever: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorLoop:
    """Linear loop of the error observer and its law, or of a stack of B of them with K bands each, on one structure.

    Parameters
    ----------
    plant : Sampled
        Structure in the device's c coordinates first.
    delay : int
        Samples from a sensed sample to its force taking effect, >= 1.
    frequency : ndarray, shape (B, K), Hz
    observer : ndarray, shape (B,)
        Gain g of the observer, per sample.
    integral : ndarray, shape (B,), 1/s
    dc, dc_drift : ndarray, shape (B,)
        Gains of the DC estimate, per sample.
    inner : ndarray, shape (B,)
        Factor on the inner damper, 0..1.
    taps : ndarray, shape (c, t), N/m
        Of the inner damper.
    law, slope : ndarray of complex, shape (B, K, c, c), N/m, N s/m
        rho D and rho D' of every band as the law has them.
    share : ndarray, shape (B, K)
        Factor on the observer's gain of each band, less than 1 where it fades out.
    forget : float, 1/s
        Decay of the states of a band whose share is 0.
    """

    plant: Sampled
    delay: int
    frequency: Array
    observer: Array
    integral: Array
    dc: Array
    dc_drift: Array
    inner: Array
    taps: Array
    law: Array
    slope: Array
    share: Array
    forget: float = FORGET

    @classmethod
    def on(
        cls,
        plant: Sampled,
        known: Structure,
        frequency: Array,
        *,
        lead: float,
        finger: FingerEstimate | None = None,
        share: Array | float = 1.0,
        **gains: Any,
    ) -> ErrorLoop:
        """Loop whose law inverts the free device `known` and `finger`; `lead` in s, the other gains by their names."""
        frequency = np.asarray(frequency, float)
        jw = 2j * np.pi * frequency[..., None, None]
        law = known.mass * jw**2 + known.damping * jw + known.stiffness
        slope = known.damping + 2 * jw * known.mass
        if finger is not None:
            arms = np.array([1.0, finger.lever])[: len(known.mass)]
            touched = np.outer(arms, arms)
            law = law + (finger.mass * jw**2 + finger.damping * jw + finger.stiffness) * touched
            slope = slope + (finger.damping + 2 * jw * finger.mass) * touched
        rho = np.exp(jw * lead) / np.sinc(frequency / plant.rate)[..., None, None]
        for name in ("observer", "integral", "dc", "dc_drift", "inner"):
            gains[name] = gains[name] * np.ones(len(frequency))
        return cls(
            plant=plant,
            frequency=frequency,
            law=rho * law,
            slope=rho * slope,
            share=share * np.ones_like(frequency),
            **gains,
        )

    @property
    def period(self) -> float:
        """Sampling period (s)."""
        return 1.0 / self.plant.rate

    @cached_property
    def carriers(self) -> StateSpace:
        """Complex matrices of every carrier from the residual: states eps and nu, outputs as listed above.

        Shapes (B, K, 2, 2), (B, K, 2), (B, K, 4, 2) and (B, K, 4).
        """
        period, ki = self.period, np.broadcast_to(self.integral[:, None], self.share.shape)
        g, fading = self.observer[:, None] * self.share, self.forget * (1.0 - self.share)
        kept, zero, one = 1.0 - period * fading, np.zeros_like(g), np.ones_like(g)
        updated = _stacked([kept, zero], [-period * ki * kept, kept])  # eps' and nu' of eps and nu
        fed = np.stack([g, -period * ki * g], axis=-1)  # and of the residual
        turn = np.exp(2j * np.pi * self.frequency * period)
        outputs = _stacked([one, zero], [zero, one], [updated[..., 1, 0], kept], [-ki * kept, -fading])
        through = np.stack([zero, zero, fed[..., 1], -ki * g], axis=-1)
        return StateSpace(turn[..., None, None] * updated, turn[..., None] * fed, outputs, through)

    @cached_property
    def dc_estimate(self) -> StateSpace:
        """Matrices of the DC estimate (type 2) from the residual: states drift and level; shapes as of one carrier."""
        a = np.broadcast_to([[1.0, 0.0], [1.0, 1.0]], (len(self.dc), 2, 2))
        return StateSpace(a, np.stack([self.dc_drift, self.dc], axis=-1), np.array([[0.0, 1.0]]), np.zeros(1))

    def controller(self, z: Array) -> tuple[Array, Array]:
        """Force per deviation, F = -K y (N/m, shape (B, N, c, c)), and the observer's return difference y/e (B, N).

        `z` is complex, shape (B, N) or (N,).
        """
        z = np.broadcast_to(z, (len(self.frequency), np.shape(z)[-1]))
        dc = self.dc_estimate
        level = _outputs(StateSpace(dc.a[:, None], dc.b[:, None], dc.c, dc.d), z)[..., 0]
        sums, force = np.zeros((*z.shape, 2), complex), np.zeros((*z.shape, *self.law.shape[-2:]), complex)
        for image, law, slope in ((False, self.law, self.slope), (True, self.law.conj(), self.slope.conj())):
            a, b, c, d = (each[:, None] for each in self.carriers)
            found = _outputs(StateSpace(a.conj(), b.conj(), c, d) if image else StateSpace(a, b, c, d), z[..., None])
            sums += 0.5 * found[..., :2].sum(axis=2)
            force += 0.5 * np.einsum("bnk,bkij->bnij", found[..., ENVELOPE], law)
            force += 0.5 * np.einsum("bnk,bkij->bnij", found[..., RATE], slope)
        rest = 1.0 + level + sums[..., OBSERVED]
        order = np.arange(self.taps.shape[1])
        taps = self.inner[:, None, None] * (z[:, :, None, None] ** -order * self.taps).sum(axis=-1)
        damping = taps * ((rest - sums[..., COMMANDED]) / rest)[:, :, None]
        return damping[..., None] * np.eye(force.shape[-1]) - force / rest[..., None, None], rest

    def state_space(self) -> StateSpace:
        """Real matrices of the whole controller from the coordinates to their forces, carriers taken out.

        States of a coordinate: of each carrier Re eps, Re nu, Im eps, Im nu; the DC estimate's two; past deviations.
        """
        a, b, c, d = self.carriers
        count, bands = self.frequency.shape
        size, taps = self.taps.shape
        past = taps - 1 if self.inner.any() else 0
        n = 4 * bands + 2 + past
        matrix, residual, deviation = np.zeros((count, n, n)), np.zeros((count, n)), np.zeros(n)
        observed, commanded = np.zeros((count, n)), np.zeros((count, n))
        real = np.concatenate([np.concatenate([a.real, -a.imag], -1), np.concatenate([a.imag, a.real], -1)], -2)
        for k in range(bands):
            matrix[:, 4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = real[:, k]
        residual[:, : 4 * bands] = np.concatenate([b.real, b.imag], -1).reshape(count, -1)
        observed[:, : 4 * bands] = _real_part(c[:, :, OBSERVED]).reshape(count, -1)
        commanded[:, : 4 * bands] = _real_part(c[:, :, COMMANDED]).reshape(count, -1)
        dc = slice(4 * bands, 4 * bands + 2)
        matrix[:, dc, dc], residual[:, dc], observed[:, dc] = *self.dc_estimate[:2], self.dc_estimate.c[0]
        if past:
            deviation[4 * bands + 2] = 1.0
            matrix[:, 4 * bands + 3 :, 4 * bands + 2 : -1] = np.eye(past - 1)
        matrix = matrix - residual[:, :, None] * observed[:, None] - deviation[:, None] * commanded[:, None]
        rows = self.law[..., None] * c[:, :, None, None, ENVELOPE] + self.slope[..., None] * c[:, :, None, None, RATE]
        through = (self.law * d[..., ENVELOPE, None, None] + self.slope * d[..., RATE, None, None]).real.sum(axis=1)
        rows = _real_part(rows).transpose(0, 2, 3, 1, 4).reshape(count, size, size, -1)
        force = (
            np.pad(rows, ((0, 0), (0, 0), (0, 0), (0, n - 4 * bands))) - through[..., None] * observed[:, None, None]
        )
        damper = self.inner[:, None, None] * self.taps
        for i in range(size):
            force[:, i, i] += damper[:, i, :1] * commanded
            force[:, i, i, n - past :] -= damper[:, i, 1 : past + 1]
            through[:, i, i] -= damper[:, i, 0]
        same = np.eye(size)
        return StateSpace(
            np.kron(same, matrix),
            np.kron(same, (residual + deviation)[:, :, None]),
            force.reshape(count, size, -1),
            through,
        )

    def loop(self, z: Array) -> Array:
        """L = G z^-delay K, broken at the coordinates, shape (B, N, c, c); S = (I + L)^-1."""
        return self.plant.response(z) @ self.controller(z)[0] * np.asarray(z)[..., None, None] ** -self.delay

    def difference(self, z: Array) -> Array:
        """Closed-loop over open-loop characteristic polynomial, shape (B, N); 1 at infinity."""
        gain, rest = self.controller(z)
        loop = self.plant.response(z) @ gain * np.asarray(z)[..., None, None] ** -self.delay
        size = loop.shape[-1]
        return rest**size * np.linalg.det(np.eye(size) + loop)

    def matrix(self) -> Array:
        """State matrix of the closed loop at sample rate, real, shape (B, s, s)."""
        plant = delayed(StateSpace(self.plant.a, self.plant.b, self.plant.c, np.zeros(0)), self.delay)
        stack = (len(self.frequency),)
        return closed_loop(StateSpace(*(np.broadcast_to(m, stack + m.shape) for m in plant)), self.state_space())

    def poles(self) -> Array:
        """Closed-loop poles (1/s, complex, shape (B, s)): growth and angular frequency."""
        return continuous_poles(self.matrix(), self.plant.rate)

    def growth(self) -> Array:
        """Growth of the slowest-decaying pole (1/s, shape (B,)), < 0 for a stable loop."""
        return self.poles().real.max(axis=-1)

    def margins(self) -> Margins:
        """Margins of a single loop (B = 1), of all its bands and coordinates together."""
        rate, carriers = self.plant.rate, self.frequency[0]
        rates = np.array([self.observer[0] * rate / 2, self.integral[0]]) / (2 * np.pi)
        widths = np.unique(rates[rates > 1e-3]) * np.array([[0.5], [1.0], [2.0]])
        grid = carrier_grid(np.concatenate([carriers, self.plant.modes(), [0.0]]), widths.ravel(), rate)
        close = np.append(carriers, 0.0)[:, None] + np.linspace(-NARROWEST, NARROWEST, 9)
        contour = np.unique(np.concatenate([grid, close.ravel(), [0.0, rate / 2]]))
        contour = contour[(contour >= 0.0) & (contour <= rate / 2)]
        outside = math.exp(SLOWEST / rate)
        if unstable_poles(lambda f: self.difference(outside * np.exp(2j * np.pi * f / rate))[0], contour):
            return Margins.unstable()
        return margins_of(lambda f: self.loop(np.exp(2j * np.pi * f / rate))[0], grid, carriers)


def _stacked(*rows: list[Array]) -> Array:
    """Matrices (..., r, 2) from r rows of two arrays each."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _real_part(row: Array) -> Array:
    """Row that takes the real part of `row` (..., 2) times a complex state out of its real and imaginary parts."""
    return np.concatenate([row.real, -row.imag], axis=-1)


def _outputs(system: StateSpace, z: Array) -> Array:
    """Response c (z - a)^-1 b + d, shape (..., outputs), of systems with two states, a lower triangular."""
    a, b, c, d = system
    first = b[..., 0] / (z - a[..., 0, 0])
    second = (b[..., 1] + a[..., 1, 0] * first) / (z - a[..., 1, 1])
    return c[..., 0] * first[..., None] + c[..., 1] * second[..., None] + d
