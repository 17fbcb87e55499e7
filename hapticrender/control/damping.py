"""Active damping at sample rate: taps on the deviation that act like a damper at each mode, delay included."""

from __future__ import annotations

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.protocols import Array

TAPS = 3


def damping_taps(model: BandModel, quality: float) -> tuple[Array, Array]:
    """Taps of the inner loop and the damping that they add, coordinate by coordinate.

    Parameters
    ----------
    model : BandModel
        The free device; each coordinate's mode is sqrt(stiffness/mass) of its diagonal.
    quality : float
        Q of each mode with its damper, > 0.

    Returns
    -------
    taps : ndarray, shape (coordinates, 3), N/m
        F = -(c0 eps[n] + c1 eps[n-1] + c2 eps[n-2]).
    grip : ndarray, shape (coordinates,), N s/m
        Added damping m w1/Q at each mode w1.

    Raises
    ------
    ValueError
        Quality is not positive.

    Notes
    -----
    Three linear equations (FACTS section 3 A): sum c_i = 0, so that the sag is left alone, and
    sum c_i e^(-j w1 i T) = j w1 grip e^(j w1 (delay + 1/2) T)/sinc(w1 T/2), so that after delay and hold the force is
    that of a damper.
    """
    if not quality > 0:
        raise ValueError(f"{quality=} must be > 0")
    mass, stiffness = model.mass.diagonal(), model.stiffness.diagonal()
    mode = np.sqrt(stiffness / mass)
    grip = mass * mode / quality
    turn = mode / model.rate
    wanted = 1j * mode * grip / model.hold_and_delay(mode / (2 * np.pi))
    order = np.arange(TAPS)
    taps = [
        np.linalg.solve(
            np.array([np.ones(TAPS), np.cos(-angle * order), np.sin(-angle * order)]), [0.0, force.real, force.imag]
        )
        for angle, force in zip(turn, wanted, strict=True)
    ]
    return np.array(taps), grip
