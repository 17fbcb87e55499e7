"""A rendering that plays block by block through the compiled entry: what `Player` starts, exchanges and asks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from hapticrender.analysis.two_touches import TouchWatch
from hapticrender.bands import Bands
from hapticrender.control.combined import CombinedBands, CombinedController, CombinedModel
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.state_transfer import ready
from hapticrender.control.supervisor import FADE_OUT, Fault, SupervisedController, design_supervisor
from hapticrender.driver_checks import check_sensed
from hapticrender.errors import DeviceFault, HapticError, WatchdogTimeout
from hapticrender.inferred import ContactLag
from hapticrender.protocols import Array, Controller, Flag, Rendering
from hapticrender.realtime import LOG_TIME, RealtimeEntry
from hapticrender.voices import FADE, Voice

JUDGED = 0.25  # s: of signal that figures are of
DEVICE = ("driver", "device", "plant")  # of a rendering: they stay where its texture changes
RIDGE = 1e-4  # of the samples: bands that the time cannot tell apart share what there is, and do not blow up
LEAST_TARGET = 1e-12  # in the device's unit: a smaller one has no error

Row = tuple[float, float, float, float]  # frequency (Hz), target, achieved amplitude, relative error


def live_controller(rendering: Rendering) -> Controller:
    """Return a controller that plays any waveform where the law can; else the scene's bands, times the gain.

    Raises
    ------
    ValueError
        The renderer designs no other controller than the scene's.
    """
    if rendering.design is None:
        raise ValueError(f"{rendering.scene.device}: its renderer designs for a whole scene only: must set `design`")
    try:
        whole = replace(Bands.none(spatial=False), differentiated=rendering.differentiated)
        return rendering.design(whole)
    except ValueError:  # a method, or a device, that works band by band
        return rendering.design(_modulated(rendering.bands))


def _modulated(bands: Bands) -> Bands:
    """Bands whose constant envelopes have a factor over time: the gain."""
    if bands.envelope is None:
        return bands
    if isinstance(bands, CombinedBands):
        return replace(bands, plate=_modulated(bands.plate), friction=_modulated(bands.friction), modulated=True)
    return replace(bands, modulated=True)


class LiveLoop:
    """Driver and controller of a rendering in closed loop.

    Parameters
    ----------
    rendering : Rendering
    **scales
        Of the entry, for a driver that calls back.
    """

    def __init__(self, rendering: Rendering, **scales: float) -> None:
        self.rendering, self.driver, self.model = rendering, rendering.driver, rendering.model
        self.controller: Any = live_controller(rendering)
        self.entry = RealtimeEntry(self.controller, **scales)
        _ = self.entry.address if scales else self.entry.plain_address  # compiled before anything is live
        rows = len(self.entry.log(0)["flags"]) + round(LOG_TIME * rendering.driver.rate)
        self._told = np.full((rows, len(self.model.places) + 1), np.nan)  # true motion and load, where the device tells
        self._true, self.senses = False, False  # whether the device tells its true motion, and where the finger is
        self._drive = np.zeros((self.driver.block, self.driver.drive_channels))
        self._bands = rendering.bands
        self._device: Any = rendering.driver if rendering.plant is None else rendering.plant
        self._reshaping: tuple[Any, Any, int] | None = None  # before the device: from, to, since (sample)
        self._reshaped: tuple[Any, Any, int] | None = None  # the one that is done
        self._stopped: int | None = None  # sample
        own = rendering.plant is not None
        self._touches = TouchWatch(rendering.model, self.controller, active=not own, slows=False)
        self._contact, self._followed = ContactLag(self.model.contact_lag), 0  # of the samples before this one
        self.entry.play(self._voice(rendering))

    @property
    def whole(self) -> bool:
        """Whether the law plays any waveform, so that textures are exchanged under it."""
        return self.entry.whole and self.controller.n_bands == 0

    @property
    def samples(self) -> int:
        """Samples that have been played."""
        return self.entry.samples

    @property
    def flags(self) -> Flag:
        """Everything that was ever raised."""
        return self.entry.flags | self._touches.flags

    def finger(self, position: float, velocity: float, load: float) -> None:
        """Say where the finger is (m, m/s, N)."""
        self.entry.finger(position, velocity, load)

    def watch(self, seconds: float | None) -> None:
        """Stop the drive once the application has not called for so long (s); None: never."""
        self.entry.watch(seconds)

    def alive(self) -> None:
        """Note a call of the application."""
        self.entry.alive()

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture."""
        self.entry.set_gain(gain)

    def silence(self) -> None:
        """Set zero drive from the next block on."""
        self.entry.silence()

    def fill(self) -> None:
        """Compute what comes next of textures in time; to be called at least once a second."""
        self.entry.fill()

    def advance(self, sensing: bool) -> None:
        """Exchange a block with the driver; `sensing`: its own sense of the finger is used, where it has one."""
        sensed = check_sensed(self.driver, self.driver.play(self._drive), len(self.model.places))
        at = (self.entry.samples + np.arange(self.driver.block)) % len(self._told)
        if sensed.motion is not None:
            self._told[at, :-1], self._true = sensed.motion, True
        if sensed.normal_load is not None:
            self._told[at, -1] = sensed.normal_load
        self.senses = sensed.position is not None
        flags = 0 if sensed.flags is None else int(np.bitwise_or.reduce(sensed.flags))
        self._touches.slow()
        self._reshape()
        self._drive = self.entry.process(sensed.sensed, sensed.position if sensing else None, flags)

    def _reshape(self) -> None:
        """Take the characteristic before the device over to that of the present texture, while it fades in."""
        change = self._reshaping
        if change is None or change is self._reshaped:
            return
        before, shape, since = change
        share = min((self.samples - since + self.driver.block) / (FADE * self.driver.rate), 1.0)
        self._device.shape = shape.after(before, share)
        if share == 1.0:
            self._reshaped = change

    def rest(self) -> None:
        """Play a block of zeros."""
        self.driver.play(np.zeros_like(self._drive))

    def exchange(self, rendering: Rendering) -> None:
        """Fade into the texture of another rendering of the same device: under the same law, or one of its own bands.

        Raises
        ------
        ValueError
            The texture cannot be played; the one before goes on.
        """
        voice, controller = self._voice(rendering), self.controller if self.whole else live_controller(rendering)
        model = joint_model(self.rendering.model, rendering.model)
        for part, its_model in _parts(controller, model):
            _widen(part, its_model)
        if controller is not self.controller:
            ready(controller)
        self.entry.play(voice, controller)
        if rendering.shape is not None:
            self._reshaping = self._device.shape, rendering.shape, self.samples
        self.rendering = replace(rendering, **{name: getattr(self.rendering, name) for name in DEVICE})
        self.model, self.controller, self._bands = model, controller, rendering.bands

    def signals(self, start: int) -> tuple[int, dict[str, Array]]:
        """Signals of a recording from sample `start` on, as far back as they are kept, and the first one's number."""
        derived = self.rendering.differentiated  # by central differences: a sample before, and one after
        found = self.entry.log(start - 1 if derived else start)
        first = int(found.pop("first"))
        if derived:
            enough, skip = len(found["flags"]) > 2, int(first == start - 1)
            found["reference"] = np.gradient(found["reference"]) * self.driver.rate if enough else found["reference"]
            rows = slice(skip, -1 if enough else skip)
            first, found = first + skip, {name: signal[rows] for name, signal in found.items()}
        count = len(found["flags"])
        told, model = self._told[(first + np.arange(count)) % len(self._told)], self.model
        found["normal_load"] = np.where(np.isnan(told[:, -1]), found["normal_load"], told[:, -1])
        motion = told[:, :-1]  # NaN where nothing is sensed
        if not self._true and found["sensed"].shape[1]:
            motion = found["sensed"] @ (model.place_from_coordinate @ model.coordinate_from_sensed).T
            motion = self._behind_contact(first, motion, found["position"]) if model.inferred else motion
        return first, found | {"motion": motion, "target": np.zeros((count, 0), complex)}

    def _behind_contact(self, first: int, motion: Array, position: Array) -> Array:
        """Friction behind the contact's lag, which goes on where these samples follow the last ones."""
        follows = first == self._followed
        lag = self._contact if follows else ContactLag(self.model.contact_lag)
        if first >= self._followed:
            self._contact, self._followed = lag, first + len(motion)
        return lag.run(motion, position)

    def watch_touches(self, signals: dict[str, Array], gap: int) -> None:
        """Flag two touches in the signals that follow those of the last call, `gap` samples later."""
        if gap and self._touches.monitor is not None:
            self._touches.monitor.restart()
        if len(signals["flags"]):
            signals["flags"] = self._touches.update(signals)

    @property
    def motion_source(self) -> str:
        """Where `motion` comes from."""
        if self._true or not self.driver.sensed_channels:
            return "true" if self._true else "unknown"
        return "inferred" if self.model.inferred else "sensors"

    def figures(self) -> list[Row]:
        """What every band did over the last `JUDGED` seconds, see `band_figures`."""
        first, signals = self.signals(self.entry.samples - round(JUDGED * self.driver.rate))
        return band_figures(self._bands, first, self.driver.rate, signals)

    def fault(self) -> HapticError | None:
        """Return why the drive was stopped, once it has faded out and stayed at zero for as long again."""
        if not self.entry.flags & Flag.STOPPED:
            return None
        found = getattr(self.entry.running, "fault", None)
        if self._stopped is None:
            own = found.sample if isinstance(found, Fault) else self.entry.samples
            self._stopped = own if self.entry.timed_out is None else self.entry.timed_out
        if self.entry.samples < self._stopped + 2 * FADE_OUT * self.driver.rate + self.driver.delay:
            return None
        at = self._stopped / self.driver.rate
        if self.entry.timed_out is not None:
            return WatchdogTimeout(at)
        text = found.text if isinstance(found, Fault) else "the device stopped itself"
        return DeviceFault(f"{type(self.rendering.device).__name__}: stopped at {at:.4g} s: {text}", at)

    def _voice(self, rendering: Rendering) -> Voice:
        own = None if not rendering.differentiated else rendering.waveform
        return Voice(rendering.scene.texture, self.driver.rate, own)


