"""What a recording is worth: envelopes over time, figures for every band and place, and a verdict.

The same estimator listens to the wanted waveform and to the motion, so its own
smoothing cancels from every error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender import wording
from hapticrender.bands import Bands
from hapticrender.protocols import Array, Flag

if TYPE_CHECKING:
    from hapticrender.recordings.recording import Recording

SHORTEST_WINDOW = 20e-3  # s [FACTS 3, standard conditions: max(20 ms, 2/f)]
PERIODS = 2.0  # of the lowest carrier and of the smallest spacing in a window
HOPS = 2  # window starts in a window's length
HOPS_LOCKED = 8  # the same where carriers are locked to the finger, which is seldom fast enough for long
LOWEST_FREQUENCY = 20.0  # Hz: below it the window does not tell a carrier from an offset
LARGEST_INFLATION = 4.0  # of an envelope's variance, by the neighbours that the window hardly tells apart from it
SETTLED = 0.05  # of the target
SETTLED_FOR = 0.5  # s, or
SETTLED_SHARE = 0.1  # of the judged time where that is shorter: inside for so long at the end, a band has settled
QUARTERS = 4  # parts of a window in each of which a carrier must be fast enough
RUNAWAY = 1e3  # m: no plate moves so far, and squares still fit into a float
CHUNK_VALUES = 2**21  # numbers in one batch of regressors
SILENT = 1e-6  # of the strongest wanted envelope: what is left of nothing by the fit beside other bands
RIDGE = 1e-12  # keeps the normal equations of a standing carrier solvable; such windows are not read
UNJUDGED: dict[str, Any] = {"figure": "rms_error", "value": None, "band": "any", "place": "any"}


@dataclass(frozen=True)
class Envelopes:
    """Envelopes at the windows of the analysis.

    Window w runs from `start[w]` over `window` seconds; `wanted` and
    `achieved` are peak amplitudes with phase, of the waveform
    ``Re sum_k X_k exp(j phi_k)``.

    Parameters
    ----------
    start : ndarray, shape (w,), s
    window : float, s
    wanted : ndarray of complex, shape (w, n_bands), m
    achieved : ndarray of complex, shape (w, places, n_bands), m
    readable : ndarray of bool, shape (w, n_bands)
        The window tells the band's carrier from its neighbours and from the offset.
    asked : ndarray of bool, shape (w, n_bands)
        Something is wanted of the band all through the window.
    frequency : ndarray, shape (w, n_bands), Hz
        Mean magnitude of the carrier's frequency; 0 for a finger-locked one while the finger is up.
    backward : ndarray of bool, shape (w, n_bands)
        The carrier runs backwards, as a finger-locked one does on the way back.
    residual : ndarray, shape (w,), m^2
        Mean square of the motion at the first place that neither the carriers nor an offset and a slope explain.
    """

    start: Array
    window: float
    wanted: Array
    achieved: Array
    readable: Array
    asked: Array
    frequency: Array
    backward: Array
    residual: Array

    @property
    def time(self) -> Array:
        """Middle of every window (s)."""
        return self.start + self.window / 2

    @property
    def finite(self) -> Array:
        """Windows in which the motion at every place is a number, and no run-away, shape (w,)."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.all(np.abs(self.achieved) < RUNAWAY, axis=(1, 2))

    @property
    def judged(self) -> Array:
        """Windows and bands that can be compared with their target, shape (w, n_bands)."""
        return self.readable & self.asked & self.finite[:, None]


def judged_from(recording: Recording) -> float:
    """Time (s) from which a run is judged: after the scene's settling time, or its second half where it is short."""
    duration = len(recording) / recording.rate
    settle = recording.header.settle
    return settle if duration >= 2 * settle else duration / 2


def shortest_run(recording: Recording) -> float:
    """Length (s) from which a run like this can be judged: what follows its settling time holds a window and a hop."""
    needed = (1 + 1 / HOPS) * window_length(recording.bands, recording.rate, recording.position, math.inf)
    return needed + min(needed, recording.header.settle)


