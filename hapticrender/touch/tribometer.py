"""A finger slid over a real surface: the recording of a tribometer, and what can be read from it."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from hapticrender import checks
from hapticrender.errors import naming
from hapticrender.protocols import Array

KEYS = ("encoder", "metre_per_count", "lateral_force", "normal_force", "rate")
MOST_SAMPLES = 1 << 24
MOST_BYTES = 8 * MOST_SAMPLES + 4096  # of an array in the file, with its header
MOST_TRAVEL = 10.0  # m in contact
MOST_SPEED = 10.0  # m/s
SMOOTHING = 0.02  # s, of force and velocity before a threshold is applied
UNLOADED = 0.5  # s at the beginning during which nothing touches
TOUCH, RELEASE = 0.2, 0.1  # N of normal load
SHORTEST_TOUCH = 0.05  # s
LEAST_FRICTION = 0.02  # N of lateral force that a sliding finger makes, at least
LEAST_SPEED = 1e-3  # m/s


@dataclass(frozen=True, eq=False)
class SwipeRecording:
    """A finger's motion and forces over n samples, offsets removed.

    Contact is read from the normal force: more than 0.2 N away from the median of the first 0.5 s (up or down), until
    less than 0.1 N.  A carriage that homes moves but does not touch; a finger that rests touches but does not slide.
    """

    rate: float  # Hz
    position: Array  # m: unwrapped, with 0 in the middle of the travel in contact
    normal_load: Array  # N above the unloaded level, smoothed over 20 ms, 0 while lifted
    lateral_force: Array  # N above its unloaded level
    touching: Array  # bool
    sliding: Array  # bool: touching, and faster than half the main speed in the main direction, with friction
    speed: float  # m/s: median while sliding; 0 where the finger never slides

    @property
    def duration(self) -> float:
        """Time of the last sample, s."""
        return (self.position.size - 1) / self.rate

    def force_profile(self, spacing: float) -> tuple[Array, float]:
        """Lateral force (N) on a uniform grid of positions `spacing` (m) apart, and the first position (m)."""
        where, force = self.position[self.sliding], self.lateral_force[self.sliding]
        start = where.min()
        cell = np.floor((where - start) / spacing).astype(np.intp)
        hits = np.bincount(cell)
        filled = np.flatnonzero(hits)
        mean = np.bincount(cell, weights=force)[filled] / hits[filled]
        return np.interp(np.arange(hits.size), filled, mean), float(start + spacing / 2)


def unwrap_counts(counts: Array) -> Array:
    """Positions (int64) of a counter of unsigned integers that wraps both ways, from the first count, signed, on."""
    counts = counts.astype(counts.dtype.newbyteorder("="))
    signed = f"i{counts.itemsize}"
    return np.cumsum(np.append(counts[:1].view(signed), np.diff(counts).view(signed)), dtype=np.int64)


def load_swipe(file: str) -> SwipeRecording:
    """Read a tribometer recording: an ``.npz`` with the arrays named in `KEYS`; raises `SceneError`."""
    with naming(f"file = {checks.show(file)}"):
        if not Path(file).is_file():
            raise ValueError("must be an existing .npz file")
        return _load_swipe(file, Path(file).stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _load_swipe(file: str, changed: int) -> SwipeRecording:
    """As `load_swipe`, cached until the file changes."""
    from scipy.ndimage import find_objects, label

    raw = _read(file)
    single = {key: raw[key].item() if raw[key].size == 1 else raw[key] for key in ("rate", "metre_per_count")}
    rate = checks.number("rate", single["rate"], "Hz", above=0, most=1e6)
    metre_per_count = checks.number("metre_per_count", single["metre_per_count"], "m", above=0, most=1e-3)
    lateral, normal = (_row(raw, key, "iuf", "numbers in N").astype(float) for key in ("lateral_force", "normal_force"))
    position = unwrap_counts(_row(raw, "encoder", "iu", "integer counts").astype(np.uint32)) * metre_per_count
    if not position.size == lateral.size == normal.size > UNLOADED * rate + 1:
        sizes = f"{position.size}, {lateral.size}, {normal.size}"
        bound = f"must be equal and more than {UNLOADED} s at {rate:g} Hz"
        raise ValueError(f"encoder, lateral_force, normal_force have {sizes} samples: {bound}")
    departure = _smooth(normal - np.median(normal[: int(UNLOADED * rate)]), rate)
    large = np.abs(departure) > np.abs(departure).max() / 2
    load = departure * (-1.0 if departure[large].sum() < 0 else 1.0)  # positive for a press, by the larger part of it
    touching = np.zeros(load.size, bool)
    for (run,) in find_objects(label(load > RELEASE)[0]):
        touching[run] = load[run].max() > TOUCH and run.stop - run.start >= SHORTEST_TOUCH * rate
    if not touching.any():
        bound = f"must be > {TOUCH} N for {SHORTEST_TOUCH} s to be a touch"
        raise ValueError(f"normal_force departs by {np.abs(load).max():.3g} N from its level before: {bound}")
    first, last = position[touching].min(), position[touching].max()
    if (travel := last - first) > MOST_TRAVEL:
        raise ValueError(f"travels {travel:.3g} m in contact: must be <= {MOST_TRAVEL:g} m; is metre_per_count right?")
    position = position - (first + last) / 2
    lateral = lateral - np.median(lateral[~touching])
    sliding, speed = _sliding(position, lateral, touching, rate)
    if speed > MOST_SPEED:
        raise ValueError(f"slides at {speed:.3g} m/s: must be <= {MOST_SPEED:g} m/s")
    return SwipeRecording(rate, position, np.where(touching, load, 0.0), lateral, touching, sliding, speed)


def _read(file: str) -> dict[str, Array]:
    """Arrays of `KEYS`, each of at most `MOST_BYTES`; a file of unknown making may fail in any way."""
    try:
        with open(file, "rb") as opened, np.load(opened) as archive:
            sizes = {member.filename: member.file_size for member in archive.zip.infolist()}
            sizes = {key: sizes.get(f"{key}.npy") for key in KEYS}
            raw = {key: archive[key] for key, size in sizes.items() if size is not None and size <= MOST_BYTES}
    except Exception as problem:
        raise ValueError(f"must be a readable .npz file ({checks.show(problem)})") from problem
    for key in KEYS:
        if key not in raw:
            found = "is missing" if sizes[key] is None else f"has {sizes[key]} bytes"
            raise ValueError(f"{key} {found}: must hold {', '.join(KEYS)}, each of <= {MOST_BYTES} bytes")
    return raw


def _row(raw: dict[str, Array], key: str, kinds: str, bound: str) -> Array:
    """Return an array that is a row of finite numbers of the dtype `kinds`."""
    row = raw[key]
    if row.ndim != 1 or row.dtype.kind not in kinds or not 2 <= row.size <= MOST_SAMPLES:
        must = f"must be a row of <= {MOST_SAMPLES} and >= 2 {bound}"
        raise ValueError(f"{key} has shape {row.shape} and type {row.dtype}: {must}")
    for bad in np.flatnonzero(~np.isfinite(row))[:1]:
        raise ValueError(f"{key}[{bad}] = {row[bad]}: must be a finite number")
    return row


def _smooth(values: Array, rate: float) -> Array:
    """Mean over `SMOOTHING` seconds around each sample, the ends held."""
    from scipy.ndimage import uniform_filter1d

    return uniform_filter1d(values, 2 * max(round(SMOOTHING * rate / 2), 1) + 1, mode="nearest")


def _sliding(position: Array, lateral: Array, touching: Array, rate: float) -> tuple[Array, float]:
    velocity = np.gradient(_smooth(position, rate)) * rate
    rubbing = touching & (np.abs(velocity) > LEAST_SPEED) & (np.abs(_smooth(lateral, rate)) > LEAST_FRICTION)
    if not rubbing.any():
        return rubbing, 0.0
    along = velocity * (1.0 if velocity[rubbing].sum() >= 0 else -1.0)
    speed = float(np.median(along[rubbing & (along > 0)]))
    return rubbing & (along > speed / 2), speed
