"""Attraction of an electroadhesive finger, read from the impedance of its gap at the carrier.

With the complex envelopes V and I of voltage and current at the carrier, both low-passed by the STDFT* of `stdft`::

    Z = V/I,  Z_stat = Z while |v| < least_speed: the gap is shorted
    A = |z_series|/|Z_stat - R_body|
    Z_g = Z - Z_stat = 1/(G + j w C)                    while sliding
    L = (w C)^2/((w C)^2 + G^2) = Im(Z_g)^2/|Z_g|^2
    F = kappa |I|^2 L/(4 w^2 eps0 A)

The area changes with the load and only a resting finger shows it: 10 % of area are 11 % of force, and so is 1 us
between the two channels some 10 %, for it turns Z.  The force itself follows |I|^2 at once; only the impedance is
averaged for long, weighed by power, so that an envelope may pass through zero.

A finger that is away, that rests, that was never seen at rest, or whose gap leaks so much that L falls below a bound,
is not sensed: it counts as F = g |I|^2, what a loop expects to see, so that nothing winds up on it, and the flag
`OPEN_LOOP` says so.  While the finger is away I is the current that the source is asked for.

References
----------
Shultz, Peshkin, Colgate 2018 (the sliding gap's impedance); Sun, Guo, Sun 2022 (a slow relative of the estimate).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.control.kernels import Section, biquad_step
from hapticrender.control.stdft import StarSTDFT
from hapticrender.control.transfer import require_positive
from hapticrender.protocols import Array

VACUUM = 8.8541878128e-12  # F/m
LIFTED, RESTING, SLIDING = -1.0, 0.0, 1.0  # what the finger does
CROSS_RE, CROSS_IM, POWER = range(3)  # entries of GapState.sums
STATIC_RE, STATIC_IM, AREA, SHARE = range(4)  # entries of GapState.known
DOING, SETTLING = range(2)  # entries of GapState.mode
SETTLED = 5.0  # time constants of the low pass, over 2 pi, that an impedance is not believed after a change


class GapTables(NamedTuple):
    """Numbers of the compiled estimator."""

    section: Section  # of the STDFT*
    kept: float  # of the sums, a sample
    settling: float  # samples that the low pass needs
    body_resistance: float  # ohm
    series: float  # ohm m2: modulus of what lies in series with the gap
    force: float  # kappa/(4 w^2 eps0), N m2/A^2
    least_speed: float  # m/s
    least_share: float
    open_loop_gain: float  # N/A^2


class GapState(NamedTuple):
    """State of the estimator; changed in place."""

    filters: Array  # (4, 2) of V and I, real and imaginary part
    envelope: Array  # (4,) V and I, low-passed
    sums: Array  # (3,) averages of V conj(I) and of |I|^2
    known: Array  # (4,) Z_stat (ohm), A (m2; 0: not seen yet), L (0: not seen yet)
    mode: Array  # (2,) what the finger does, samples until the low pass has settled


@dataclass(frozen=True, kw_only=True)
class GapEstimator:
    """Design of the estimator.

    Parameters
    ----------
    rate : float, Hz
        Of the envelopes, > 0.
    carrier_frequency : float, Hz
        > 0.
    series_impedance : complex, ohm m2
        Insulator and stratum corneum at the carrier, per area; not 0.
    open_loop_gain : float, N/A^2
        g for a finger that cannot be sensed, > 0.
    bandwidth : float, Hz
        Of the STDFT*, > 0 and < rate/2.
    smoothing : float, s
        Time constant over which the impedance is averaged, at least a sample.
    body_resistance : float, ohm
        >= 0.
    unevenness : float
        kappa = <d^-2>/<d^-1>^2 of the gap, >= 1.
    least_speed : float, m/s
        Slower than this a finger rests, > 0.
    least_share : float
        Bound of L, 0 to 1: a gap that leaks more is not sensed.

    Notes
    -----
    `frequency_response` and `delay` are those of a small change of |I|^2 around a level.
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
        for name, least, most, unit in (
            ("smoothing", 1 / self.rate, math.inf, "s"),
            ("body_resistance", 0.0, math.inf, "ohm"),
            ("unevenness", 1.0, math.inf, ""),
            ("least_share", 0.0, 1.0, ""),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                bound = f">= {least:g}" + (f" and <= {most:g}" if most < math.inf else "")
                raise ValueError(f"{name} = {value!r}: must be {bound} {unit}".rstrip())
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

    @property
    def tables(self) -> GapTables:
        """Numbers of the compiled estimator."""
        b, a = self.low_pass.coefficients
        return GapTables(
            section=(float(b[0]), float(b[1]), float(b[2]), float(a[1]), float(a[2])),
            kept=math.exp(-1.0 / (self.smoothing * self.rate)),
            settling=float(math.ceil(SETTLED * self.rate / (2 * math.pi * self.bandwidth))),
            body_resistance=float(self.body_resistance),
            series=abs(self.series_impedance),
            force=self.unevenness / (4 * (2 * math.pi * self.carrier_frequency) ** 2 * VACUUM),
            least_speed=float(self.least_speed),
            least_share=float(self.least_share),
            open_loop_gain=float(self.open_loop_gain),
        )

    def run(self, voltage: Array, current: Array, speed: Array) -> tuple[Array, Array]:
        """Estimate a force from the start on.

        Parameters
        ----------
        voltage, current : ndarray of complex, shape (n,), V and A
            Envelopes at the carrier, amplitude being the modulus.
        speed : ndarray, shape (n,), m/s
            Of the finger, NaN while it is lifted.

        Returns
        -------
        force : ndarray, shape (n,), N
        open_loop : ndarray of bool, shape (n,)
        """
        envelopes = [np.asarray(part, float) for each in (voltage, current) for part in (np.real(each), np.imag(each))]
        force, open_loop = np.zeros(len(speed)), np.zeros(len(speed), bool)
        _gap_run(self.tables, gap_state(), np.stack(envelopes, axis=1), np.asarray(speed, float), force, open_loop)
        return force, open_loop


def gap_state() -> GapState:
    """An estimator that has seen nothing."""
    return GapState(np.zeros((4, 2)), np.zeros(4), np.zeros(3), np.zeros(4), np.array([LIFTED, 0.0]))


@kernel
def _average(tables, state, doing):
    """Average V conj(I) and |I|^2 afresh whenever the finger does something else; whether they are known."""
    sums, mode, x = state.sums, state.mode, state.envelope
    if doing != mode[DOING]:
        mode[DOING], mode[SETTLING] = doing, tables.settling
        sums[CROSS_RE] = sums[CROSS_IM] = sums[POWER] = 0.0
    if mode[SETTLING] > 0.0:
        mode[SETTLING] -= 1.0
        return False
    power = x[2] * x[2] + x[3] * x[3]
    sums[CROSS_RE] = tables.kept * sums[CROSS_RE] + x[0] * x[2] + x[1] * x[3]
    sums[CROSS_IM] = tables.kept * sums[CROSS_IM] + x[1] * x[2] - x[0] * x[3]
    sums[POWER] = tables.kept * sums[POWER] + power
    return sums[POWER] > 0.0


@kernel
def _learn(tables, state, doing):
    """Learn Z_stat and A of a finger that rests, L of one that slides."""
    known, sums = state.known, state.sums
    re, im = sums[CROSS_RE] / sums[POWER], sums[CROSS_IM] / sums[POWER]
    if doing == RESTING:
        known[STATIC_RE], known[STATIC_IM] = re, im
        known[AREA] = tables.series / math.hypot(re - tables.body_resistance, im)
    elif known[AREA] > 0.0:
        re, im = re - known[STATIC_RE], im - known[STATIC_IM]
        known[SHARE] = im * im / (re * re + im * im) if im < 0.0 else 0.0


@kernel
def gap_step(tables, state, voltage_re, voltage_im, current_re, current_im, speed):
    """Attraction (N) and whether it had to be taken open loop, from one sample of envelopes; junk counts as zero."""
    x, known = state.envelope, state.known
    x[0], x[1], x[2], x[3] = voltage_re, voltage_im, current_re, current_im
    for i in range(4):
        w, value = state.filters[i], x[i]
        if not math.isfinite(value):
            value = 0.0
        x[i], w[0], w[1] = biquad_step(tables.section, w[0], w[1], value)
    power = x[2] * x[2] + x[3] * x[3]
    if math.isnan(speed):
        state.mode[DOING] = LIFTED
        known[AREA] = known[SHARE] = 0.0
        return tables.open_loop_gain * power, True
    doing = SLIDING if abs(speed) >= tables.least_speed else RESTING
    if _average(tables, state, doing):
        _learn(tables, state, doing)
    if doing == SLIDING and known[AREA] > 0.0 and known[SHARE] > tables.least_share:
        return tables.force * power * known[SHARE] / known[AREA], False
    return tables.open_loop_gain * power, True


@kernel
def _gap_run(tables, state, envelopes, speed, force, open_loop):
    for n in range(speed.shape[0]):
        x = envelopes[n]
        force[n], open_loop[n] = gap_step(tables, state, x[0], x[1], x[2], x[3], speed[n])
