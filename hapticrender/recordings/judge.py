"""Judge a recording: figures for every band and place, and a verdict."""

import math
from typing import Any

import numpy as np

from hapticrender.defaults import FADE_IN
from hapticrender.formatting import bands_label, percent
from hapticrender.protocols import Array, Flag
from hapticrender.recordings.envelopes import DIVERGING, RUNAWAY, Envelopes, amplitude_error, judged_from
from hapticrender.recordings.recording import Recording
from hapticrender.recordings.waveform_figures import BAND, LOOSER, WINDOW

READ_AT_ONCE = 2**18  # samples
SETTLED = 0.05  # of the target
SETTLED_FOR = 0.5  # s, or
SETTLED_SHARE = 0.1  # of the judged time where that is shorter: inside for so long at the end, a band has settled
INFERRED = "the friction is inferred by a law that is assumed, not measured"
HARDLY = 2.0  # times what the sensors' noise alone reads: a smaller figure is not distinct from it
IN_BAND = f"{BAND[0]:g} to {BAND[1]:g} Hz"
MATTERS = Flag.SATURATED | Flag.NONFINITE | Flag.SENSOR_CLIPPED | Flag.OVERRUN  # a sample with one of these fails
UNPLAYABLE = 0.01  # share of the reference's energy outside the band from which it is noted
UNJUDGED: dict[str, Any] = {"figure": "waveform_error", "value": None, "bound": None, "band": "any", "place": "any"}


@np.errstate(**DIVERGING)
def summary(recording: Recording) -> dict[str, Any]:
    """Figures and verdict as plain numbers, strings, lists and dicts; None for no figure (docs/theory.md, section 7).

    `verdict` is "passed", "passed in band" (part of the texture's energy cannot be played), "failed" or "not judged";
    it rests on `waveform_error`, `window_error` and `third_octave_error` at every place in `waveform`, and on flags.
    `worst` is the figure furthest over its `bound`; `reason` states what else decided.  `contacts` are the errors after
    touches and lifts; `delay` (s), `gain` and `incoherent` share state how the motion differs from the reference and
    decide nothing, like all that follows.

    Relative errors of a band compare with the target at every place over the judged windows: `error_*` is that of the
    mean amplitude, `rms_error_*` the rms of |X| - |target| over the rms of |target|, `phase_error` the lead of the mean
    at the first place.  `frequency` of a finger-locked band is the median while it is judged.  `settling_time` is None
    unless the band stays within 5 % of its target, in amplitude and phase, for the last 0.5 s, or 10 % of the judged
    time where shorter.

    `wobble` (m) is the rms of the narrowband motion at the first place that is no multiple of its target: the root of
    sum_k mean |X_k - c_k target_k|^2 / 2 with c_k by least squares; a window of 2 periods passes variations up to about
    0.44/window.
    """
    header, places = recording.header, [place.replace(" ", "_") for place in recording.header.places]
    envelopes, begin = recording.envelopes, judged_from(recording)
    settled = envelopes.start >= begin * (1 - 1e-9)
    judged = envelopes.judged & settled[:, None]
    bands = [_band(recording, k, judged[:, k], places) for k in range(len(recording.bands))]
    worst, misses, noise = _worst(recording)
    verdict, reason = _verdict(recording, worst, misses, noise)
    flags = _flag_counts(recording)
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
        "waveform": recording.waveform,
        "bands": bands,
        "wobble": _wobble(envelopes, judged),
        "saturated_share": flags[Flag.SATURATED] / max(1, len(recording)),
        "flags": {str(flag.name): count for flag, count in flags.items() if count},
        "notes": _notes(recording, bands, settled, flags[Flag.TWO_TOUCHES]),
    }


