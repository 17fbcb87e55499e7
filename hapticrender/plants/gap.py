"""Estimate the attraction on an electroadhesive finger from the impedance of its gap at the carrier.

With the complex envelopes V and I of voltage and current at the carrier, both low-passed by the STDFT* of
`hapticrender.control.estimators`::

    Z = V/I,  Z_stat = Z while |v| < least_speed: the gap is shorted
    A = |z_series|/|Z_stat - R_body|
    Z_g = Z - Z_stat = 1/(G + j w C)                    while sliding
    L = (w C)^2/((w C)^2 + G^2) = Im(Z_g)^2/|Z_g|^2
    F = kappa |I|^2 L/(4 w^2 eps0 A)

The area changes with the load and only a resting finger shows it: 10 % of area is 11 % of force, and 1 us between the
two channels about 10 %, because it turns Z.  The force follows |I|^2 at once; only the impedance is averaged over a
longer time, weighted by power, so that an envelope may pass through zero.

The force cannot be estimated while the finger is away or rests, when it was never seen at rest, or when its gap leaks
so much that L falls below a bound.  The output is then F = g |I|^2, what a control loop expects of a nominal finger, so
that no integrator winds up, and `Flag.OPEN_LOOP` is raised.

References
----------
Shultz, Peshkin, Colgate 2018 (the sliding gap's impedance); Sun, Guo, Sun 2022 (a slower relative of the estimate).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hapticrender.control.estimators import StarSTDFT
from hapticrender.control.transfer import require_positive
from hapticrender.jit import kernel
from hapticrender.plants.contact import new_record
from hapticrender.protocols import Array

VACUUM = 8.8541878128e-12  # F/m
LIFTED, RESTING, MOVING = -1, 0, 1  # states of the finger
SETTLING = 5.0  # time constants of the low pass for which an impedance is not used after a change

GAP = np.dtype(
    [(name, "f8") for name in ("body_resistance", "least_speed", "least_share", "open_loop_gain")]
    + [
        ("b", "f8", (3,)),  # of the STDFT*
        ("a", "f8", (2,)),
        ("retention", "f8"),  # of the averages, a sample
        ("settling", "i8"),  # samples that the low pass needs
        ("series", "f8"),  # ohm m2: modulus of the impedance in series with the gap
        ("force", "f8"),  # kappa/(4 w^2 eps0), N m2/A^2
        ("filters", "c16", (2, 2)),  # state: of V and of I
        ("envelope", "c16", (2,)),  # state: V and I, low-passed
        ("cross", "c16"),  # state: average of V conj(I)
        ("power", "f8"),  # state: average of |I|^2
        ("static", "c16"),  # state: Z_stat, ohm
        ("area", "f8"),  # state: m2, 0: not measured yet
        ("share", "f8"),  # state: L, 0: not measured yet
        ("contact", "i8"),  # state: what the finger does
        ("waiting", "i8"),  # state: samples until the low pass has settled
    ],
    align=True,
)


@dataclass(frozen=True, kw_only=True)
class GapEstimator:
    """Estimator of the attraction from voltage and current at the carrier, for plants and for drivers.

    Parameters
    ----------
    rate, carrier_frequency : float, Hz
        Sampling rate of the envelopes, and the carrier, > 0.
    series_impedance : complex, ohm m2
        Insulator and stratum corneum at the carrier, per area; not 0.
    open_loop_gain : float, N/A^2
        g for a finger whose gap cannot be measured, > 0.
    bandwidth : float, Hz
        Of the STDFT*, > 0 and < rate/2.
    smoothing : float, s
        Time constant over which the impedance is averaged, at least a sample.
    body_resistance : float, ohm
    unevenness : float
        kappa = <d^-2>/<d^-1>^2 of the gap, >= 1.
    least_speed : float, m/s
        A slower finger rests, > 0.
    least_share : float
        Bound of L, 0 to 1, below which the gap leaks too much for an estimate.

    Notes
    -----
    `frequency_response` and `delay` are those of a small change of |I|^2 around a constant.

    Examples
    --------
    A driver keeps a state between blocks, here of 4 samples with 20 of both channels in each; `phase` (rad) is that of
    the carrier:

    >>> def envelope(samples, phase):
    ...     return 2 * np.mean(samples * np.exp(-1j * phase), axis=1)
    >>> estimator = GapEstimator(
    ...     rate=10e3, carrier_frequency=20e3, series_impedance=0.06 - 0.49j, open_loop_gain=2.2e4
    ... )
    >>> state, phase = estimator.start(), np.arange(80).reshape(4, 20) * np.pi / 5
    >>> current = envelope(5e-3 * np.cos(phase), phase)
    >>> force, open_loop = estimator.run(10e3 * current, current, np.zeros(4), state)
    >>> open_loop.all()
    np.True_
    """

    rate: float
    carrier_frequency: float
    series_impedance: complex
    open_loop_gain: float
    bandwidth: float = 1500.0
    smoothing: float = 5e-3
    body_resistance: float = 1e3
    unevenness: float = 1.0
    least_speed: float = 1e-3
    least_share: float = 0.5

    def __post_init__(self) -> None:
        require_positive(
            rate=self.rate,
            carrier_frequency=self.carrier_frequency,
            open_loop_gain=self.open_loop_gain,
            least_speed=self.least_speed,
            smoothing=self.smoothing,
        )
        for name, least, most, bound in (
            ("smoothing", 1 / self.rate, math.inf, f">= {1 / self.rate:g} s"),
            ("body_resistance", 0.0, math.inf, ">= 0 ohm"),
            ("unevenness", 1.0, math.inf, ">= 1"),
            ("least_share", 0.0, 1.0, ">= 0 and <= 1"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                raise ValueError(f"{name} = {value!r}: must be {bound}")
        if not 0.0 < abs(self.series_impedance) < math.inf:
            raise ValueError(f"series_impedance = {self.series_impedance!r}: must be finite and not 0 ohm m2")
        _ = self.low_pass  # refuses a bad bandwidth

    @property
    def low_pass(self) -> StarSTDFT:
        """The STDFT* of both envelopes."""
        return StarSTDFT(bandwidth=self.bandwidth, rate=self.rate)

    @property
    def delay(self) -> float:
        """Group delay of a slow force, s."""
        return self.low_pass.delay

    def frequency_response(self, frequency: Any) -> Any:
        """Estimated force per force (complex) at `frequency` (Hz), for a small change of |I|^2."""
        return self.low_pass.frequency_response(frequency)

    def start(self) -> Array:
        """Return the state of an estimator that has measured nothing, a record of shape (1,)."""
        b, a = self.low_pass.coefficients
        return new_record(
            GAP,
            self,
            b=b,
            a=a[1:],
            retention=math.exp(-1.0 / (self.smoothing * self.rate)),
            settling=math.ceil(SETTLING * self.rate / (2 * math.pi * self.bandwidth)),
            series=abs(self.series_impedance),
            force=self.unevenness / (4 * (2 * math.pi * self.carrier_frequency) ** 2 * VACUUM),
            contact=LIFTED,
        )

    def run(self, voltage: Array, current: Array, speed: Array, state: Array | None = None) -> tuple[Array, Array]:
        """Estimate the attraction of n samples.

        Parameters
        ----------
        voltage, current : ndarray of complex, shape (n,), V and A
            Envelopes at the carrier; the modulus is the amplitude.  Non-finite values count as zero.
        speed : ndarray, shape (n,), m/s
            Of the finger, NaN while it is lifted.
        state : ndarray, optional
            From `start`; changed in place, so that a run continues the one before.  By default a new one.

        Returns
        -------
        force : ndarray, shape (n,), N
        open_loop : ndarray of bool, shape (n,)
            Whether the force is that of a nominal finger, because the gap could not be measured.
        """
        n = len(speed)
        force, open_loop = np.zeros(n), np.zeros(n, bool)
        voltage, current = (np.ascontiguousarray(np.broadcast_to(each, n), complex) for each in (voltage, current))
        record = self.start() if state is None else state
        _gap_run(record, voltage, current, np.ascontiguousarray(speed, float), force, open_loop)
        return force, open_loop


@kernel
def gap_step(g, voltage, current, speed):
    """Attraction (N) from a sample of both envelopes (V, A), and whether the gap could not be measured.

    `g` is a record of `GAP`; `speed` (m/s) is NaN while the finger is lifted.
    """
    x, w = g.envelope, g.filters
    x[0], x[1] = voltage, current
    for i in range(2):  # transposed direct form II
        u = x[i]
        if not (math.isfinite(u.real) and math.isfinite(u.imag)):
            u = 0j
        x[i] = g.b[0] * u + w[i, 0]
        w[i, 0] = g.b[1] * u - g.a[0] * x[i] + w[i, 1]
        w[i, 1] = g.b[2] * u - g.a[1] * x[i]
    power = x[1].real * x[1].real + x[1].imag * x[1].imag
    if math.isnan(speed):
        g.contact = LIFTED
        g.area = g.share = 0.0
        return g.open_loop_gain * power, True
    contact = MOVING if abs(speed) >= g.least_speed else RESTING
    if contact != g.contact:
        g.contact, g.waiting, g.cross, g.power = contact, g.settling, 0j, 0.0
    if g.waiting > 0:
        g.waiting -= 1
    else:
        g.cross = g.retention * g.cross + x[0] * x[1].conjugate()
        g.power = g.retention * g.power + power
        if g.power > 0.0:
            impedance = g.cross * (1.0 / g.power)
            gap = impedance - g.static
            if contact == RESTING:
                g.static, g.area = impedance, g.series / abs(impedance - g.body_resistance)
            elif g.area > 0.0:
                g.share = gap.imag * gap.imag / (gap.real * gap.real + gap.imag * gap.imag) if gap.imag < 0.0 else 0.0
    if contact == MOVING and g.area > 0.0 and g.share > g.least_share:
        return g.force * power * g.share / g.area, False
    return g.open_loop_gain * power, True


@kernel
def _gap_run(record, voltage, current, speed, force, open_loop):
    for n in range(speed.shape[0]):
        force[n], open_loop[n] = gap_step(record[0], voltage[n], current[n], speed[n])
