"""The paper's loop about its steady state: amplitude and phase of one carrier in several coordinates, as a real system.

In the frame of the carrier (angular frequency w) the plant takes the drive's envelope U to the watched one X by
P(e^(j (w + W) T)).  About the steady state X = R, U = A e^(j theta) the law answers a deviation x = Re x + j Im x of
the measured envelope with

    u = -C [Re x + j r Im x],  dU = e^(j theta)/table u,  r = A/|R|,

C the loop controller: amplitude and phase errors are real numbers, so a complex deviation and its conjugate mix, and c
coordinates make a real loop of size 2 c.  r is 1 where the look-up table is true, as on the free plate.  Neglected: the
demodulator's image at 2 w, (rL rT/4)^2 with rL = fL/f0, rT = fT/f0, which a design by the paper's rule keeps below
0.1 %; the clamp at 0, the phase cut and the drive's limit, which a small deviation does not meet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank.loop import LEAST_POLE, Sampled
from hapticrender.control.loopshape import reduced_controller
from hapticrender.control.margins import Margins, borne_errors, halved_within, highest_peak, sensitivity
from hapticrender.control.transfer import butterworth
from hapticrender.protocols import Array

MOST_GAIN = 64.0  # plant gain errors are sought up to this factor
HALVINGS = 24


@dataclass(frozen=True, kw_only=True)
class PolarLoop:
    """Small-signal loop of a stack of B carriers, each alone, in c watched coordinates.

    Parameters
    ----------
    plant : Sampled
        What the controller meets.
    delay : int, samples
    frequency : ndarray, shape (B,), Hz
    watched : ndarray, shape (c, n)
        Watched displacements from the device's coordinates.
    force : ndarray, shape (n, c)
        Forces in the device's coordinates per unit of the controller's drives.
    table : ndarray, shape (B, c)
        What the look-up table says of each, m per drive unit.
    low_pass, law : ndarray, shape (B, 5)
        Sections b0 b1 b2 a1 a2 of the estimator and of the loop controller.
    gain : float
        Error of the plant's gain; 1 is none.
    """

    plant: Sampled
    delay: int
    frequency: Array
    watched: Array
    force: Array
    table: Array
    low_pass: Array
    law: Array
    gain: float = 1.0

    @classmethod
    def on(
        cls,
        plant: Sampled,
        model: BandModel,
        frequency: Array,
        bandwidth: Array,
        *,
        common: bool,
        delay: int | None = None,
    ) -> PolarLoop:
        """Loop of the paper's controller, per side or in common mode.

        Parameters
        ----------
        plant : Sampled
        model : BandModel
            The free device, of which the look-up table is made.
        frequency, bandwidth : ndarray, shape (B,), Hz
            Carriers, and bandwidths fT of their loops; the estimator's is 2 fT.
        common : bool
            One loop on the mean of the sides, or one a side.
        delay : int, optional
            Samples that the loop really has; by default the model's.
        """
        sides = model.side_from_coordinate
        watched = sides.mean(axis=0, keepdims=True) if common else sides
        spread = np.ones((len(sides), 1)) if common else np.eye(len(sides))
        answer = model.response(frequency) @ np.ones(len(sides)) @ watched.T
        table = np.abs(answer * model.hold_and_delay(frequency)[:, None])
        widths, which = np.unique(bandwidth, return_inverse=True)
        filters = [butterworth(2 * b).tustin(model.rate, prewarp=2 * b) for b in widths]
        laws = [reduced_controller(b, 2 * b).tustin(model.rate) for b in widths]
        return cls(
            plant=plant,
            delay=model.delay if delay is None else delay,
            frequency=np.asarray(frequency, float),
            watched=watched,
            force=model.force_from_drive @ spread,
            table=table,
            low_pass=np.array([[*b, *a[1:]] for b, a in filters])[which],
            law=np.array([[*b, *a[1:]] for b, a in laws])[which],
        )

    def _answer(self, offset: Array) -> Array:
        """Watched envelope per drive envelope at `offset` (Hz, shape (B, N)) from the carrier: (B, N, c, c)."""
        z = np.exp(2j * np.pi * (self.frequency[:, None] + offset) / self.plant.rate)
        answer = self.watched @ self.plant.response(z) @ self.force
        return self.gain * answer * z[..., None, None] ** -self.delay

    def steady(self) -> tuple[Array, Array]:
        """Unit vector e^(j theta) of each drive and r = A/|R|, both (B, c), where X = R in every coordinate."""
        answer = self._answer(np.zeros((len(self.frequency), 1)))[:, 0]
        drive = np.linalg.solve(answer, np.ones((*answer.shape[:-1], 1), complex))[..., 0]
        return drive / np.abs(drive), np.abs(drive) * self.table

    def loop(self, offset: Array) -> Array:
        """L (B, N, 2 c, 2 c) at `offset` (Hz, > 0, (N,) or (B, N)), in real and imaginary parts."""
        turn, ratio = self.steady()
        scale = (turn / self.table)[:, None, None, :]
        offset = np.broadcast_to(offset, (len(self.frequency), np.shape(offset)[-1]))
        above = self._answer(offset) * scale
        below = (self._answer(-offset) * scale).conj()
        mean, half = 0.5 * (above + below), 0.5j * (above - below)
        plant = np.concatenate([np.concatenate([mean, half], axis=-1), np.concatenate([-half, mean], axis=-1)], axis=-2)
        z = np.exp(2j * np.pi * offset / self.plant.rate)
        shared = (_section(self.low_pass, z) * _section(self.law, z))[..., None, None]
        return shared * plant * np.concatenate([np.ones_like(ratio), ratio], axis=1)[:, None, None, :]

    def matrix(self) -> Array:
        """State matrix of the loop at sample rate in the carrier's frame, real, shape (B, s, s)."""
        count, size = len(self.plant.advance), len(self.watched)
        states = 2 * count + 2 * self.delay * size + 8 * size
        columns = np.broadcast_to(np.eye(states), (len(self.frequency), states, states))
        return self._advance(columns, count, size)

    def _advance(self, state: Array, count: int, size: int) -> Array:
        """One sample of the small deviation, column by column of `state` (B, s, columns)."""
        batch, columns = len(state), state.shape[-1]
        edges = np.cumsum([2 * count, 2 * self.delay * size, 4 * size, 2 * size])
        x, pending, filtered, amplitude, phase = np.split(state, edges, axis=1)
        x = x[:, :count] + 1j * x[:, count:]
        pending = pending.reshape(batch, 2, self.delay, size, columns)
        pending = pending[:, 0] + 1j * pending[:, 1]
        filtered = filtered.reshape(batch, 2, 2, size, columns)
        filtered = filtered[:, 0] + 1j * filtered[:, 1]
        turn, ratio = self.steady()
        seen = self.watched @ self.plant.watch @ x
        measured, filtered = _step(self.low_pass, filtered, seen)
        more, amplitude = _step(self.law, amplitude.reshape(batch, 2, size, columns), -measured.real)
        ahead, phase = _step(self.law, phase.reshape(batch, 2, size, columns), -measured.imag)
        drive = (turn / self.table)[..., None] * (more + 1j * ratio[..., None] * ahead)
        line = np.concatenate([drive[:, None], pending], axis=1)
        back = np.exp(-2j * np.pi * self.frequency / self.plant.rate)[:, None, None]
        push = self.gain * self.plant.push @ self.force
        x = back * (self.plant.advance @ x + push @ line[:, -1])
        line = back[:, None] * line[:, :-1]
        parts = [x.real, x.imag, line.real, line.imag, filtered.real, filtered.imag, amplitude, phase]
        return np.concatenate([part.reshape(batch, -1, columns) for part in parts], axis=1)

    def poles(self) -> Array:
        """Closed-loop poles in the frame of the carrier (1/s, complex, shape (B, s))."""
        z = np.linalg.eigvals(self.matrix()).astype(complex)
        return self.plant.rate * np.log(np.where(z == 0, LEAST_POLE, z))

    def growth(self) -> Array:
        """Growth of the slowest-decaying pole (1/s, shape (B,)), < 0 for a stable loop."""
        return self.poles().real.max(axis=-1)

    def margins(self) -> Margins:
        """Margins of a single carrier (B = 1).

        The phase of the plant is found by the loop itself, so any error of it is borne while the deviation is small:
        `phase` is pi.  A gain error multiplies the amplitude loops only (A/|R| falls as the gain rises).
        """
        if self.growth()[0] >= 0:
            return Margins(
                stable=False, modulus=0.0, worst_frequency=math.nan, delay=0.0, phase=0.0, gain=1.0, bandwidth=0.0
            )
        offset = np.geomspace(1e-3, self.plant.rate / 2, 2000)
        loop = self.loop(offset)[0]
        peak = sensitivity(loop)
        highest, where = highest_peak(lambda offset: sensitivity(self.loop(offset)[0]), offset, peak)
        return Margins(
            stable=True,
            modulus=1.0 / highest,
            worst_frequency=float(self.frequency[0] + where),
            delay=borne_errors(offset, loop)[0],
            phase=math.pi,
            gain=min(self._borne(1.0), self._borne(-1.0)),
            bandwidth=halved_within(offset, peak),
        )

    def _borne(self, sign: float) -> float:
        """Largest factor on the plant's gain (`sign` 1), or on its inverse (-1), that leaves the loop stable."""

        def grows(log_gain: float) -> bool:
            return bool(replace(self, gain=math.exp(sign * log_gain)).growth()[0] >= 0)

        low, high = 0.0, math.log(MOST_GAIN)
        if not grows(high):
            return math.inf
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if grows(middle) else (middle, high)
        return math.exp(low)


def _section(sections: Array, z: Array) -> Array:
    """Response of second-order sections (B, 5) at `z` (B, N)."""
    b0, b1, b2, a1, a2 = (column[:, None] for column in sections.T)
    return (b0 + b1 / z + b2 / z**2) / (1.0 + a1 / z + a2 / z**2)


def _step(sections: Array, state: Array, x: Array) -> tuple[Array, Array]:
    """One sample of sections (B, 5), transposed direct form II; `state` (B, 2, c, columns)."""
    b0, b1, b2, a1, a2 = (column[:, None, None] for column in sections.T)
    y = b0 * x + state[:, 0]
    return y, np.stack([b1 * x - a1 * y + state[:, 1], b2 * x - a2 * y], axis=1)
