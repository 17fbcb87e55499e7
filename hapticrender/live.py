"""A rendering that plays block by block through the compiled entry: what `Player` starts, exchanges and asks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from hapticrender.analysis.two_touches import TouchWatch
from hapticrender.bands import Bands
from hapticrender.control.combined import CombinedBands
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.supervisor import FADE_OUT, Fault, SupervisedController, design_supervisor
from hapticrender.driver_checks import check_sensed
from hapticrender.errors import DeviceFault, HapticError, WatchdogTimeout
from hapticrender.inferred import ContactLag
from hapticrender.protocols import Array, Controller, Flag, Rendering
from hapticrender.realtime import LOG_TIME, RealtimeEntry
from hapticrender.voices import Voice

JUDGED = 0.25  # s: of signal that figures are of
SILENT = 1e-3  # of the gain: below it a texture has faded out
DEVICE = ("driver", "device", "plant")  # of a rendering: they stay where its texture changes
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

    @property
    def silent(self) -> bool:
        """Whether the gain has come down to nothing."""
        return self.entry.current_gain < SILENT

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
        self._drive = self.entry.process(sensed.sensed, sensed.position if sensing else None, flags)

    def rest(self) -> None:
        """Play a block of zeros."""
        self.driver.play(np.zeros_like(self._drive))

    def exchange(self, rendering: Rendering) -> None:
        """Fade into the texture of another rendering of the same device, under the same controller."""
        self.model = joint_model(self.rendering.model, rendering.model)
        inner = self.controller
        if isinstance(inner, SupervisedController):
            for name, value in design_supervisor(inner.controller, self.model).items():
                inner.state["p"][name] = value
        self.controller.settings["drive_limit"] = self.model.drive_limit
        self.rendering = replace(rendering, **{name: getattr(self.rendering, name) for name in DEVICE})
        self._bands = rendering.bands
        self.entry.play(self._voice(rendering))

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
        found = getattr(self.controller, "fault", None)
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


def joint_model(old: DeviceModel, new: DeviceModel) -> DeviceModel:
    """Device model of the new scene, its drive limited by, and supervised for, what both scenes need."""
    if old.demand is None or new.demand is None:
        return new
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
    """Frequency (Hz), target, achieved amplitude and relative error of every band, by least squares; see `Row`.

    Of a waveform without bands the amplitudes are rms, and the frequency is 0.
    """
    reference, motion = signals["reference"], signals["motion"][:, 0]
    if not len(reference) or not np.isfinite(motion).all():
        return []
    time, position = (first + np.arange(len(reference))) / rate, signals["position"]
    if not len(bands) or (bands.follows_finger and not np.isfinite(position).all()):
        motion = motion - motion.mean()
        size, left = (float(np.sqrt(np.mean(each**2))) for each in (reference, motion - reference))
        return [(0.0, size, float(np.sqrt(np.mean(motion**2))), _share(left, size))]
    phase = bands.carrier_phase(time, position)
    waves = np.hstack([np.cos(phase), -np.sin(phase), np.ones((len(time), 1))])
    found = np.linalg.lstsq(waves, np.stack([reference, motion], axis=1), rcond=1e-6)[0]
    target, achieved = (found[: len(bands)] + 1j * found[len(bands) : -1]).T
    speed = np.nan_to_num(abs(np.diff(position))).mean() * rate if len(time) > 1 else 0.0
    rows = zip(bands.frequency + bands.wavenumber * speed, target, achieved, strict=True)
    return [band_row(*row) for row in rows]


def band_row(frequency: float, target: complex, achieved: complex) -> Row:
    """Row of a band of `frequency` (Hz) with two complex amplitudes."""
    return float(frequency), float(abs(target)), float(abs(achieved)), _share(abs(achieved - target), abs(target))


def _share(error: float, target: float) -> float:
    return float(error / target) if target > LEAST_TARGET else math.nan
