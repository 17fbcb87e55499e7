"""Figures of the waveform: the motion against the texture as the scene specifies it, without time shift or gain fit.

Equations and reasons: docs/theory.md, section 7.

Symbols: r reference, y motion at a place over the place's share of the target, e = y - r; rms_B over B = 20 to 500 Hz,
rms_b over a third octave b with both edges in B (on a plate also above, see `_thirds`); S_b detection threshold (rms)
in it.  Over the whole play both come from spectra, windows of 100 ms and contacts from signals filtered without phase;
E = rms_B(e)/rms_B(r) is the larger one by both: spectra hardly see the ends, the filter blurs the edges of B.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hapticrender.protocols import Array, Flag
from hapticrender.recordings.envelopes import DIVERGING, RUNAWAY, judged_from
from hapticrender.recordings.journal import Header
from hapticrender.recordings.recording import Recording
from hapticrender.touch.perception import VELOCITY_PER_FORCE, detection_threshold

BAND = (20.0, 500.0)  # Hz
HIGHEST = 0.4  # of the rate: B ends there at low rates
ORDERS = (4, 12)  # of the Butterworth high pass and low pass, run both ways: half the amplitude is left at the edges
MARGIN = 0.25  # s around a piece, in which the filter settles
WINDOW = 0.1  # s
SEGMENT = 10  # windows in a segment of the spectra (Hann, half overlapping): 1 s
WORST_WINDOWS = 95.0  # percentile
QUIET = 0.1  # of the rms of the whole reference: windows, and places, below count as this loud
READ_AT_ONCE = 2**17  # samples
NOMINAL = (
    *(25.0, 31.5, 40.0, 50.0, 63.0, 80.0, 100.0, 125.0, 160.0, 200.0, 250.0, 315.0, 400.0),
    *(500.0, 630.0, 800.0, 1000.0),  # beyond B; beyond these no detection threshold is known
)  # Hz [IEC 61260]
THIRDS = 1000.0 * 2.0 ** (np.arange(-16, 1) / 3)  # Hz: their exact middles
EDGE = 2.0 ** (1 / 6)
CURVE = "classic"  # detection threshold; the rounding of a 12-bit converter alone is 1.4 times the safe one at 200 Hz
SPUR = 0.01  # of the rms of the whole reference: S_b where no threshold is known
LOOSER = 2.0  # times the tolerance: bound on a third octave and on the worst windows
LEAST = 1e-4  # share of the reference's energy in B, and of the least energy felt, below which nothing is judged
LONGEST_DELAY, DELAYS = 20e-3, 4001  # s, of the best delay; how many are tried
FRICTION = ("N", "m/s")  # units of what a finger's own friction is part of: of friction, and of a hybrid's skin
LANDING = 3e-3  # s: five memory lengths of a contact at 20 mm/s, in which the friction of a touch builds up
AFTER_CONTACT = (0.0, 0.05, 0.2)  # s: edges of the two spans that are stated


@np.errstate(**DIVERGING)
def waveform_figures(recording: Recording) -> dict[str, Any]:
    """Figures of the waveform as plain numbers, None where there is none; see ``judge.summary``."""
    header, rate = recording.header, recording.rate
    window, begin = round(WINDOW * rate), math.ceil(judged_from(recording) * rate - 1e-6)
    stop = _end(recording)
    count = max(stop - begin, 0) // max(window, 1)
    places = [place.replace(" ", "_") for place in header.places]
    found: dict[str, Any] = {"lost_windows": 0, "places": dict.fromkeys(places), "contacts": None, "sensor_noise": 0.0}
    found |= dict.fromkeys(("rms_reference", "share_in_band", "share_outside", "delay", "gain", "incoherent"))
    if not window or not count:
        return found
    whole, size = begin + count * window, max(READ_AT_ONCE // window, 1) * window
    pieces = [(start, min(start + size, whole)) for start in range(begin, whole, size)]
    pieces += [(stop - window, stop)] * (whole < stop)  # a last window, which overlaps the one before
    power = np.concatenate([_power(recording, *piece, window) for piece in pieces])
    found["lost_windows"] = int(np.isnan(power).any(axis=1).sum())
    if found["lost_windows"]:
        return found
    frequency, spectrum, cross = _spectra(recording, begin, stop, min(SEGMENT, count) * window)
    inside = _within(frequency, *_band(rate), 2 * frequency[1])
    reference = spectrum[:, 0]
    rms = found["rms_reference"] = math.sqrt(reference.sum())
    if not rms > _least(header.unit):
        return found | {"rms_reference": 0.0}
    total = spectrum[_within(frequency, *_band(rate))].sum(axis=0)
    weights = np.append(np.ones(count), [(stop - whole) / window] * (whole < stop))  # of the last one what is new
    least = min(total[0], weights @ power[:, 0] / weights.sum())  # rms_B(r)^2: no figure of B divides by less
    found["share_in_band"] = float(reference[inside].sum() / reference.sum())
    found["share_outside"] = _outside(reference, frequency, inside, header.unit)
    if least < LEAST * reference.sum():
        return found
    shares, scales = _scales(header)
    noise = _noise(recording, *_band(rate)) / scales / math.sqrt(least)
    found["sensor_noise"] = float(noise.max())
    for i, place in enumerate(places, start=1):
        alike = float(weights @ power[:, i] / (weights @ power[:, 0]))
        whole_error = math.sqrt(max(alike, total[i] / total[0]))
        each = power[:, i] / np.maximum(power[:, 0], QUIET**2 * power[:, 0].mean())  # of quiet windows that loud
        errors = {"waveform_error": whole_error, "window_error": float(np.sqrt(np.percentile(each, WORST_WINDOWS)))}
        thirds = _thirds(recording, spectrum[:, [0, i, i + len(places)]], frequency, rms, i - 1)
        found["places"][place] = errors | {"sensor_noise": float(noise[i - 1])} | thirds
    found |= _likeness(frequency[inside], spectrum[inside, :2], cross[inside], float(shares[0] / scales[0]))
    return found | {"contacts": _contacts(recording, begin, stop, math.sqrt(power[:, 0].mean()))}


def _band(rate: float) -> tuple[float, float]:
    return BAND[0], min(BAND[1], HIGHEST * rate)


def _within(frequency: Array, low: float, high: float, blur: float = 0.0) -> Array:
    return (frequency >= low - blur) & (frequency < high + blur)


def _end(recording: Recording) -> int:
    """Samples that are judged: all but the one of unknown motion that ends a run which was cut off."""
    last = recording.read("flags", max(len(recording) - 1, 0))
    return len(recording) - int((last & Flag.STOPPED).any())


def _least(unit: str) -> float:
    """Rms below which a reference is none: 1e-4 of the energy of the faintest motion felt; 0 where that is unknown."""
    hertz = THIRDS[_within(THIRDS, *BAND)]
    rate = 2.0 * np.pi * hertz
    faintest = detection_threshold(hertz) * {"m": 1.0, "m/s": rate, "N": rate / VELOCITY_PER_FORCE}.get(unit, 0.0)
    return float(math.sqrt(LEAST / 2.0) * np.min(faintest))


def _scales(header: Header) -> tuple[Array, Array]:
    """Share of the target at every place, and the magnitude that its errors are relative to."""
    shares = np.array(header.profile or np.ones(len(header.places)))
    return shares, np.maximum(np.abs(shares), QUIET * (np.abs(shares).max() or 1.0))


def _signals(recording: Recording, start: int, stop: int) -> Array:
    """Reference, and error at every place relative to its share of the target, shape (n, 1 + places).

    Both are 0 while the finger that a friction device or a hybrid is felt by is away.
    """
    shares, scales = _scales(recording.header)
    names = "reference", "motion"
    values = (np.asarray(recording.read(name, start, stop)) for name in names)
    reference, motion = (np.where(np.abs(each) < RUNAWAY, each, np.nan) for each in values)
    landed = np.zeros(len(motion), bool)
    if recording.header.unit in FRICTION and recording.touched:
        landing, before = round(LANDING * recording.rate), max(start - round(LANDING * recording.rate), 0)
        touching = np.isfinite(recording.read("position", before, stop))
        touching = np.pad(touching, (landing - start + before, 0), mode="edge")  # a run begins as it is
        felt = np.asarray(sliding_window_view(touching, landing + 1).all(axis=1))
        motion, landed = _without_base(motion, touching[landing:], felt), touching[landing:] & ~felt
        reference = reference * touching[landing:]
    error = (motion - np.outer(reference, shares)) / scales
    error[landed] *= 0.0
    return np.column_stack([reference, error])


def _without_base(friction: Array, touching: Array, felt: Array) -> Array:
    """Friction (n, places) less its mean over each touch, where `felt`: a touch brings friction of its own.

    Without a finger there is none; as that of a touch builds up, nothing else is felt, and nothing is judged.
    """
    for part in np.split(np.arange(len(touching)), np.flatnonzero(np.diff(touching)) + 1):
        known = part[felt[part]]
        count = np.isfinite(friction[known]).sum(axis=0)  # a lost sample is lost alone
        friction[part] -= np.nansum(friction[known], axis=0) / np.maximum(count, 1)
    friction[~touching] *= 0.0
    return friction


def _filtered(recording: Recording, start: int, stop: int) -> Array:
    """`_signals` within B."""
    from scipy.signal import butter, sosfiltfilt

    margin = round(MARGIN * recording.rate)
    first = max(start - margin, 0)
    sides = zip(ORDERS, _band(recording.rate), ("highpass", "lowpass"), strict=True)
    sections = np.vstack([butter(order, edge, kind, fs=recording.rate, output="sos") for order, edge, kind in sides])
    signals = np.nan_to_num(_signals(recording, first, min(stop + margin, _end(recording))))
    return sosfiltfilt(sections, signals, axis=0, padlen=min(margin, len(signals) - 1))[start - first : stop - first]


def _power(recording: Recording, start: int, stop: int, window: int) -> Array:
    """Mean square within B in every window, shape (windows, 1 + places); NaN where the motion is no number."""
    lost = np.isnan(_signals(recording, start, stop).sum(axis=1)).reshape(-1, window).any(axis=1)
    values = _filtered(recording, start, stop)
    return np.where(lost[:, None], np.nan, (values**2).reshape(-1, window, values.shape[1]).mean(axis=1))


def _spectra(recording: Recording, begin: int, stop: int, segment: int) -> tuple[Array, Array, Array]:
    """Frequencies (Hz), mean square a bin of r, e and y (bins, 1 + 2 places), cross spectrum of r and the first e."""
    shares, scales = _scales(recording.header)
    starts = np.unique([*range(begin, stop - segment + 1, max(segment // 2, 1)), stop - segment])
    taper = np.hanning(segment + 1)[:-1, None]
    scale = 2.0 / (segment * (taper**2).sum()) / len(starts)
    power, cross = 0.0, 0.0
    for start in starts:
        values = _signals(recording, start, start + segment)
        turned = np.fft.rfft(taper * (values - values.mean(axis=0)), axis=0)
        power += scale * np.abs(np.hstack([turned, turned[:, 1:] + shares / scales * turned[:, :1]])) ** 2
        cross += scale * turned[:, 0].conj() * turned[:, 1]
    return np.fft.rfftfreq(segment, 1 / recording.rate), np.asarray(power), np.asarray(cross)


def _thirds(recording: Recording, spectrum: Array, frequency: Array, rms: float, place: int) -> dict[str, Any]:
    """Error of every third octave in B (on a plate, m, also above) at a place, and the largest; `rms` is that of r.

    The texture counts as no less than S_b over the bound, so that an error of S_b is on it.
    """
    header, rate = recording.header, recording.rate
    share, scale = (float(each[place]) for each in _scales(header))
    low, high = _band(rate)
    found = {}
    for name, middle in zip(NOMINAL, THIRDS, strict=True):
        edges = middle / EDGE, middle * EDGE
        if low <= edges[0] and edges[1] <= (HIGHEST * rate if header.unit == "m" else high):
            reference, error, motion = spectrum[_within(frequency, *edges)].sum(axis=0)
            if edges[1] > high:
                error = min(error, max(math.sqrt(motion) - abs(share) / scale * math.sqrt(reference), 0.0) ** 2)
            felt = float(detection_threshold(middle, CURVE)) / math.sqrt(2.0) / scale
            noise = 2.0 * float(_noise(recording, *edges)[place]) / scale
            least = max(felt if header.unit == "m" else SPUR * rms, noise) / (LOOSER * header.tolerance)
            found[f"{name:g} Hz"] = math.sqrt(error) / max(math.sqrt(reference), least)
    worst = max(found, key=lambda name: found[name], default=None)
    return {"third_octave_error": found.get(worst or ""), "third_octave": worst, "third_octaves": found}


def _noise(recording: Recording, low: float, high: float) -> Array:
    """Rms of the sensors' noise from `low` to `high` (Hz) at every place; 0 where the motion is not from sensors."""
    header = recording.header
    measured = header.motion_source == "sensors"
    return np.resize(header.sensed_noise, len(header.places)) * math.sqrt(2.0 * (high - low) / header.rate) * measured


