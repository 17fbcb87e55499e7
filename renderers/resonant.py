"""A user's resonant plate as a driver of friction, through the friction law and the amplitude's own controller."""

import math
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numba import carray

from hapticrender import defaults
from hapticrender.checks import require
from hapticrender.control.controller import BankController
from hapticrender.control.device_model import Demand
from hapticrender.control.kernel import observed_envelope
from hapticrender.control.methods import method_named
from hapticrender.control.records import CONTROLLER_T
from hapticrender.control.supervisor import JUMP, Fault, supervised
from hapticrender.driver_checks import check_channels, check_sensed
from hapticrender.jit import CONVERSION_T, F8, I8, SIGNALS, call, kernel, pointer, record, record_of, step
from hapticrender.plants.compiled import HUGE, LOAD, SATURATED, SPEED, finger_inputs
from hapticrender.plants.friction_laws import LAW, friction_ratio
from hapticrender.plants.ultrasonic_kernels import amplitude_decay, sliding_reference, within_reach
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, full_slew
from hapticrender.protocols import Array, Driver, Flag, Sensed
from hapticrender.renderers.shaped import WrappedDriver, thinned
from hapticrender.touch.finger import Finger

SIGMAS, DRIVE_ERROR = 8.0, 2.0  # of noise; of the force that the drive may make, over that assumed
QUIET = 64  # samples at the start, before the drive has risen, that show the noise of the sensor
LONGEST_DELAY = 0.25e-3  # s: a tenth of a turn of 400 Hz, 3 % off there, and beyond 10 % at half as much again
STOPPED = int(Flag.STOPPED)

RESONANT = np.dtype(
    [
        *(
            (name, "i8")
            for name in ("hold", "piece", "sensors", "controller", "controller_state", "observed", "signals_at")
        ),
        *((name, "f8") for name in ("friction_coefficient", "bias", "least_ratio", "least_speed", "load", "speed")),
        *((name, "f8") for name in ("slew", "free_damping", "mass", "period")),  # as in `SURFACE`
        *((name, "f8") for name in ("twice", "sine", "share", "stated", "driven")),  # of the test for jumps
        ("signals", SIGNALS),  # of the amplitude loop: addresses of the six fields below
        ("drive", "f8", (1,)),  # V
        ("sensed", "f8"),  # m
        ("position", "f8"),  # NaN
        ("waveform", "f8"),  # m: amplitude within reach; the last one is what the drive could reach
        ("target", "c16"),  # m
        ("flags", "i8"),
        *((name, "f8") for name in ("reference", "goal")),  # state: amplitude (m) before a sample of friction and after
        ("rises", "i8"),  # state: it starts from rest, where the loop's own ramp is slower
        *((name, "f8") for name in ("whole", "touch_load", "pace", "friction")),  # state: of that sample (N, N, m/s, N)
        *((name, "i8") for name in ("samples", "jumped")),  # state: samples of the device; at which it jumped, or -1
        *((name, "f8") for name in ("before", "last", "quiet")),  # state: the last two samples (m); sum of squares
        ("counted", "i8"),  # state: of so many differences
        ("peaks_at", "i8"),  # V: largest drives of the pieces that act, a ring
        *((name, "i8") for name in ("peaks", "peak")),  # their number; state: the next one
        ("law", LAW),
    ],
    align=True,
)
RESONANT_T = numba.from_dtype(RESONANT)


