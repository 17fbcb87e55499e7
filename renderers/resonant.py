"""A user's resonant plate as a driver of friction, through the friction law and the amplitude's own controller."""

import math
from collections import deque
from dataclasses import replace

import numpy as np

from hapticrender import defaults
from hapticrender.checks import require
from hapticrender.control.controller import BankController
from hapticrender.control.device_model import Demand
from hapticrender.control.kernel import observed_envelope
from hapticrender.control.methods import method_named
from hapticrender.control.supervisor import JUMP, Fault, supervised
from hapticrender.driver_checks import check_channels, check_sensed
from hapticrender.plants.compiled import LOAD, SPEED, finger_inputs
from hapticrender.plants.friction_laws import friction_ratios, reference_amplitudes
from hapticrender.plants.ultrasonic_kernels import amplitude_decay, references_within_reach
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, full_slew
from hapticrender.protocols import Array, Driver, Flag, Sensed
from hapticrender.renderers.shaped import WrappedDriver, thinned
from hapticrender.touch.finger import Finger

SIGMAS, DRIVE_ERROR = 8.0, 2.0  # of noise; of the force that the drive may make, over that assumed
QUIET = 64  # samples at the start, before the drive has risen, that show the noise of the sensor
LONGEST_DELAY = 0.25e-3  # s: a tenth of a turn of 400 Hz, 3 % off there, and beyond 10 % at half as much again


