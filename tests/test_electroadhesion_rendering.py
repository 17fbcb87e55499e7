"""Electroadhesion end to end: tones on the tribometer, fingers that rest or lift, refusals."""

import numpy as np
import pytest
from electroadhesive import FORCE, RATE, SLIDE, Screen, band, tone
from held import amplitude

import hapticrender as hr

# A millinewton of noise on the tribometer, white over 10 kHz, in an observer whose pole lies at 10 Hz: the envelope's
# standard deviation is 1e-3 sqrt(4 * 10 pi/2/10e3) = 0.08 mN; four of them in 0.1 N.
NOISE = 4 * 0.8e-4 / FORCE


@pytest.mark.parametrize(
    ("frequency", "finger"),
    [(20.0, {}), (100.0, {"area_scale": 0.7}), (400.0, {"area_scale": 1.3, "gap_thickness": 3e-6})],
)
def test_a_tone_follows_its_target_whatever_the_finger(frequency, finger):
    """Area +-30 % and gaps of 0.5 to 3 um change the gain by -41 to +43 %; the loop leaves the noise alone."""
    recording = hr.render(tone(frequency, **finger))
    figures = band(recording)
    assert figures["target"] == pytest.approx(FORCE, rel=1e-6)
    assert figures["rms_error_friction"] < NOISE
    assert abs(figures["phase_error"]) < NOISE  # rad, of the same noise
    assert not recording.flags[RATE:].any()


def test_a_friction_coefficient_other_than_assumed_is_corrected():
    """A driver of the user's own, whose finger has another mu than the scene's 0.8."""
    mu = 0.5
    recording = hr.render(tone(100.0, duration=1.0, finger=SLIDE), driver=Screen(blind=False, friction_coefficient=mu))
    assert band(recording)["rms_error_friction"] < NOISE


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (tone(100.0, finger=hr.Finger.still(normal_load=1.0)), r"finger: must slide faster than 0.001 m/s"),
        (tone(100.0, force=2.0), r"asks for an attraction of 10.* N: must be <= 2.23 N, at 0.01 A under a nominal"),
        (
            hr.Scene(texture=hr.Grating(frequency=80.0, amplitude=1e-5), finger=SLIDE, device="electroadhesion",
                     duration=1.0, gradient=1.0),
            r"gradient = 1.0: must be 0 1/m",
        ),
    ],
)  # fmt: skip
def test_what_the_screen_cannot_do_is_refused(scene, message):
    with pytest.raises(ValueError, match=message):
        hr.render(scene)


@pytest.mark.parametrize(("device", "lifted"), [("electroadhesion", True), ("ultrasonic", False)])
def test_a_finger_that_rests_or_is_away_winds_nothing_up(device, lifted):
    """Slides, rests (or is lifted) for 1.2 s, slides on: nothing saturates.

    0.2 s later the texture is back, within 1 % as the accuracy suite has it.
    """
    time = np.arange(0.0, 3.2, 1e-3)
    way = np.cumsum(np.where((time < 1.2) | (time > 2.4), 0.08, 0.0)) * 1e-3
    position = abs(way % 0.1 - 0.05) - 0.025
    touches = [(0.0, 1.2), (2.4, 3.2)] if lifted else None
    finger = hr.Finger.sampled(position, rate=1000.0, normal_load=0.4, mechanics="light", touches=touches)
    texture = hr.Grating(frequency=100.0, velocity=10e-3)
    recording = hr.render(hr.Scene(texture=texture, finger=finger, duration=3.2, device=device))
    late = recording.time > 0.3  # the first touch finds a loop that knows nothing yet
    assert not (recording.flags[late] & hr.Flag.SATURATED).any()
    assert amplitude(recording.motion, 100.0, 0.6, recording.rate)[0] == pytest.approx(10e-3 / 0.64, rel=0.01)
