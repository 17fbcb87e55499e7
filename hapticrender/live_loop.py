"""The loop of live play: driver and controller of a rendering, block by block, through the real-time entry."""

import math
import threading
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np

from hapticrender import sampled_texture
from hapticrender.analysis.two_touches import TouchWatch
from hapticrender.bands import Bands
from hapticrender.control.combined import CombinedBands, CombinedController, CombinedModel
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.inverse import lookahead
from hapticrender.control.state_transfer import ready
from hapticrender.control.supervisor import FADE_OUT, SupervisedController, design_supervisor
from hapticrender.driver_checks import check_sensed
from hapticrender.errors import HapticError, WatchdogTimeout
from hapticrender.inferred import ContactLag
from hapticrender.loop import RECENT, device_fault, motion_of, motion_source, stops_itself
from hapticrender.process_signals import stopped_by_signal
from hapticrender.protocols import Array, Controller, Flag, Rendering, Sensed
from hapticrender.realtime_entry import RealtimeEntry
from hapticrender.realtime_kernel import HORIZON
from hapticrender.sampled_texture import EvaluatedTexture, ForeseenTexture, SampledTexture
from hapticrender.touch.composed import InseparableTexture
from hapticrender.touch.finger import Finger

JUDGED = 0.25  # s: of signal that figures are of
DEVICE = ("driver", "device", "plant")  # of a rendering: they stay where its texture changes
CATCH_UP, MOST_CONSTANTS = 5e-3, 100.0  # s: time constant of either pole; what is left after so many is 0
TURN = 2e-3  # s: a simulated device held to the clock is played for so long at once
PIECE, SPELL = 0.25, 0.5  # s: of a texture, computed at once; after which other work has its turn
DERIVATIVE = np.array([5 / 6, -5 / 21, 5 / 84, -5 / 504, 1 / 1260])  # central differences, exact to the tenth order
REFRESH = 0.02  # s: after which a texture in time and place is evaluated again while its finger goes on as it did
CHANGES = "current", "previous", "finger_changes"  # of an entry: after which it is evaluated at once
RIDGE = 1e-4  # of the samples: bands that the time cannot tell apart share what there is, and do not blow up
LEAST_TARGET = 1e-12  # in the device's unit: a smaller one has no error

Row = tuple[float, float, float, float]  # frequency (Hz), target, achieved amplitude, relative error


def uninterrupted() -> AbstractContextManager[None]:
    """Let signals wait in the main thread: an exception is lost where compiled code calls a texture in Python."""
    main = threading.current_thread() is threading.main_thread()
    return stopped_by_signal(wait=True) if main else nullcontext()


class LiveMotion:
    """Motion of the finger on a simulated device that is played live: as the application has last set it.

    A finger that is not where it was expected catches up by two poles, whatever the distance: a real one cannot leap,
    and at 40 m/s no vibration is felt, which would teach the controller another device.
    """

    def __init__(self) -> None:
        self._clock = 0.0  # s
        # since (s), position, velocity, load; distance to catch up then (m), behind both poles and behind the first one
        self._last = (0.0, math.nan, 0.0, 0.0, 0.0, 0.0)  # replaced as a whole: another thread reads it

    def update(self, position: float, velocity: float, load: float) -> None:
        """Set the finger (m, m/s, N)."""
        since, place, before, _, both, first = self._last
        passed = max(self._clock - since, 0.0)
        jump = place + before * min(passed, HORIZON) - position
        constants = min(passed / CATCH_UP, MOST_CONSTANTS)
        decay = math.exp(-constants)
        both, first = (both + first * constants) * decay, first * decay
        left = (both + jump, first + jump) if math.isfinite(jump) else (0.0, 0.0)
        self._last = (self._clock, position, velocity, load, *left)

    def position(self, time: Array) -> Array:
        """Position (m) at `time` (s): at the last velocity, for `HORIZON` at most."""
        time, (since, place, velocity, _, both, first) = np.asarray(time, float), self._last
        self._clock = float(time[-1]) if time.size else self._clock
        passed = np.maximum(time - since, 0.0)
        constants = np.minimum(passed / CATCH_UP, MOST_CONSTANTS)
        return place + velocity * np.minimum(passed, HORIZON) + (both + first * constants) * np.exp(-constants)

    def load(self, time: Array) -> Array:
        """Return the normal load (N)."""
        return np.full(np.shape(time), self._last[3])

    def attach(self, rendering: Rendering) -> None:
        """Put a finger that moves like this on a simulated device."""
        finger, plant = rendering.scene.finger, rendering.plant
        live = Finger(self, None, mechanics=finger.mechanics, load_scaling=finger.load_scaling)
        for part in (plant, getattr(plant, "screen", plant)):
            part.finger = live  # type: ignore[union-attr]