def _band(recording: Recording, k: int, judged: Array, places: list[str]) -> dict[str, Any]:
    """All figures of one band over its judged windows."""
    bands, envelopes = recording.bands, recording.envelopes
    wavenumber, judged_seconds = float(bands.wavenumber[k]), len(recording) / recording.rate - judged_from(recording)
    target = envelopes.target[judged, k]
    shares = np.array(recording.header.profile or np.ones(len(places)))
    aimed = ~np.isclose(shares, 0.0)  # a place that a gradient leaves at rest has no target
    achieved = envelopes.achieved[judged, :, k] / np.where(aimed, shares, 1.0)
    lead = achieved[:, 0] * target.conj()
    lead = np.where(envelopes.backward[judged, k], lead.conj(), lead)  # a lead stays a lead on the way back
    some = bool(judged.any())
    mean = float(np.mean(np.abs(target))) if some else None
    frequency = envelopes.frequency[judged, k]
    figures: dict[str, Any] = {
        "frequency": float(bands.frequency[k]) if not wavenumber else float(np.median(frequency)) if some else None,
        "wavelength": 1 / wavenumber if wavenumber else None,
        "target": mean,
        "achieved": float(np.mean(np.abs(achieved[:, 0]))) if some else None,
        "phase_error": float(np.angle(lead.mean())) if some else None,
        "settling_time": _settling_time(envelopes, k, min(SETTLED_FOR, SETTLED_SHARE * judged_seconds)),
        "judged_windows": int(judged.sum()),
    }
    for place, has_target, envelope in zip(places, aimed, achieved.T, strict=True):
        figures[f"error_{place}"] = float(np.mean(np.abs(envelope))) / mean - 1.0 if mean and has_target else None
        figures[f"rms_error_{place}"] = float(amplitude_error(envelope, target, 0)) if some and has_target else None
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


def _flag_counts(recording: Recording, first: int = 0) -> dict[Flag, int]:
    """Count the samples from the `first` on in which each flag is set."""
    counts = dict.fromkeys(Flag, 0)
    for start in range(first, len(recording), READ_AT_ONCE):
        flags = recording.read("flags", start, start + READ_AT_ONCE)
        for flag in Flag:
            counts[flag] += int(np.count_nonzero(flags & flag))
    return counts


def _verdict(recording: Recording, worst: dict[str, Any], misses: bool, noise: float) -> tuple[str, str]:
    """Verdict and, where the worst figure is not the reason, what is; flags come before what cannot be judged."""
    header, found = recording.header, recording.waveform
    if header.motion_source != "unknown" and found["lost_windows"]:
        bound = f"not finite, or beyond {RUNAWAY:g} {header.unit},"
        lost = f"{found['lost_windows']} windows of {1e3 * WINDOW:g} ms"
        return "failed", f"the motion, or the texture, is {bound} in {lost}"
    unjudged = _unjudged(recording)
    if not unjudged and not misses and worst["value"] > worst["bound"]:
        unjudged = f"the worst figure is not distinct from the noise of the sensors, {percent(noise)}"
    if not unjudged and misses:
        return "failed", _stopped(recording)
    counts = _flag_counts(recording, round(judged_from(recording) * recording.rate))
    raised = [f"{flag.name} in {count} samples" for flag, count in counts.items() if count and flag & MATTERS]
    if raised:
        return "failed", f"flags that are not allowed: {', '.join(raised).lower()}"
    if unjudged or (unjudged := _cut(recording)):
        return "not judged", "; ".join(filter(None, (_stopped(recording), unjudged)))
    if found["share_outside"] > UNPLAYABLE:
        return "passed in band", _unplayable(found["share_outside"])
    return "passed", ""


def _unjudged(recording: Recording) -> str:
    """State why no figure is to be judged; nothing where the worst one is."""
    header, found = recording.header, recording.waveform
    if header.motion_source == "unknown":
        return "the device has no sensors, so its motion is not measured"
    if found["rms_reference"] is None:
        needed = min(max(header.settle, FADE_IN) + WINDOW, 2 * WINDOW)
        return f"the run is too short: needs >= {needed:g} s"
    if not found["rms_reference"]:
        return "the texture is zero, or far below what can be felt"
    if None in found["places"].values():
        return f"the texture has nothing from {IN_BAND}"
    return INFERRED if header.motion_source == "inferred" else ""