def _parts(controller: Any, model: Any) -> list[tuple[Any, DeviceModel]]:
    """Controllers of the parts of a device, None where there is none, and their models."""
    if isinstance(controller, CombinedController):
        return list(zip(controller.parts, (model.plate, model.friction), strict=True))
    return [(controller, model)]


def _widen(controller: Any, model: DeviceModel) -> None:
    """Let a controller, and its supervisor, do what `model` needs at most."""
    if controller is None:
        return
    if isinstance(controller, SupervisedController):
        for name, value in design_supervisor(controller.controller, model).items():
            controller.state["p"][name] = value
    controller.settings["drive_limit"] = model.drive_limit


def joint_model(old: Any, new: Any) -> Any:
    """Device model of the new scene, its drive limited by, and supervised for, what both scenes need."""
    if isinstance(new, CombinedModel):
        friction = new.friction and old.friction and joint_model(old.friction, new.friction)
        return replace(new, plate=joint_model(old.plate, new.plate), friction=friction or new.friction)
    if old.demand is None or new.demand is None:
        return replace(new, drive_limit=max(old.drive_limit, new.drive_limit))
    demand = replace(
        new.demand,
        motion=max(old.demand.motion, new.demand.motion),
        drive=max(old.demand.drive, new.demand.drive),
        lowest=min(old.demand.lowest, new.demand.lowest),
        highest=max(old.demand.highest, new.demand.highest),
    )
    return replace(new, demand=demand, drive_limit=max(old.drive_limit, new.drive_limit))


