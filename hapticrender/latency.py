"""Delay of a driver's loop, measured through a cable from its first output to its first input.

A burst of random signs x is played and y is sensed; with the cross-spectrum S = Y X* the round trip is the shift s of
the largest peak of its correlation, and then, to a fraction of a sample, the slope of the phase of S exp(j w s) through
the origin (least squares, weighted by the magnitude of S, 0.05 to 0.4 of the rate).  With blocks of B samples, and
`host_delay` samples that the driver's `play` itself adds, the delay of the device's loop is

    delay = B + s - 1/2 - host_delay,

for in the loop's models a drive is held for a sample, and so acts half a sample after its number.
"""

import statistics
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hapticrender.checks import integer
from hapticrender.devices import open_driver
from hapticrender.errors import DriverError
from hapticrender.loop import opened as open_at_rest
from hapticrender.protocols import Array, Flag
from hapticrender.touch.device_profile import DeviceProfile

BURST, TAIL = 0.05, 0.5  # s: noise that is played; after it, the longest round trip of a device that can be found
FEWEST = 2048  # samples of a burst
BAND = (0.05, 0.4)  # of the rate
LEAST_CORRELATION = 0.5  # of what is sensed with what was played
WHOLE = 0.995  # correlation from which on a burst has come back whole (its gain within 1 %), although samples were lost
MOST_SPREAD = 0.5  # samples, between runs
TINY = float(np.finfo(float).tiny)
TRIES = 10  # times as many runs as requested, where samples are lost


class Trip(NamedTuple):
    """One run: round trip (samples), gain, and correlation (0 to 1) of what was sensed with what was played."""

    samples: float
    gain: float  # negative: the cable is inverted
    correlation: float  # in the band that is used


@dataclass(frozen=True)
class Latency:
    """Measured round trips (samples) of a driver of `rate` (Hz) and `block` (samples)."""

    trips: tuple[Trip, ...]
    rate: float
    block: int
    host_delay: int = 0  # samples that the driver's `play` adds

    @property
    def spread(self) -> float:
        """Largest less smallest round trip (samples)."""
        found = [trip.samples for trip in self.trips]
        return max(found) - min(found)

    @property
    def gain(self) -> float:
        """Median of sensed over played, in the driver's units."""
        return statistics.median(trip.gain for trip in self.trips)

    @property
    def delay(self) -> float:
        """Delay of the device's loop (samples), the driver's argument `delay`."""
        return self.block + statistics.median(trip.samples for trip in self.trips) - 0.5 - self.host_delay

    def __str__(self) -> str:
        milliseconds = 1e3 * self.delay / self.rate
        cure = "; inverted: swap the two wires of the cable, or of the coils where the card inverts"
        return (
            f"delay {self.delay:.2f} samples ({milliseconds:.3f} ms) at {self.rate:g} Hz in blocks of {self.block}; "
            f"{len(self.trips)} runs, spread {self.spread:.3f} samples, gain of the cable {self.gain:.4g}"
            f"{cure if self.gain < 0.0 else ''}"
        )


