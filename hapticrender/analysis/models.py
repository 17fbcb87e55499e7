"""Fit finger models to measured impedances: order, parameters with intervals, growth with the normal load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, log, nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender.analysis.records import FingerRecord, Impedance
from hapticrender.checks import require
from hapticrender.protocols import Array
from hapticrender.touch.mechanics import HEAVY, LIGHT, LIGHT_BELOW, FingerMechanics

LOAD_CLASSES: Mapping[str, tuple[float, float]] = {"light": (0.0, LIGHT_BELOW), "heavy": (LIGHT_BELOW, inf)}  # N
APART = 0.01  # two carriers, or two loads, count as different if they differ by more than this, relatively
BAND = 0.05  # relative width of a bin of frequencies in which |Z| is compared over the load
FEWEST = {2: 2, 4: 4}  # different carriers for a model of this order: one more complex number than unknown pairs, if 4
NAMES = ("mass", "damping", "stiffness", "phalanx_mass", "phalanx_damping", "phalanx_stiffness")
_UNITS = np.array([1e-3, 1.0, 1e3, 1e-3, 1.0, 1e3])  # g, N s/m, N/mm: the fit's parameters are then near 1
_MOST = np.array([1.0, 1e4, 1e6, 1.0, 1e4, 1e6]) / _UNITS  # bounds of FingerMechanics
MOST_STEPS = 100  # of a search; without a skin in the data its stiffness would grow for ever
_STIFF_SKIN = (0.1, 20.0, 40.0)  # in these units: hardly a skin


Source = FingerRecord | Impedance


class Samples(NamedTuple):
    """Unmasked entries of impedances, one row each."""

    frequency: Array  # Hz
    value: Array  # N s/m, complex
    standard_error: Array  # N s/m
    load: Array  # N
    source: Array  # which of the recordings


@dataclass(frozen=True)
class FingerFit:
    """A finger model fitted to measured impedances.

    Parameters
    ----------
    mechanics : FingerMechanics
        The finger at its `reference_load`, the geometric mean of the loads; for ``hr.Finger(mechanics=...)``.
    load_exponent : float
        n in ``|Z| ~ (W/reference_load)**n``, one for all frequencies; 0 where the loads do not differ.
    names : tuple of str
        Fitted parameters, in the order of `covariance`: fields of `mechanics`, then "load_exponent" if it was fitted.
    covariance : ndarray, shape (p, p)
        Of the parameters in SI units, times ``max(1, chi_square/degrees_of_freedom)``.
    chi_square : float
        Sum of squares of real and imaginary residuals, each over its standard error.
    degrees_of_freedom : int
        Real numbers measured minus parameters fitted.
    loads : (float, float)
        Least and largest load in the data (N).
    bic_margin : float
        By how much the Bayesian information criterion prefers this order to the other; NaN where the order was given,
        or the data are too few for the other.

    Notes
    -----
    Intervals hold for a model that explains the data (see `p_value`).
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
        from scipy.special import chdtrc

        return float(chdtrc(self.degrees_of_freedom, self.chi_square)) if self.degrees_of_freedom else nan

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of a parameter (SI) at a `level` between 0 and 1; not below 0 but for the exponent."""
        from scipy.special import ndtri

        require(name in self.names, "name", name, f"one of {', '.join(self.names)}")
        require(0 < level < 1, "level", level, "> 0 and < 1")
        value, half = self.values[name], float(ndtri(0.5 + level / 2)) * self.standard_errors[name]
        return (value - half if name == "load_exponent" else max(value - half, 0.0)), value + half

    def impedance(self, frequency: Array, normal_load: float | None = None) -> Array:
        """Z_f of the model (complex, N s/m) at `frequency` (Hz) and a load (N); None: the reference load."""
        return _impedance(self._all(), np.asarray(frequency, float), normal_load)

    def relative_error(self, frequency: Array, normal_load: float | None = None) -> Array:
        """Standard error of ln Z_f, as a complex number: of ln |Z_f| (real part) and of the phase (rad, imaginary)."""
        frequency = np.asarray(frequency, float)
        whole, gradient = self.impedance(frequency, normal_load), []
        for name in self.names:
            step = 1e-6 * max(self.values[name], 1e-3 * _unit(name))
            moved = self._all() | {name: self.values[name] + step}
            gradient.append((_impedance(moved, frequency, normal_load) / whole - 1) / step)
        slope = np.array(gradient)
        real, imaginary = (np.einsum("if,ij,jf->f", part, self.covariance, part) for part in (slope.real, slope.imag))
        return np.sqrt(np.maximum(real, 0)) + 1j * np.sqrt(np.maximum(imaginary, 0))

    def _all(self) -> dict[str, Any]:
        """Every number of the model by name."""
        fields = {name: getattr(self.mechanics, name) for name in ("order", *NAMES, "reference_load")}
        return fields | {"load_exponent": self.load_exponent}


@dataclass(frozen=True)
class LoadLaw:
    """Growth of the impedance with the load, ``|Z_f| = magnitude (W/reference_load)**exponent``, per frequency.

    Parameters
    ----------
    frequency : ndarray, shape (bands,)
        Median of each band (Hz), rising.
    exponent, standard_error : ndarray, shape (bands,)
        n and its standard error; NaN where fewer than 3 windows are above their noise, or the loads differ by
        less than 1 %.
    magnitude : ndarray, shape (bands,)
        |Z_f| at the reference load (N s/m).
    reference_load : ndarray, shape (bands,)
        Geometric mean of the loads (N).
    determination : ndarray, shape (bands,)
        Squared correlation of |Z_f| and W.
    count : ndarray of int, shape (bands,)
        Windows in each band.
    """

    frequency: Array
    exponent: Array
    standard_error: Array
    magnitude: Array
    reference_load: Array
    determination: Array
    count: Array


def fit_finger(
    impedance: Source | Sequence[Source],
    order: int | None = None,
    *,
    loads: tuple[float, float] = (0.0, inf),
    load_exponent: float | None = None,
) -> FingerFit:
    """Fit a finger of 2nd or 4th order to measured impedances by weighted complex least squares.

    Parameters
    ----------
    impedance : FingerRecord, Impedance, or a sequence of them
        As measured, in one or several recordings; masked entries (NaN) are left out.  All errors of an Impedance count
        as independent; those of a FingerRecord are in part shared, see the notes.
    order : {2, 4} or None
        None takes the order that the data support: the 4th where the Bayesian information criterion is smaller.
    loads : (float, float), N
        The class of loads: least (included) and largest (excluded).
    load_exponent : float or None
        Growth of |Z_f| with the load inside the class; None fits it, 0 takes the finger as the same at all loads.

    Returns
    -------
    FingerFit

    Raises
    ------
    ValueError
        Too few different carriers (2 for the 2nd order, 4 for the 4th), or a standard error of 0.

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
    what the impedance's errors have room for.  They add to the covariance of the samples: ``r^T (S + G G^T)^-1 r``.

    References
    ----------
    Grigorii et al. 2021, Table 1 and Fig. 9; Schwarz: Estimating the dimension of a model, 1978.

    Examples
    --------
    >>> f, n = np.array([20.0, 47.0, 111.0, 261.0]), 5
    >>> truth = FingerMechanics(order=2, mass=4e-3, damping=1.0, stiffness=200.0)
    >>> ones, row = np.ones((n, len(f))), np.ones(n)
    >>> data = Impedance(np.arange(n), f * ones, truth.impedance(f) * ones, 0.05 * ones, 0.3 * row, 0 * row)
    >>> fit = fit_finger(data)
    >>> fit.order, round(fit.mechanics.stiffness), round(fit.standard_errors["stiffness"], 1)
    (2, 200, 2.6)
    """
    require(order in (None, 2, 4), "order", order, "2, 4 or None")
    samples = samples_of(impedance, loads)
    _check_enough(samples, order or 2, loads)
    shared = _shared_errors(impedance, samples)
    second = _fit(samples, shared, 2, load_exponent)
    if order == 2 or (order is None and _carriers(samples) < FEWEST[4]):
        return second
    fourth = _fit(samples, shared, 4, load_exponent, second)
    return fourth if order == 4 else _supported(second, fourth)


def fit_load_classes(
    impedance: Source | Sequence[Source],
    classes: Mapping[str, tuple[float, float]] = LOAD_CLASSES,
    *,
    order: int | None = None,
) -> dict[str, FingerFit]:
    """Fit a finger to every class of loads, as `fit_finger`, by name; a class with too few data is left out.

    `classes` holds least and largest load (N) by name: below and above 0.5 N, as in Table 1 of Grigorii et al. 2021.
    """
    fewest = FEWEST[order or 2]
    return {
        name: fit_finger(impedance, order, loads=loads)
        for name, loads in classes.items()
        if _carriers(samples_of(impedance, loads)) >= fewest
    }


def load_exponent(impedance: Source | Sequence[Source]) -> LoadLaw:
    """Fit ``|Z_f| ~ W**n`` at every frequency (bins of 5 %), weighted by the standard errors.

    The standard error of n is enlarged by ``sqrt(chi^2/degrees of freedom)`` where the windows scatter by more than
    they state.  |Z| is corrected for its noise, ``sqrt(|Z|^2 - sigma^2)``, good to 1 % of |Z| from |Z| = 3 sigma on.
    Hertz contact suggests n = 1/3 (Grigorii et al. 2021, from 111 Hz on).
    """
    samples = samples_of(impedance)
    rows = [_power(each) for each in by_frequency(samples)]
    columns: Any = zip(*rows, strict=True) if rows else [()] * 7
    return LoadLaw(*(np.array(column) for column in columns))


def _parts(impedance: Source | Sequence[Source]) -> list[Source]:
    return [impedance] if isinstance(impedance, FingerRecord | Impedance) else list(impedance)


def samples_of(impedance: Source | Sequence[Source], loads: tuple[float, float] = (0.0, inf)) -> Samples:
    """Unmasked entries with a load (N) from the first of `loads` to below the second, and above 0."""
    parts = [each.impedance if isinstance(each, FingerRecord) else each for each in _parts(impedance)]
    rows = [
        np.broadcast_arrays(each.frequency, each.value, each.standard_error, each.normal_load[:, None], number)
        for number, each in enumerate(parts)
    ]
    columns = [np.concatenate([np.ravel(column) for column in same]) for same in zip(*rows, strict=True)]
    found = Samples(*(columns or [np.empty(0)] * 5))
    good = np.isfinite(found.frequency) & np.isfinite(found.value) & np.isfinite(found.standard_error)
    with np.errstate(invalid="ignore"):
        good &= (found.frequency > 0) & (found.load > 0) & (found.load >= loads[0]) & (found.load < loads[1])
    found = Samples(*(column[good] for column in found))
    least = found.standard_error.min(initial=inf)
    require(bool(least > 0), "standard_error", float(least), "> 0 N s/m: mask (NaN) what was not measured")
    return found


def by_frequency(samples: Samples) -> list[Samples]:
    """Split samples into bins of 5 % of frequency, by rising frequency."""
    bins = np.rint(np.log(samples.frequency) / BAND).astype(int)
    return [Samples(*(column[bins == at] for column in samples)) for at in np.unique(bins)]


def _carriers(samples: Samples) -> int:
    """Number of carriers that differ by more than 1 %."""
    if not samples.frequency.size:
        return 0
    return 1 + int((np.diff(np.log(np.sort(samples.frequency))) > APART).sum())


def _check_enough(samples: Samples, order: int, loads: tuple[float, float]) -> None:
    found, fewest = _carriers(samples), FEWEST[order]
    if found < fewest:
        raise ValueError(
            f"impedance: {found} different carriers with data at loads from {loads[0]:g} to {loads[1]:g} N, a "
            f"finger of order {order} needs at least {fewest}: record more frequencies, or widen the loads"
        )


def _unit(name: str) -> float:
    return 1.0 if name == "load_exponent" else float(_UNITS[NAMES.index(name)])


def _impedance(numbers: Mapping[str, Any], frequency: Array, normal_load: float | Array | None) -> Array:
    """Z_f (N s/m) of a model given by its numbers, times its growth with the load."""
    fields = {name: value for name, value in numbers.items() if name != "load_exponent"}
    whole = FingerMechanics(**fields).impedance(frequency)
    if normal_load is None:
        return whole
    return whole * np.exp(numbers["load_exponent"] * np.log(np.asarray(normal_load) / numbers["reference_load"]))


def _shared_errors(impedance: Source | Sequence[Source], samples: Samples) -> Array:
    """G over the samples' own errors, for real and imaginary parts: shape (2 n, 3 recordings); see `fit_finger`."""
    parts, w, sigma = _parts(impedance), 2 * np.pi * samples.frequency, samples.standard_error
    shared = np.zeros((2, len(w), len(parts), 3))
    for number, each in enumerate(parts):
        own = samples.source == number
        if not isinstance(each, FingerRecord) or not own.any():
            continue
        errors = each.plate.standard_errors
        known = [
            np.hypot(errors[f"{name}_1"].mean(), errors[f"{name}_2"].mean()) if f"{name}_1" in errors else inf
            for name in ("damping", "stiffness")
        ]
        most = [sqrt(2) * (sigma[own] * factor).min() for factor in (1 / w[own], 1.0, w[own])]
        mass, damping, stiffness = np.minimum([inf, *known], most)
        shared[0, own, number, 1] = damping / sigma[own]
        shared[1, own, number, 0] = mass * w[own] / sigma[own]
        shared[1, own, number, 2] = -stiffness / w[own] / sigma[own]
    return shared.reshape(2 * len(w), -1)


