"""The finger out of a recording: contact, then the plate where nothing touches it, then the finger on that plate."""

import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from hapticrender.analysis.course import Course, MotionFilter, Rest, Signals, at_least, sensor_noise
from hapticrender.analysis.lock_in import Lines, demodulate, tile, window_length
from hapticrender.analysis.records import DOUBTFUL, LOADED, UNLOADED, FingerRecord, Impedance, Segment, Touch, joined
from hapticrender.analysis.smoothing import LEAST_SPREAD, spread_of
from hapticrender.analysis.tracker import FingerTracker
from hapticrender.bands import Bands, hold_last
from hapticrender.checks import require
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array, Flag
from hapticrender.recordings.recording import Recording
from hapticrender.touch.curve import strongest_carriers
from hapticrender.touch.device_profile import DeviceProfile

WIDE = 0.25e-3  # s: spread of the kernel under the carriers; 0.8 of 400 Hz passes
RINGING = 0.25  # s after a lift in which the free plate rings down: 6 time constants of its heave mode
SETTLING = 0.06  # s after a touch in which the finger does: 6 of the least damped one of Table 1
BEFORE = 0.02  # s before a change of contact that are left out
SLOWEST, FASTEST = 15.0, 0.1  # Hz, of the sampling rate: carriers between them are analysed
NEAR_END = 5e-3  # m: a finger nearer to an end of the glass is not judged
MIDDLE = 15e-3  # m from the middle: where `least_load` holds
MILLIMETRE = 1e-3  # m
AROUND = 0.1  # s: what is lost acts so far, by the kernels
HEAVIEST, MOST_TOUCHES = 20.0, 5.0  # N; 1/s: no finger presses harder, or touches more often
STIFFEST = 100.0  # N s/m: no finger has a larger impedance from 15 Hz on
START = 0.5  # s: free of a finger with `free_start`
BLOCK = 1.0  # s of signal at a time


def analyse_finger(
    recording: Recording,
    profile: DeviceProfile | PlateParameters | str | os.PathLike[str] | None = None,
    *,
    block: int | None = None,
    free_start: bool = False,
) -> FingerRecord:
    """Estimate load, position, velocity, contact, force and impedance of the finger in a recording of a plate.

    Only `drive` and `sensed` are read: in a simulation the recorded position, load and motion are the truth.

    Parameters
    ----------
    recording : Recording
        Of a plate with two sensors at the ends of its glass, at least 1 s and 500 Hz.
    profile : DeviceProfile, PlateParameters or path of a profile, optional
        Model of the plate, with its uncertainty; default: that of the recording's scene.  Parameters without one have
        2 %, damping 10 %.  The delay is that of the recording, if known, where a profile states none.
    block : int, samples, optional
        Of the driver: a row of the drive acts ``delay - block`` samples after the row sensed with it; default: that of
        the recording, 1 where unknown.
    free_start : bool
        Whether nothing touches in the first 0.5 s, from which the sensors' zero is then taken; default: they read zero
        where nothing touches.

    Raises
    ------
    ValueError, TypeError
        An argument is of another kind; the recording is not of such a plate, too short, too slow, or a measurement is
        nowhere finite.

    Notes
    -----
    Contact is first decided on the profile's plate; the plate's parameters and the sensors' zero are then estimated
    from the spans without contact, and all is repeated with them.  On a plate so far off its profile that its carriers
    look like touches no such span is left: then they are taken where the force below 5 Hz is near zero.  The series end
    85 ms before the recording does.
    """
    require(isinstance(recording, Recording), "recording", recording, "a Recording: see Recording.load", TypeError)
    course = _course(recording, profile)
    block = recording.header.block or 1 if block is None else block
    _check(recording, course.plate, block)
    rate, late = recording.rate, course.plate.delay - block
    drive, sensed = (np.apply_along_axis(hold_last, 0, each) for each in (recording.drive, recording.sensed))
    if free_start:
        sensed = sensed - sensed[: round(START * rate)].mean(axis=0)
    signals = _Signals(course.plate, late, rate, drive, sensed)
    first, tracker = signals.track(course, None)
    frequency, threshold = _carriers(recording.bands, sensed, rate), tracker.threshold
    length = window_length(frequency, rate)
    lines = signals.unloaded(first.contact == UNLOADED, first.normal_load.value, frequency, length, threshold / 2)
    if not len(lines.time):
        slow = signals.slow_force(course)
        lines = signals.unloaded(np.abs(slow) < threshold, slow, frequency, length, threshold / 2)
    rest = None
    if len(lines.time):
        course = course.regressed(lines, signals.noise) if frequency.size else course
        rest = course.rest(lines)
    touch, tracker = signals.track(course, rest)
    bad = (recording.flags & int(Flag.OVERRUN | Flag.NONFINITE | Flag.TWO_TOUCHES)) > 0  # what is near is doubtful, too
    spoiled = maximum_filter1d(bad.astype(np.uint8), 2 * round(AROUND * rate) + 1)[: len(touch.contact)] > 0
    touch = replace(touch, contact=np.where(spoiled, DOUBTFUL, touch.contact))
    impedance = signals.impedance(course, touch, recording.bands, frequency, length, recording.header.calibration)
    edges = np.r_[0, np.flatnonzero(np.diff(touch.contact)) + 1, len(touch.contact)]
    return FingerRecord(
        **vars(touch),
        name=recording.header.name,
        segments=tuple(Segment(int(touch.contact[i]), i / rate, j / rate) for i, j in pairwise(edges.tolist())),
        plate=course.track(len(drive) / rate),
        impedance=impedance,
        least_load=tracker.least_load(MIDDLE, MILLIMETRE),
        notes=tuple(_notes(recording, course, touch, rest, impedance, threshold)),
    )


