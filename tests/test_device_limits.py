"""Limits of a device: refused where a scene must pass them, held where it might, and no hindrance below."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from electroadhesive import Screen
from live_devices import Bench
from other_plate import OtherPlate
from scipy.signal import lfilter

import hapticrender as hr
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.renderers.limits import needed
from hapticrender.touch.mechanics import HEAVY_SECOND
from hapticrender.touch.recorded import Recorded

RATE = 5000.0
HALF_STEP = 3.0 / 2**12  # A: the converter rounds what is played
HEAVY = hr.Finger.still(normal_load=0.8, mechanics=HEAVY_SECOND)


def scene(frequency=189.0, amplitude=50e-6, duration=2.0, **fields):
    return hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=amplitude), duration=duration, **fields)


def need_of(asked):
    rendering = hr.prepare(asked)
    return needed(asked, rendering.model, rendering.bands, asked.texture.waveform)


def heat(drive, time):
    """Largest root of the mean square of each channel, over a time constant (s)."""
    pole = -np.expm1(-1.0 / (RATE * time))
    return np.sqrt(lfilter([pole], [1.0, pole - 1.0], drive**2, axis=0).max(axis=0))


MUST = {  # limit: what the scene needs of it (a tone over 20 time constants), message
    "peak_drive": (
        lambda need: need.drive,
        r"at 72 Hz needs .* A: must be <= .* A in each coil, \[limits\] peak_drive",
    ),
    "rms_drive": (lambda need: need.drive / np.sqrt(2), r" A rms: must be <= .* over 0.1 s, \[limits\] rms_drive"),
    "displacement": (lambda need: need.amplitude, r"5e-05 m: must be <= .* m, \[limits\] displacement"),
}


def refused_beyond(asked, limit, message, room=0.01):
    """A scene is prepared with a limit by `room` above `limit`, and refused with one below it."""
    hr.prepare(asked((1 + room) * limit))
    with pytest.raises(ValueError, match=message):
        hr.prepare(asked((1 - room) * limit))


@pytest.mark.parametrize("name", MUST)
def test_a_scene_that_must_pass_a_limit_is_refused(name):
    """1 % below and above, a peak being rounded to 1.5 mA of 0.27 A; after 20 time constants the mean is 1 - e^-20."""
    least, message = MUST[name]
    limit = least(need_of(scene(72.0)))
    refused_beyond(lambda value: scene(72.0, limits={name: value, "rms_time": 0.1}), limit, message)


def test_a_short_scene_may_heat_a_coil_more():
    """The mean of a tenth of the time constant is 1 - e^-0.1 of the square: 0.31 of the rms."""
    rms = np.sqrt(-np.expm1(-0.1) / 2) * need_of(scene(72.0)).drive
    asked = lambda value: scene(72.0, duration=1.0, limits={"rms_drive": value, "rms_time": 10.0})  # noqa: E731
    refused_beyond(asked, rms, "rms_drive", 0.001)


def test_a_recording_is_judged_by_the_hottest_part_of_it():
    """A burst of 72 Hz in silence; its mean over 0.1 s is that of the drive that plays it on the free plate."""
    time = np.arange(round(RATE)) / RATE
    burst = np.sin(2 * np.pi * 72.0 * time) * np.where(abs(time - 0.5) < 0.15, np.cos(np.pi * (time - 0.5) / 0.3), 0.0)
    texture = Recorded(samples=burst, rate=RATE, amplitude=50e-6)
    need = need_of(hr.Scene(texture=texture, duration=1.0, limits={"rms_time": 0.1}))
    tone = need_of(scene(72.0)).drive
    assert 0.4 * tone < need.rms < 0.71 * tone  # the top of the burst, but never more than its amplitude
    asked = hr.Scene(texture=texture, duration=1.0)
    limited = lambda value: replace(asked, limits={"rms_drive": value, "rms_time": 0.1})  # noqa: E731
    refused_beyond(limited, need.rms, r"over 0.1 s, \[limits\] rms_drive", 0.001)


def test_the_peak_is_held_under_a_finger_that_asks_for_more():
    free = hr.render(scene(finger=HEAVY))
    limit = 2.0 * need_of(scene()).drive
    assert abs(free.drive[-1000:]).max() > limit
    held = hr.render(scene(finger=HEAVY, limits={"peak_drive": limit}))
    assert abs(held.drive).max() <= limit
    assert (held.flags & hr.Flag.SATURATED).any()
    above = hr.render(scene(finger=HEAVY, limits={"peak_drive": 1.0}))  # never reached
    np.testing.assert_array_equal(above.drive, free.drive)


@pytest.mark.parametrize("method", ["inverse", "h2", "paper-common"])
def test_a_coil_never_gets_hotter_than_its_limit_and_the_texture_goes_on(method):
    """At 189 Hz the finger takes more than twice what the free plate needs, on which the scene is judged."""
    asked = scene(finger=HEAVY, method=method)
    limit = 1.5 * need_of(asked).drive / np.sqrt(2)
    free = hr.render(asked)
    assert heat(free.drive, 0.2).max() > 1.5 * limit
    held = hr.render(scene(finger=HEAVY, method=method, limits={"rms_drive": limit, "rms_time": 0.2}))
    assert heat(held.drive, 0.2).max() <= limit + HALF_STEP
    assert np.isfinite(held.motion).all()
    assert (held.flags & hr.Flag.SATURATED).any()
    assert not (held.flags & hr.Flag.STOPPED).any()
    assert np.ptp(held.motion[-1000:, 0]) / 2 > 10e-6


def test_below_its_limit_a_coil_plays_every_sample_as_without():
    free = hr.render(scene(72.0, finger=HEAVY))
    limited = scene(72.0, finger=HEAVY, limits={"rms_drive": 1.2 * heat(free.drive, 0.2).max(), "rms_time": 0.2})
    np.testing.assert_array_equal(hr.render(limited).drive, free.drive)


class Blind(Bench):
    """A device without sensors."""

    rate, block, delay, drive_channels, sensed_channels = RATE, 50, 50, 2, 0

    def play(self, drive):
        return hr.Sensed(np.empty((self.block, 0)))


def test_open_loop_a_coil_is_held_too():
    """A swept finger passes 189 Hz slowly; the texture needs most at the lowest speed, and is not refused for it."""
    finger = hr.Finger.sliding(speed=0.05, normal_load=0.2)
    asked = {"texture": hr.Grating(wavelength=1e-3, amplitude=30e-6), "finger": finger, "duration": 1.0}
    free = hr.render(hr.Scene(**asked), driver=Blind())
    limit = 0.7 * heat(free.drive, 0.2).max()
    held = hr.render(hr.Scene(**asked, limits={"rms_drive": limit, "rms_time": 0.2}), driver=Blind())
    assert heat(held.drive, 0.2).max() <= limit * (1 + 1e-9)
    assert (held.flags & hr.Flag.SATURATED).any()


def pressed(load, displacement):
    """A tone of 20 um at 72 Hz under a finger that presses from 0.5 s on."""
    curve = ((0.0, 0.5, 0.52), (0.05, 0.05, load))
    return scene(72.0, 20e-6, finger=hr.Finger.still(normal_load=curve), limits={"displacement": displacement})


def test_a_press_beyond_the_displacement_stops_the_drive():
    """2 N sag the glass by 44 um beside the 20 um of the tone: 70 um is passed by neither, 55 um by both together."""
    hr.render(pressed(2.0, 75e-6))
    with pytest.raises(hr.DeviceFault, match=r"sensor 1 and 2: more than \[limits\] displacement: check") as stopped:
        hr.render(pressed(2.0, 55e-6))
    assert 0.5 < stopped.value.time < 0.56
    drive = stopped.value.recording.drive
    assert not drive[round((stopped.value.time + 10e-3) * RATE) + 2 :].any()
    first = np.flatnonzero(stopped.value.recording.flags & hr.Flag.STOPPED)[0]
    assert (abs(stopped.value.recording.sensed[: first + 1]) > 55e-6).any(axis=1).sum() == 3


@pytest.mark.parametrize(("count", "stops"), [(2, False), (3, True)])
def test_single_samples_beyond_the_displacement_are_no_motion(count, stops):
    """Three in 10 ms stop the drive; two do not."""

    def spoil(sample, sensed):
        spike = sample in range(3000, 3000 + 20 * count, 20)
        return sensed._replace(sensed=sensed.sensed + 60e-6) if spike else sensed

    fields = {"rendering": {"probe": False}, "method": "paper-common"}  # it has no damper that would ring
    limited = scene(72.0, 10e-6, 1.0, limits={"displacement": 45e-6}, **fields)
    with pytest.raises(hr.DeviceFault, match="displacement") if stops else nullcontext():
        hr.render(limited, driver=OtherPlate(spoil=spoil))


SLIDING = hr.Finger.sliding(speed=0.08, normal_load=0.5)


@pytest.mark.parametrize("bits", [12, 0])
def test_a_limit_that_is_refused_is_the_one_that_was_stated(bits):
    """12 bits over +- 3 A are steps of 1.46 mA: 1 mA leaves none of them."""
    with pytest.raises(ValueError, match=r"must be <= 0.001 A in each coil, \[limits\] peak_drive") as refused:
        hr.prepare(replace(scene(72.0, limits={"peak_drive": 0.001}), profile={"current_bits": bits}))
    step = ", rounded down to a multiple of the converter's step of 0.00146 A"
    assert str(refused.value).endswith(step if bits else "peak_drive")


def friction(device, **limits):
    texture = hr.Grating(frequency=100.0, amplitude=20e-6)
    return hr.Scene(texture=texture, finger=SLIDING, device=device, duration=0.1, limits=limits)


@pytest.mark.parametrize(("name", "share"), [("peak_drive", 1.0), ("rms_drive", np.sqrt(0.5))])
def test_a_screens_current_is_limited_by_the_peak_of_its_carrier(name, share):
    """The rms of a carrier is its peak over the root of 2; bias and swing together need most."""
    driver = hr.prepare(friction("electroadhesion"), driver=Screen()).driver
    bias, floor = (float(driver.state[name][0]) for name in ("bias", "floor"))
    most = driver.convert(np.array([[bias - floor * bias]])).item()
    message = r"texture.amplitude asks for an attraction of .* N: must be <= .* A"
    refused_beyond(lambda value: friction("electroadhesion", **{name: value}), share * most, message)


@pytest.mark.parametrize(("name", "share"), [("peak_drive", 1.0), ("rms_drive", np.sqrt(0.5))])
def test_an_ultrasonic_plates_voltage_is_limited_by_the_peak_of_its_carrier(name, share):
    message = r"vibration of .* m, which takes (.*) V under .*: must be <= 0.1 V"
    with pytest.raises(ValueError, match=message) as refused:
        hr.prepare(friction("ultrasonic", **{name: 0.1 * share}))
    volts = float(str(refused.value).split("takes ")[1].split(" V")[0])
    refused_beyond(lambda value: friction("ultrasonic", **{name: value}), share * volts, "must be <=")


def test_a_hybrids_limits_are_those_of_its_plate():
    asked = {"texture": hr.Grating(frequency=50.0, amplitude=10e-6), "finger": SLIDING, "duration": 0.1}
    limited = hr.prepare(hr.Scene(**asked, device="hybrid", limits={"peak_drive": 0.2}))
    assert 0.2 - 2 * HALF_STEP < limited.model.plate.drive_limit <= 0.2
    with pytest.raises(ValueError, match=r"\[limits\] peak_drive"):
        hr.prepare(hr.Scene(**asked, device="hybrid", limits={"peak_drive": 0.001}))


def hybrid(**profile):
    texture = hr.Grating(frequency=250.0, velocity=10e-3)
    return hr.Scene(texture=texture, finger=SLIDING, device="hybrid", duration=0.1, profile=profile)


def test_a_hybrids_screen_is_limited_by_the_current_and_the_voltage_of_its_source():
    """Both as peaks of the carrier, in [device]; the limiter holds what the square root takes them for."""
    rendering = hr.prepare(hybrid())
    shape, message = rendering.shape, r"texture.amplitude asks for an attraction of .* N: must be <= .* A"
    assert rendering.model.friction.drive_limit == shape.bias - shape.floor
    most = shape(shape.bias - shape.floor).item()
    refused_beyond(lambda value: hybrid(screen_current_limit=value), most, message)
    impedance = abs(ElectroadhesionParameters().impedance(0.5))
    refused_beyond(lambda value: hybrid(voltage_limit=value), most * impedance, message)
