"""Figures of what was played, by plain least squares; nothing of the library is imported here."""

from dataclasses import dataclass

import numpy as np

PERIODS = 1.5  # of a carrier, and of the beat of two carriers, that a window must hold to tell them apart
SETTLED = 0.05  # of the target
SEGMENT = 400  # samples of drive that are kept at each of three places of a run
FAILS = 0.1  # relative error from which a method fails: below it no difference is felt


@dataclass(frozen=True, kw_only=True)
class Played:
    """Signals of n samples; carriers are ``cos(2 pi (frequency t + wavenumber x) + phase)``."""

    rate: float
    frequency: np.ndarray  # Hz, (bands,), as wavenumber (1/m) and phase (rad)
    wavenumber: np.ndarray
    phase: np.ndarray
    drive: np.ndarray  # (n, channels)
    motion: np.ndarray  # (n, places), the centre first: true motion, or friction, or skin velocity
    position: np.ndarray  # m, (n,), NaN while the finger is lifted
    target: np.ndarray  # complex, (n, bands)
    flags: dict[str, np.ndarray]  # bool, (n,)


@dataclass(frozen=True, kw_only=True)
class Envelopes:
    """Envelopes in w consecutive windows.

    `judged`: the window separates the carrier from its neighbours and an offset, and something is wanted all through
    it.  `residual`: mean square of the centre's motion that neither carriers nor an offset and a slope explain, and
    that is no multiple of what they leave of the wanted waveform.
    """

    time: np.ndarray  # s, (w,): start of each window
    wanted: np.ndarray  # complex, (w, bands)
    achieved: np.ndarray  # complex, (w, places, bands)
    judged: np.ndarray  # bool, (w, bands)
    residual: np.ndarray  # (w,)


def turns_of(played: Played) -> np.ndarray:
    """Phase of every carrier (turns, shape (n, bands)); a lifted finger holds it."""
    down = np.isfinite(played.position)
    last = np.maximum.accumulate(np.where(down, np.arange(down.size), -1))
    place = np.where(last >= 0, played.position[np.maximum(last, 0)], 0.0)
    time = np.arange(len(place)) / played.rate
    return np.outer(time, played.frequency) + np.outer(place, played.wavenumber) + played.phase / (2 * np.pi)


def envelopes(played: Played, window: float) -> Envelopes:
    """Fit all carriers, an offset and a slope to every window (s) of the motion and of the wanted waveform."""
    turns, size = turns_of(played), int(round(window * played.rate))
    carrier = np.exp(2j * np.pi * turns)
    waveform = (played.target * carrier).real.sum(axis=1)
    signals = np.column_stack([waveform, played.motion])
    starts = np.arange(0, len(turns) - size + 1, size)
    rows = [_window(played, carrier, turns, signals, slice(at, at + size)) for at in starts]
    wanted, achieved, judged, residual = (np.array(column) for column in zip(*rows, strict=True))
    return Envelopes(time=starts / played.rate, wanted=wanted, achieved=achieved, judged=judged, residual=residual)


def _window(played, carrier, turns, signals, part):
    """Wanted and achieved envelopes, what is judged, and the residual of one window."""
    few, n = carrier[part], carrier.shape[1]
    slope = np.linspace(-1.0, 1.0, len(few))
    regressors = np.column_stack([few.real, -few.imag, np.ones_like(slope), slope])
    solution = np.linalg.lstsq(regressors, signals[part], rcond=1e-9)[0]
    rest = signals[part] - regressors @ solution
    found = (solution[:n] + 1j * solution[n : 2 * n]).T
    beside = rest[:, 1] - rest[:, 0] * (rest[:, 1] @ rest[:, 0]) / max(rest[:, 0] @ rest[:, 0], 1e-300)
    return found[0], found[1:], _judged(played, turns, part), np.mean(beside**2)


