"""Control methods: one table of rows, each with its name, its options and the design of its controller.

=============== =======================================================================================================
h, h2           error envelopes by a residual observer, law through the device's dynamic stiffness, finger included
paper           Grigorii et al. 2021: amplitude and phase loops on the STDFT* at each transducer; the baseline
paper-common    the same on the mean displacement only; all transducers get the same drive
boxcar          the paper's loops, per transducer, on a running mean over whole periods of the lowest carrier
static          complex loops in the device's coordinates, then the static inverse D(jw) of the free device
stiffness       the same, then D V + D' dV/dt
resonant        one integrator a band and coordinate, no low pass; then D V + D' dV/dt
=============== =======================================================================================================

All but h and h2 leave the finger out; docs/theory.md, "Where methods fail", says what that costs.  The name of another
row belongs into `hapticrender.defaults.METHODS`, too.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import Validated, parameter
from hapticrender.control.controller import (
    BankController,
    device_settings,
    refuse_whole_waveform,
    ridge_spacing,
    shared_settings,
    spacing,
)
from hapticrender.control.controller_design import ONE_SPEED, Rules, design_controller, rules_for
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.inverse import AdaptiveInverse
from hapticrender.control.linear import DiscretePlant
from hapticrender.control.loopshape import Bandwidths, envelope_loop
from hapticrender.control.low_pass import low_pass_step
from hapticrender.control.records import W
from hapticrender.defaults import FADE_IN
from hapticrender.errors import DesignError
from hapticrender.protocols import Array, Method

TABLE_STEP = 0.5  # Hz, resolution of the look-up table
CONTACT_FADE = 0.02  # s: targets of the polar methods that follow the finger fade in and out with contact
HIGHEST_EDGE = 1.25  # of the highest frequency, where position-locked carriers have faded out
MOST_INTEGRAL = 0.613034  # an integrator's gain times the delay: the least margins of `loopshape.MOST_DELAY`
ALL_PASS = (1.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ErrorObserver:
    """The law by bands: an error observer and the device's dynamic stiffness, finger included.

    Without `rules` it runs at two speeds, by the carriers' spacing.
    """

    name: str = "h2"
    rules: Rules | None = None

    def design(self, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> BankController:
        """Design the controller; see `design_controller`."""
        return design_controller(self.name, model, bands, self.rules or rules_for(bands), feedback=feedback)


@dataclass(frozen=True, kw_only=True)
class Polar:
    """The paper's controller: amplitude and phase loops; the options show what each precaution is good for.

    References
    ----------
    Grigorii, Li, Peshkin and Colgate, IEEE Transactions on Haptics, 2021, eqs. 1-5.
    """

    name: str = "paper"
    common: bool = False  # loops on the mean displacement; all transducers get the same drive
    boxcar: bool = False  # estimate by a running mean
    clamp: bool = True  # keep the command amplitude from going negative
    subtract: bool = False  # naive phase error arg X - arg R, with a seam at -270/90 deg in each, not arg(X conj R)
    bandwidths: Bandwidths | None = None  # Hz, of loop and low pass, unchecked; None: the paper's rule

    def design(self, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> BankController:
        """Design loops on the displacements at the transducers; a `DesignError` where the delay leaves no margin.

        Targets that are modulated (in a player) or differentiated (along a friction device) are refused alike.
        """
        refuse_whole_waveform(bands)
        if bands.modulated or bands.differentiated:
            cure = "use 'inverse', 'h2' or 'stiffness'"
            raise DesignError(f"method {self.name!r} cannot modulate or differentiate targets: {cure}")
        loop, width = envelope_loop(model, bands, boxcar=self.boxcar, bandwidths=self.bandwidths, feedback=feedback)
        sensor_map, drive_map = model.side_from_coordinate, np.eye(len(model.side_from_coordinate))
        if self.common:
            sensor_map, drive_map = sensor_map.mean(axis=0)[None], np.ones((len(sensor_map), 1))
        table = frequency_table(model, sensor_map, drive_map, feedback)
        settings = {
            **low_pass_settings(model, bands, width, sensor_map @ model.coordinate_from_sensed, drive_map, feedback),
            **loop,
            "polar": True,
            "clamped": self.clamp,
            "subtracted": self.subtract,
            "table": table.shape[1],
            "table_step": TABLE_STEP,
            "fade_in": 1.0 / (CONTACT_FADE * model.rate),
        }
        controller = BankController(self.name, low_pass_step, settings, bands, arrays={"gains": table})
        controller.tiles["fade"] = controller.setpoints[1].reshape(-1, W) == 0.0  # a constant target is there at once
        return controller


@dataclass(frozen=True, kw_only=True)
class Inverse:
    """Complex loops and the inverse of the free device; the options show what each precaution is good for."""

    name: str
    dynamic: bool  # D V + D' dV/dt in place of the static D(jw) V
    feed_forward: bool = False  # command the reference plus what the loop adds, in place of the loop alone
    filtered: bool = True  # with feed-forward, compare the reference behind the estimator's low pass; naive without
    bandwidths: Bandwidths | None = None  # Hz, of loop and low pass, unchecked; None: the paper's rule

    def design(self, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> BankController:
        """Design loops in the device's coordinates; raises `DesignError` where its delay leaves no margin."""
        loop, width = envelope_loop(model, bands, bandwidths=self.bandwidths, feedback=feedback)
        settings = complex_settings(model, bands, width, self.feed_forward, feedback) | loop
        settings |= {"dynamic": self.dynamic, "deviation": self.feed_forward and self.filtered}
        return BankController(self.name, low_pass_step, settings, bands)


