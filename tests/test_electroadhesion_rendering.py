"""Electroadhesion end to end: tones on the tribometer, without a force sensor, and as a carrier in a file; refusals."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from electroadhesive import FORCE, RATE, SLIDE, SPEED, Screen, band, tone
from held import amplitude
from tables import scene_on
from waves import read_back

import hapticrender as hr
from hapticrender import loop
from hapticrender.drivers.wavefile import WaveFileDriver
from hapticrender.renderers.electroadhesion import ElectroadhesionRenderer

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


@pytest.mark.parametrize(("table", "error"), [("profile", 0.0), ("simulation", 0.3)])
def test_an_impedance_is_read_by_what_is_assumed_of_the_screen(table, error):
    """An unevenness of 1.3 makes 1.3 times the attraction of the same current and gap."""
    tables = {"profile": {"sensor": "impedance"}, "simulation": {"level": "carrier"}}
    tables[table]["unevenness"] = 1.3
    scene = hr.Scene(
        texture=hr.Grating(frequency=100.0, amplitude=20e-6),
        finger=SLIDE,
        device="electroadhesion",
        duration=2.0,
        **tables,
    )
    assert hr.render(scene).summary()["worst"]["value"] == pytest.approx(error, abs=0.01)


def test_a_friction_coefficient_other_than_assumed_is_corrected():
    """A driver of the user's own, whose finger has another mu than the scene's 0.8."""
    screen = Screen(blind=False, block=10, friction_coefficient=0.5)
    recording = hr.render(tone(100.0, duration=1.0, finger=SLIDE), driver=screen)
    assert band(recording)["rms_error_friction"] < NOISE


@pytest.mark.parametrize("frequency", [100.0, 110.0, 125.0, 250.0])
def test_a_running_mean_over_whole_periods_removes_the_mean_friction(frequency):
    """0.8 N of it, which a mean over 50 ms reads as 46 mN at 110 Hz: more than the target of 10 mN, so no drive."""
    scene = tone(frequency, force=0.01, duration=1.0)
    recording = hr.render(replace(scene, method="boxcar"))
    assert band(recording)["rms_error_friction"] < 0.01
    assert recording.drive[RATE // 2 :].any()


@pytest.mark.parametrize(("frequency", "played"), [(110.0, False), (140.0, True)])
def test_a_low_pass_plays_nothing_where_the_mean_friction_hides_the_target(frequency, played):
    """2 F_0 (f_L/f)^2 of 0.82 N is above a target of 10 mN up to 128 Hz."""
    recording = hr.render(replace(tone(frequency, force=0.01, duration=1.0), method="paper"))
    assert recording.drive[RATE // 2 :].any() == played


def untold(sample, sensed):
    """The true friction is kept to oneself."""
    return sensed._replace(motion=None)


def shown_late(frequency, rate=RATE):
    """Error of a friction that a tribometer of 1.3 kHz shows behind its delay at zero frequency, on lines at `rate`."""
    s, angle = 2j * np.pi * frequency, 2 * np.pi * 1300.0
    delay = 2 * 0.65 / angle
    whole, part = divmod(delay * rate, 1.0)
    line = (1 - part) * np.exp(s * whole / rate) + part * np.exp(s * (whole + 1) / rate)
    return abs(line / (1 + s * delay + (s / angle) ** 2) - 1)


@pytest.mark.parametrize(("frequency", "block"), [(100.0, 1), (300.0, 10)])
def test_the_tribometers_delay_is_no_error_of_the_device(frequency, block):
    """Of which 100 Hz shows 10 and 300 Hz 31 %; the noise of 1 mN is its own error. Live as in `render`, to the end."""
    scene, own = tone(frequency, duration=0.8), Screen(blind=False, block=block, tell=untold)
    recording = hr.render(scene, driver=own)
    with hr.Player(scene, driver=Screen(blind=False, block=block, tell=untold), paced=False) as player:
        player.play(scene.texture)
        player.sleep(0.6)
        (live,) = player.state().bands
    assert recording.header.motion_source == "sensors"
    assert len(recording) == 0.8 * RATE
    error = recording.motion[RATE // 2 :, 0] - np.concatenate(own.moved)[RATE // 2 : len(recording), 0]
    expected = np.hypot(shown_late(frequency) * FORCE / np.sqrt(2), 1e-3)
    assert error.std() < 1.05 * expected
    assert live.error < shown_late(frequency) + NOISE
    assert recording.summary()["worst"]["value"] < 0.05


def test_no_sample_is_lost_where_the_tribometers_device_fails(tmp_path):
    def breaks(sample, sensed):
        if sample >= 1000:
            raise hr.DeviceLost("screen: play: no answer")
        return untold(sample, sensed)

    with pytest.raises(hr.DeviceLost):
        hr.render(tone(100.0), driver=Screen(blind=False, tell=breaks), journal=tmp_path / "cut.au")
    assert len(hr.Recording.load(tmp_path / "cut.au")) == 1001  # and the one that is stopped


TONE = hr.Grating(frequency=100.0, velocity=10e-3)


@pytest.mark.parametrize(("device", "lifted"), [("electroadhesion", True), ("ultrasonic", False)])
def test_a_finger_that_rests_or_is_away_winds_nothing_up(device, lifted):
    """For 1.2 s; nothing saturates, and 0.2 s later the texture is back, within 1 % as the accuracy suite has it."""
    time = np.arange(0.0, 3.2, 1e-3)
    way = np.cumsum(np.where((time < 1.2) | (time > 2.4), 0.08, 0.0)) * 1e-3
    position = abs(way % 0.1 - 0.05) - 0.025
    touches = [(0.0, 1.2), (2.4, 3.2)] if lifted else None
    finger = hr.Finger.sampled(position, rate=1000.0, normal_load=0.4, mechanics="light", touches=touches)
    recording = hr.render(hr.Scene(texture=TONE, finger=finger, duration=3.2, device=device))
    late = recording.time > 0.3  # the first touch finds a loop that knows nothing yet
    assert not (recording.flags[late] & hr.Flag.SATURATED).any()
    assert amplitude(recording.motion, 100.0, 0.6, recording.rate)[0] == pytest.approx(10e-3 / 0.64, rel=0.01)


@pytest.mark.parametrize("device", ["electroadhesion", "hybrid"])
def test_silence_is_played(device):
    """Which needs no attraction: the loop's answer to noise is not cut off, which would be a failure."""
    recording = hr.render(scene_on(device, 0.0 * TONE, SLIDE, 1.5, keep_unfelt=True))
    assert recording.summary()["reason"] == "the texture is zero, or far below what can be felt"
    assert not recording.flags.any()


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_a_finger_without_load_counts_as_lifted(device):
    """Nothing is wanted of it, nothing is driven for it, and what follows is what was wanted."""
    loads = ([0.0, 1.0, 1.01, 2.0, 2.01, 3.0], [0.4, 0.4, 0.0, 0.0, 0.4, 0.4])
    finger = hr.Finger.sliding(speed=SPEED, normal_load=loads, mechanics="light")
    recording = hr.render(scene_on(device, TONE, finger, 3.0))
    away = (recording.time > 1.2) & (recording.time < 2.0)
    assert not recording.target[away].any()
    assert np.isnan(recording.position[away]).all()
    assert abs(recording.drive[away]).max() < 1e-3 * abs(recording.drive).max()
    assert amplitude(recording.motion, 100.0, 0.5, recording.rate)[0] == pytest.approx(10e-3 / 0.64, rel=0.01)


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_a_skin_faster_than_the_finger_is_refused(device):
    """10.1 mm/s of skin velocity under a finger of 10 mm/s, against 10 mm/s."""
    finger = hr.Finger.sliding(speed=0.01, normal_load=0.4, mechanics="light")
    with pytest.raises(ValueError, match=r"skin velocity of 0.0101 m/s: must be <= 0.01 m/s, the median speed"):
        hr.prepare(scene_on(device, hr.Grating(velocity=1.01e-2, frequency=100.0), finger, 1.0))
    hr.prepare(scene_on(device, TONE, finger, 1.0))


