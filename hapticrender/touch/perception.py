"""Perception: detection threshold, sensation level, equivalent force, roughness, and bands too weak to be felt.

Amplitudes are peaks (m, m/s, N) of sinusoids; levels are dB above the classic detection threshold.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hapticrender import checks
from hapticrender.bands import Bands
from hapticrender.protocols import Array
from hapticrender.touch.mechanics import FingerMechanics

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

# Just noticeable differences, the smallest of each source: an error below them is not felt.
AMPLITUDE_JND = 2.2  # dB, of 2.2 to 2.5: Israr, Tan and Reed 2006
ELECTROVIBRATION_JND = 1.21  # dB of voltage, twice that of force: Ryu et al. 2018


class Unfelt(NamedTuple):
    """A band that was dropped, and why."""

    frequency: float  # Hz, fixed part of the carrier
    wavelength: float | None  # m, of a carrier locked to the finger
    amplitude: float  # m peak
    threshold: float  # m peak, the least that anyone could feel wherever the band can be
    most_sensitive: float  # Hz, where that is

    def text(self) -> str:
        """Say so in a line.

        >>> Unfelt(1050.0, None, 4e-10, 2.81e-7, 1050.0).text()
        '1050 Hz: 0.4 nm wanted, below the 281 nm that anyone could feel there'
        """
        fixed = [] if self.wavelength is not None and self.frequency == 0 else [f"{self.frequency:.4g} Hz"]
        locked = [] if self.wavelength is None else [f"wavelength {_length(self.wavelength)}"]
        place = "there" if self.wavelength is None else f"at {self.most_sensitive:.4g} Hz"
        wanted, least = _length(self.amplitude), _length(self.threshold)
        return f"{' + '.join(fixed + locked)}: {wanted} wanted, below the {least} that anyone could feel {place}"


def detection_threshold(frequency: float | Array, curve: str = "safe") -> Array:
    """Least amplitude of a sinusoid that is felt.

    Parameters
    ----------
    frequency : float or ndarray, Hz
        Finite and >= 0.
    curve : {"safe", "classic"}
        "classic" is the published threshold for a large contactor, log-log
        between its table's entries; to score and to state levels by.
        "safe" is what may be left out: 6 dB below it under 40 Hz, 10 dB from
        40 Hz on and 25 dB from 80 Hz on, since active touch of a flat plate
        is that much more sensitive.  At a border the lower value holds.

    Returns
    -------
    float or ndarray, m peak
        Beyond 1 to 1000 Hz the classic threshold is unknown: NaN.  The safe one is
        0 below 1 Hz (nothing can be left out); above 1 kHz it stays as it is
        at 1 kHz, but never above the motion that `REALISTIC_FORCE` makes.

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
    hertz = _frequency(frequency)
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
    return np.asarray(velocity) / (2 * np.pi * _frequency(frequency, zero=False))


def to_velocity(displacement: float | Array, frequency: float | Array) -> Array:
    """Velocity (m/s peak) of a sinusoidal `displacement` (m peak) at `frequency` (Hz, >= 0): V = 2 pi f X."""
    return np.asarray(displacement) * (2 * np.pi * _frequency(frequency))


def force(
    velocity: float | Array, mechanics: FingerMechanics | None = None, frequency: float | Array | None = None
) -> Array:
    """Lateral force on the finger that feels as strong as a skin velocity.

    Parameters
    ----------
    velocity : float or ndarray, m/s
        Of the skin: peak, or complex.
    mechanics : FingerMechanics, optional
        Of order 2 or 4: the force that moves this finger's skin so.  Default:
        any finger, matched by feeling.
    frequency : float or ndarray, Hz
        Needed with `mechanics`, > 0; the match by feeling holds from 20 to
        400 Hz (below 31 Hz it is displacement rather than velocity that is matched).

    Returns
    -------
    float or ndarray, N
        ``velocity/0.64``, or ``velocity/(V_s/F)``: complex, its magnitude the
        peak and its angle the force's lead.

    References
    ----------
    Grigorii, Li, Peshkin, Colgate: Comparison of wide-band vibrotactile and
    friction modulation surface gratings, 2021.

    Examples
    --------
    >>> float(force(0.064))
    0.1
    """
    if mechanics is None:
        return np.asarray(velocity) / VELOCITY_PER_FORCE
    if not isinstance(mechanics, FingerMechanics):
        checks.refuse("mechanics", mechanics, "FingerMechanics or None", TypeError)
    if frequency is None:
        checks.refuse("frequency", frequency, "finite numbers > 0 Hz where mechanics are given")
    return np.asarray(velocity) / mechanics.skin_velocity_per_force(_frequency(frequency, zero=False))


def roughness(displacement: float | Array, frequency: float | Array) -> float:
    """Roughness of a fine texture: its power as the Pacinian channel weighs it.

    Parameters
    ----------
    displacement : float or ndarray, m peak
        Of every partial; may be complex.
    frequency : float or ndarray, Hz
        Of every partial, >= 0.

    Returns
    -------
    float
        ``sum |X(f)|^2/T_P(f)^2`` with the threshold T_P of the Pacinian
        channel: the classic one from 40 Hz on, rising by 12 dB an octave below.
        Partials above 1 kHz, where T_P is unknown, add nothing.

    References
    ----------
    Bensmaia, Hollins: The vibrations of texture, Somatosens. Mot. Res. 20, 2003.
    """
    hertz = _frequency(frequency)
    threshold = detection_threshold(np.clip(hertz, PACINIAN_FROM, HIGHEST), "classic")
    with np.errstate(under="ignore"):
        weight = np.minimum(hertz / PACINIAN_FROM, 1.0) ** 2
        return float(np.sum(np.where(hertz <= HIGHEST, np.abs(displacement) * weight / threshold, 0.0) ** 2))


