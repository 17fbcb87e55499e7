"""Judge a recording: figures for every band and place, and a verdict."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.formatting import band_label, bands_label
from hapticrender.protocols import Array, Flag
from hapticrender.recordings.envelopes import (
    CALM,
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
SILENT = 1e-6  # of the strongest reference envelope: what the fit leaves of a zero target beside other bands
UNJUDGED: dict[str, Any] = {"figure": "rms_error", "value": None, "band": "any", "place": "any"}


@np.errstate(**CALM)
def summary(recording: Recording) -> dict[str, Any]:
    """Figures of every band, and the verdict.

    Relative errors compare with the target at every place: `error_*` is that
    of the mean amplitude, `rms_error_*` the rms of |X| - |target| over the
    rms of |target|, both over the judged windows.  The verdict compares the
    largest `rms_error_*` with the scene's tolerance.  A band whose target is
    below the tolerance times the strongest band decides only if its error
    exceeds the tolerance times the strongest band.  `verdict` is "passed",
    "failed" or "not judged" (without sensors, or without a band that can be
    judged), `reason` says why where there is no worst figure, and
    `motion_source` says whether the figures come from the true motion or from
    the sensors.

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
    verdict, reason = _verdict(recording, worst)
    flags = _flag_counts(recording)
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
        "verdict": verdict,
        "passed": verdict == "passed",
        "reason": reason,
        "motion_source": header.motion_source,
        "worst": worst,
        "bands": bands,
        "wobble": _wobble(envelopes, judged),
        "residual_rms": _residual(envelopes, late[:, 0]),
        "saturated_share": flags[Flag.SATURATED] / max(1, len(recording)),
        "flags": {str(flag.name): count for flag, count in flags.items() if count},
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
    for place, envelope in zip(places, achieved.T, strict=True):
        figures[f"rms_error_{place}"] = float(amplitude_error(envelope, wanted, 0)) if wanted.size else None
    product = achieved[:, 0] * wanted.conj()
    product = np.where(
        envelopes.backward[judged, k], product.conj(), product
    )  # a lead stays a lead on a carrier that runs backwards
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
    mean_square = _mean(envelopes.residual[late & envelopes.finite])
    return math.sqrt(mean_square) if mean_square is not None and math.isfinite(mean_square) else None


def _flag_counts(recording: Recording) -> dict[Flag, int]:
    """Count the samples in which each flag is set."""
    counts = dict.fromkeys(Flag, 0)
    for start in range(0, len(recording), READ_AT_ONCE):
        flags = recording.read("flags", start, start + READ_AT_ONCE)
        for flag in Flag:
            counts[flag] += int(np.count_nonzero(flags & flag))
    return counts


def _diverges(envelopes: Envelopes) -> bool:
    """Whether the motion is not finite, or beyond `RUNAWAY`, in any window: then the other figures give no verdict."""
    return not envelopes.finite.all()


def _verdict(recording: Recording, worst: dict[str, Any]) -> tuple[str, str]:
    """Verdict and, where there is no worst figure, the reason."""
    header, envelopes = recording.header, recording.envelopes
    if header.motion_source == "unknown":
        return "not judged", "the device has no sensors, so its motion is not known"
    if _diverges(envelopes):
        count = int((~envelopes.finite).sum())
        bound = f"not finite, or beyond {RUNAWAY:g} {header.unit},"
        return "failed", f"the motion is {bound} in {count} of {len(envelopes.finite)} windows"
    if worst["value"] is not None:
        return ("passed" if worst["value"] <= header.tolerance else "failed"), ""
    seconds, needed = len(recording) / recording.rate, shortest_run(recording)
    if seconds < needed < math.inf:
        return "not judged", f"the run is too short: needs >= {math.ceil(1e3 * needed - 1e-6) / 1e3:g} s"
    if not envelopes.asked.any():
        return "not judged", "no band has a target"
    return (
        "not judged",
        f"no carrier is faster than {LOWEST_FREQUENCY:g} Hz and far enough from the others for a window",
    )


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


def _notes(recording: Recording, bands: list[dict[str, Any]], late: Array) -> list[str]:
    """State in plain sentences what limits the figures."""
    header, envelopes = recording.header, recording.envelopes
    seconds, notes = len(recording) / recording.rate, [f"left out, {text}" for text in recording.bands.unfelt]
    if header.motion_source == "sensors":
        notes.append("the figures come from the sensors: errors of the sensors themselves do not show")
    if seconds < header.duration - 0.5 / recording.rate:
        notes.append(f"the run ended after {seconds:.3f} s of {header.duration:.3f} s")
    if seconds < 2 * header.settle:
        notes.append("the run is shorter than twice the settling time: its second half is judged")
    if header.motion_source == "unknown" or not (late & envelopes.finite).any():
        return notes
    late = late & envelopes.finite
    partly = [k for k, band in enumerate(bands) if band["judged_windows"] < late.sum()]
    if partly:
        shares = sorted(100 * bands[k]["judged_windows"] / late.sum() for k in partly)
        share = f"{shares[0]:.0f} %" if shares[-1] - shares[0] < 1 else f"{shares[0]:.0f} to {shares[-1]:.0f} %"
        beyond = ", faster than the device's range" if _beyond_range(envelopes, recording.bands, late, partly) else ""
        notes.append(
            f"{bands_label([bands[k] for k in partly])}: {share} of the windows judged; in the others the target is "
            f"zero, the finger is up, or the carrier is slower than 20 Hz{beyond} or too close to another"
        )
    return notes


def _beyond_range(envelopes: Envelopes, bands: Bands, late: Array, partly: list[int]) -> bool:
    """Whether a finger-locked carrier is silent in a window where it runs faster than wherever it is wanted."""
    meant = bands.wavenumber != 0 if bands.envelope is None else (bands.wavenumber != 0) & (bands.envelope != 0)
    strength = np.abs(envelopes.wanted)
    silent = strength <= SILENT * strength.max(initial=0.0)
    fastest = np.where(envelopes.asked, envelopes.frequency, LOWEST_FREQUENCY).max(axis=0, initial=LOWEST_FREQUENCY)
    return bool((meant & silent & (envelopes.frequency > fastest))[late][:, partly].any())


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if values.size else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(np.abs(values) ** 2))) if values.size else None


def _median(values: Array) -> float | None:
    return float(np.median(values)) if values.size else None


def _ratio(value: float | None, reference: float | None, less: float = 0.0) -> float | None:
    return value / reference - less if value is not None and reference else None
