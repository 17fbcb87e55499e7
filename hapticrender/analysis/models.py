"""Fit finger models to measured impedances: order, and parameters with intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, log, nan, sqrt
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtrc, ndtri

from hapticrender.analysis.records import FingerRecord, Impedance
from hapticrender.checks import require
from hapticrender.protocols import Array
from hapticrender.touch.mechanics import HEAVY, LIGHT, LIGHT_BELOW, PARTS, FingerMechanics

APART = 0.01  # two carriers, or two loads, count as different if they differ by more than this, relatively
BAND = 0.05  # relative width of a bin of frequencies
Source = FingerRecord | Impedance
Loads = tuple[float, float]  # N: least, and largest, which is excluded
LOAD_CLASSES: Mapping[str, Loads] = {"light": (0.0, LIGHT_BELOW), "heavy": (LIGHT_BELOW, inf)}  # N
FEWEST = {2: 2, 4: 4}  # carriers by order: two numbers each, for three or six parameters and the exponent
UNITS = {  # of the fit's parameters, which are then near 1: g, N s/m, N/mm
    "mass": 1e-3, "damping": 1.0, "stiffness": 1e3, "phalanx_mass": 1e-3, "phalanx_damping": 1.0,
    "phalanx_stiffness": 1e3, "load_exponent": 1.0,
}  # fmt: skip
MOST = dict(zip(UNITS, (1.0, 1e4, 1e6, 1.0, 1e4, 1e6, 10.0), strict=True))  # bounds of FingerMechanics
MOST_STEPS = 100  # of a search; without a skin in the data its stiffness would grow for ever
_STIFF_SKIN = (0.1, 20.0, 40.0)  # in these units: hardly a skin


def parts_of(impedance: Source | Sequence[Source]) -> list[Source]:
    """List of the recordings, of which one may stand alone."""
    parts = [impedance] if isinstance(impedance, FingerRecord | Impedance) else impedance
    good = isinstance(parts, Sequence) and all(isinstance(each, FingerRecord | Impedance) for each in parts)
    require(good, "impedance", impedance, "what analyse_finger returns, an Impedance, or a list of them", TypeError)
    return list(parts)


class Samples(NamedTuple):
    """Unmasked entries of impedances, one row each."""

    frequency: Array  # Hz
    value: Array  # N s/m, complex
    standard_error: Array  # N s/m
    load: Array  # N
    source: Array  # which of the recordings

    @classmethod
    def of(cls, impedance: Source | Sequence[Source], loads: tuple[float, float] = (0.0, inf)) -> Self:
        """Unmasked entries with a load (N) from the first of `loads` to below the second, and above 0."""
        rising = np.shape(loads) == (2,) and loads[0] < loads[1]
        require(rising, "loads", loads, "two loads in N, the least and a larger one")
        parts = [each.impedance if isinstance(each, FingerRecord) else each for each in parts_of(impedance)]
        rows = [
            np.broadcast_arrays(each.frequency, each.value, each.standard_error, each.normal_load[:, None], number)
            for number, each in enumerate(parts)
        ]
        columns = [np.concatenate([np.ravel(column) for column in same]) for same in zip(*rows, strict=True)]
        found = cls(*(columns or [np.empty(0)] * 5))
        good = np.isfinite(found.frequency) & np.isfinite(found.value) & np.isfinite(found.standard_error)
        with np.errstate(invalid="ignore"):
            good &= (found.frequency > 0) & (found.load > 0) & (found.load >= loads[0]) & (found.load < loads[1])
        found = cls(*(column[good] for column in found))
        least = found.standard_error.min(initial=inf)
        require(bool(least > 0), "standard_error", float(least), "> 0 N s/m: mask (NaN) what was not measured")
        return found

    def by_frequency(self) -> list[Self]:
        """Split into bins of 5 % of frequency, by rising frequency."""
        bins = np.rint(np.log(self.frequency) / BAND).astype(int)
        return [type(self)(*(column[bins == at] for column in self)) for at in np.unique(bins)]

    @property
    def carriers(self) -> int:
        """Number of frequencies that differ by more than 1 %."""
        return len(self.frequency[:1]) + int((np.diff(np.log(np.sort(self.frequency))) > APART).sum())

    @property
    def loads_differ(self) -> bool:
        """Whether growth with the load is in the data."""
        return bool(self.load.size and np.ptp(np.log(self.load)) >= APART)


def weighted_mean(value: Array, standard_error: Array) -> tuple[complex, float]:
    """Mean of complex values weighted by their standard errors, and its own, enlarged where the values scatter more."""
    weight = standard_error**-2.0
    mean = complex(np.average(value, weights=weight))
    scatter = float(np.sum(np.abs(value - mean) ** 2 * weight)) / max(2 * len(value) - 2, 1)
    return mean, (max(1.0, scatter) / float(weight.sum())) ** 0.5


@dataclass(frozen=True)
class FingerFit:
    """A finger model fitted to measured impedances.

    `mechanics` is the finger at its `reference_load`, the geometric mean of the loads, for
    ``hr.Finger(mechanics=...)``; `load_exponent` is n in ``|Z| ~ (W/reference_load)**n``, one for all frequencies, 0
    where the loads do not differ.  `names` are the fitted parameters: fields of `mechanics`, then "load_exponent" if it
    was fitted; `covariance`, (p, p) in their order, is that in SI units, times
    ``max(1, chi_square/degrees_of_freedom)``.  `chi_square` is the sum of squares of real and imaginary residuals, each
    over its standard error, `degrees_of_freedom` the count of real numbers measured minus that of parameters fitted,
    `loads` least and largest load in the data (N).  `bic_margin` is by how much the Bayesian information criterion
    prefers this order to the other; NaN where the order was given, or the data are too few for the other.

    Notes
    -----
    Intervals hold for a model that explains the data (see `p_value`), and for small errors, in which it is linear:
    where the data hardly separate the skin's stiffness from the phalanx (standard error above half of it), the phalanx
    may be off by more.
    """

    mechanics: FingerMechanics
    load_exponent: float
    names: tuple[str, ...]
    covariance: Array
    chi_square: float
    degrees_of_freedom: int
    loads: tuple[float, float]
    bic_margin: float = nan

    @property
    def order(self) -> int:
        """2 or 4."""
        return self.mechanics.order

    @property
    def values(self) -> dict[str, float]:
        """Fitted parameters by name (SI)."""
        return {name: float(self._all()[name]) for name in self.names}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name (SI)."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square if the model and the stated errors are right; below 0.01: they are not."""
        return float(chdtrc(self.degrees_of_freedom, self.chi_square)) if self.degrees_of_freedom else nan

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of a parameter (SI) at a `level` between 0 and 1; not below 0 but for the exponent."""
        require(name in self.names, "name", name, f"one of {', '.join(self.names)}")
        require(0 < level < 1, "level", level, "> 0 and < 1")
        value, half = self.values[name], float(ndtri(0.5 + level / 2)) * self.standard_errors[name]
        return (value - half if name == "load_exponent" else max(value - half, 0.0)), value + half

    def impedance(self, frequency: Array, normal_load: float | None = None) -> Array:
        """Z_f of the model (complex, N s/m) at `frequency` (Hz) and a load (N); None: the reference load."""
        return _impedance(self._all(), np.asarray(frequency, float), normal_load)

    def relative_error(self, frequency: Array, normal_load: float | None = None) -> Array:
        """Standard error of ln Z_f, as a complex number: of ln |Z_f| (real part) and of the phase (rad, imaginary)."""
        frequency, all_values = np.asarray(frequency, float), self._all()
        whole, gradient = self.impedance(frequency, normal_load), []
        for name in self.names:
            step = 1e-6 * max(all_values[name], 1e-3 * UNITS[name])
            moved = all_values | {name: all_values[name] + step}
            gradient.append((_impedance(moved, frequency, normal_load) / whole - 1) / step)
        slope = np.array(gradient)
        real, imaginary = (np.einsum("if,ij,jf->f", part, self.covariance, part) for part in (slope.real, slope.imag))
        return np.sqrt(np.maximum(real, 0)) + 1j * np.sqrt(np.maximum(imaginary, 0))

    def _all(self) -> dict[str, Any]:
        """Every number of the model by name."""
        return vars(self.mechanics) | {"load_exponent": self.load_exponent}


def fit_finger(
    impedance: Source | Sequence[Source], order: int | None = None, *, loads: tuple[float, float] = (0.0, inf)
) -> FingerFit:
    """Fit a finger of 2nd or 4th order to measured impedances by weighted complex least squares.

    Parameters
    ----------
    impedance : FingerRecord, Impedance, or a sequence of them
        As measured, in one or several recordings; masked entries (NaN) are left out, a standard error of 0 is a
        ValueError.  All errors of an Impedance count as independent; those of a FingerRecord are in part shared, see
        the notes.
    order : {2, 4} or None
        None takes the order that the data support: the 4th where the Bayesian information criterion is smaller.  A
        ValueError where there are too few different carriers (2 for the 2nd order, 4 for the 4th).
    loads : (float, float), N
        The class of loads: least (included) and largest (excluded).

    Notes
    -----
    Minimises ``chi^2 = sum |Z_f(f_i) (W_i/W_ref)^n - Z_i|^2/sigma_i^2`` over the parameters, which are >= 0; Z_f is
    that of `FingerMechanics`.  Errors of the load are neglected: where they are a share e of the spread of ln W, n is
    too small by e^2.  The 2nd order is the limit of the 4th for a stiff skin, so that the difference of chi^2 between
    them is at most that of 3 more parameters; both are divided by ``max(1, chi^2/degrees of freedom)`` of the 4th (as
    an F test does), so that errors which were stated too small do not call for more parameters.

    All windows of a recording share the errors of the plate's own mass, damping and stiffness, which no number of
    windows averages: ``dZ = j w dm + db + dk/(j w)``.  Their standard deviations are those of the record's plate, at
    most ``min sqrt(2) sigma_i/w_i`` (for the mass: just this), ``min sqrt(2) sigma_i`` and ``min sqrt(2) sigma_i w_i``,
    what the impedance's errors have room for.  They are fitted as well, with these as the prior.

    References
    ----------
    Grigorii et al. 2021, Table 1 and Fig. 9; Schwarz: Estimating the dimension of a model, 1978.

    Examples
    --------
    >>> from hapticrender.analysis.records import Impedance
    >>> f, n = np.array([20.0, 47.0, 111.0, 261.0]), 5
    >>> truth = FingerMechanics(order=2, mass=4e-3, damping=1.0, stiffness=200.0)
    >>> ones, row = np.ones((n, len(f))), np.ones(n)
    >>> data = Impedance(np.arange(n), f * ones, truth.impedance(f) * ones, 0.05 * ones, 0.3 * row, 0 * row)
    >>> fit = fit_finger(data)
    >>> fit.order, round(fit.mechanics.stiffness), round(fit.standard_errors["stiffness"], 1)
    (2, 200, 2.6)
    """
    require(order in (None, 2, 4), "order", order, "2, 4 or None")
    samples = Samples.of(impedance, loads)
    found, fewest = samples.carriers, FEWEST[order or 2]
    if found < fewest:
        raise ValueError(
            f"impedance: {found} different carriers with data at loads from {loads[0]:g} to {loads[1]:g} N, a "
            f"finger of order {order or 2} needs at least {fewest}: record more frequencies, or widen the loads"
        )
    patterns = _plate_patterns(impedance, samples)
    second = _fit(samples, patterns, 2)
    if order == 2 or (order is None and found < FEWEST[4]):
        return second
    fourth = _fit(samples, patterns, 4, second)
    if order == 4:
        return fourth
    size = fourth.degrees_of_freedom + len(fourth.names)
    scatter = max(1.0, fourth.chi_square / max(fourth.degrees_of_freedom, 1))
    gain = (second.chi_square - fourth.chi_square) / scatter - 3 * log(size)
    return replace(fourth, bic_margin=gain) if gain > 0 else replace(second, bic_margin=-gain)


def _impedance(numbers: Mapping[str, Any], frequency: Array, normal_load: float | Array | None) -> Array:
    """Z_f (N s/m) of a model given by its numbers, times its growth with the load."""
    fields = dict(numbers)
    exponent = fields.pop("load_exponent")
    whole = FingerMechanics(**fields).impedance(frequency)
    return whole if normal_load is None else whole * (normal_load / fields["reference_load"]) ** exponent


def _plate_patterns(impedance: Source | Sequence[Source], samples: Samples) -> Array:
    """Errors of the samples (N s/m, (n, 3 a recording)) by one standard error of each number of the plate."""
    w, columns = 2 * np.pi * samples.frequency, []
    for number, each in enumerate(parts_of(impedance)):
        own = samples.source == number
        if isinstance(each, FingerRecord) and own.any():
            side = {name: error.mean() for name, error in each.plate.standard_errors.items()}
            both = (np.hypot(side[f"{name}_1"], side[f"{name}_2"]) for name in ("damping", "stiffness"))
            known = [inf, *both]  # of mass (kg), damping (N s/m), stiffness (N/m)
            room = [sqrt(2) * (samples.standard_error * factor)[own].min() for factor in (1 / w, 1.0, w)]
            mass, damping, stiffness = np.minimum(known, room)
            columns += [1j * w * mass * own, damping * own, stiffness / (1j * w) * own]
    return np.array(columns).reshape(-1, len(w)).T


def _fit(samples: Samples, patterns: Array, order: int, second: FingerFit | None = None) -> FingerFit:
    """Fit one order, from several starts where it is the 4th, and the errors of the plates on the way."""
    names, logs = PARTS[: 3 * order // 2], np.log(samples.load)
    fixed = {"order": order, "reference_load": float(np.exp(logs.mean())), "load_exponent": 0.0}
    if samples.loads_differ:
        names = (*names, "load_exponent")
    units, weight, count = np.array([UNITS[name] for name in names]), 1 / samples.standard_error, len(names)

    def residual(x: Array) -> Array:
        numbers = fixed | dict(zip(names, (x[:count] * units).tolist(), strict=True))
        model = _impedance(numbers, samples.frequency, samples.load) + patterns @ x[count:]
        off = (model - samples.value) * weight
        return np.concatenate([off.real, off.imag, x[count:]])

    most = np.array([MOST[name] for name in names]) / units
    least = np.where(np.array(names) == "load_exponent", -10.0, 0.0)
    free = np.full(patterns.shape[1], np.inf)
    bounds = np.r_[least, -free], np.r_[most, free]
    settings: Any = {"bounds": bounds, "x_scale": "jac", "ftol": 1e-6, "max_nfev": MOST_STEPS}
    with np.errstate(under="ignore"):  # the solver's own step from a bound of 0
        starts = [np.clip(start[:count], least + 1e-6, most) for start in _starts(samples, second)]
        searches = (least_squares(residual, np.r_[start, np.zeros_like(free)], **settings) for start in starts)
        best = min(searches, key=lambda each: each.cost)
    numbers = fixed | dict(zip(names, (best.x[:count] * units).tolist(), strict=True))
    growth, chi_square, freedom = numbers.pop("load_exponent"), 2 * float(best.cost), best.fun.size - best.x.size
    _, size, right = np.linalg.svd(best.jac, full_matrices=False)
    spread = right.T / np.maximum(size, 1e-12 * size[0])  # a direction without data: beyond every bound, not 0
    covariance = (spread @ spread.T)[:count, :count] * np.outer(units, units) * max(1.0, chi_square / max(freedom, 1))
    reach = float(samples.load.min()), float(samples.load.max())
    return FingerFit(FingerMechanics(**numbers), growth, names, covariance, chi_square, freedom, reach)


def _starts(samples: Samples, second: FingerFit | None) -> list[Array]:
    """Where the search begins, in the fit's units.

    The 2nd order: at its linear solution; the 4th: at both fingers of Table 1, and at the 2nd order behind a stiff
    skin, so that it fits no worse.
    """
    if second is not None:
        units = np.array([UNITS[name] for name in PARTS])
        whole = [getattr(second.mechanics, name) / UNITS[name] for name in PARTS[:3]]
        table = [[getattr(each, name) for name in PARTS] / units for each in (LIGHT, HEAVY)]
        return [np.append(each, 0.0) for each in (*table, [*_STIFF_SKIN, *whole])]
    w, weight = 2e-3 * np.pi * samples.frequency, 1 / samples.standard_error
    zero = np.zeros_like(w)
    real, imaginary = np.column_stack([zero, weight, zero]), np.column_stack([w * weight, zero, -weight / w])
    matrix = np.vstack([real, imaginary])
    right = np.concatenate([samples.value.real, samples.value.imag]) * np.tile(weight, 2)
    return [np.append(np.linalg.lstsq(matrix, right, rcond=None)[0], 0.0)]