def _course(recording: Recording, profile: DeviceProfile | PlateParameters | str | os.PathLike[str] | None) -> Course:
    """Return the plate's parameters before the recording is looked at."""
    duration, given = len(recording) / recording.rate, profile is not None
    if isinstance(profile, PlateParameters):
        return Course.of(profile, duration=duration)
    if isinstance(profile, str | os.PathLike):
        profile = DeviceProfile.load(profile)
    elif profile is None:
        profile = recording.scene.device_profile
    accepted = "a DeviceProfile, PlateParameters, the path of a profile, or None for that of the recording"
    require(isinstance(profile, DeviceProfile), "profile", profile, accepted, TypeError)
    plate = "vt-plate, a plate with sensors of displacement"
    require(profile.kind == "vt-plate", "profile.kind", profile.kind, plate)
    known = {} if recording.header.delay is None else {"delay": recording.header.delay}
    stated = {**known, **profile.device} if given else {**profile.device, **known}
    return Course.of(PlateParameters.with_overrides(stated), profile.uncertainty, duration)


def _check(recording: Recording, plate: PlateParameters, block: int) -> None:
    header = recording.header
    if header.sensed_channels != 2 or header.unit != "m":
        found = f"{header.sensed_channels} sensors in {header.unit}"
        raise ValueError(f"{header.name}: {found}: must be 2 in m, at the ends of a plate's glass")
    if header.drive_channels != plate.coils:
        raise ValueError(f"{header.name}: {header.drive_channels} drive channels: must be {plate.coils}, one a coil")
    if len(recording) < recording.rate:
        raise ValueError(f"{header.name}: {len(recording) / recording.rate:g} s long: must be >= 1 s")
    cure = "state delay, from a sensed sample to the drive computed from it, in [device] of the profile"
    if not (isinstance(block, int | np.integer) and 1 <= block <= plate.delay):
        raise ValueError(f"{block=} samples: must be an integer from 1 to the plate's delay, {plate.delay}: {cure}")
    if not np.isfinite(recording.sensed).any(axis=0).all():
        raise ValueError(f"{header.name}: a sensor is finite nowhere: must be displacement in m")