SENSORLESS = {"sensor": "impedance", "level": "carrier"}
REST = 0.2  # s
REST_THEN_SLIDE = hr.Finger.sampled([0.0, 0.0, 0.1], times=[0.0, REST, REST + 0.1 / SPEED], normal_load=1.0)


def sensed(seconds=1.2, finger=REST_THEN_SLIDE, **plant):
    """Drive, flags and true attraction (N) of a run, sample by sample; the plant keeps that of the whole run."""
    session = loop.prepare(tone(100.0, finger=finger, duration=seconds, **SENSORLESS, **plant))
    screen = session.driver.plant
    drive, _, flags, _ = screen.closed_loop(session.controller(), np.zeros(session.samples))
    return drive[:, 0], flags, screen.motion[:, 1]


def test_a_swipe_shows_its_area_where_it_turns():
    """It starts in full motion, so the first stroke is open loop; then the finger rests for 8 ms below 1 mm/s."""
    finger = hr.Finger.swiping(frequency=1.0, speed=0.05, normal_load=1.0)
    _, flags, _ = sensed(seconds=1.2, finger=finger, area_scale=0.7)
    guessed = (flags & hr.Flag.OPEN_LOOP) > 0
    assert guessed[1:2500].all()  # it turns after 0.25 s
    assert not guessed[2600:7400].any()
    assert guessed[7480:7520].all()
    assert not guessed[7600:].any()


def test_the_carrier_starts_at_its_crest_and_keeps_its_phase(tmp_path):
    """Every sample is the envelope's times cos(2 pi k 5/48), over what the file's hold leaves of the carrier.

    The file's floats round to 2^-24 of full scale; a phase that slipped by a turn a million would be 6e-6 off.
    """
    full, droop = 10e-3, np.sinc(5 / 48)
    driver = WaveFileDriver(tmp_path / "a.wav", rate=192_000, drive_channels=1, full_scale=full)
    scene = tone(100.0, duration=0.5, output="carrier")
    recording = hr.render(scene, driver=driver)
    file = read_back(driver.path, full_scale=full)[:, 0]
    envelope = ElectroadhesionRenderer().read(scene, None).compensation(recording.drive[:, 0])
    wanted = np.repeat(envelope, round(driver.rate / recording.rate))
    turns = np.array([float(Fraction(5 * k % 48, 48)) for k in range(48)])
    carrier = np.cos(2 * np.pi * np.resize(turns, len(wanted)))
    np.testing.assert_allclose(file[: len(wanted)], wanted * carrier / droop, rtol=0, atol=2**-24 * full)
    assert file[0] == pytest.approx(wanted[0] / droop)
