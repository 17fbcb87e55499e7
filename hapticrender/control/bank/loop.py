"""The bank in its loop, exactly: what holds a carrier is linear and time-invariant at sample rate, so margins are too.

A band turns with its carrier, E[n+1] = E[n] + g e[n] e^(-j phi[n]), yet what it hands on, Re(E e^(j phi)), is a plain
resonator driven by the residual: with eps = E e^(j phi), nu = v e^(j phi) and a = e^(j w T),

    eps' = eps + g e,  nu' = nu - T ki eps',  F = Re sum rho (D nu' - ki D' eps') - inner sum_i c_i dev[n-i],
    e = y - level - Re sum eps,  dev = y - Re sum nu,  next eps = a eps', next nu = a nu',

rho = e^(j w lead)/sinc(w T/2).  A carrier that fades out, with the share s of its feedback, has s g for g and forgets
both eps and nu at the rate (1 - s) times `FORGET`.  No envelope is averaged: all bands, their images and the DC band,
all coordinates, the delay and the hold are inside.  Assumed: carriers of fixed frequency (a moving finger: its speed
frozen), the finger's three numbers frozen, drive inside its limits, no rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank.observer import FORGET
from hapticrender.control.margins import (
    Margins,
    borne_errors,
    carrier_grid,
    halved_within,
    highest_peak,
    sensitivity,
    unstable_poles,
)
from hapticrender.protocols import Array

LEAST_POLE = 1e-300  # stands for a pole at z = 0, whose logarithm is not finite


@dataclass(frozen=True, kw_only=True)
class Structure:
    """What stands behind the loop: M x'' + C x' + K x = push f, of which the controller sees q = watch x.

    Parameters
    ----------
    mass, damping, stiffness : ndarray, shape (n, n), kg, N s/m, N/m
        Of the device's coordinates and of whatever else moves (a finger's phalanx, glass that bends); mass regular.
    push : ndarray, shape (n, c)
        Where the forces of the c controlled coordinates act.
    watch : ndarray, shape (c, n)
        What the sensors show as the controlled coordinates.
    """

    mass: Array
    damping: Array
    stiffness: Array
    push: Array
    watch: Array

    @classmethod
    def free(cls, mass: Array, damping: Array, stiffness: Array) -> Structure:
        """Return a device without anything else on it."""
        same = np.eye(len(mass))
        return cls(mass=mass, damping=damping, stiffness=stiffness, push=same, watch=same)

    @classmethod
    def of(cls, model: BandModel) -> Structure:
        """Return the free device that the controller was designed for."""
        return cls.free(model.mass, model.damping, model.stiffness)

    def stronger(self, gain: float) -> Structure:
        """Return the same structure with `gain` times the force."""
        return replace(self, push=gain * self.push)

    def sampled(self, rate: float) -> Sampled:
        """Exact discretisation with the force held over each sample."""
        from scipy.linalg import expm

        n, c = self.push.shape
        inverse = np.linalg.inv(self.mass)
        system = np.zeros((2 * n + c, 2 * n + c))
        system[:n, n : 2 * n] = np.eye(n)
        system[n : 2 * n, :n] = -inverse @ self.stiffness
        system[n : 2 * n, n : 2 * n] = -inverse @ self.damping
        system[n : 2 * n, 2 * n :] = inverse @ self.push
        held = expm(system / rate)[: 2 * n]
        return Sampled(
            rate=rate, advance=held[:, : 2 * n], push=held[:, 2 * n :], watch=np.pad(self.watch, ((0, 0), (0, n)))
        )


@dataclass(frozen=True, kw_only=True)
class Sampled:
    """A structure at sample rate: x[n+1] = advance x[n] + push f[n], q[n] = watch x[n]."""

    rate: float
    advance: Array
    push: Array
    watch: Array

    @cached_property
    def _modal(self) -> tuple[Array, Array, Array]:
        poles, shapes = np.linalg.eig(self.advance)
        return poles, self.watch @ shapes, np.linalg.solve(shapes, self.push.astype(complex))

    def modes(self) -> Array:
        """Frequencies (Hz, > 0) of the oscillating modes."""
        angle = np.angle(self._modal[0])
        return np.unique(angle[angle > 1e-9]) * self.rate / (2 * np.pi)

    def response(self, z: Array) -> Array:
        """Coordinates per force (m/N, shape (..., c, c)) at complex `z`."""
        poles, out, into = self._modal
        return np.einsum("ip,...p,pj->...ij", out, 1.0 / (np.asarray(z)[..., None] - poles), into)


class KnownFinger(NamedTuple):
    """What the law knows of the finger: kg, N s/m, N/m, numbers or arrays (B, 1, 1, 1), and its place p/a."""

    mass: Any
    damping: Any
    stiffness: Any
    place: float


@dataclass(frozen=True, kw_only=True)
class BankLoop:
    """The linear loop of a bank, or of a stack of B banks with K bands each, on one structure.

    Parameters
    ----------
    plant : Sampled
        What the bank meets, in the device's c coordinates first.
    delay : int
        Samples from a sensed sample to its force taking effect, >= 1.
    frequency : ndarray, shape (B, K), Hz
    observer : ndarray, shape (B,)
        Gain g of the observer, per sample.
    integral : ndarray, shape (B,), 1/s
    dc, dc_drift : ndarray, shape (B,)
        Gains of the DC band, per sample.
    inner : ndarray, shape (B,)
        Share of the inner loop that is on.
    taps : ndarray, shape (c, t), N/m
        Of the inner loop.
    law, slope : ndarray of complex, shape (B, K, c, c), N/m, N s/m
        D and D' of every band as the law knows them, already turned ahead by rho.
    share : ndarray, shape (B, K)
        Of the observer's gain that each band has, less than 1 where it fades out.
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

    @classmethod
    def on(
        cls,
        plant: Sampled,
        known: Structure,
        frequency: Array,
        *,
        delay: int,
        lead: float,
        observer: Array,
        integral: Array,
        dc: Array,
        dc_drift: Array,
        inner: Array,
        taps: Array,
        finger: KnownFinger | None = None,
        share: Array | float = 1.0,
    ) -> BankLoop:
        """Loop of a bank whose law believes in the free device `known` and in `finger`; `lead` in s."""
        jw = 2j * np.pi * np.asarray(frequency, float)[..., None, None]
        law = known.mass * jw**2 + known.damping * jw + known.stiffness
        slope = known.damping + 2 * jw * known.mass
        if finger is not None:
            place = np.array([1.0, finger.place])[: len(known.mass)]
            touched = np.outer(place, place)
            law = law + (finger.mass * jw**2 + finger.damping * jw + finger.stiffness) * touched
            slope = slope + (finger.damping + 2 * jw * finger.mass) * touched
        ahead = np.exp(jw * lead) / np.sinc(np.asarray(frequency, float) / plant.rate)[..., None, None]
        stack = np.ones(len(frequency))
        return cls(
            plant=plant,
            delay=delay,
            frequency=np.asarray(frequency, float),
            observer=observer * stack,
            integral=integral * stack,
            dc=dc * stack,
            dc_drift=dc_drift * stack,
            inner=inner * stack,
            taps=taps,
            law=ahead * law,
            slope=ahead * slope,
            share=share * np.ones_like(frequency, float),
        )

    @property
    def period(self) -> float:
        """Sampling period (s)."""
        return 1.0 / self.plant.rate

    def _turn(self) -> Array:
        return np.exp(2j * np.pi * self.frequency * self.period)

    def controller(self, z: Array) -> tuple[Array, Array]:
        """Force per deviation, F = -K y (N/m, shape (B, N, c, c)), and 1 + O, the residual's share (B, N).

        `z` is complex, shape (B, N) or (N,).
        """
        z = np.broadcast_to(z, (len(self.frequency), np.shape(z)[-1]))
        g, ki = (self.observer[:, None] * self.share)[:, None], self.integral[:, None, None]
        turn, at = self._turn()[:, None, :], z[:, :, None]
        fading = FORGET * (1.0 - self.share)[:, None]
        kept = 1.0 - self.period * fading
        force = np.zeros((*z.shape, *self.law.shape[-2:]), complex)
        observed = self.dc[:, None] / (z - 1.0) + self.dc_drift[:, None] / (z - 1.0) ** 2
        integrated = np.zeros(z.shape, complex)
        for a, law, slope in ((turn, self.law, self.slope), (turn.conj(), self.law.conj(), self.slope.conj())):
            error = g * at / (at - kept * a)
            part = -ki * self.period * at / (at - kept * a) * error
            observed = observed + 0.5 * (a / at * error).sum(axis=-1)
            integrated += 0.5 * (a / at * part).sum(axis=-1)
            force += 0.5 * np.einsum("bnk,bkij->bnij", part, law)
            force += 0.5 * np.einsum("bnk,bkij->bnij", -ki * error - fading * a / at * part, slope)
        rest = 1.0 + observed
        order = np.arange(self.taps.shape[1])
        taps = self.inner[:, None, None] * (z[:, :, None, None] ** -order * self.taps).sum(axis=-1)
        damping = taps * ((rest - integrated) / rest)[:, :, None]
        return damping[..., None] * np.eye(force.shape[-1]) - force / rest[..., None, None], rest

    def loop(self, z: Array) -> Array:
        """L = G z^-delay K, broken at the coordinates, shape (B, N, c, c); S = (I + L)^-1."""
        lag = np.asarray(z)[..., None, None] ** -self.delay
        return self.plant.response(z) @ self.controller(z)[0] * lag

    def difference(self, z: Array) -> Array:
        """Closed-loop over open-loop characteristic polynomial, shape (B, N); 1 at infinity."""
        gain, rest = self.controller(z)
        loop = self.plant.response(z) @ gain * np.asarray(z)[..., None, None] ** -self.delay
        size = loop.shape[-1]
        return rest**size * np.linalg.det(np.eye(size) + loop)

    def matrix(self) -> Array:
        """State matrix of the closed loop at sample rate, real, shape (B, s, s); carriers taken out."""
        states = sum(math.prod(shape) for shape in self._shapes())
        columns = np.broadcast_to(np.eye(states), (len(self.frequency), states, states))
        return self._advance(columns)

    def _shapes(self) -> list[tuple[int, ...]]:
        c, bands, taps = len(self.taps), self.frequency.shape[1], self.taps.shape[1]
        past = taps - 1 if self.inner.any() else 0
        return [(len(self.plant.advance),), (self.delay, c), (c,), (c,), (past, c), *[(bands, c)] * 4]

    def _advance(self, state: Array) -> Array:
        """One sample of the homogeneous loop, column by column of `state` (B, s, columns)."""
        parts, start = [], 0
        for shape in self._shapes():
            size = math.prod(shape)
            parts.append(state[:, start : start + size].reshape(len(state), *shape, state.shape[-1]))
            start += size
        x, pending, level, drift, past, *real = parts
        eps, nu = real[0] + 1j * real[1], real[2] + 1j * real[3]
        wide = (-1, 1, 1)
        y = self.plant.watch @ x
        error = y - level - eps.real.sum(axis=1)
        deviation = y - nu.real.sum(axis=1)
        held = np.concatenate([deviation[:, None], past], axis=1)
        fading = FORGET * (1.0 - self.share)[..., None, None]
        eps = (1.0 - self.period * fading) * eps
        eps = eps + (self.observer[:, None] * self.share)[..., None, None] * error[:, None]
        slope = -self.integral.reshape(*wide, 1) * eps - fading * nu
        nu = nu + self.period * slope
        force = (self.law @ nu + self.slope @ slope).real.sum(axis=1)
        taps = self.taps.T[: held.shape[1], :, None]
        force = force - self.inner.reshape(wide) * (taps * held).sum(axis=1)
        line = np.concatenate([force[:, None], pending], axis=1)
        x = self.plant.advance @ x + self.plant.push @ line[:, -1]
        level = level + self.dc.reshape(wide) * error + drift
        drift = drift + self.dc_drift.reshape(wide) * error
        turn = self._turn()[:, :, None, None]
        eps, nu = turn * eps, turn * nu
        after = [x, line[:, :-1], level, drift, held[:, : past.shape[1]], eps.real, eps.imag, nu.real, nu.imag]
        return np.concatenate([part.reshape(len(state), -1, state.shape[-1]) for part in after], axis=1)

    def poles(self) -> Array:
        """Closed-loop poles (1/s, complex, shape (B, s)): growth, and angular frequency."""
        z = np.linalg.eigvals(self.matrix()).astype(complex)
        return self.plant.rate * np.log(np.where(z == 0, LEAST_POLE, z))

    def growth(self) -> Array:
        """Growth of the slowest-decaying pole (1/s, shape (B,)), < 0 for a stable loop."""
        return self.poles().real.max(axis=-1)

    def margins(self) -> Margins:
        """Every margin of a single bank (B = 1), of all its bands and coordinates together."""
        rate, carriers = self.plant.rate, self.frequency[0]
        rates = np.array([self.observer[0] * rate / 2, self.integral[0]]) / (2 * np.pi)
        widths = np.unique(rates[rates > 1e-3]) * np.array([[0.5], [1.0], [2.0]])
        grid = carrier_grid(np.concatenate([carriers, self.plant.modes(), [0.0]]), widths.ravel(), rate)
        if unstable_poles(lambda z: self.difference(z)[0], grid, carriers, rate):
            return Margins(
                stable=False, modulus=0.0, worst_frequency=math.nan, delay=0.0, phase=0.0, gain=1.0, bandwidth=0.0
            )
        loop = self.loop(np.exp(2j * np.pi * grid / rate))[0]
        peak = sensitivity(loop)
        highest, where = highest_peak(
            lambda grid: sensitivity(self.loop(np.exp(2j * np.pi * grid / rate))[0]), grid, peak
        )
        delay, phase, gain = borne_errors(grid, loop)
        return Margins(
            stable=True,
            modulus=1.0 / highest,
            worst_frequency=where,
            delay=delay,
            phase=phase,
            gain=gain,
            bandwidth=min(halved_within(grid - carrier, peak) for carrier in carriers),
        )