def measure_latency(driver: Any, *, runs: int = 5, amplitude: float = 0.1) -> Latency:
    """Measure the delay of a driver's loop through a cable from its first output to its first input.

    `driver` is any object with `play`, not opened yet, or a text as ``--driver`` takes it; one with ``loop_back()``
    makes a new driver for each of the `runs` (>= 1).  The `amplitude` (> 0) is that of the burst, in the unit of the
    drive; of full scale for a sound card.  A ValueError where an argument is out of its bound, or the driver senses
    nothing; a DriverError where nothing of what was played is sensed, samples were lost in most of the runs, or the
    runs disagree.
    """
    integer("runs", runs, least=1)
    if isinstance(driver, str) and (driver := open_driver(text := driver)) is None:
        raise ValueError(f"driver = {text!r}: must be a device with a cable, such as audio:0")
    again = hasattr(driver, "loop_back")  # a new driver for every run
    most = 1.0 if again else getattr(driver, "drive_limit", np.inf)
    if not 0 < amplitude < np.inf or amplitude > most:
        raise ValueError(f"{amplitude=}: must be > 0 and <= {most:g}, the limit of the drive in its unit")
    if not (again or driver.sensed_channels):
        raise ValueError(f"{driver}: senses nothing: a round trip needs an input")
    rng, trips, tries = np.random.default_rng(0), list[Trip](), 0
    while len(trips) < runs and tries < TRIES * runs:
        with open_at_rest(made := driver.loop_back() if again else driver, made) as opened:
            for _ in range(1 if again else TRIES * runs):
                tries += 1
                if trip := _trip(opened, amplitude, rng):
                    trips.append(trip)
                if len(trips) == runs:
                    break
    name = f"{driver}: latency"
    if len(trips) < runs:
        raise DriverError(f"{name}: samples were lost in {tries - len(trips)} of {tries} runs: use larger blocks")
    found = Latency(tuple(trips), float(opened.rate), int(opened.block), int(getattr(opened, "host_delay", 0)))
    weakest = min(trip.correlation for trip in trips)
    if weakest < LEAST_CORRELATION:
        raise DriverError(
            f"{name}: what is sensed follows what is played with a correlation of {weakest:.2f}, must be >= "
            f"{LEAST_CORRELATION:g}: connect the first output to the first input, nothing between, and turn both up"
        )
    if found.spread > MOST_SPREAD:
        listed = ", ".join(f"{trip.samples:.2f}" for trip in trips)
        raise DriverError(
            f"{name}: the runs disagree by {found.spread:.2f} samples (bound {MOST_SPREAD:g}): {listed}; end other "
            "programs that use the card, or use larger blocks"
        )
    return found


def _trip(driver: Any, amplitude: float, rng: np.random.Generator) -> Trip | None:
    """Play a burst and find it in what is sensed; None where samples of it were lost."""
    block = driver.block
    length = -(-max(round(BURST * driver.rate), FEWEST) // block) * block
    burst = amplitude * rng.choice([-1.0, 1.0], length)
    tail = round(TAIL * driver.rate) + getattr(driver, "host_delay", 0)
    played = np.concatenate([burst, np.zeros(-(-tail // block) * block)])
    sensed, lost = np.empty_like(played), np.zeros(len(played), bool)
    for start in range(0, len(played), block):
        drive = np.zeros((block, driver.drive_channels))
        drive[:, 0] = played[start : start + block]
        got = driver.play(drive)
        sensed[start : start + block] = got.sensed[:, 0]
        lost[start : start + block] = 0 if got.flags is None else got.flags & Flag.OVERRUN
    trip = find_trip(played, sensed)
    damaged = lost[: length + int(trip.samples) + block].any() and trip.correlation < WHOLE
    return None if damaged else trip


def find_trip(played: Array, sensed: Array) -> Trip:
    """Find `played` (shape (n,), its end silent) in `sensed` (n,): see the module for the equations."""
    n = 2 * len(played)
    turns = np.fft.rfftfreq(n)
    cross = np.fft.rfft(sensed, n) * np.fft.rfft(played, n).conj()
    correlation = np.fft.irfft(cross, n)[: len(played)]
    shift = int(np.argmax(abs(correlation)))
    inside = (turns >= BAND[0]) & (turns <= BAND[1])
    omega = 2 * np.pi * turns[inside]
    aligned = np.sign(correlation[shift]) * cross[inside] * np.exp(1j * omega * shift)
    weight = abs(aligned)
    slope = -np.sum(weight * omega * np.angle(aligned)) / max(float(np.sum(weight * omega**2)), TINY)
    powers = [float(np.sum(abs(np.fft.rfft(each, n)[inside]) ** 2)) for each in (played, sensed)]
    common = float(np.sum((aligned * np.exp(1j * omega * slope)).real))
    gain = float(np.sign(correlation[shift])) * common / powers[0]
    return Trip(shift + float(slope), gain, common / max((powers[0] * powers[1]) ** 0.5, TINY))


def write_delay(path: Path, found: Latency, tool: str = "") -> None:
    """Write the delay into the calibration of a profile; a new one is that of a plate.

    One without parameters of the device says that it was measured with `tool` (200 characters of it), today.
    """
    profile = DeviceProfile.load(path) if path.exists() else DeviceProfile(kind="vt-plate")
    origin: Any = {} if profile.device else {"measured_with": tool[:200], "measured_on": date.today()}
    calibration = replace(profile.calibration, delay=round(found.delay, 3))
    replace(profile, calibration=calibration, **origin).save(path)