@np.errstate(under="ignore")
def band_figures(bands: Bands, first: int, rate: float, signals: dict[str, Array]) -> list[Row]:
    """Frequency (Hz), target, achieved amplitude and relative error of every band; see `Row`.

    Least squares by the normal equations and a `RIDGE`, which makes amplitudes 0.02 % too small.  Of a waveform without
    bands the amplitudes are rms, and the frequency is 0.
    """
    reference, motion = signals["reference"], signals["motion"][:, 0]
    if not len(reference) or not np.isfinite(motion).all():
        return []
    time, position = (first + np.arange(len(reference))) / rate, signals["position"]
    if not len(bands) or (bands.follows_finger and not np.isfinite(position).all()):
        motion = motion - motion.mean()
        size, left = (float(np.sqrt(np.mean(each**2))) for each in (reference, motion - reference))
        return [(0.0, size, float(np.sqrt(np.mean(motion**2))), _share(left, size))]
    phase = bands.carrier_phase(time, position).astype(np.float32)
    waves = np.hstack([np.cos(phase), -np.sin(phase), np.ones((len(time), 1), np.float32)])
    products = (waves.T @ waves).astype(float)
    products[np.diag_indices(len(products))] += RIDGE * len(time)
    values = np.stack([reference, motion - motion.mean()], axis=1).astype(np.float32)
    found = np.linalg.solve(products, (waves.T @ values).astype(float))
    target, achieved = (found[: len(bands)] + 1j * found[len(bands) : -1]).T
    speed = np.nan_to_num(abs(np.diff(position))).mean() * rate if len(time) > 1 else 0.0
    rows = zip(bands.frequency + bands.wavenumber * speed, target, achieved, strict=True)
    return [band_row(*row) for row in rows]


def band_row(frequency: float, target: complex, achieved: complex) -> Row:
    """Row of a band of `frequency` (Hz) with two complex amplitudes."""
    return float(frequency), float(abs(target)), float(abs(achieved)), _share(abs(achieved - target), abs(target))


def _share(error: float, target: float) -> float:
    return float(error / target) if target > LEAST_TARGET else math.nan
