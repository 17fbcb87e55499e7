"""Perception: detection threshold, sensation level, roughness, and bands below the threshold.

Amplitudes are peaks (m, m/s, N) of sinusoids; levels are dB above the classic detection threshold.
"""

import numpy as np

from hapticrender import checks
from hapticrender.bands import Bands
from hapticrender.formatting import short
from hapticrender.protocols import Array

# Classic threshold (um peak at Hz), large contactor (2.9 cm2), about 1 s: Bolanowski, Gescheider, Verrillo and
# Checkosky 1988; Verrillo 1963, 1992.  Known to within 4 dB; Grigorii et al. 2021 give 0.1 um at 250 Hz.
_CLASSIC = (
    *((1.0, 28.0), (3.0, 25.0), (5.0, 18.0), (10.0, 11.0), (20.0, 6.3), (31.5, 4.7), (40.0, 4.0)),
    *((50.0, 2.5), (63.0, 1.7), (80.0, 1.06), (100.0, 0.63), (125.0, 0.40), (160.0, 0.22), (200.0, 0.14)),
    *((250.0, 0.11), (300.0, 0.11), (400.0, 0.18), (500.0, 0.35), (700.0, 1.1), (1000.0, 5.0)),
)
_FREQUENCY, _THRESHOLD = np.array(_CLASSIC).T * [[1.0], [1e-6]]
LOWEST, HIGHEST = 1.0, 1000.0  # Hz: where the classic threshold is known
PACINIAN_FROM = 40.0  # Hz: from here on the classic threshold is that of the Pacinian channel
_SAFE_OFFSETS = ((0.0, -6.0), (PACINIAN_FROM, -10.0), (80.0, -25.0))  # dB from this frequency (Hz) on

VELOCITY_PER_FORCE = 0.64  # m/(N s): Grigorii et al. 2021, mean over 20-400 Hz of vibration and friction felt as equal
REALISTIC_FORCE = 0.05  # N: lateral force of a texture up to which motion above 1 kHz is not felt


def detection_threshold(frequency: float | Array, curve: str = "safe") -> Array:
    """Detection threshold (m peak) of a sinusoid at `frequency` (Hz, >= 0, scalar or array).

    `curve` "classic" is the published one for a large contactor, log-log between its table's entries, for levels; NaN
    beyond 1 to 1000 Hz.  "safe" is what may be left out: 6 dB below it under 40 Hz, 10 dB from 40 Hz on, 25 dB from
    80 Hz on (at a border the lower value), since active touch of a flat plate is that much more sensitive; 0 below
    1 Hz, and above 1 kHz as there, but never above the motion that `REALISTIC_FORCE` makes.

    References
    ----------
    Bolanowski, Gescheider, Verrillo, Checkosky, J. Acoust. Soc. Am. 84, 1988 (classic).
    Papetti et al., IEEE Trans. Haptics 10, 2017 (active touch: 22 to 37 dB lower at 250 Hz).

    Examples
    --------
    >>> f"{detection_threshold(250.0, 'classic'):.2g} m"
    '1.1e-07 m'
    >>> f"{detection_threshold(250.0):.2g} m"
    '6.2e-09 m'
    """
    checks.choice("curve", curve, ("safe", "classic"))
    hertz = checks.frequencies(frequency, zero=True)
    inside = (hertz >= LOWEST) & (hertz <= HIGHEST)
    known = np.clip(hertz, LOWEST, HIGHEST)
    classic = 10 ** np.interp(np.log10(known), np.log10(_FREQUENCY), np.log10(_THRESHOLD))
    if curve == "classic":
        return np.where(inside, classic, np.nan)[()]
    starts, offsets = np.array(_SAFE_OFFSETS).T
    safe = classic * 10 ** (offsets[np.searchsorted(starts, known, side="right") - 1] / 20)
    least_felt = from_velocity(REALISTIC_FORCE * VELOCITY_PER_FORCE, np.maximum(hertz, HIGHEST))
    return np.where(inside, safe, np.where(hertz < LOWEST, 0.0, np.minimum(safe, least_felt)))[()]


def sensation_level(displacement: float | Array, frequency: float | Array) -> Array:
    """Level (dB above the classic threshold) of `displacement` (m peak, may be complex) at `frequency` (Hz).

    -inf of no motion, NaN beyond 1 to 1000 Hz.

    >>> round(float(sensation_level(10e-6, 100.0)), 2)
    24.01
    """
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.abs(displacement) / detection_threshold(frequency, "classic"))


def displacement(level: float | Array, frequency: float | Array) -> Array:
    """Displacement (m peak) of a `level` (dB above the classic threshold) at `frequency` (Hz, NaN beyond 1 to 1000)."""
    return detection_threshold(frequency, "classic") * 10 ** (np.asarray(level, float) / 20)


