"""A user's resonant plate as a driver of friction: the law, and the amplitude's own controller, in between.

The device plays volts and senses the displacement of its mode, both at the carrier's rate.  What the friction loop
sees of it is the interface of the simulated surface: friction (N) in, and the friction that the sensed amplitude must
leave out, at a fraction of that rate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hapticrender import defaults
from hapticrender.contract import check_driver, check_sensed
from hapticrender.control.bank.controller import BankController
from hapticrender.control.methods import method_named
from hapticrender.plants.electroadhesion import finger_rows
from hapticrender.plants.friction_laws import friction_ratios, wanted_amplitudes
from hapticrender.plants.surface import SurfaceParameters, full_slew
from hapticrender.plants.surface_kernels import LOAD, SPEED, amplitude_fade, ask_within_reach, sensed_amplitude
from hapticrender.protocols import Array, Driver, Flag, Sensed
from hapticrender.touch.finger import Finger

LONGEST_DELAY = 0.25e-3  # s: a tenth of a turn of 400 Hz, 3 % off there, and beyond 10 % half as late again


class ResonantDriver:
    """A driver of friction (N) on a device that vibrates: its drive in V, its sensor in m of the mode.

    Parameters
    ----------
    driver : Driver
        The device, at a whole multiple of `parameters.rate`, with one drive channel and one sensed channel, or none:
        then it is driven open loop, by what a finger of nominal load makes of the mode.
        Its block is a whole multiple of that multiple, or divides it.
    parameters : SurfaceParameters
        What is known of the surface; its rate is that of the friction.
    finger : Finger
        Where the finger is, and how hard it presses where the device does not tell.
    nominal : (float, float), N and m/s
        Load and speed that the amplitude is held for while no finger is there.

    Attributes
    ----------
    loop : BankController
        The amplitude's own controller, on the device's samples.

    Raises
    ------
    ValueError
        Rate, block or channels of the device do not fit.

    Notes
    -----
    A friction that is asked for acts a block of the device after it was handed over, and is felt as amplitude within
    the device's own delay: `delay` is their sum.  The loop steps with every sample, its resonance lock as well, however
    long the device's blocks are; but what it learns of a finger it learns no faster than the device answers, and it
    takes what is late for wrong: a texture of f Hz behind a delay d is up to 1 % off at f d = 1/15 and 7 % at 1/10.
    """

    drive_channels = 1

    def __init__(
        self, driver: Driver, parameters: SurfaceParameters, finger: Finger, nominal: tuple[float, float]
    ) -> None:
        check_driver(driver)
        many = _multiple(driver, parameters)
        self.driver, self.finger = driver, finger
        self.parameters = replace(
            parameters, level="carrier", oversampling=many, mode=replace(parameters.mode, delay=driver.delay)
        )
        self.rate = float(parameters.rate)
        self.block = max(driver.block // many, 1)
        self.delay = max(self.block, round((driver.block + driver.delay) / many))
        self.sensed_channels = driver.sensed_channels
        self._piece = min(driver.block, many)
        self._nominal = nominal
        self.loop = amplitude_loop(self.parameters, held=None if driver.sensed_channels else nominal[0])
        self._samples = 0
        self._wanted = 0.0  # m, at the end of the last sample
        self._reached = -1.0  # m, alike, by what the drive can do; negative: it starts from rest
        self._friction = 0.0  # N: what was heard of the last sample
        self._drive = np.zeros((driver.block, 1))
        self._next = np.zeros((driver.block, 1))

    def __enter__(self) -> ResonantDriver:
        self.driver.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.driver.__exit__(*exc)

    def play(self, drive: Array) -> Sensed:
        """Play a block of friction (N); sample i of what is sensed was there at the start of interval i."""
        rows = finger_rows(self.finger, self._samples, self.block, self.rate)
        self._samples += self.block
        whole, load, speed = self._contact(rows)
        flags = np.zeros((self.block, self.parameters.oversampling), np.int64)
        asked = self._asked(np.asarray(drive, float)[:, 0], whole, load, speed, flags)
        heard, played = self._carry(asked, flags.ravel())
        friction = np.empty(self.block)
        friction_ratios(self.parameters.friction_law.numbers, heard, load, speed, friction)
        felt = np.r_[self._friction, whole * friction]
        self._friction = felt[-1]
        return self._sensed(felt[:-1, None], played, np.bitwise_or.reduce(flags, axis=1))

    def _contact(self, rows: Array) -> tuple[Array, Array, Array]:
        """Whole friction (N, 0 where no finger slides), load (N) and speed (m/s) that the amplitude is held for."""
        there = np.isfinite(rows[:, SPEED]) & (rows[:, LOAD] > 0.0)
        load = np.where(there, rows[:, LOAD], self._nominal[0])
        pace = np.maximum(np.nan_to_num(abs(rows[:, SPEED])), self.parameters.least_speed)
        whole = np.where(there, self.parameters.friction_coefficient * load, 0.0)
        return whole, load, np.where(there, pace, self._nominal[1])

    def _asked(self, drive: Array, whole: Array, load: Array, speed: Array, flags: Array) -> Array:
        """Amplitude (m) at every sample of the device, on straight lines; shape (block, oversampling)."""
        p = self.parameters
        change = np.divide(np.nan_to_num(drive), whole, out=np.zeros(len(drive)), where=whole > 0.0)
        ratio = np.clip(p.bias + change, p.least_ratio, 1.0)
        flags[ratio != p.bias + change] |= Flag.SATURATED
        wanted = np.empty(self.block)
        wanted_amplitudes(p.friction_law.numbers, ratio, load, speed, wanted)
        before = np.r_[self._wanted, wanted[:-1]]
        self._wanted = wanted[-1]
        lines = before[:, None] + (wanted - before)[:, None] * np.arange(1, p.oversampling + 1) / p.oversampling
        return self._within_reach(lines, flags)

    def _within_reach(self, lines: Array, flags: Array) -> Array:
        """Amplitude (m) to which the drive can take the mode at every sample of the device, on its way on `lines`."""
        asked, first = lines.ravel().copy(), 0
        if self._reached < 0.0:  # from rest the loop's own ramp is slower
            first, self._reached = self.parameters.oversampling, lines[0, -1]
        mode, loop = self.parameters.carrier_mode, self.loop
        fade = amplitude_fade(loop.tables, loop.state.touch, 1.0 / mode.rate)
        ask_within_reach(asked[first:], self._reached, full_slew(mode), fade, asked[first:], flags.ravel()[first:])
        self._reached = asked[-1]
        return asked

    def _carry(self, asked: Array, flags: Array) -> tuple[Array, list[Sensed]]:
        """Take the amplitude along `asked` (m); amplitude heard in each sample of friction, and what was played."""
        step, many, long = self._piece, self.parameters.oversampling, self.driver.block
        heard, played = np.empty(self.block), []
        away, deaf = np.full(step, np.nan), np.zeros((step, 1))
        for start in range(0, len(asked), step):
            at = start % long
            if at == 0:
                played.append(check_sensed(self.driver, self.driver.play(self._drive), 1))
            here = slice(at, at + step)
            sensed = played[-1].sensed[here] if self.sensed_channels else deaf
            self._next[here], _, raised = self.loop.run(sensed, away, asked[start : start + step])
            flags[start : start + step] |= raised
            if at + step == long:
                self._drive = self._next.copy()
            if (start + step) % many == 0:
                heard[start // many] = sensed_amplitude(self.loop.state.band, self.loop.state.loop)
        return heard, played

    def _sensed(self, friction: Array, played: list[Sensed], flags: Array) -> Sensed:
        """What the device tells of the finger, once a sample of friction; where its motion is no friction, nothing."""
        many = self.parameters.oversampling
        columns: dict[str, Any] = {}
        for name in ("position", "normal_load", "flags"):
            parts = [getattr(each, name) for each in played]
            columns[name] = None if any(each is None for each in parts) else np.concatenate(parts)
        if columns["flags"] is not None:
            flags |= np.bitwise_or.reduce(columns["flags"].reshape(-1, many), axis=1)
        told = {name: columns[name][::many] for name in ("position", "normal_load") if columns[name] is not None}
        return Sensed(friction if self.sensed_channels else np.empty((self.block, 0)), flags=flags, **told)


def _multiple(driver: Driver, parameters: SurfaceParameters) -> int:
    """Samples of the device in one of the friction; refuses a device that has none."""
    for name, value, known in (("drive", driver.drive_channels, (1,)), ("sensed", driver.sensed_channels, (0, 1))):
        if value not in known:
            raise ValueError(f"driver.{name}_channels = {value}: must be {' or '.join(map(str, known))}")
    many = round(driver.rate / parameters.rate)
    if many < 1 or abs(driver.rate - many * parameters.rate) > 1e-9 * driver.rate:
        raise ValueError(
            f"driver.rate = {driver.rate:g}: must be a whole multiple of plant.rate = {parameters.rate:g} Hz"
        )
    if driver.block % many and many % driver.block:
        raise ValueError(
            f"driver.block = {driver.block}: must be a multiple of {many} samples, {driver.rate:g} Hz over plant.rate, "
            "or divide them"
        )
    late = driver.delay / driver.rate
    if driver.sensed_channels and late > LONGEST_DELAY * (1 + 1e-9):
        raise ValueError(
            f"driver.delay = {driver.delay} samples, {late:.3g} s: must be <= {LONGEST_DELAY:g} s for an amplitude to "
            "follow a texture in closed loop; a driver without sensed channels is driven open loop"
        )
    if parameters.sensor != "amplitude":
        raise ValueError(f"plant.sensor = {parameters.sensor!r}: must be 'amplitude', all that a driver can sense")
    return many


def amplitude_loop(parameters: SurfaceParameters, *, held: float | None = None) -> BankController:
    """Return the amplitude's own controller, of the default method, at rest.

    Parameters
    ----------
    parameters : SurfaceParameters
        The surface, with the delay of its mode.
    held : float, N, or None
        Load of the finger that is taken to hold the mode where nothing is sensed; None: there is feedback.
    """
    model, mode = parameters.amplitude_model(), parameters.carrier_mode
    if held is not None:
        stiffness = mode.mass * (2 * np.pi * float(mode.resonance(held))) ** 2
        model = replace(model, damping=np.array([[float(mode.damping(held))]]), stiffness=np.array([[stiffness]]))
    loop = method_named(defaults.METHOD).design(model, parameters.amplitude_bands(), feedback=held is None)
    if not isinstance(loop, BankController):
        raise TypeError(f"method {defaults.METHOD!r}: must step sample by sample on a carrier")
    return loop