class LiveLoop(RealtimeEntry):
    """Driver and controller of a rendering in closed loop; the entry itself where the driver calls back.

    Parameters
    ----------
    rendering : Rendering
    **scales
        Of the entry, for a driver that calls back.

    Raises
    ------
    ValueError
        The renderer designs no other controller than the scene's.
    """

    def __init__(self, rendering: Rendering, **scales: float) -> None:
        wrapped = bool(scales) and rendering.driver is not rendering.device
        converter = rendering.driver if wrapped else None
        own, frames = live_controller(rendering), rendering.driver.block
        ahead = lookahead(rendering.model) if isinstance(rendering.model, CombinedModel) else 0  # of whole waveforms
        super().__init__(own, frames=frames, ahead=ahead, converter=converter, **scales)
        self.rendering, self.driver, self.model = rendering, rendering.driver, rendering.model
        self._calls_back = bool(scales)
        offered = None if rendering.plant is None else getattr(self.driver, "device_loop", None)
        self._device_loop = None if offered is None else offered(self)  # a simulated device's loop in compiled code
        if self._device_loop is not None:
            self._device_loop(0, lambda position: position[:0])  # compiled before anything is live
        else:
            _ = self.address if scales else self.plain_address
        rows = len(self._arrays["log"])
        self._true = np.full((rows, len(self.model.places) + 1), np.nan)  # motion and load, where stated
        self._turn = threading.Lock()  # of threads that play what is not paced
        self._known = 0  # samples that have been played, and whose motion is known
        self._has_motion, self.senses = False, False  # whether the device states its motion, and senses the finger
        self._itself = False  # whether it has stopped itself
        self._drive = np.zeros((self.driver.block, self.driver.drive_channels))
        self._began = math.nan  # s: computing a piece of a texture
        self._foreseen: tuple[int, tuple[int, ...]] = (0, ())  # sample and state of the last `foresee`
        self.slow = ""  # what to say of a texture that has run out as it takes longer than it lasts
        real = rendering.plant is None
        self._touches = TouchWatch(rendering.model, self.controller, active=real, slows=False)
        self._contact, self._followed = ContactLag(self.model.contact_length), 0  # of the samples before this one
        self.play(self._texture(rendering))

    @property
    def samples(self) -> int:
        """Samples that have been played; those of a driver that does not call back with what it has stated of them."""
        return super().samples if self._calls_back else self._known

    @property
    def flags(self) -> Flag:
        """Everything that was ever raised."""
        return super().flags | self._touches.flags

    def advance(self, sensing: bool, late: bool = False, most: int = 0) -> int:
        """Exchange a block with the driver; `sensing`: its own sense of the finger is used, where it has one.

        `late`: the device was left behind by the clock before it.  A simulated device in compiled code plays `most`
        samples, or `TURN`.  Returns how many were played.
        """
        with self._turn:
            return self._advance(sensing, Flag.OVERRUN if late else 0, most)

    def _advance(self, sensing: bool, flags: int, most: int) -> int:
        first = self.samples
        if self._device_loop is None:
            sensed = self._exchange(sensing, flags)
        else:
            count = most or max(round(TURN * self.rate), 1)
            self._entry["sensed_position"], self._entry["lost"] = sensing, flags  # any number, for the step's address
            with uninterrupted():
                sensed = self._device_loop(count, lambda position: np.zeros(len(position)))[-1]
        at = (first + np.arange(len(sensed.sensed))) % len(self._true)
        if sensed.motion is not None:
            self._true[at, :-1], self._has_motion = sensed.motion, True
        if sensed.normal_load is not None:
            self._true[at, -1] = sensed.normal_load
        self.senses = sensed.position is not None
        self._known = first + len(at)
        for texture in self._textures:
            if isinstance(texture, EvaluatedTexture) and texture.error is not None:
                raise texture.error
        return len(at)

    def _exchange(self, sensing: bool, flags: int) -> Sensed:
        """Play a block, and compute the drive of the next one from what was sensed."""
        if hasattr(self.driver, "resting"):
            self.driver.resting = self.stopped is not None or not self._slot["playing"][0]
        places = len(self.model.places)
        sensed = check_sensed(self.driver, self.driver.play(self._drive), places, self._has_motion)
        if sensed.flags is not None:
            flags |= int(np.bitwise_or.reduce(sensed.flags))
        self._itself = self._itself or stops_itself(sensed, self.running)
        self._touches.slow()
        with uninterrupted():
            self._drive = self.process(sensed.sensed, sensed.position if sensing else None, flags)
        return sensed

    def fill_some(self) -> None:
        """As `fill`, for `SPELL` at most; what is past by then is left out."""
        rate, ahead, until = self.driver.rate, sampled_texture.AHEAD, time.monotonic() + SPELL
        playing = [int(self._entry[name][0]) for name in ("current", "previous")]
        timed = [each for each in self._textures if isinstance(each, SampledTexture) and each.record["length"][0]]
        for texture in [each for each in timed if each.address in playing]:
            while time.monotonic() < until:
                now = self.samples + self.ahead - int(texture.record["begun"][0])
                written = max(int(texture.record["written"][0]), now)
                if written >= now + round(ahead * rate):
                    break
                texture.record["written"], self._began = written, time.monotonic()
                texture.fill(min(now, written + round((PIECE - ahead) * rate)))
                if self.samples + self.ahead - int(texture.record["begun"][0]) > written + PIECE * rate:
                    self.slow = self.computing
                self._began = math.nan

    def foresee(self) -> None:
        """Evaluate what comes of textures in time and place, where it is due: the finger was set, or it runs out."""
        playing = [each for each in self._textures if isinstance(each, ForeseenTexture)]
        if not playing:
            return
        entry, path = self.foreseen(sampled_texture.PIECE)
        sample, state = int(entry["samples"][0]), tuple(int(entry[name][0]) for name in CHANGES)
        if state == self._foreseen[1] and sample < self._foreseen[0] + REFRESH * self.driver.rate:
            return
        self._foreseen = sample, state
        faded = int(entry["switch"][0]) + max(int(entry[name][0]) for name in ("fade", "fade_out"))
        audible = ("current", "previous") if sample < faded else ("current",)  # before its fade one may have failed
        for texture in playing:
            if texture.address in [int(entry[name][0]) for name in audible]:
                texture.foresee(sample, path)

    @property
    def evaluating(self) -> str:
        """What to say of a texture in time and place that is being evaluated, and does not end."""
        return f"{type(self.rendering.scene.texture).__name__}: its waveform has not returned: it was faded out"

    @property
    def computing(self) -> str:
        """What to say of the texture that is being computed and takes longer than it lasts; empty: there is none."""
        took, name = time.monotonic() - self._began, type(self.rendering.scene.texture).__name__
        if not took > PIECE:
            return ""
        slow = f"{PIECE:g} s of it took {took:.3g} s to compute, {took / PIECE:.3g} times as long as it lasts"
        return f"{name}: {slow}: it was not played to its end: compute it before play begins"

    def made(self, rendering: Rendering) -> tuple[SampledTexture | EvaluatedTexture, Controller]:
        """Return what plays another rendering of the same device; a ValueError where nothing can."""
        last, bands = self._control.controller, rendering.bands
        goes_on = last.bands.whole and (bands.whole or not isinstance(bands, CombinedBands))
        return self._texture(rendering), last if goes_on else live_controller(rendering)

    def replace(self, rendering: Rendering, texture: SampledTexture | EvaluatedTexture, controller: Controller) -> None:
        """Fade into the texture of another rendering of the same device; texture and controller are `made` of it.

        A controller that takes waveforms goes on; else there is a new one for the texture's bands.
        """
        model = joint_model(self.rendering.model, rendering.model)
        parts: Any = [(controller, model)]
        if isinstance(controller, CombinedController):
            parts = zip(controller.parts, (model.plate, model.friction), strict=True)
        for part, its_model in parts:
            if part is not None:
                _widen(part, its_model)
        if controller is not self._control.controller:
            ready(controller)
        with nullcontext() if self._device_loop is None else self._turn:  # a piece is played with one shape
            self.play(texture, controller)
            if rendering.shape is not None:
                device: Any = self.rendering.plant or self.driver
                device.reshape(rendering.shape)
        self.rendering = replace(rendering, **{name: getattr(self.rendering, name) for name in DEVICE})
        self.model = model

    def signals(self, start: int) -> tuple[int, dict[str, Array]]:
        """Signals of a recording from sample `start` on, as far back as they are kept, and the first one's number."""
        derived, reach = self.rendering.differentiated, len(DERIVATIVE)  # samples before, and after
        found = self.log(start - max(getattr(self.driver, "early", 1), reach) if derived else start)
        first = int(found.pop("first"))
        if self._calls_back and hasattr(self.driver, "skin") and self.driver.sensed_channels:
            self._has_motion, found["motion"] = True, self.driver.skin(found["sensed"], found["position"])
        if derived:
            enough, skip = len(found["flags"]) > 2 * reach, max(start - first, 0)
            weights = np.r_[DERIVATIVE[::-1], 0.0, -DERIVATIVE] * self.driver.rate
            found["reference"] = np.convolve(found["reference"], weights, "same") if enough else found["reference"]
            rows = slice(skip, -reach if enough else skip)
            first, found = first + skip, {name: signal[rows] for name, signal in found.items()}
        if self.model.finger.needs_contact:  # as `Rendering.requested`
            found["reference"] = np.where(np.isnan(found["position"]), 0.0, found["reference"])
        true = self._true[(first + np.arange(len(found["flags"]))) % len(self._true)]
        found["normal_load"] = np.where(np.isnan(true[:, -1]), found["normal_load"], true[:, -1])
        stated = {"motion": true[:, :-1]} if self._has_motion else {}
        contact = self._contact if first == self._followed else ContactLag(self.model.contact_length)
        motion = motion_of(self.driver, self.model, stated | found, contact)
        if first >= self._followed:
            self._contact, self._followed = contact, first + len(motion)
        found = {name: signal[: len(motion)] for name, signal in found.items()}
        return first, found | {"motion": motion, "target": np.zeros((len(motion), 0), complex)}

    def watch_touches(self, signals: dict[str, Array], gap: int) -> None:
        """Flag two touches in the signals that follow those of the last call, `gap` samples later."""
        if gap and self._touches.monitor is not None:
            self._touches.monitor.restart()
        if len(signals["flags"]):
            signals["flags"] = self._touches.update(signals)

    @property
    def motion_source(self) -> str:
        """Where `motion` comes from."""
        return motion_source(self.driver, self.model, self._has_motion)

    def figures(self) -> list[Row]:
        """What every band did over the last `JUDGED` seconds, see `band_figures`."""
        first, signals = self.signals(self.samples - round(JUDGED * self.driver.rate))
        return band_figures(self.rendering.bands, first, self.driver.rate, signals)

    @property
    def learned(self) -> Controller | None:
        """The controller that runs, and has learned of the device, unless that was stopped."""
        return None if self.stopped is not None else self.running

    def fault(self) -> HapticError | None:
        """Return why the drive was stopped, once it has faded out and stayed at zero for as long again."""
        stopped = self.stopped
        if stopped is None or self.samples < stopped + 2 * FADE_OUT * self.driver.rate + self.driver.delay:
            return None
        if self.timed_out:
            return WatchdogTimeout(stopped / self.driver.rate)
        before = round(RECENT * self.driver.rate)
        flags = self.log(max(stopped - before, 0))["flags"][:before]
        return device_fault(self.rendering, None if self._itself else self.running, stopped, flags)

    def _texture(self, rendering: Rendering) -> SampledTexture | EvaluatedTexture:
        try:
            return SampledTexture(rendering.scene.texture, self.driver.rate, rendering.waveform_of)
        except InseparableTexture:
            if self._calls_back:  # by a callback without Python's lock
                return ForeseenTexture(rendering, self.ahead, self.foreseen(sampled_texture.PIECE)[1])
        return EvaluatedTexture(rendering, self.ahead, self._arrays["places"], self._arrays["position"])