class ResonantDriver(WrappedDriver):
    """A driver of friction (N) on a device that vibrates: its drive in V, its sensor in m of the mode, or none.

    The device works at the carrier's rate, a whole multiple of that of `parameters`, the surface as assumed; friction
    (N) goes in, and what follows from the sensed amplitude comes out, at the lower rate.  The device's block is a whole
    multiple of that multiple, or divides it.  `finger` says where the finger is, and how hard it presses where the
    device does not measure it; `nominal` is the load (N) and speed (m/s) for which the amplitude is held while no
    finger is there.  `demand` is what the scene needs of the mode (m, V); its drive is supervised by it.

    Notes
    -----
    `delay` is the block alone: the amplitude loop foresees a target over the device's own delay, by its slope.  Behind
    1, 16 and 32 samples at 192 kHz 200 Hz come 0.95, 0.95 and 1.07 samples of friction late, and 0.2 % too small, 1.8 %
    and 7 % too large.  That loop (`loop`) and its resonance lock step with every sample of the device, however long its
    blocks are.  The finger estimate takes the delay d for a finger: a texture of f Hz is up to 1 % off at f d = 1/15
    and 7 % at 1/10.
    """

    def __init__(
        self,
        driver: Driver,
        parameters: SurfaceParameters,
        finger: Finger,
        nominal: tuple[float, float],
        demand: Demand | None = None,
    ) -> None:
        many = _multiple(driver, parameters)
        super().__init__(driver)
        self.drive_channels, self.finger = 1, finger
        mode = replace(parameters.mode, delay=driver.delay)
        self.parameters = replace(parameters, level="carrier", oversampling=many, mode=mode)
        self.rate = float(parameters.rate)
        self.block = max(driver.block // many, 1)
        self.delay = self.block
        self._piece = min(driver.block, many)
        self._nominal = nominal
        self.loop = amplitude_loop(self.parameters, held=None if driver.sensed_channels else nominal[0])
        model = replace(self.parameters.amplitude_model(), demand=demand)
        self._supervised = supervised(self.loop, model) if driver.sensed_channels else self.loop
        self._samples = 0
        self._target = 0.0  # m, at the end of the last sample
        self._reached = -1.0  # m, alike, by what the drive can do; negative: it starts from rest
        self._friction = 0.0  # N: measured in the last sample
        self._load = math.nan  # N: that the device has last measured
        self._drive = np.zeros((driver.block, 1))
        self._next = np.zeros((driver.block, 1))
        self._last = np.full(2, np.nan)  # m: the last two samples
        self._quiet = np.zeros(0)  # m: differences of the first samples, see `_jumps`
        self._peaks = deque([0.0], maxlen=2 + driver.delay // driver.block)  # V: of the blocks that act
        self._jumped: Fault | None = None

    @property
    def fault(self) -> Fault | None:
        """Why the drive of the amplitude has been stopped; see `control.supervisor`."""
        return self._jumped or getattr(self._supervised, "fault", None)

    def play(self, drive: Array) -> Sensed:
        """Play a block of friction (N); sample i of what is sensed was there at the start of interval i."""
        rows = finger_inputs(self.finger, self._samples, self.block, self.rate)
        rows[:, LOAD] = rows[:, LOAD] if math.isnan(self._load) else self._load
        self._samples += self.block
        whole, load, speed = self._contact(rows)
        flags = np.zeros((self.block, self.parameters.oversampling), np.int64)
        target = self._amplitudes(np.asarray(drive, float)[:, 0], whole, load, speed, flags)
        measured, played = self._carry(target, flags.ravel())
        ratio = friction_ratios(self.parameters.friction_law.numbers, measured, load, speed)
        measured_friction = np.r_[self._friction, whole * ratio]
        self._friction = measured_friction[-1]
        if played[-1].normal_load is not None:
            self._load = float(played[-1].normal_load[-1])
        return self._sensed(measured_friction[:-1, None], played, np.bitwise_or.reduce(flags, axis=1))

    def _contact(self, rows: Array) -> tuple[Array, Array, Array]:
        """Whole friction (N, 0 where no finger slides), load (N) and speed (m/s) that the amplitude is held for."""
        there = np.isfinite(rows[:, SPEED]) & (rows[:, LOAD] > 0.0)
        load = np.where(there, rows[:, LOAD], self._nominal[0])
        pace = np.maximum(np.nan_to_num(abs(rows[:, SPEED])), self.parameters.least_speed)
        whole = np.where(there, self.parameters.friction_coefficient * load, 0.0)
        return whole, load, np.where(there, pace, self._nominal[1])

    def _amplitudes(self, drive: Array, whole: Array, load: Array, speed: Array, flags: Array) -> Array:
        """Amplitude (m) at every sample of the device, on straight lines; shape (block, oversampling)."""
        p = self.parameters
        change = np.divide(np.nan_to_num(drive), whole, out=np.zeros(len(drive)), where=whole > 0.0)
        ratio = np.clip(p.bias + change, p.least_ratio, 1.0)
        flags[ratio != p.bias + change] |= Flag.SATURATED
        target = reference_amplitudes(p.friction_law.numbers, ratio, load, speed)
        before = np.r_[self._target, target[:-1]]
        self._target = target[-1]
        lines = before[:, None] + (target - before)[:, None] * np.arange(1, p.oversampling + 1) / p.oversampling
        return self._within_reach(lines, flags)

    def _within_reach(self, lines: Array, flags: Array) -> Array:
        """Amplitude (m) to which the drive can take the mode at every sample of the device, on its way on `lines`."""
        target, first = lines.ravel().copy(), 0
        if self._reached < 0.0:  # from rest the loop's own ramp is slower
            first, self._reached = self.parameters.oversampling, lines[0, -1]
        mode, loop = self.parameters.carrier_mode, self.loop
        finger = float(loop.state["finger_damping"][0])
        decay = amplitude_decay(float(mode.damping()), finger, mode.mass, 1.0 / mode.rate)
        rest = target[first:]
        references_within_reach(rest, self._reached, full_slew(mode), decay, rest, flags.ravel()[first:])
        self._reached = target[-1]
        return target

    def _carry(self, target: Array, flags: Array) -> tuple[Array, list[Sensed]]:
        """Take the amplitude along `target` (m); amplitude measured in each sample of friction, and what was played."""
        step, many, long = self._piece, self.parameters.oversampling, self.driver.block
        measured, played = np.empty(self.block), []
        away, silent = np.full(step, np.nan), np.zeros((step, 1))
        for start in range(0, len(target), step):
            at = start % long
            if at == 0:
                played.append(check_sensed(self.driver, self.put(self._drive), 1))
                self._peaks.append(abs(self._drive).max())
                if self._jumped is None and self.sensed_channels and self._jumps(played[-1]):
                    self._jumped = Fault(JUMP, self._samples, 1)
            here = slice(at, at + step)
            sensed = played[-1].sensed[here] if self.sensed_channels else silent
            self._next[here], _, raised = self._supervised.run(sensed, away, target[start : start + step])
            flags[start : start + step] |= raised
            if self._jumped is not None:
                self._next[here], flags[start : start + step] = 0.0, Flag.STOPPED
            if at + step == long:
                self._drive = self._next.copy()
            if (start + step) % many == 0:
                measured[start // many] = abs(complex(*observed_envelope(self.loop.state.ctypes.data)))
        return measured, played

    def _jumps(self, sensed: Sensed) -> bool:
        """Whether the sensor has jumped: ``e = y_n - 2 cos(w T) y_n-1 + y_n-2`` is 0 in a steady vibration.

        A drive u adds N u T^2/m at most, and what decays w T/Q of the amplitude, 1/9 where a finger damps most.  A gain
        that changes by g makes (g - 1) y_n, then (1 - g) y_n-1, of which one is at least |g - 1| sin(w T/2) of it; half
        of that for 1/3 is the bound.  Noise is what is stated, or the first `QUIET` samples show.  Nothing is compared
        where a converter holds its values, or samples were lost.
        """
        mode, lost = self.parameters.mode, sensed.flags is not None and bool((sensed.flags & Flag.OVERRUN).any())
        y = np.r_[np.full(2, np.nan) if lost else self._last, sensed.sensed[:, 0]]
        self._last, turn = y[-2:], 2 * np.pi * mode.frequency / self.driver.rate
        twice = 2 * math.cos(turn)
        with np.errstate(invalid="ignore", over="ignore"):  # no numbers are the supervisor's
            change = y[2:] - twice * y[1:-1] + y[:-2]
            squares = y[1:-1] ** 2 + y[:-2] ** 2 - twice * y[1:-1] * y[:-2]
            size = np.sqrt(np.maximum(squares, 0.0)) / abs(math.sin(turn))
        if len(self._quiet) < QUIET:
            self._quiet = np.r_[self._quiet, change[np.isfinite(change)]]
            return False
        stated = math.sqrt(2 + twice**2) * (mode.sensor_noise + mode.sensor_step)
        noise = SIGMAS * max(stated, math.sqrt(np.mean(self._quiet**2)))
        driven = DRIVE_ERROR * mode.force_constant * max(self._peaks) / (mode.modal_mass * self.driver.rate**2)
        moves = (y[2:] != y[1:-1]) & (y[1:-1] != y[:-2])
        return bool((moves & (abs(change) > noise + driven + math.sin(turn / 2) / 3 * size)).any())

    def _sensed(self, friction: Array, played: list[Sensed], flags: Array) -> Sensed:
        """Measurements of the finger and flags, once a sample of friction; the mode's motion is left out."""
        columns = zip(*played, strict=True)
        whole = Sensed(*(None if any(part is None for part in parts) else np.concatenate(parts) for parts in columns))
        device = thinned(whole, self.parameters.oversampling)
        flags = flags if device.flags is None else flags | device.flags
        return device._replace(sensed=friction if self.sensed_channels else friction[:, :0], motion=None, flags=flags)


def _multiple(driver: Driver, parameters: SurfaceParameters) -> int:
    """Samples of the device in one of the friction; refuses a device that has none."""
    check_channels(driver, {1: ""}, {0: "", 1: ""})
    rate, block, delay = driver.rate, driver.block, driver.delay / driver.rate
    many = round(rate / parameters.rate)
    whole = many >= 1 and abs(rate - many * parameters.rate) <= 1e-9 * rate
    require(whole, "driver.rate", rate, f"a whole multiple of device.rate = {parameters.rate:g} Hz")
    bound = f"a multiple of {many} samples, {rate:g} Hz over device.rate, or divide them"
    require(not (block % many and many % block), "driver.block", block, bound)
    bound = (
        f"<= {LONGEST_DELAY * rate:g} samples, {LONGEST_DELAY:g} s, for an amplitude to follow a texture in closed "
        "loop; a driver without sensed channels is driven open loop"
    )
    close = not driver.sensed_channels or delay <= LONGEST_DELAY * (1 + 1e-9)
    require(close, "driver.delay", driver.delay, bound)
    require(parameters.sensor == "amplitude", "device.sensor", parameters.sensor, "'amplitude' for a driver")
    return many


def amplitude_loop(parameters: SurfaceParameters, *, held: float | None = None) -> BankController:
    """Return the amplitude's own controller, of the default method, at rest.

    `held` is the finger's load (N) on the mode where nothing is sensed; None: there is feedback.
    """
    model, mode = parameters.amplitude_model(), parameters.carrier_mode
    if held is not None:
        stiffness = mode.mass * (2 * np.pi * float(mode.resonance(held))) ** 2
        model = replace(model, damping=np.array([[float(mode.damping(held))]]), stiffness=np.array([[stiffness]]))
    return method_named(defaults.METHOD).design(model, parameters.amplitude_bands(), feedback=held is None)