def _cut(recording: Recording) -> str:
    """State after what part of its planned length the run ended; nothing where it is whole, or has none."""
    seconds, planned = len(recording) / recording.rate, recording.header.duration
    return f"the run ended after {seconds:.3f} s of {planned:.3f} s" if seconds < planned - 0.5 / recording.rate else ""


def _stopped(recording: Recording) -> str:
    """State when the drive was stopped; nothing where it was not."""
    for start in range(0, len(recording), READ_AT_ONCE):
        stopped = recording.read("flags", start, start + READ_AT_ONCE) & Flag.STOPPED
        if stopped.any():
            return f"the drive was stopped at {(start + int(np.argmax(stopped > 0))) / recording.rate:.4g} s"
    return ""


def _unplayable(share: float) -> str:
    return f"not judged: {percent(share)} of the reference's energy, which lies outside {IN_BAND}"


def _worst(recording: Recording) -> tuple[dict[str, Any], bool, float]:
    """Figure that is largest over its bound, whether it distinctly misses it, and what the sensors' noise reads there.

    One that distinctly misses its bound comes first.  The uncertainty of the sensors' gain is added to every figure and
    is no noise: where that alone is over the bound, so is the figure.
    """
    header, found = recording.header, list[tuple[dict[str, Any], bool, float]]()
    unsure = header.calibration if header.motion_source == "sensors" else 0.0
    for place, figures in recording.waveform["places"].items():
        for name, looser in (("waveform_error", 1.0), ("window_error", LOOSER), ("third_octave_error", LOOSER)):
            if figures and figures[name] is not None:
                value, bound, noise = figures[name] + unsure, looser * header.tolerance, figures["sensor_noise"]
                misses = value > bound and (figures[name] > HARDLY * noise or unsure > bound)
                band = figures["third_octave"] if name == "third_octave_error" else IN_BAND
                where = {"band": band, "place": place.replace("_", " ")}
                found.append(({"figure": name, "value": value, "bound": bound, **where}, misses, noise))
    return max(found, key=lambda it: (it[1], it[0]["value"] / it[0]["bound"]), default=(dict(UNJUDGED), False, 0.0))


def _notes(recording: Recording, bands: list[dict[str, Any]], settled: Array, touched: int) -> list[str]:
    """State in plain sentences what limits the figures."""
    header, envelopes = recording.header, recording.envelopes
    seconds, notes = len(recording) / recording.rate, [f"left out, {text}" for text in recording.bands.unfelt]
    if header.motion_source == "inferred":
        notes.append(INFERRED)
    if header.motion_source == "sensors":
        gain = f"+-{percent(header.calibration)}, which is added to every figure" if header.calibration else "not known"
        notes.append(f"the figures come from the sensors, whose errors do not show; uncertainty of their gain: {gain}")
    if touched:
        notes.append(f"more than one finger touched, in {percent(touched / len(recording))} of the samples")
    if recording.least_scale < 1.0:
        notes.append(f"the drive's limit scaled the texture to {recording.least_scale:.2g} of it at the least")
    if "[touch_panel]" in header.scene:
        notes.append(
            "the motion is judged against the texture at the recorded position, which the touch panel estimates: its "
            "error against the finger's true position is in none of the figures; hr.phase_error predicts it"
        )
    if cut := _cut(recording):
        notes.append(cut)
    if seconds < 2 * header.settle:
        notes.append("the run is shorter than twice the settling time: its second half is judged")
    if (recording.waveform["share_outside"] or 0.0) > UNPLAYABLE:
        notes.append(_unplayable(recording.waveform["share_outside"]))
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