def _outside(reference: Array, frequency: Array, inside: Array, unit: str) -> float:
    """Share of the reference's energy outside B; 0 where it is below the threshold at its strongest frequency (m)."""
    outside = np.where(inside, 0.0, reference)
    strongest = float(np.clip(frequency[outside.argmax()], 1.0, 1000.0))
    if unit == "m" and math.sqrt(2.0 * outside.sum()) < detection_threshold(strongest):
        return 0.0
    return float(outside.sum() / reference.sum())


def _likeness(frequency: Array, spectrum: Array, cross: Array, sign: float) -> dict[str, float]:
    """Best delay (s) and gain of y over r within 20 ms, and the share of y's energy that they do not explain."""
    from scipy.signal import czt

    reference, error = spectrum.T
    whole = cross + sign * reference  # of r and y = e + sign r
    motion = error + 2.0 * sign * cross.real + sign**2 * reference
    delay = np.linspace(-LONGEST_DELAY, LONGEST_DELAY, DELAYS)
    turn = 2j * np.pi * (frequency[-1] - frequency[0]) / max(len(frequency) - 1, 1)  # a second, from bin to bin
    turned = czt(whole, DELAYS, np.exp(turn * (delay[1] - delay[0])), np.exp(-turn * delay[0]))
    turned *= np.exp(2j * np.pi * frequency[0] * delay)
    best = int(np.argmax(turned.real * (1.0 - 1e-6 * np.abs(delay) / LONGEST_DELAY)))  # of equal ones the shortest
    found, total = float(turned.real[best]), float(reference.sum())
    incoherent = 1.0 - found**2 / max(total * float(motion.sum()), np.finfo(float).tiny)
    return {"delay": float(delay[best]), "gain": found / total, "incoherent": max(incoherent, 0.0)}