def window_length(bands: Bands, rate: float, position: Array, longest: float) -> float:
    """Length of the analysis window (s): max(20 ms, 2/lowest frequency, 2/spacing), cut to `longest` (s).

    A carrier that is locked to the finger counts with its lowest frequency
    while the finger is down; frequencies below 20 Hz are not judged and do
    not count.
    """
    step = max(1, round(SHORTEST_WINDOW / QUARTERS * rate))
    coarse = position[::step]
    if bands.wavenumber.any() and coarse.size > 1:
        velocity = np.diff(coarse) * rate / step
        frequency = np.abs(bands.instantaneous_frequency(velocity[np.isfinite(velocity)]))
    else:
        frequency = bands.frequency[None, :]
    lowest = max(LOWEST_FREQUENCY, frequency.min(initial=np.inf))
    window = max(SHORTEST_WINDOW, PERIODS / lowest if np.isfinite(lowest) else 0.0)
    fast = np.sort(frequency[(frequency >= LOWEST_FREQUENCY).all(axis=1)], axis=1)
    if len(bands) > 1 and len(fast):
        spacing = np.quantile(np.diff(fast, axis=1).min(axis=1), 0.05)
        window = max(window, PERIODS / spacing if spacing > PERIODS / longest else longest)
    return min(window, longest)