@kernel
def jumps(r, given, start, count, lost):
    """Whether the sensor has jumped: ``e = y_n - 2 cos(w T) y_n-1 + y_n-2`` is 0 in a steady vibration.

    A drive u adds N u T^2/m at most, and what decays w T/Q of the amplitude, 1/9 where a finger damps most.  A gain
    that changes by g makes (g - 1) y_n, then (1 - g) y_n-1, of which one is at least |g - 1| sin(w T/2) of it; half of
    that for 1/3 is the bound.  Noise is what is stated, or the first `QUIET` samples show.  Nothing is compared where a
    converter holds its values, or samples were lost.
    """
    quiet, found, bound = r.counted < QUIET, False, 0.0
    if not quiet:
        peaks = carray(pointer(r.peaks_at, F8), r.peaks)
        bound = SIGMAS * max(r.stated, math.sqrt(r.quiet / r.counted)) + r.driven * peaks.max()
    before, last = (math.nan, math.nan) if lost else (r.before, r.last)
    for n in range(start, start + count):
        y = given[n]
        change = abs(y - r.twice * last + before)
        if not quiet:
            size = math.sqrt(max(last * last + before * before - r.twice * last * before, 0.0)) / r.sine
            found |= y != last and last != before and change > bound + r.share * size
        elif change < HUGE:
            r.quiet += change * change
            r.counted += 1
        before, last = last, y
    r.before, r.last = before, last
    return found


@kernel
def approach(r, k, decay):
    """Take the reference on a straight line to sample k of one of friction, no faster than the drive can; flags."""
    line = r.reference + (r.goal - r.reference) * (k + 1) / r.hold
    r.waveform = line if r.rises > 0 else within_reach(r.waveform, line, r.slew, decay)
    if k == r.hold - 1:
        r.reference, r.rises = r.goal, 0
    return SATURATED if r.waveform != line else 0


@kernel
def advance(r, io, start, count, lost):
    """Take the amplitude on by a piece of a block, whose samples are tested before any drive is computed from them."""
    end = start + count
    rows = (end - 1) // r.hold + 1
    given, played = carray(pointer(io.given, F8), end), carray(pointer(io.played, F8), end)
    drive, finger = carray(pointer(io.drive, F8), rows), carray(pointer(io.finger, F8), (rows, 2))
    sensed, flags = carray(pointer(io.sensed, F8), rows), carray(pointer(io.flags, I8), rows)
    r.samples += count
    if r.sensors > 0 and r.jumped < 0 and jumps(r, given, start, count, lost):
        r.jumped = r.samples
    finger_damping = record(r.observed, CONTROLLER_T, 0).finger_damping
    decay, peak = amplitude_decay(r.free_damping, finger_damping, r.mass, r.period), 0.0
    for n in range(start, end):
        row, k = n // r.hold, n % r.hold
        if k == 0:
            touch = finger[row]
            r.whole, r.touch_load, r.pace, r.goal, raised = sliding_reference(r, drive[row], touch[0], touch[1])
            flags[row] |= raised
            if r.sensors > 0:
                sensed[row] = r.friction
        flags[row] |= approach(r, k, decay)
        r.sensed, r.flags = given[n] if r.sensors > 0 else 0.0, 0
        call(r.controller, (r.controller_state, r.signals_at, 0, 1))
        played[n] = r.drive[0] if r.jumped < 0 else 0.0
        flags[row] |= r.flags if r.jumped < 0 else STOPPED
        peak = max(peak, abs(played[n]))
        if k == r.hold - 1:
            re, im = observed_envelope(r.observed)
            r.friction = r.whole * friction_ratio(r.law, math.hypot(re, im), r.touch_load, r.pace)
    carray(pointer(r.peaks_at, F8), r.peaks)[r.peak] = peak
    r.peak = (r.peak + 1) % r.peaks


