"""A user's resonant plate as a driver of friction, through the friction law and the amplitude's own controller."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from hapticrender import defaults
from hapticrender.checks import require
from hapticrender.control.controller import BankController
from hapticrender.control.device_model import Demand
from hapticrender.control.methods import method_named
from hapticrender.control.probe_resonance import probe_resonance
from hapticrender.control.supervisor import JUMP, Fault, supervised
from hapticrender.driver_checks import check_channels, check_sensed
from hapticrender.jit import record_of
from hapticrender.plants.compiled import LOAD, SPEED, finger_inputs
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, full_slew
from hapticrender.protocols import Array, Driver, Flag, Sensed
from hapticrender.renderers.conversions import RESONANT, resonant_sense
from hapticrender.renderers.shaped import WrappedDriver, thinned
from hapticrender.touch.finger import Finger

DRIVE_ERROR = 2.0  # of the force that the drive may make, over that assumed
LONGEST_DELAY = 0.25e-3  # s: none longer has been tried


class ResonantDriver(WrappedDriver):
    """A driver of friction (N) on a device that vibrates: its drive in V, its sensor in m of the mode, or none.

    The device works at the carrier's rate, a whole multiple of that of `parameters`, the surface as assumed; friction
    (N) goes in, and what follows from the sensed amplitude comes out, at the lower rate.  The device's block is a whole
    multiple of that multiple, or divides it.  `finger` says where the finger is, and how hard it presses where the
    device does not measure it; `nominal` is the load (N) and speed (m/s) for which the amplitude is held while no
    finger is there.  `demand` is what the scene needs of the mode (m, V); its drive is supervised by it.

    Notes
    -----
    `delay` is the block and the whole samples of friction in the device's own delay, `lag` (s) what is left of that:
    the amplitude follows its target that much later, and the friction's controller is to foresee it.  The amplitude's
    loop (`loop`) and its resonance lock step with every sample of the device, however long its blocks are.
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
        self.delay = self.block + driver.delay // many
        self.lag = driver.delay % many / driver.rate
        self.loop = amplitude_loop(self.parameters, held=None if driver.sensed_channels else nominal[0], late=True)
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
            starting=1,
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

    def calibrate(self, device: Driver) -> None:
        """Probe the open `device`, and correct the force per volt in the amplitude's loop by the gain found."""
        mode = self.parameters.mode
        self.loop.settings["drive_from_force"][0, 0] = 1.0 / (probe_resonance(device, mode) * mode.force_constant)

    @property
    def fault(self) -> Fault | None:
        """Why the drive of the amplitude has been stopped; see `control.supervisor`."""
        jumped = int(self.state["jumped"][0])
        return getattr(self._supervised, "fault", None) if jumped < 0 else Fault(JUMP, -(-jumped // self.hold), 1)

    def play(self, drive: Array) -> Sensed:
        """Play a block of friction (N); sample i of what is sensed was there at the start of interval i."""
        io, played = self.signals, list[Sensed]()
        io["finger"][:] = finger_inputs(self.finger, self._samples, self.block, self.rate)[:, [LOAD, SPEED]]
        if not math.isnan(self._load):
            io["finger"][:, 0] = self._load
        self._samples += self.block
        io["drive"][:], io["flags"][:], long = drive, 0, self.driver.block
        for start in range(0, len(io["played"]), long):
            here = slice(start, start + long)
            played.append(check_sensed(self.driver, self.put(self._drive), 1))
            io["raw"][here], flags = played[-1].sensed, played[-1].flags
            self.conversion["lost"] = flags is not None and bool((flags & Flag.OVERRUN).any())
            resonant_sense(self.state.ctypes.data, self.conversion.ctypes.data, start, long)
            self._drive = io["played"][here].copy()
        if played[-1].normal_load is not None:
            self._load = float(played[-1].normal_load[-1])
        return self._sensed(io["sensed"].copy(), played, io["flags"])

    def _sensed(self, friction: Array, played: list[Sensed], flags: Array) -> Sensed:
        """Measurements of the finger and flags, once a sample of friction; the mode's motion is left out."""
        columns = zip(*played, strict=True)
        whole = Sensed._make(
            None if any(part is None for part in parts) else np.concatenate(parts) for parts in columns
        )
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


def amplitude_loop(parameters: SurfaceParameters, *, held: float | None = None, late: bool = False) -> BankController:
    """Return the amplitude's own controller, of the default method, at rest.

    `held` is the finger's load (N) on the mode where nothing is sensed; None: there is feedback.  Of a `late` one the
    amplitude follows after the drive's delay, however high the gains are; else it depends on them.
    """
    model, mode = replace(parameters.amplitude_model(), late=late), parameters.carrier_mode
    if held is not None:
        stiffness = mode.mass * (2 * np.pi * float(mode.resonance(held))) ** 2
        model = replace(model, damping=np.array([[float(mode.damping(held))]]), stiffness=np.array([[stiffness]]))
    method: Any = method_named(defaults.METHOD)
    return method.design(model, parameters.amplitude_bands(), feedback=held is None)  # type: ignore[no-any-return]