def _fit(
    samples: Samples, shared: Array, order: int, exponent: float | None, second: FingerFit | None = None
) -> FingerFit:
    """Fit one order, from several starts where it is the 4th."""
    from scipy.optimize import least_squares

    names, logs = NAMES[: 3 * order // 2], np.log(samples.load)
    fixed = {"order": order, "reference_load": float(np.exp(logs.mean())), "load_exponent": exponent or 0.0}
    if exponent is None and np.ptp(logs) > APART:
        names = (*names, "load_exponent")
    units = np.array([_unit(name) for name in names])
    weight = 1 / samples.standard_error
    along, size, _ = np.linalg.svd(shared, full_matrices=False)  # (1 + G G^T)^(-1/2) = 1 - U (1 - (1 + s^2)^(-1/2)) U^T
    shrink = 1 - 1 / np.sqrt(1 + size**2)

    def residual(x: Array) -> Array:
        numbers = fixed | dict(zip(names, (x * units).tolist(), strict=True))
        apart = (_impedance(numbers, samples.frequency, samples.load) - samples.value) * weight
        white = np.concatenate([apart.real, apart.imag])
        return white - along @ (shrink * (along.T @ white))

    most = np.append(_MOST, 10.0)[[*range(3 * order // 2), *([6] if len(names) % 3 else [])]]
    least = np.where(np.array(names) == "load_exponent", -10.0, 0.0)
    settings: Any = {"bounds": (least, most), "x_scale": "jac", "ftol": 1e-6, "max_nfev": MOST_STEPS}
    with np.errstate(under="ignore"):  # the solver's own step from a bound of 0
        starts = [np.clip(start[: len(names)], least + 1e-6, most) for start in _starts(samples, second)]
        best = min((least_squares(residual, start, **settings) for start in starts), key=lambda each: each.cost)
    numbers = fixed | dict(zip(names, (best.x * units).tolist(), strict=True))
    growth, chi_square, freedom = numbers.pop("load_exponent"), 2 * float(best.cost), best.fun.size - len(names)
    covariance = _inverse(best.jac) * np.outer(units, units) * max(1.0, chi_square / max(freedom, 1))
    reach = float(samples.load.min()), float(samples.load.max())
    return FingerFit(FingerMechanics(**numbers), growth, names, covariance, chi_square, freedom, reach)


def _starts(samples: Samples, second: FingerFit | None) -> list[Array]:
    """Where the search begins, in the fit's units.

    The 2nd order: at its linear solution; the 4th: at both fingers of Table 1, and at the 2nd order behind a stiff
    skin, so that it fits no worse.
    """
    if second is not None:
        whole = [getattr(second.mechanics, name) / unit for name, unit in zip(NAMES, _UNITS[:3], strict=False)]
        table = [[getattr(each, name) for name in NAMES] / _UNITS for each in (LIGHT, HEAVY)]
        return [np.append(each, 0.0) for each in (*table, [*_STIFF_SKIN, *whole])]
    w, weight = 2e-3 * np.pi * samples.frequency, 1 / samples.standard_error
    zero = np.zeros_like(w)
    real, imaginary = np.column_stack([zero, weight, zero]), np.column_stack([w * weight, zero, -weight / w])
    matrix = np.vstack([real, imaginary])
    right = np.concatenate([samples.value.real, samples.value.imag]) * np.tile(weight, 2)
    return [np.append(np.linalg.lstsq(matrix, right, rcond=None)[0], 0.0)]


def _inverse(jacobian: Array) -> Array:
    """Inverse of J^T J; a direction in which the data say nothing has a variance beyond every bound, not 0."""
    _, size, right = np.linalg.svd(jacobian, full_matrices=False)
    spread = right.T / np.maximum(size, 1e-12 * size[0])
    return spread @ spread.T


def _supported(second: FingerFit, fourth: FingerFit) -> FingerFit:
    """Return the fit with the smaller Bayesian information criterion, with its margin."""
    size = fourth.degrees_of_freedom + len(fourth.names)
    scatter = max(1.0, fourth.chi_square / max(fourth.degrees_of_freedom, 1))
    gain = (second.chi_square - fourth.chi_square) / scatter - 3 * log(size)
    return replace(fourth, bic_margin=gain) if gain > 0 else replace(second, bic_margin=-gain)


def _power(samples: Samples) -> tuple[float, ...]:
    """One row of `LoadLaw` from the samples of a bin."""
    from scipy.optimize import curve_fit

    logs, sigma = np.log(samples.load), samples.standard_error
    middle, count = float(logs.mean()), len(logs)
    size = np.sqrt(np.maximum(np.abs(samples.value) ** 2 - sigma**2, 0.0))
    frequency, mean = float(np.median(samples.frequency)), float(np.average(size, weights=sigma**-2))
    if np.count_nonzero(size) < 3 or np.ptp(logs) < APART:
        return frequency, nan, nan, mean, float(np.exp(middle)), nan, count

    def power(at: Array, magnitude: float, exponent: float) -> Array:
        return magnitude * np.exp(np.clip(exponent * at, -50, 50))

    (magnitude, exponent), covariance = curve_fit(
        power, logs - middle, size, p0=(mean, 0.3), sigma=sigma, absolute_sigma=True
    )
    chi_square = float(np.sum(((power(logs - middle, magnitude, exponent) - size) / sigma) ** 2))
    error = sqrt(covariance[1, 1] * max(1.0, chi_square / (count - 2)))
    together = float(np.corrcoef(samples.load, size)[0, 1] ** 2) if np.ptp(size) else 0.0
    return frequency, float(exponent), error, float(magnitude), float(np.exp(middle)), together, count