@dataclass(frozen=True, kw_only=True)
class Resonant(Validated):
    """Adaptive feed-forward cancellation (proportional-resonant control): one integrator a band and coordinate.

    Notes
    -----
    From motion to force an integrator is ``-ki [D(jw)/(s - jw) + D'(jw) + conj. at -jw]``.  At a mode w1 of mass m and
    stiffness m w1^2 that is ``+j w1 2 ki m``: negative damping of 2 ki m from every band.  All together must stay below
    the mode's own m w1/Q, that is, sum ki < w1/2Q, its decay rate.
    """

    gain: float = parameter(
        15.0, "1/s", above=0.0
    )  # sum of ki over the bands, below the decay rate of the least damped mode
    checked: bool = True  # refuse a gain or a delay beyond its bound; naive without
    name: ClassVar[str] = "resonant"

    def design(self, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> BankController:
        """Design integrators; a `DesignError` where the gain drives a mode, or the delay leaves no margin."""
        each, period = self.gain / max(len(bands), 1), 1.0 / model.rate
        if feedback and self.checked:
            least, late = least_decay(model), model.delay * period
            if self.gain >= least:
                raise DesignError(
                    f"gain={self.gain:g} 1/s must be below {least:.3g} 1/s, the decay rate of the least damped mode, "
                    f"which it takes away: lower gain"
                )
            if each * late > MOST_INTEGRAL:
                most = len(bands) * MOST_INTEGRAL / late
                bound = f"must be <= {most:.3g} 1/s of {len(bands)} bands behind a delay of {late:.3g} s"
                raise DesignError(f"too small a margin: gain={self.gain:g} 1/s {bound}: lower it, or the delay")
        settings = complex_settings(model, bands, model.lowest_frequency / 4, False, feedback)
        half = 0.5 * each * period
        settings |= {"low_pass": ALL_PASS, "loop": (half, half, 0.0, -1.0, 0.0)}
        settings |= {"dynamic": True, "deviation": True}
        return BankController(self.name, low_pass_step, settings, bands)


def least_decay(model: DeviceModel) -> float:
    """Decay rate of the least damped mode of the free device, 1/s."""
    poles = np.linalg.eigvals(DiscretePlant.free(model.mass, model.damping, model.stiffness, model.rate).a)
    return float(-model.rate * np.log(abs(poles)).max())


def frequency_table(model: DeviceModel, sensor_map: Array, drive_map: Array, feedback: bool) -> Array:
    """Gain (m per drive unit) and lag (rad) of the free device and its hold by coordinate, shape (2 coordinates, n).

    `sensor_map` rows are the controlled displacements from the device's coordinates, `drive_map` columns their drive
    channels.  With feedback it is what each coordinate does while all are driven alike, as a sweep of the device shows
    it; without, what makes all of them do the same.
    """
    frequency = np.arange(0.0, model.rate / 2 + TABLE_STEP, TABLE_STEP)
    response = sensor_map @ model.response(frequency) @ drive_map  # (n, coordinates, coordinates)
    alike = np.ones(len(sensor_map))
    gain = response @ alike if feedback else 1.0 / np.linalg.solve(response, alike[None, :, None])[..., 0]
    gain = gain.T * np.sinc(frequency / model.rate)
    return np.ascontiguousarray(np.concatenate([abs(gain), np.unwrap(np.angle(gain), axis=1)]))


def low_pass_settings(
    model: DeviceModel, bands: Bands, width: float, sensor_map: Array, drive_map: Array, feedback: bool
) -> dict[str, Any]:
    """Settings that every method with a low pass shares; the maps are those of sensors to coordinates and back.

    `width` (Hz) is the bandwidth of the loop.
    """
    # a waveform's envelopes pass two poles, with the delay of the low pass's two
    analysis = min(2 * math.pi * math.sqrt(2.0) * 2.0 * width, spacing(bands))
    refuse_whole_waveform(bands)
    if model.shape is not None:
        raise DesignError(
            "gradient: must be 0 1/m, this method moves the surface as a whole: use 'inverse', 'h2' or 'h'"
        )
    return {
        **shared_settings(model, bands, sensor_map, drive_map, feedback),
        "waveform_gain": 2 * analysis / model.rate,
        "crowd_speed": analysis / ridge_spacing(bands),
        "highest_edge": HIGHEST_EDGE,
        "feedback": feedback,
    }


def complex_settings(
    model: DeviceModel, bands: Bands, width: float, feed_forward: bool, feedback: bool
) -> dict[str, Any]:
    """Settings of the complex methods; without feedback the reference alone is inverted."""
    forward = feed_forward or not feedback
    drive_map = np.linalg.pinv(model.force_from_drive)
    return {
        **low_pass_settings(model, bands, width, model.coordinate_from_sensed, drive_map, feedback),
        **device_settings(model),
        "pattern": (1.0, 0.0),
        "forward": forward,
        "fade_in": 1.0 / (FADE_IN * model.rate) if forward else 1.0,
    }


_ALL: tuple[Any, ...] = (
    Polar(),
    Polar(name="paper-common", common=True),
    Polar(name="boxcar", boxcar=True),
    Inverse(name="static", dynamic=False),
    Inverse(name="stiffness", dynamic=True),
    Resonant(),
    ErrorObserver("h", ONE_SPEED),
    ErrorObserver("h2"),
    AdaptiveInverse(),
)
METHODS = {method.name: method for method in _ALL}


def method_named(name: str) -> Method:
    """Return the method called `name`; a ValueError lists those there are."""
    if name not in METHODS:
        raise ValueError(f"method = {name!r}: must be one of {', '.join(METHODS)}")
    return METHODS[name]