def from_velocity(velocity: float | Array, frequency: float | Array) -> Array:
    """Displacement (m peak) of a sinusoidal `velocity` (m/s peak) at `frequency` (Hz, > 0): X = V/(2 pi f)."""
    return np.asarray(velocity) / (2 * np.pi * checks.frequencies(frequency, zero=False))


def roughness(displacement: float | Array, frequency: float | Array) -> float:
    """Roughness of a fine texture of partials at `frequency` (Hz, >= 0): its power as the Pacinian channel weighs it.

    ``sum |X(f)|^2/T_P(f)^2`` of the `displacement` X (m peak, may be complex) with the threshold T_P of that channel:
    the classic one from 40 Hz on, rising by 12 dB an octave below.  Partials above 1 kHz add nothing [Bensmaia,
    Hollins: The vibrations of texture, Somatosens. Mot. Res. 20, 2003].
    """
    hertz = checks.frequencies(frequency, zero=True)
    threshold = detection_threshold(np.clip(hertz, PACINIAN_FROM, HIGHEST), "classic")
    with np.errstate(under="ignore"):
        weight = np.minimum(hertz / PACINIAN_FROM, 1.0) ** 2
        return float(np.sum(np.where(hertz <= HIGHEST, np.abs(displacement) * weight / threshold, 0.0) ** 2))


def drop_unfelt(bands: Bands, *, top_speed: float, lowest: float, highest: float) -> Bands:
    """Leave out the bands below the detection threshold, and note them in `Bands.unfelt`.

    A band can go if it stays below the safe threshold at every frequency it can have: a fixed carrier at its own, one
    that is locked to the finger at all from `lowest` to `highest` (Hz, where the device renders it) that a finger of up
    to `top_speed` (m/s) gives it, in both directions.  A band that never gets there is kept, as is one that gets below
    1 Hz, and those of a recording, whose amplitudes are not known here.  The weakest go first, and only as long as all
    that went, each over its threshold, sum to less than 1: together and in phase they are below it too.  Masking of one
    band by another is not used.  No band left is a ValueError.

    >>> bands = Bands(frequency=[20.0, 60.0], wavenumber=[0.0, 0.0], phase=[0.0, 0.0], envelope=[1e-5, 1e-7])
    >>> drop_unfelt(bands, top_speed=0.0, lowest=5.0, highest=1000.0).unfelt
    ('60 Hz: target 100 nm is below the detection threshold, 583 nm at 60 Hz',)
    """
    if bands.envelope is None or not len(bands):
        return bands
    threshold, sensitive = _most_sensitive(bands, top_speed, lowest, highest)
    share = np.full(len(bands), np.inf)
    np.divide(np.abs(bands.envelope), threshold, out=share, where=threshold > 0)
    order = np.argsort(share, kind="stable")
    going = np.zeros(len(bands), bool)
    going[order] = np.cumsum(share[order]) < 1
    notes = {int(k): _note(bands, int(k), threshold[k], sensitive[k]) for k in np.flatnonzero(going)}
    if going.all():
        strongest = notes[int(order[-1])]
        raise ValueError(f"no band can be felt: {strongest} (keep_unfelt renders such bands all the same)")
    return bands.select(~going, unfelt=tuple(notes.values()))


def _most_sensitive(bands: Bands, top_speed: float, lowest: float, highest: float) -> tuple[Array, Array]:
    """Least safe threshold (m) of each band and where (Hz) it is; 0 for a band that never gets where it is rendered."""
    spread = top_speed * bands.wavenumber
    locked = bands.wavenumber > 0
    low = np.where(locked, np.maximum(bands.frequency - spread, lowest), bands.frequency)
    high = np.where(locked, np.minimum(bands.frequency + spread, highest), bands.frequency)
    # Between entries of the table the curve is monotonic, so its least value is at one of them or at an end.
    candidates = np.clip(np.concatenate([[0.0], _FREQUENCY, [1e9]]), low[:, None], np.maximum(low, high)[:, None])
    thresholds = detection_threshold(candidates)
    best = thresholds.argmin(axis=1)[:, None]
    least, place = (np.take_along_axis(values, best, axis=1)[:, 0] for values in (thresholds, candidates))
    return np.where(low <= high, least, 0.0), place


def _note(bands: Bands, index: int, threshold: float, sensitive: float) -> str:
    """State why a band is left out: its carrier, its target, and the threshold at the most sensitive frequency (Hz)."""
    frequency, wavenumber = float(bands.frequency[index]), float(bands.wavenumber[index])
    parts = [f"{frequency:.4g} Hz"] if frequency or not wavenumber else []
    parts += [f"wavelength {short(1 / wavenumber, 'm', 3)}"] if wavenumber else []
    target, least = (short(float(size), "m", 3) for size in (abs(bands.envelope[index]), threshold))  # type: ignore[index]
    return f"{' + '.join(parts)}: target {target} is below the detection threshold, {least} at {sensitive:.4g} Hz"
