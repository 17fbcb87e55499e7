"""What the carrier of an electroadhesion screen adds to the attraction of its envelope, a sample at a time.

With t counted from the crest at which a sample of the envelope I begins, a capacitor that leaks with the time constant
tau, and beside I a direct current i_dc, holds the charge::

    q(t) = I Re(Q e^(j w t)) + p e^(-t/tau) + i_dc tau,   Q = 1/(j w + 1/tau)

where p is what the last sample left behind: Re Q for every step of I.  Of the mean of q^2 over the sample, which
attracts, the envelope's ``g I^2`` is I^2 |Q|^2/2.  The rest is what the envelope leaves out::

    p^2 <E^2> + 2 I p <Re(Q e^(j w t)) E> + 2 p i_dc tau <E> + (i_dc tau)^2,   E = e^(-t/tau)

All means over a sample are geometric series, so this costs a sample, not its substeps, and is exact while the source
stays inside its compliance.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.control.gap import VACUUM
from hapticrender.plants.electroadhesion import BLOCKING, ElectroadhesionParameters
from hapticrender.protocols import Array

LOAD, SPEED = 1, 3  # columns of the finger
LEAST_RESISTANCE = 1e-9  # ohm m2: stands for a shorted gap, which leaks within a femtosecond


class ScreenNumbers(NamedTuple):
    """Numbers of the screen's circuit."""

    period: float  # s
    substeps: float  # in a sample
    omega: float  # rad/s
    offset: float  # A
    servo: float  # S
    body: float  # ohm
    kappa: float


@kernel
def leak_means(tau, period, substeps, omega):
    """Of E = e^(-t/tau) over the ends of a sample's substeps: last, mean, mean square, <e^(j w t) E>; and Q."""
    short = math.exp(-period / substeps / tau)
    last = short**substeps
    missing = -math.expm1(-period / tau)
    mean = short * missing / (-math.expm1(-period / substeps / tau) * substeps)
    square = mean * (1.0 + last) * short / (1.0 + short)
    turned = short * cmath.exp(1j * omega * period / substeps)
    return last, mean, square, turned * missing / ((1.0 - turned) * substeps), 1.0 / (1j * omega + 1.0 / tau)


@kernel
def carrier_attraction(numbers, envelope, area, gap, resistance, here, charge, tau, capacitance, out):
    """Attraction (N) at the carrier less that of the envelope, and the largest voltage (V), shape (n, 2).

    `charge`, `tau` and `capacitance` (3,) are those of insulator, stratum corneum and gap; the gap's are filled in.
    """
    servo = 0.0
    for n in range(envelope.shape[0]):
        if not here[n]:
            for k in range(3):
                charge[k] = 0.0
            servo = out[n, 0] = out[n, 1] = 0.0
            continue
        current, direct = envelope[n], numbers.offset + servo
        capacitance[2] = VACUUM / gap[n]
        tau[2] = max(resistance[n], LEAST_RESISTANCE) * capacitance[2]
        swing, rest, level = complex(numbers.body, 0.0), abs(numbers.body * direct), numbers.body * direct
        for k in range(3):
            last, mean, square, turned, share = leak_means(tau[k], numbers.period, numbers.substeps, numbers.omega)
            held, whole = direct * tau[k], capacitance[k] * area[n]
            left = charge[k] - current * share.real - held
            if k == 2:
                more = left * left * square + held * held
                more += 2.0 * left * (current * (share * turned).real + held * mean)
                out[n, 0] = numbers.kappa * more / (2.0 * VACUUM * area[n])
            swing += share / whole
            rest += max(abs(left + held), abs(left * last + held)) / whole
            level += (left * mean + held) / whole
            charge[k] = current * share.real + left * last + held
        out[n, 1] = abs(current) * abs(swing) + rest
        servo = -numbers.servo * level


def attractions(parameters: ElectroadhesionParameters, envelope: Array, finger: Array) -> tuple[Array, Array, float]:
    """Attraction at either level.

    Parameters
    ----------
    parameters : ElectroadhesionParameters
        The screen; its drive is a current.
    envelope : ndarray, shape (n,), A
        Peak of the carrier, inside its limit.
    finger : ndarray, shape (n, 4)
        Position (m), load (N), strength and speed (m/s, NaN: lifted), as of `finger_rows`.

    Returns
    -------
    carrier, envelope : ndarray, shape (n,), N
    voltage : float, V
        No larger one comes up, were the source without a limit.
    """
    p = parameters
    here = np.isfinite(finger[:, SPEED]) & (finger[:, LOAD] > 0.0)
    position, load = np.where(here, finger[:, 0], 0.0), np.where(here, finger[:, LOAD], 1.0)
    area = p.area(load)
    gap = p.gap_thickness * (1.0 + p.ripple * np.cos(2 * np.pi / p.ripple_wavelength * position))
    resistance = np.where(abs(finger[:, SPEED]) < p.least_speed, p.gap_short, p.gap_resistance)
    lag = (p.omega * resistance * VACUUM / gap) ** 2
    plain = np.where(here, p.unevenness * envelope**2 * lag / (1.0 + lag) / (4 * p.omega**2 * VACUUM * area), 0.0)
    out = np.zeros((len(envelope), 2))
    tau = np.array([BLOCKING, p.corneum_resistance * p.corneum_capacitance, 0.0])
    capacitance = np.array([p.insulator_capacitance, p.corneum_capacitance, 0.0])
    envelope = np.ascontiguousarray(envelope, float)
    carrier_attraction(_numbers(p), envelope, area, gap, resistance, here, np.zeros(3), tau, capacitance, out)
    return plain + out[:, 0], plain, float(out[:, 1].max(initial=0.0))


def _numbers(parameters: ElectroadhesionParameters) -> ScreenNumbers:
    p = parameters
    return ScreenNumbers(
        period=1.0 / p.rate,
        substeps=float(p.oversampling),
        omega=p.omega,
        offset=float(p.current_offset),
        servo=float(p.servo_conductance),
        body=float(p.body_resistance),
        kappa=float(p.unevenness),
    )
