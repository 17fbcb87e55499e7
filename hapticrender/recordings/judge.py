"""Judge a recording: figures for every band and place, and a verdict."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.formatting import band_label, bands_label
from hapticrender.protocols import Array, Flag
from hapticrender.recordings.envelopes import (
    DIVERGING,
    LOWEST_FREQUENCY,
    RUNAWAY,
    Envelopes,
    amplitude_error,
    judged_from,
    shortest_run,
)

if TYPE_CHECKING:
    from hapticrender.recordings.recording import Recording

READ_AT_ONCE = 2**18  # samples
SETTLED = 0.05  # of the target
SETTLED_FOR = 0.5  # s, or
SETTLED_SHARE = 0.1  # of the judged time where that is shorter: inside for so long at the end, a band has settled
UNJUDGED: dict[str, Any] = {"figure": "rms_error", "value": None, "band": "any", "place": "any"}


@np.errstate(**DIVERGING)
def summary(recording: Recording) -> dict[str, Any]:
    """Figures of every band, and the verdict, as plain numbers, strings, lists and dicts; None for no figure.

    Relative errors compare with the target at every place over the judged windows: `error_*` is that of the mean
    amplitude, `rms_error_*` the rms of |X| - |target| over the rms of |target|, `complex_error` the rms of |X - target|
    at the first place over the same, `phase_error` the lead of the mean there.  The verdict ("passed", "failed", or
    "not judged", with a `reason`) compares the largest `rms_error_*` with the scene's tolerance; a band whose target is
    below the tolerance times the strongest band decides only if its error exceeds the tolerance times that band.

    `wobble` (m) is the rms of the narrowband motion at the first place that is no multiple of its target: the root of
    sum_k mean |X_k - c_k target_k|^2 / 2 with c_k by least squares; a window of 2 periods passes variations up to about
    0.44/window.  `residual_rms` (m) is the rms of all other motion there, see `Envelopes.residual`.

    `frequency` of a finger-locked band is the median while it is judged.  `settling_time` is None unless the band stays
    within 5 % of its target, in amplitude and phase, for the last 0.5 s, or 10 % of the judged time where shorter.
    """
    header, places = recording.header, [place.replace(" ", "_") for place in recording.header.places]
    envelopes, begin = recording.envelopes, judged_from(recording)
    settled = envelopes.start >= begin * (1 - 1e-9)
    judged = envelopes.judged & settled[:, None]
    bands = [_band(recording, k, judged[:, k], places) for k in range(len(recording.bands))]
    worst = _worst(bands, places, header.tolerance) if envelopes.finite.all() else dict(UNJUDGED)
    verdict, reason = _verdict(recording, worst)
    flags = _flag_counts(recording)
    residual = _mean(envelopes.residual[settled & envelopes.finite])
    names = ("device", "method", "seed", "unit", "rate", "tolerance", "motion_source")
    return {
        "scene": header.name,
        **{name: getattr(header, name) for name in names},
        "duration": len(recording) / recording.rate,
        "judged_from": begin,
        "verdict": verdict,
        "passed": verdict == "passed",
        "reason": reason,
        "worst": worst,
        "bands": bands,
        "wobble": _wobble(envelopes, judged),
        "residual_rms": math.sqrt(residual) if residual is not None and math.isfinite(residual) else None,
        "saturated_share": flags[Flag.SATURATED] / max(1, len(recording)),
        "flags": {str(flag.name): count for flag, count in flags.items() if count},
        "notes": _notes(recording, bands, settled),
    }


def _band(recording: Recording, k: int, judged: Array, places: list[str]) -> dict[str, Any]:
    """All figures of one band over its judged windows."""
    bands, envelopes = recording.bands, recording.envelopes
    wavenumber, seconds = float(bands.wavenumber[k]), len(recording) / recording.rate
    target = envelopes.target[judged, k]
    achieved = envelopes.achieved[judged, :, k] / np.array(recording.header.profile or 1.0)
    lead = achieved[:, 0] * target.conj()
    lead = np.where(envelopes.backward[judged, k], lead.conj(), lead)  # a lead stays a lead on the way back
    some = bool(judged.any())
    mean, size = _mean(np.abs(target)), np.sqrt(np.mean(np.abs(target) ** 2)) if some else 0.0
    frequency = envelopes.frequency[judged, k]
    figures: dict[str, Any] = {
        "frequency": float(bands.frequency[k]) if not wavenumber else float(np.median(frequency)) if some else None,
        "wavelength": 1 / wavenumber if wavenumber else None,
        "target": mean,
        "achieved": _mean(np.abs(achieved[:, 0])),
        "complex_error": float(np.sqrt(np.mean(np.abs(achieved[:, 0] - target) ** 2)) / size) if size else None,
        "phase_error": float(np.angle(lead.mean())) if some else None,
        "settling_time": _settling_time(
            envelopes, k, min(SETTLED_FOR, SETTLED_SHARE * (seconds - judged_from(recording)))
        ),
        "judged_windows": int(judged.sum()),
    }
    for place, envelope in zip(places, achieved.T, strict=True):
        figures[f"error_{place}"] = float(np.mean(np.abs(envelope))) / mean - 1.0 if mean else None
    for place, envelope in zip(places, achieved.T, strict=True):
        figures[f"rms_error_{place}"] = float(amplitude_error(envelope, target, 0)) if some else None
    return figures


def _settling_time(envelopes: Envelopes, k: int, least: float) -> float | None:
    """Middle (s) of the first window after which the centre stays within 5 % of the target, for `least` (s) or more."""
    compared = envelopes.readable[:, k] & envelopes.has_target[:, k]
    target = envelopes.target[compared, k]
    outside = ~(np.abs(envelopes.achieved[compared, 0, k] - target) <= SETTLED * np.abs(target))
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
        target, achieved = envelopes.target[judged[:, k], k], envelopes.achieved[judged[:, k], 0, k]
        scale = np.vdot(target, achieved) / np.vdot(target, target).real
        power += np.mean(np.abs(achieved - scale * target) ** 2) / 2
    return math.sqrt(power)


def _flag_counts(recording: Recording) -> dict[Flag, int]:
    """Count the samples in which each flag is set."""
    counts = dict.fromkeys(Flag, 0)
    for start in range(0, len(recording), READ_AT_ONCE):
        flags = recording.read("flags", start, start + READ_AT_ONCE)
        for flag in Flag:
            counts[flag] += int(np.count_nonzero(flags & flag))
    return counts


def _verdict(recording: Recording, worst: dict[str, Any]) -> tuple[str, str]:
    """Verdict and, where there is no worst figure, the reason."""
    header, envelopes = recording.header, recording.envelopes
    if header.motion_source == "unknown":
        return "not judged", "the device has no sensors, so its motion is not measured"
    if not envelopes.finite.all():
        count, bound = int((~envelopes.finite).sum()), f"not finite, or beyond {RUNAWAY:g} {header.unit},"
        return "failed", f"the motion is {bound} in {count} of {len(envelopes.finite)} windows"
    if worst["value"] is not None:
        return ("passed" if worst["value"] <= header.tolerance else "failed"), ""
    needed = shortest_run(recording)
    if len(recording) / recording.rate < needed < math.inf:
        return "not judged", f"the run is too short: needs >= {math.ceil(1e3 * needed - 1e-6) / 1e3:g} s"
    if not envelopes.has_target.any():
        return "not judged", "no band has a target"
    reason = f"no carrier is faster than {LOWEST_FREQUENCY:g} Hz and far enough from the others for a window"
    return "not judged", reason


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
                figure, label = f"rms_error_{place}", band_label(band)
                worst = {"figure": figure, "value": value, "band": label, "place": place.replace("_", " ")}
    return worst


def _notes(recording: Recording, bands: list[dict[str, Any]], settled: Array) -> list[str]:
    """State in plain sentences what limits the figures."""
    header, envelopes = recording.header, recording.envelopes
    seconds, notes = len(recording) / recording.rate, [f"left out, {text}" for text in recording.bands.unfelt]
    if header.motion_source == "sensors":
        notes.append("the figures come from the sensors: errors of the sensors themselves do not show")
    if seconds < header.duration - 0.5 / recording.rate:
        notes.append(f"the run ended after {seconds:.3f} s of {header.duration:.3f} s")
    if seconds < 2 * header.settle:
        notes.append("the run is shorter than twice the settling time: its second half is judged")
    windows = settled & envelopes.finite
    partly = [k for k, band in enumerate(bands) if band["judged_windows"] < windows.sum()]
    if header.motion_source != "unknown" and partly:
        shares = sorted(100 * bands[k]["judged_windows"] / windows.sum() for k in partly)
        share = f"{shares[0]:.0f} %" if shares[-1] - shares[0] < 1 else f"{shares[0]:.0f} to {shares[-1]:.0f} %"
        notes.append(
            f"{bands_label([bands[k] for k in partly])}: {share} of the windows judged; in the others the target is "
            "zero, the finger is up, or the carrier is slower than 20 Hz, out of range, or too close to another"
        )
    return notes


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if values.size else None