def analyse(recording: Recording) -> Envelopes:
    """Envelopes of every band at every place, by joint least squares over overlapping windows.

    Each window fits all carriers of the scene, an offset and a slope to the
    motion, and the same to the waveform that is wanted.  Windows start half a
    window apart, an eighth where a carrier is locked to the finger.

    Parameters
    ----------
    recording : Recording

    Returns
    -------
    Envelopes
    """
    bands, rate, count = recording.bands, recording.rate, len(recording)
    longest = max(SHORTEST_WINDOW, (count / rate - judged_from(recording)) / 2)
    position = recording.position
    size = round(window_length(bands, rate, position, longest) * rate)
    size = max(2, size + size % 2)
    hop = max(1, size // (HOPS_LOCKED if bands.wavenumber.any() else HOPS))
    first = np.arange(0, count - size + 1, hop)
    parts = [
        _analyse_chunk(recording, position, starts, size) for starts in _batches(first, size * (2 * len(bands) + 2))
    ]
    places, n_bands = len(recording.header.places), len(bands)
    shapes = [(0, n_bands), (0, places, n_bands), (0, n_bands), (0, n_bands), (0, n_bands), (0, n_bands), (0,)]
    kinds = [complex, complex, bool, bool, float, bool, float]
    empty: list[Array] = [np.empty(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)]
    return Envelopes(first / rate, size / rate, *(np.concatenate(part) for part in zip(empty, *parts, strict=True)))


def _batches(first: Array, values: int) -> Iterator[Array]:
    """Window starts in batches whose regressors (`values` numbers a window) stay small."""
    each = max(1, CHUNK_VALUES // values)
    for i in range(0, len(first), each):
        yield first[i : i + each]


def _analyse_chunk(recording: Recording, position: Array, first: Array, size: int) -> tuple[Array, ...]:
    envelope, inflation, rest, asked = _fit_windows(recording, position, first, size)
    signed = _quarterly(recording.bands, recording.rate, position[first[:, None] + np.arange(size)])
    frequency = abs(signed)
    fast = np.all(frequency >= LOWEST_FREQUENCY * (1 - 1e-6), axis=1)
    with np.errstate(invalid="ignore", over="ignore", under="ignore"):
        residual = np.mean(rest**2, axis=1)
    return (
        envelope[:, 0],
        envelope[:, 1:],
        fast & (inflation <= LARGEST_INFLATION),
        asked,
        frequency.mean(axis=1),
        signed.mean(axis=1) < 0.0,
        residual,
    )


def _fit_windows(recording: Recording, position: Array, first: Array, size: int) -> tuple[Array, ...]:
    """Fit windows that begin at samples `first`: envelopes, inflation, what is beside the bands, whether all ask."""
    start, stop = int(first[0]), int(first[-1]) + size
    index = (first - start)[:, None] + np.arange(size)
    phase = recording.bands.carrier_phase(np.arange(start, stop) / recording.rate, position[start:stop])
    target = recording.read("target", start, stop)
    waveform = (target.real * np.cos(phase) - target.imag * np.sin(phase)).sum(axis=1)
    signals = np.column_stack([waveform, recording.read("motion", start, stop)])[index]
    envelope, inflation, rest = fit(phase[index], signals)
    beside = _unexplained(rest[..., 1], rest[..., 0], signals[..., 0])
    return envelope, inflation, beside, (target != 0)[index].all(axis=1)


def beside_the_bands(recording: Recording) -> Iterator[Array]:
    """Motion at the first place that is no band's, in batches of the judged windows; see `summary`, `residual_rms`.

    Yields
    ------
    ndarray, shape (w, m)
        In the device's unit, w windows of m samples.
    """
    envelopes, rate = recording.envelopes, recording.rate
    size = round(envelopes.window * rate)
    late = (envelopes.start >= judged_from(recording) * (1 - 1e-9)) & envelopes.finite
    first, position = np.rint(envelopes.start[late] * rate).astype(int), recording.position
    for starts in _batches(first, size * (2 * len(recording.bands) + 2)):
        yield _fit_windows(recording, position, starts, size)[2]


def fit(phase: Array, signals: Array) -> tuple[Array, Array, Array]:
    """Least-squares envelopes of all carriers at once, with an offset and a slope.

    Parameters
    ----------
    phase : ndarray, shape (w, m, n_bands), rad
        Carrier phases in each window of m samples.
    signals : ndarray, shape (w, m, s)

    Returns
    -------
    envelope : ndarray of complex, shape (w, s, n_bands)
        In the unit of the signals.
    inflation : ndarray, shape (w, n_bands)
        Variance of an envelope's worse part relative to that of a lone carrier, >= 1 or nearly so.
    rest : ndarray, shape (w, m, s)
        What is left of the signals.
    """
    windows, size, n_bands = phase.shape
    regressors = np.empty((windows, size, 2 * n_bands + 2))
    regressors[..., :n_bands] = np.cos(phase)
    regressors[..., n_bands:-2] = -np.sin(phase)
    regressors[..., -2] = math.sqrt(0.5)
    regressors[..., -1] = np.linspace(-1, 1, size) * math.sqrt(1.5)
    transposed = regressors.transpose(0, 2, 1)
    normal = transposed @ regressors
    normal += RIDGE * size * np.eye(2 * n_bands + 2)
    inverse = np.linalg.inv(normal)
    with np.errstate(invalid="ignore", over="ignore", under="ignore"):  # a motion that is no number is told by `finite`
        solution = inverse @ (transposed @ signals)
        rest = signals - regressors @ solution
    parts = solution.transpose(0, 2, 1)
    envelope = parts[..., :n_bands] + 1j * parts[..., n_bands:-2]
    variance = np.diagonal(inverse, axis1=1, axis2=2)[:, :-2].reshape(windows, 2, n_bands).max(axis=1)
    return envelope, variance * (size / 2), rest


def _unexplained(rest: Array, wanted_rest: Array, wanted: Array) -> Array:
    """What is left of a motion (shape (w, m)), less the multiple of what is left of the wanted waveform.

    A window in which the target fades holds wanted motion that no constant envelope explains.
    """
    with np.errstate(invalid="ignore", over="ignore", under="ignore"):
        floor = RIDGE * np.mean(wanted**2, axis=1) + np.finfo(float).tiny
        multiple = np.mean(rest * wanted_rest, axis=1) / (np.mean(wanted_rest**2, axis=1) + floor)
        return rest - multiple[:, None] * wanted_rest


def _quarterly(bands: Bands, rate: float, finger: Array) -> Array:
    """Signed frequency (Hz, shape (w, quarters, n_bands)) in each quarter of a window; 0 where its finger is up."""
    edges = np.linspace(0, finger.shape[1] - 1, QUARTERS + 1).round().astype(int)
    down = np.all(np.isfinite(finger), axis=1)[:, None]
    velocity = np.diff(np.where(down, finger[:, edges], 0.0), axis=1) * rate / np.diff(edges)
    free = bands.wavenumber == 0
    return np.where(down[:, :, None] | free, bands.instantaneous_frequency(velocity), 0.0)


def summary(recording: Recording) -> dict[str, Any]:
    """Figures of every band, and the verdict.

    Relative errors compare with the target at every place: `error_*` is that
    of the mean amplitude, `rms_error_*` the rms of |X| - |target| over the
    rms of |target|, both over the judged windows.  The verdict compares the
    largest `rms_error_*` with the scene's tolerance.  A band that is wanted
    with less than the tolerance times the strongest band decides only if its
    error exceeds the tolerance times the strongest band.

    `wobble` is the rms deviation (m) at the centre of the narrowband motion
    from its mean: the root of sum_k mean |X_k - c_k target_k|^2 / 2, with c_k
    the least-squares multiple of the target over the judged windows (for a
    constant target, the mean of X_k).  A window of 2 periods passes
    variations up to about 0.44/window, 4.4 Hz at 20 Hz.  `residual_rms` is
    the rms (m) of all other true motion at the centre in the judged time:
    what is neither a band's envelope as fitted in each window, nor a multiple
    of what that fit leaves of the wanted waveform where a target fades, nor
    the window's offset and slope.

    `phase_error` is the lead of the mean at the first place, on a carrier
    that runs backwards as well as on one that runs forwards, and
    `complex_error` the rms of |X - target| over the rms of |target| there,
    phase included.  `frequency` of a band that is locked to the finger is the median while it
    is judged.  `settling_time` is None unless the band stays within 5 % of
    its target, in amplitude and phase, for the last 0.5 s, or for the last
    10 % of the judged time where that is shorter.

    Parameters
    ----------
    recording : Recording

    Returns
    -------
    dict
        Numbers, strings, lists and dicts only; None where there is no figure.
    """
    header, places = recording.header, [place.replace(" ", "_") for place in recording.header.places]
    envelopes, begin = recording.envelopes, judged_from(recording)
    late = (envelopes.start >= begin * (1 - 1e-9))[:, None]
    judged = envelopes.judged & late
    bands = [_band(recording, k, judged[:, k], places) for k in range(len(recording.bands))]
    worst = dict(UNJUDGED) if _diverges(envelopes) else _worst(bands, places, header.tolerance)
    flags = recording.flags
    return {
        "scene": header.name,
        "device": header.device,
        "method": header.method,
        "seed": header.seed,
        "unit": header.unit,
        "rate": header.rate,
        "duration": len(recording) / recording.rate,
        "judged_from": begin,
        "tolerance": header.tolerance,
        "passed": worst["value"] is not None and worst["value"] <= header.tolerance,
        "worst": worst,
        "bands": bands,
        "wobble": _wobble(envelopes, judged),
        "residual_rms": _residual(envelopes, late[:, 0]),
        "saturated_share": float(np.mean((flags & Flag.SATURATED) != 0)) if len(flags) else 0.0,
        "flags": {str(flag.name): int(np.count_nonzero(flags & flag)) for flag in Flag if (flags & flag).any()},
        "notes": _notes(recording, bands, late[:, 0]),
    }


def _band(recording: Recording, k: int, judged: Array, places: list[str]) -> dict[str, Any]:
    """All figures of one band over its judged windows."""
    bands, envelopes = recording.bands, recording.envelopes
    wavenumber = float(bands.wavenumber[k])
    wanted = envelopes.wanted[judged, k]
    achieved = envelopes.achieved[judged, :, k] / np.array(recording.header.profile or 1.0)
    figures: dict[str, Any] = {
        "frequency": _median(envelopes.frequency[judged, k]) if wavenumber else float(bands.frequency[k]),
        "wavelength": 1 / wavenumber if wavenumber else None,
        "target": _mean(np.abs(wanted)),
        "achieved": _mean(np.abs(achieved[:, 0])),
    }
    for place, amplitude in zip(places, np.abs(achieved).T, strict=True):
        figures[f"error_{place}"] = _ratio(_mean(amplitude), figures["target"], less=1.0)
    for place, amplitude in zip(places, np.abs(achieved).T, strict=True):
        figures[f"rms_error_{place}"] = _ratio(_rms(amplitude - np.abs(wanted)), _rms(wanted))
    product = achieved[:, 0] * wanted.conj()
    product = np.where(envelopes.backward[judged, k], product.conj(), product)  # a lead is one on the way back, too
    figures["complex_error"] = _ratio(_rms(achieved[:, 0] - wanted), _rms(wanted))
    figures["phase_error"] = float(np.angle(product.mean())) if product.size else None
    judged_time = len(recording) / recording.rate - judged_from(recording)
    figures["settling_time"] = _settling_time(envelopes, k, min(SETTLED_FOR, SETTLED_SHARE * judged_time))
    figures["judged_windows"] = int(judged.sum())
    return figures


def _settling_time(envelopes: Envelopes, k: int, least: float) -> float | None:
    """Middle (s) of the first window after which the centre stays within 5 % of the target, for `least` (s) or more."""
    compared = envelopes.readable[:, k] & envelopes.asked[:, k]
    wanted = envelopes.wanted[compared, k]
    with np.errstate(invalid="ignore"):
        outside = ~(np.abs(envelopes.achieved[compared, 0, k] - wanted) <= SETTLED * np.abs(wanted))
    time = envelopes.time[compared]
    first = int(np.flatnonzero(outside)[-1]) + 1 if outside.any() else 0
    if first == len(time) or time[-1] - time[first] + envelopes.window < least * (1 - 1e-9):
        return None
    return float(time[first])


def _wobble(envelopes: Envelopes, judged: Array) -> float | None:
    """Rms (m) of the centre's narrowband motion that is no multiple of the targets, see `summary`."""
    if not judged.any():
        return None
    power = 0.0
    for k in np.flatnonzero(judged.any(axis=0)):
        wanted, achieved = envelopes.wanted[judged[:, k], k], envelopes.achieved[judged[:, k], 0, k]
        scale = np.vdot(wanted, achieved) / np.vdot(wanted, wanted).real
        power += np.mean(np.abs(achieved - scale * wanted) ** 2) / 2
    return math.sqrt(power)


def _residual(envelopes: Envelopes, late: Array) -> float | None:
    """Rms (m) at the centre of what is neither a band nor slow, see `summary`."""
    with np.errstate(over="ignore"):
        mean_square = _mean(envelopes.residual[late & envelopes.finite])
    return math.sqrt(mean_square) if mean_square is not None and math.isfinite(mean_square) else None


def _diverges(envelopes: Envelopes) -> bool:
    """Whether the motion is no number somewhere, or runs away: then no figure of the rest may pass for a verdict."""
    return not envelopes.finite.all()


def _worst(bands: list[dict[str, Any]], places: list[str], tolerance: float) -> dict[str, Any]:
    """Find the largest rms error of all bands that decide, at all places."""
    strongest = max((band["target"] for band in bands if band["target"] is not None), default=0.0)
    worst: dict[str, Any] = dict(UNJUDGED)
    for band in bands:
        for place in places:
            value = band[f"rms_error_{place}"]
            if value is None or max(value, 1.0) * band["target"] < tolerance * strongest:
                continue
            if worst["value"] is None or value > worst["value"]:
                figure, label = f"rms_error_{place}", wording.band_label(band)
                worst = {"figure": figure, "value": value, "band": label, "place": place.replace("_", " ")}
    return worst


def _notes(recording: Recording, bands: list[dict[str, Any]], late: Array) -> list[str]:
    """Say in plain sentences what a reader of the figures ought to know."""
    header, envelopes = recording.header, recording.envelopes
    seconds, notes = len(recording) / recording.rate, [f"left out, {text}" for text in recording.bands.unfelt]
    if seconds < header.duration - 0.5 / recording.rate:
        notes.append(f"the run ended after {seconds:.3f} s of {header.duration:.3f} s")
    if seconds < 2 * header.settle:
        notes.append("the run is shorter than twice the settling time: its second half is judged")
    finite = envelopes.finite if len(envelopes.start) else np.isfinite(recording.motion)
    if finite.size and not finite.any():
        return [*notes, "the motion is not known"]
    if not finite.all():
        notes.append(f"the motion is not finite in {int((~finite).sum())} of {len(finite)} windows")
    needed = shortest_run(recording)
    if seconds < needed < math.inf and not any(band["judged_windows"] for band in bands):
        return [*notes, f"too short to judge: needs >= {math.ceil(1e3 * needed - 1e-6) / 1e3:g} s"]
    late = late & envelopes.finite
    partly = [k for k, band in enumerate(bands) if band["judged_windows"] < late.sum()]
    if partly:
        shares = sorted(100 * bands[k]["judged_windows"] / late.sum() for k in partly)
        share = f"{shares[0]:.0f} %" if shares[-1] - shares[0] < 1 else f"{shares[0]:.0f} to {shares[-1]:.0f} %"
        beyond = ", faster than the device's range" if _beyond_range(envelopes, recording.bands, late, partly) else ""
        notes.append(
            f"{wording.bands_label([bands[k] for k in partly])}: {share} of the windows judged; in the others nothing "
            f"is wanted, the finger is up, or the carrier is slower than 20 Hz{beyond} or too close to another"
        )
    return notes


def _beyond_range(envelopes: Envelopes, bands: Bands, late: Array, partly: list[int]) -> bool:
    """Whether a finger-locked carrier is silent in a window where it runs faster than wherever it is wanted."""
    meant = bands.wavenumber != 0 if bands.envelope is None else (bands.wavenumber != 0) & (bands.envelope != 0)
    strength = np.abs(envelopes.wanted)
    silent = strength <= SILENT * strength.max(initial=0.0)
    fastest = np.where(envelopes.asked, envelopes.frequency, LOWEST_FREQUENCY).max(axis=0, initial=LOWEST_FREQUENCY)
    return bool((meant & silent & (envelopes.frequency > fastest))[late][:, partly].any())


def text(summary: Mapping[str, Any]) -> str:
    """Write a summary as a table for the terminal."""
    places = [key.removeprefix("rms_error_") for key in (summary["bands"] or [{}])[0] if key.startswith("rms_error_")]
    titles = ["band", "target", "achieved", *(place.replace("_", " ") for place in places), "phase", "settled"]
    rows = [titles]
    for band in summary["bands"]:
        phase = band["phase_error"]
        rows.append(
            [
                wording.band_label(band),
                wording.quantity(band["target"], summary["unit"]),
                wording.quantity(band["achieved"], summary["unit"]),
                *(wording.percent(band[f"rms_error_{place}"]) for place in places),
                "–" if phase is None else f"{round(math.degrees(phase), 1) + 0.0:.1f}°",
                wording.quantity(band["settling_time"], "s"),
            ]
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(titles))]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    wobble, residual = (wording.quantity(summary[key], summary["unit"]) for key in ("wobble", "residual_rms"))
    saturated = wording.percent(summary["saturated_share"])
    lines.append(
        f"rms errors {wording.at(places)}; wobble {wobble}, beside the bands {residual}, saturated {saturated}"
    )
    lines.extend(summary["notes"])
    return "\n".join([*lines, f"{summary['scene']} {wording.verdict(summary)}"])


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if values.size else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(np.abs(values) ** 2))) if values.size else None


def _median(values: Array) -> float | None:
    return float(np.median(values)) if values.size else None


def _ratio(value: float | None, reference: float | None, less: float = 0.0) -> float | None:
    return value / reference - less if value is not None and reference else None