def live_controller(rendering: Rendering) -> Controller:
    """Return a controller that takes any waveform where the method can; else of the scene's bands, times the gain."""
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


def _widen(controller: Any, model: DeviceModel) -> None:
    """Let a controller, and its supervisor, do what `model` needs at most."""
    if isinstance(controller, SupervisedController):
        p, designed = controller.state["p"], SupervisedController(controller.controller, model)
        if not p["gains"][0]:  # the texture before was beyond the frequencies at which gains are tested
            controller.gains, p["gains"] = designed.gains, designed.state["p"]["gains"]
        settings = design_supervisor(controller.controller, model)
        for name in sorted(settings, key="modelled".__eq__):  # which begins the tests that take the others
            p[name] = settings[name]
    controller.settings["drive_limit"] = model.drive_limit


def joint_model(old: Any, new: Any) -> Any:
    """Device model of the new scene, its drive limited by, and supervised for, what both scenes need."""
    if isinstance(new, CombinedModel):
        friction = new.friction and old.friction and joint_model(old.friction, new.friction)
        return replace(new, plate=joint_model(old.plate, new.plate), friction=friction or new.friction)
    model = replace(new, drive_limit=max(old.drive_limit, new.drive_limit))
    if old.demand is None or new.demand is None:
        return model
    most = {name: max(getattr(old.demand, name), getattr(new.demand, name)) for name in ("motion", "drive", "highest")}
    return replace(model, demand=replace(new.demand, **most, lowest=min(old.demand.lowest, new.demand.lowest)))