def _carriers(bands: Bands, sensed: Array, rate: float) -> Array:
    """Fixed carriers (Hz) to be analysed; where there are no carriers at all, the strongest of the motion."""
    if len(bands):
        fixed = bands.frequency[bands.wavenumber == 0.0]
    else:
        fixed = strongest_carriers(sensed.mean(axis=1), rate, passband=(SLOWEST, FASTEST * rate))
    return np.unique(fixed[(fixed >= SLOWEST) & (fixed <= FASTEST * rate)])


class _Signals:
    """Drive and measurement of a recording: tracked, and demodulated in windows."""

    def __init__(self, plate: PlateParameters, late: int, rate: float, drive: Array, sensed: Array) -> None:
        self.late, self.rate, self.drive, self.sensed = late, rate, drive, sensed
        self.spread = max(WIDE, LEAST_SPREAD / rate)
        wide = MotionFilter(plate, rate, self.spread, late)
        padded = (np.concatenate([each, np.repeat(each[-1:], wide.delay, axis=0)]) for each in (drive, sensed))
        x = wide.update(*padded)
        self.columns = np.hstack([x.displacement, x.velocity, x.acceleration, x.force])[wide.delay :]
        self.white = at_least(sensor_noise(sensed), plate)
        self.noise = wide.coordinate_noise(self.white)

    def track(self, course: Course, rest: Rest | None) -> tuple[Touch, FingerTracker]:
        """Track the whole recording, symmetric in time, a second at a time."""
        tracker = FingerTracker(course, rate=self.rate, late=self.late, noise=self.white, lookahead=1.0, rest=rest)
        step = round(BLOCK * self.rate)
        starts = range(0, len(self.drive), step)
        parts = [tracker.update(self.drive[i : i + step], self.sensed[i : i + step]) for i in starts]
        return joined(parts), tracker

    def slow_force(self, course: Course) -> Array:
        """Heave force (N, (n,)) below a third of `SLOWEST`: of a carrier there 4 % pass, at 20 Hz 0.4 %.

        What carriers leave of a plate that is far off its profile is not in it.
        """
        theta = course.at(np.arange(len(self.columns)) / self.rate)
        force = Signals.of(self.columns).residual(theta, course.plate.half_spacing)
        return np.asarray(gaussian_filter1d(force[:, 0], spread_of(SLOWEST / 3) * self.rate, mode="nearest"))

    def unloaded(self, free: Array, load: Array, frequency: Array, length: int, quiet: float) -> Lines:
        """Demodulate windows that are free of a finger, whose mean load (N) is below `quiet`."""
        starts = tile(free, length, round(RINGING * self.rate), round(BEFORE * self.rate))
        mean = np.array([load[i : i + length].mean() for i in starts])
        starts = starts[np.abs(mean) < quiet] if len(starts) else starts
        return self.lines(self.columns, starts, length, np.tile(frequency, (len(starts), 1)))

    def lines(self, columns: Array, starts: Array, length: int, frequency: Array) -> Lines:
        """Demodulate, and undo what the kernel does to the carriers."""
        lines = demodulate(columns, starts, length, frequency, self.rate)
        passed = np.exp(-0.5 * (2 * np.pi * frequency * self.spread) ** 2)
        return replace(lines, amplitude=lines.amplitude / passed[..., None])

    def impedance(
        self, course: Course, touch: Touch, bands: Bands, fixed: Array, length: int, gain: float
    ) -> Impedance:
        """Impedance of the finger in windows under load."""
        a, end = course.plate.half_spacing, course.plate.glass_length / 2 - NEAR_END
        place, error = touch.position.value, touch.position.standard_error
        with np.errstate(invalid="ignore"):
            inside = (touch.contact == LOADED) & (np.abs(place) < end)
        starts = tile(inside, length, round(SETTLING * self.rate), round(BEFORE * self.rate))
        series = touch.normal_load.value, place, error, touch.velocity.value
        load, middle, spread, speed = (np.array([each[i : i + length].mean() for i in starts]) for each in series)
        locked = bands.wavenumber > 0.0
        moving = np.abs(bands.frequency[locked] + np.multiply.outer(speed, bands.wavenumber[locked]))
        frequency = np.hstack([np.tile(fixed, (len(starts), 1)), moving.reshape(len(starts), int(locked.sum()))])
        usable = (frequency >= SLOWEST) & (frequency <= FASTEST * self.rate)
        frequency = np.where(usable, frequency, SLOWEST)
        lever = np.nan_to_num(place) / a * self.columns[: len(place), 3]
        columns = np.column_stack([self.columns[: len(place)], lever])
        lines = self.lines(columns, starts, length, frequency)
        found = course.impedance(lines, self.noise, load, middle, spread, gain)
        value, errors = (np.where(usable, each, np.nan) for each in (found.value, found.standard_error))
        return replace(found, value=value, standard_error=errors)