def drop_unfelt(
    bands: Bands, *, top_speed: float, lowest: float, highest: float, margin: float = 0.0
) -> tuple[Bands, tuple[Unfelt, ...]]:
    """Leave out the bands that no one can feel.

    A band can go if it stays below the safe threshold wherever it can be: a
    fixed carrier at its frequency, one that is locked to the finger at every
    frequency from `lowest` to `highest` that a finger of up to `top_speed`
    gives it, in both directions.  The weakest go first, and only as long as
    all that went, each over its threshold, sum to less than 1: together and
    in step they cannot be felt either.  That one band masks another is not used.

    Parameters
    ----------
    bands : Bands
        Those of a recording (envelope None) are kept: how strong they get is not known here.
    top_speed : float, m/s
        Of the finger, >= 0 and <= 10; 0 without a finger.
    lowest, highest : float, Hz
        Where the device renders finger-locked carriers, 0 <= lowest <= highest <= 1e6.
        A band that never gets there is kept, as is one that gets below 1 Hz.
    margin : float, dB
        Lowers the safe threshold further, >= 0 and <= 60.  The classic table is
        known to within 4 dB; the keenest fingers known are 12 dB below the safe one (250 Hz).

    Returns
    -------
    bands : Bands
        Those that are left.
    dropped : tuple of Unfelt
        In the order of `bands`.

    Raises
    ------
    ValueError
        No band would be left, or an argument is out of its bounds.

    Examples
    --------
    >>> bands = Bands(frequency=[20.0, 60.0], wavenumber=[0.0, 0.0], phase=[0.0, 0.0], envelope=[1e-5, 1e-7])
    >>> left, dropped = drop_unfelt(bands, top_speed=0.0, lowest=5.0, highest=1000.0)
    >>> len(left), dropped[0].text()
    (1, '60 Hz: 100 nm wanted, below the 583 nm that anyone could feel there')
    """
    top_speed = checks.number("top_speed", top_speed, "m/s", least=0, most=10)
    lowest = checks.number("lowest", lowest, "Hz", least=0, most=1e6)
    highest = checks.number("highest", highest, "Hz", least=lowest, most=1e6)
    margin = checks.number("margin", margin, "dB", least=0, most=60)
    if bands.envelope is None or not len(bands):
        return bands, ()
    least, place = _most_sensitive(bands, top_speed, lowest, highest)
    least *= 10 ** (-margin / 20)
    going = _unfelt_together(np.abs(bands.envelope), least)
    dropped = tuple(_unfelt(bands, int(index), least, place) for index in np.flatnonzero(going))
    if going.all():
        strongest = max(dropped, key=lambda band: band.amplitude / band.threshold)
        raise ValueError(f"no band can be felt: {strongest.text()} (keep_unfelt renders such bands all the same)")
    return (_select(bands, ~going), dropped) if dropped else (bands, ())


def _frequency(frequency: float | Array, zero: bool = True) -> Array:
    """Return frequencies (Hz) as an array, if all are finite and >= 0 (> 0 if not `zero`)."""
    hertz = np.asarray(frequency, float)
    if not (np.isfinite(hertz) & ((hertz >= 0) if zero else (hertz > 0))).all():
        checks.refuse("frequency", frequency, f"finite numbers {'>=' if zero else '>'} 0 Hz")
    return hertz


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


def _unfelt_together(amplitude: Array, threshold: Array) -> Array:
    """Mark the weakest bands, as many as sum to less than 1 in units of their thresholds."""
    share = np.full(amplitude.size, np.inf)
    np.divide(amplitude, threshold, out=share, where=threshold > 0)
    order = np.argsort(share, kind="stable")
    going = np.zeros(amplitude.size, bool)
    going[order] = np.cumsum(share[order]) < 1
    return going


def _unfelt(bands: Bands, index: int, least: Array, place: Array) -> Unfelt:
    wavenumber = float(bands.wavenumber[index])
    wavelength = 1 / wavenumber if wavenumber else None
    amplitude = 0.0 if bands.envelope is None else float(abs(bands.envelope[index]))
    return Unfelt(float(bands.frequency[index]), wavelength, amplitude, float(least[index]), float(place[index]))


def _select(bands: Bands, kept: Array) -> Bands:
    envelope = None if bands.envelope is None else bands.envelope[kept]
    frequency, wavenumber, phase = (each[kept] for each in (bands.frequency, bands.wavenumber, bands.phase))
    return replace(bands, frequency=frequency, wavenumber=wavenumber, phase=phase, envelope=envelope)


def _length(metres: float) -> str:
    """Three digits of a length in nm, um or mm."""
    scale, unit = (1e-9, "nm") if metres < 9.995e-7 else (1e-6, "µm") if metres < 9.995e-4 else (1e-3, "mm")
    return f"{metres / scale:.3g} {unit}"