@np.errstate(under="ignore")
def band_figures(bands: Bands, first: int, rate: float, signals: dict[str, Array]) -> list[Row]:
    """Frequency (Hz), target, achieved amplitude and relative error of every band; see `Row`.

    Least squares by the normal equations and a `RIDGE`, which makes amplitudes 0.02 % too small, about the means of
    target and motion: what rests has no amplitude.  Of a waveform without bands the amplitudes are rms, and the
    frequency is 0.
    """
    reference, motion = signals["reference"], signals["motion"][:, 0]
    if not len(reference):
        return []
    time, position = (first + np.arange(len(reference))) / rate, signals["position"]
    reference, motion = reference - reference.mean(), motion - motion.mean()
    if not len(bands) or (bands.follows_finger and not np.isfinite(position).all()):
        target, achieved, error = (float(np.sqrt(np.mean(each**2))) for each in (reference, motion, motion - reference))
        return [(0.0, target, achieved, _share(error, target))]
    phase = bands.carrier_phase(time, position).astype(np.float32)
    waves = np.hstack([np.cos(phase), -np.sin(phase), np.ones((len(time), 1), np.float32)])
    products = (waves.T @ waves).astype(float)
    products[np.diag_indices(len(products))] += RIDGE * len(time)
    values = np.stack([reference, motion], axis=1).astype(np.float32)
    found = np.linalg.solve(products, (waves.T @ values).astype(float))
    target, achieved = (found[: len(bands)] + 1j * found[len(bands) : -1]).T
    speed = np.nan_to_num(abs(np.diff(position))).mean() * rate if len(time) > 1 else 0.0
    frequency = bands.frequency + bands.wavenumber * speed
    return [
        (float(hertz), float(abs(desired)), float(abs(found)), _share(abs(found - desired), abs(desired)))
        for hertz, desired, found in zip(frequency, target, achieved, strict=True)
    ]


def _share(error: float, target: float) -> float:
    return float(error / target) if target > LEAST_TARGET else math.nan