def _notes(
    recording: Recording, course: Course, touch: Touch, rest: Rest | None, impedance: Impedance, threshold: float
) -> Iterator[str]:
    """List what could not be measured, and why."""
    if rest is None:
        yield "no unloaded span is long enough: the sensors' zero and the plate's parameters are taken from the profile"
    elif not course.measured:
        yield "the carriers do not determine the stiffness in the unloaded spans: it is mostly that of the profile"
    if course.misfit > 1.0:
        times = f"{course.misfit**0.5:.2g} times as much as noise explains"
        yield f"without a finger the plate moves otherwise than its model, {times}: identify it, its glass may bend"
    if rest is not None and abs(force := float(np.median(rest.values[:, 0]))) > threshold:
        yield (
            f"the sensors show {force:.3g} N while unloaded, beyond the threshold of contact ({threshold:.3g} N): "
            "set their zero, or take it from the first 0.5 s (free_start, --free-start)"
        )
    if not (touch.contact == LOADED).any():
        yield "no finger touches"
    elif not len(impedance.time):
        yield "no touch is long enough for a window: the impedance is not measured"
    flags = np.bitwise_or.reduce(recording.flags) if len(recording) else 0
    for bad, text in (
        (Flag.NONFINITE, "samples that are no numbers are held"),
        (Flag.SENSOR_CLIPPED, "a sensor clips"),
        (Flag.OVERRUN, "samples were lost"),
        (Flag.TWO_TOUCHES, "more than one finger touched"),
        (Flag.STOPPED, "the drive was stopped"),
    ):
        if flags & bad:
            yield f"{text}: errors near there are larger than stated"
    heaviest, touches = np.nanmax(touch.normal_load.value, initial=0.0), np.diff(touch.contact == LOADED).sum() / 2
    sizes = np.abs(impedance.value[np.isfinite(impedance.value)])
    size = np.median(sizes) if sizes.size else 0.0
    most = MOST_TOUCHES * max(len(recording) / recording.rate, 1.0)
    if heaviest > HEAVIEST or touches > most or size > STIFFEST:  # no finger's
        found = f"up to {heaviest:.3g} N in {touches:.0f} touches, |Z| {size:.3g} N s/m"
        yield f"{found}: check units, signs and scales of drive and sensors, the block, and the profile"
    plate, known = course.plate, recording.header.delay
    if known is not None and plate.delay != known:
        yield f"the profile's delay, {plate.delay} samples, is not that of the recording, {known} samples"
    if known != plate.delay and abs(recording.rate - plate.rate) > 1e-3 * plate.rate:
        yield f"the profile's delay, {plate.delay} samples, is taken at {recording.rate:g} Hz, not at {plate.rate:g} Hz"