def _contacts(recording: Recording, begin: int, stop: int, rms: float) -> dict[str, Any]:
    """Count of touches and lifts, and the error after them over the reference's `rms`, at the worst place."""
    edges = [round(seconds * recording.rate) for seconds in AFTER_CONTACT]
    events, squares = np.array(list(_events(recording, begin, stop - edges[-1])), int), []
    for start in range(begin, stop, READ_AT_ONCE):
        here = events[(events >= start) & (events < start + READ_AT_ONCE)]
        if here.size:
            values = _filtered(recording, here[0], here[-1] + edges[-1])[:, 1:]
            power = np.concatenate([0 * values[:1], np.cumsum(values**2, axis=0)])
            at = here[:, None] - here[0] + np.array(edges)
            squares.append(np.diff(power[at], axis=1) / np.diff(edges)[:, None])
    errors = [None, None]
    if squares:
        errors = (np.sqrt(np.concatenate(squares).mean(axis=0).max(axis=1)) / rms).tolist()
    return {"count": len(events), "error_0_50_ms": errors[0], "error_50_200_ms": errors[1]}


def _events(recording: Recording, begin: int, stop: int) -> Iterator[int]:
    """Samples at which the finger touches or lifts."""
    before = np.zeros(1, bool)
    for start in range(begin, stop, READ_AT_ONCE):
        touching = np.isfinite(recording.read("position", start, min(start + READ_AT_ONCE, stop)))
        path = np.concatenate([touching[:1] if start == begin else before, touching])
        yield from (start + np.flatnonzero(np.diff(path))).tolist()
        before = touching[-1:]