def _judged(played, turns, part):
    """Bands whose carrier and beats are fast enough, of which something is wanted, and whose finger is down."""
    least = PERIODS * played.rate / (part.stop - part.start) * (1 - 1e-6)
    speed = np.sort(abs(np.diff(turns[part], axis=0)) * played.rate, axis=1)
    apart = (np.diff(speed, axis=1) >= least).all()
    fast = (abs(np.diff(turns[part], axis=0)) * played.rate >= least).all(axis=0)
    down = (played.wavenumber == 0.0) | np.isfinite(played.position[part]).all()
    target = abs(played.target)
    return fast & apart & down & (target[part] > 1e-3 * target.max(axis=0)).all(axis=0)


def figures(played: Played, window: float, settle: float) -> dict[str, float | None]:
    """Figures of a run from `settle` (s) on; None where there is none (a run that diverges has no figures).

    Returns
    -------
    dict
        Relative to the rms of a band's target: `worst`, rms error of the amplitude, of the worst band and place;
        `rms`, that of all bands at the centre; `peak`, the largest of any window, band and place; `complex`, rms error
        with phase at the centre, worst band.  In the unit of the device: `wobble`, rms at the centre of the envelopes
        about a multiple of their targets; `residual`, rms at the centre of all that is no band's; `target`, rms of what
        is wanted.  `settled` (s): start of the window from which every band stays within 5 % of its target at the
        centre.  `drive_rms`, `drive_peak` in the unit of the drive.
    """
    found = envelopes(played, window)
    level = _rms(np.where(found.judged, abs(found.wanted), np.nan), 0)
    late = found.judged & (found.time >= settle)[:, None]
    off = (abs(found.achieved) - abs(found.wanted)[:, None]) / level
    off = np.where(late[:, None], off, np.nan)
    turned = np.where(late, (found.achieved[:, 0] - found.wanted) / level, np.nan)
    values = {
        "worst": _rms(off, 0).max(),
        "rms": _rms(off[:, 0], None),
        "peak": np.nanmax(abs(off)),
        "complex": _rms(turned, 0).max(),
        "wobble": _wobble(found, late),
        "residual": np.sqrt(found.residual[found.time >= settle].mean()),
        "target": np.sqrt(np.nansum(np.where(late.any(axis=0), level, np.nan) ** 2) / 2),
        "settled": _settled(found),
        "drive_rms": np.sqrt(np.mean(played.drive**2)),
        "drive_peak": abs(played.drive).max(),
    }
    return {key: float(value) if value is not None and np.isfinite(value) else None for key, value in values.items()}


def _rms(values, axis):
    return np.sqrt(np.nanmean(abs(values) ** 2, axis=axis))


def _wobble(found, late):
    power = 0.0
    for k in range(late.shape[1]):
        wanted, achieved = found.wanted[late[:, k], k], found.achieved[late[:, k], 0, k]
        multiple = np.vdot(wanted, achieved) / np.vdot(wanted, wanted)
        power += np.mean(abs(achieved - multiple * wanted) ** 2) / 2
    return np.sqrt(power)


def _settled(found):
    outside = found.judged & (abs(found.achieved[:, 0] - found.wanted) > SETTLED * abs(found.wanted))
    first = np.flatnonzero(outside.any(axis=1)).max(initial=-1) + 1
    return found.time[first] if first < len(found.time) else None


def flags(played: Played) -> dict[str, dict[str, float]]:
    """Count, and time (s) of the first sample, of every flag that was raised."""
    return {
        name: {"count": int(raised.sum()), "first": float(np.argmax(raised) / played.rate)}
        for name, raised in played.flags.items()
        if raised.any()
    }


def drive_of(played: Played) -> np.ndarray:
    """Drive at the start, in the middle and at the end of a run, shape (3, SEGMENT, channels)."""
    n = len(played.drive)
    return np.stack([played.drive[at : at + SEGMENT] for at in (0, (n - SEGMENT) // 2, n - SEGMENT)])