@step
def resonant_sense(state, signals, start, count):
    """Take the amplitude on by a block of the device; its friction comes out once in `hold` samples.

    From a jump on nothing is played.
    """
    r, io = record(state, RESONANT_T, 0), record(signals, CONVERSION_T, 0)
    for first in range(start, start + count, r.piece):
        advance(r, io, first, r.piece, io.lost > 0 and first == start)
    return 0


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

    sense = resonant_sense

    def __init__(
        self,
        driver: Driver,
        parameters: SurfaceParameters,
        finger: Finger,
        nominal: tuple[float, float],
        demand: Demand | None = None,
    ) -> None:
        many = _multiple(driver, parameters)
        super().__init__(driver, many)
        self.drive_channels, self.finger = 1, finger
        mode = replace(parameters.mode, delay=driver.delay)
        self.parameters = replace(parameters, level="carrier", oversampling=many, mode=mode)
        self.rate = float(parameters.rate)
        self.delay = self.block
        self.loop = amplitude_loop(self.parameters, held=None if driver.sensed_channels else nominal[0])
        model = replace(self.parameters.amplitude_model(), demand=demand)
        self._supervised: Any = supervised(self.loop, model) if driver.sensed_channels else self.loop
        self._samples = 0
        self._load = math.nan  # N: that the device has last measured
        self._drive = np.zeros((driver.block, 1))
        self.state = self._record(nominal)

    def _record(self, nominal: tuple[float, float]) -> Array:
        """Record of the steps, at rest."""
        p, mode, carrier = self.parameters, self.parameters.mode, self.parameters.carrier_mode
        turn, period = 2 * np.pi * mode.frequency / self.driver.rate, 1.0 / self.driver.rate
        twice = 2 * math.cos(turn)
        piece = min(self.driver.block, self.hold)
        self._peaks = np.zeros((2 * self.driver.block + self.driver.delay) // piece)
        state = record_of(
            RESONANT,
            p,
            hold=self.hold,
            piece=piece,
            sensors=self.sensed_channels,
            controller=self._supervised.step.address,
            controller_state=self._supervised.state,
            observed=self.loop.state,
            load=nominal[0],
            speed=nominal[1],
            slew=full_slew(carrier),
            free_damping=float(carrier.damping()),
            mass=carrier.mass,
            period=period,
            twice=twice,
            sine=abs(math.sin(turn)),
            share=math.sin(turn / 2) / 3,
            stated=math.sqrt(2 + twice**2) * (mode.sensor_noise + mode.sensor_step),
            driven=DRIVE_ERROR * mode.force_constant / mode.modal_mass * period**2,
            position=np.nan,
            rises=1,
            jumped=-1,
            before=np.nan,
            last=np.nan,
            peaks_at=self._peaks,
            peaks=len(self._peaks),
            law=p.friction_law.numbers,
        )
        for name in ("drive", "sensed", "position", "waveform", "target", "flags"):
            state["signals"][name] = state[name].ctypes.data
        state["signals_at"] = state["signals"].ctypes.data
        return state

    @property
    def fault(self) -> Fault | None:
        """Why the drive of the amplitude has been stopped; see `control.supervisor`."""
        jumped = int(self.state["jumped"][0])
        return getattr(self._supervised, "fault", None) if jumped < 0 else Fault(JUMP, -(-jumped // self.hold), 1)

    def play(self, drive: Array) -> Sensed:
        """Play a block of friction (N); sample i of what is sensed was there at the start of interval i."""
        rows, io, played = (
            finger_inputs(self.finger, self._samples, self.block, self.rate),
            self.signals,
            list[Sensed](),
        )
        io["finger"][:] = rows[:, [LOAD, SPEED]]
        if not math.isnan(self._load):
            io["finger"][:, 0] = self._load
        self._samples += self.block
        io["drive"][:], io["flags"][:], long = drive, 0, self.driver.block
        for start in range(0, len(io["played"]), long):
            here = slice(start, start + long)
            played.append(check_sensed(self.driver, self.put(self._drive), 1))
            io["given"][here], flags = played[-1].sensed, played[-1].flags
            self.conversion["lost"] = flags is not None and bool((flags & Flag.OVERRUN).any())
            resonant_sense(self.state.ctypes.data, self.conversion.ctypes.data, start, long)
            self._drive = io["played"][here].copy()
        if played[-1].normal_load is not None:
            self._load = float(played[-1].normal_load[-1])
        return self._sensed(io["sensed"].copy(), played, io["flags"])

    def _sensed(self, friction: Array, played: list[Sensed], flags: Array) -> Sensed:
        """Measurements of the finger and flags, once a sample of friction; the mode's motion is left out."""
        columns = zip(*played, strict=True)
        whole = Sensed(*(None if any(part is None for part in parts) else np.concatenate(parts) for parts in columns))
        device = thinned(whole, self.hold)
        flags = flags.copy() if device.flags is None else flags | device.flags
        return device._replace(sensed=friction, motion=None, flags=flags)


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
