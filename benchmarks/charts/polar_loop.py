"""Linear model of the paper's polar loop about its steady state: amplitude and phase of one carrier, as a real system.

In the frame of the carrier (angular frequency w) the plant takes the drive's envelope U to the measured one X by
P(e^(j (w + W) T)).  About the steady state X = R, U = A e^(j theta) the law takes a deviation x of the estimate to

    u = -C [Re x + j r Im x],  dU = e^(j theta)/table u,  r = A/|R|,

C the loop controller: amplitude and phase errors are real numbers, so a complex deviation and its conjugate mix, and c
coordinates make a real loop of size 2 c.  r is 1 where the look-up table is true, as on the free plate.  Neglected: the
demodulator's image at 2 w, (rL rT/4)^2 with rL = fL/f0, rT = fT/f0, which the paper's rule keeps below 0.1 %; the clamp
at 0, the phase cut and the drive's limit, which a small deviation does not reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.charts.poles import logarithms
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.linear import DiscretePlant
from hapticrender.control.loopshape import loop_section
from hapticrender.protocols import Array


@dataclass(frozen=True, kw_only=True)
class PolarLoop:
    """Small-signal loop of a stack of B carriers, each alone, in c measured coordinates.

    Parameters
    ----------
    plant : DiscretePlant
        What the loop closes on.
    delay : int, samples
    frequency : ndarray, shape (B,), Hz
    measured : ndarray, shape (c, n)
        Measured displacements from the device's coordinates.
    force : ndarray, shape (n, c)
        Forces in the device's coordinates per unit of the controller's drives.
    table : ndarray, shape (B, c)
        Look-up table of each, m per drive unit.
    low_pass, law : ndarray, shape (B, 5)
        Sections b0 b1 b2 a1 a2 of the estimator and of the loop controller.
    """

    plant: DiscretePlant
    delay: int
    frequency: Array
    measured: Array
    force: Array
    table: Array
    low_pass: Array
    law: Array

    @classmethod
    def on(
        cls,
        plant: DiscretePlant,
        model: DeviceModel,
        frequency: Array,
        bandwidth: Array,
        *,
        common: bool,
    ) -> PolarLoop:
        """Loop of the paper's controller, per side or in common mode.

        Parameters
        ----------
        plant : DiscretePlant
        model : DeviceModel
            The free device, of which the look-up table is made.
        frequency, bandwidth : ndarray, shape (B,), Hz
            Carriers, and bandwidths fT of their loops; the estimator's is 2 fT.
        common : bool
            One loop on the mean of the sides, or one for each side.
        """
        frequency, sides = np.asarray(frequency, float), model.side_from_coordinate
        measured = sides.mean(axis=0, keepdims=True) if common else sides
        drive_map = np.ones((len(sides), 1)) if common else np.eye(len(sides))
        alike = model.response(frequency) @ np.ones(len(sides)) @ measured.T
        widths, which = np.unique(bandwidth, return_inverse=True)
        filters = [StarSTDFT(bandwidth=2 * b, rate=model.rate).coefficients for b in widths]
        laws = [loop_section(b, 2 * b, model.rate) for b in widths]
        return cls(
            plant=plant,
            delay=model.delay,
            frequency=frequency,
            measured=measured,
            force=model.force_from_drive @ drive_map,
            table=np.abs(alike * model.hold_and_delay(frequency)[:, None]),
            low_pass=np.array([[*b, *a[1:]] for b, a in filters])[which],
            law=np.array(laws)[which],
        )

    def envelope_response(self, offset: Array) -> Array:
        """Measured envelope per drive envelope at `offset` (Hz, shape (B, N)) from the carrier: (B, N, c, c)."""
        z = np.exp(2j * np.pi * (self.frequency[:, None] + offset) / self.plant.rate)
        response = self.measured @ self.plant.response(z) @ self.force
        return response * z[..., None, None] ** -self.delay

    def steady(self) -> tuple[Array, Array]:
        """Unit vector e^(j theta) of each drive and r = A/|R|, both (B, c), where X = R in every coordinate."""
        response = self.envelope_response(np.zeros((len(self.frequency), 1)))[:, 0]
        drive = np.linalg.solve(response, np.ones((*response.shape[:-1], 1), complex))[..., 0]
        return drive / np.abs(drive), np.abs(drive) * self.table

    def loop(self, offset: Array) -> Array:
        """L (B, N, 2 c, 2 c) at `offset` (Hz, > 0, (N,) or (B, N)), in real and imaginary parts."""
        turn, ratio = self.steady()
        scale = (turn / self.table)[:, None, None, :]
        offset = np.broadcast_to(offset, (len(self.frequency), np.shape(offset)[-1]))
        above = self.envelope_response(offset) * scale
        below = (self.envelope_response(-offset) * scale).conj()
        mean, half = 0.5 * (above + below), 0.5j * (above - below)
        plant = np.concatenate([np.concatenate([mean, half], axis=-1), np.concatenate([-half, mean], axis=-1)], axis=-2)
        z = np.exp(2j * np.pi * offset / self.plant.rate)
        shared = (_section_response(self.low_pass, z) * _section_response(self.law, z))[..., None, None]
        return shared * plant * np.concatenate([np.ones_like(ratio), ratio], axis=1)[:, None, None, :]

    def matrix(self) -> Array:
        """State matrix of the closed loop in the carrier's frame, real, (B, s, s): one sample from every unit state.

        States: plant and drives under way, turned back with the carrier, and two of each section and real error.
        """
        turn, ratio = self.steady()
        back = np.exp(-2j * np.pi * self.frequency / self.plant.rate)[:, None, None]
        n, c = len(self.plant.a), ratio.shape[1]
        under_way = self.delay * c
        sizes = [2 * n, 2 * under_way, 4 * c, 4 * c]
        unit = np.broadcast_to(np.eye(sum(sizes)), (len(ratio), sum(sizes), sum(sizes)))
        x, drives, filtered, controlled = np.split(unit, np.cumsum(sizes)[:-1], axis=1)
        x, drives = x[:, :n] + 1j * x[:, n:], drives[:, :under_way] + 1j * drives[:, under_way:]
        errors, filtered = _section_step(self.low_pass, _parts(self.measured @ self.plant.c @ x), filtered)
        command, controlled = _section_step(self.law, errors, controlled)
        command *= -np.concatenate([np.ones_like(ratio), ratio], axis=1)[:, :, None]
        drive = (command[:, :c] + 1j * command[:, c:]) * (turn / self.table)[:, :, None]
        x = back * (self.plant.a @ x + self.plant.b @ self.force @ drives[:, :c])
        drives = back * np.concatenate([drives[:, c:], drive], axis=1)
        return np.concatenate([_parts(x), _parts(drives), filtered, controlled], axis=1)

    def poles(self) -> Array:
        """Closed-loop poles in the frame of the carrier (1/s, complex: growth and angular frequency, shape (B, s))."""
        return logarithms(np.linalg.eigvals(self.matrix()), self.plant.rate)


def _parts(values: Array) -> Array:
    """Real parts above imaginary ones, (B, 2 n, s)."""
    return np.concatenate([values.real, values.imag], axis=1)


def _section_response(sections: Array, z: Array) -> Array:
    """Response of second-order sections (B, 5) at `z` (B, N)."""
    b0, b1, b2, a1, a2 = (column[:, None] for column in sections.T)
    return (b0 + b1 / z + b2 / z**2) / (1.0 + a1 / z + a2 / z**2)


def _section_step(sections: Array, u: Array, states: Array) -> tuple[Array, Array]:
    """Outputs (B, m, s) and next states (B, 2 m, s) of m equal sections each, transposed direct form II."""
    b0, b1, b2, a1, a2 = sections.T[:, :, None, None]
    first, second = np.split(states, 2, axis=1)
    y = b0 * u + first
    return y, np.concatenate([b1 * u - a1 * y + second, b2 * u - a2 * y], axis=1)
