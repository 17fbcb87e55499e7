"""Two fingers on a plate: told from one at a stated rate of false alarms, flagged, held stable, refused in a scene."""

import numpy as np
import pytest
from other_plate import REACH, OtherPlate
from strangers_plate import WRONG, StrangersPlate
from waves import white

import hapticrender as hr
from benchmarks.panels import PANELS
from hapticrender.analysis.two_touches import (
    CORRELATION,
    SPACING,
    TouchMonitor,
    bound_of,
    measures_moment,
    windows_under_touch,
)
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.touch_panel import PanelReader

LIGHT, HEAVY = (0.2e-3, 1.5, 1e3, 4e-3, 1.0, 200.0), (0.2e-3, 8.0, 8e3, 4e-3, 1.5, 300.0)  # Table 1 of the paper
RATE, PAIR = 5000.0, ((HEAVY, -20e-3, 0.8, 0.6, 1.9), (HEAVY, 20e-3, 0.8, 1.0, 1.9))


class TwoFingers(OtherPlate):
    """Fingers are (mechanics, position m, load N, on s, off s); the position of the first one is reported, or `place`.

    `senses` False leaves the controller without sensors.
    """

    probe, touching = False, None

    def __init__(self, *fingers, place=None, senses=True):
        super().__init__()
        self.fingers, self.times = [each[:3] for each in fingers], [each[3:] for each in fingers]
        self.place, self.sensed_channels, self.motion = place, 2 * senses, []
        self._state = np.zeros(4 + 2 * len(fingers))

    def play(self, drive):
        touching = [on <= len(self.played) / RATE < off for on, off in self.times]
        if touching != self.touching:
            self.touching = touching
            self._design(touching)
        self.motion.append(self._state[0] + np.array([0.0, -REACH, REACH]) * self._state[1])
        sensed, (_, place, load) = super().play(drive).sensed[:, : self.sensed_channels], self.fingers[0]
        place = np.nan if not touching[0] else place if self.place is None else self.place
        return hr.Sensed(sensed, np.array([place]), normal_load=np.array([touching[0] * load]))

    def error(self, reference, start, stop):
        """Deviation of the motion from the reference in the middle and at both ends, of the reference, rms."""
        rows = slice(round(start * RATE), round(stop * RATE))
        motion, wanted = np.array(self.motion)[rows], reference[rows]
        return ((motion - motion.mean(axis=0)) - wanted[:, None]).std(axis=0) / wanted.std()


@pytest.fixture
def noise():
    """White noise of 20-400 Hz, 5 um rms."""
    return hr.Recorded(samples=white(29_599, 5e-6), rate=RATE, gain=1.0)


def wrong(position, late, kind=StrangersPlate):
    """A plate that is wrong in everything, with a heavy finger from 1 s on, reported 5 ms late.

    In blocks of 5; it is a sample later than they take, of which `late` is told.
    """
    touch = {"finger": HEAVY, "load": 0.8, "contact": lambda time: 1.0 * (time > 1.0), "report_lag": 5e-3}
    return kind(position=position, block=5, told=5 + late, **touch, **WRONG)


def test_false_alarms_are_as_stated(rng):
    """Windows of noise: the share beyond the bound is the stated one, to 5 sigma of its count."""
    length, rate, count = 500, 0.01, 4000
    bins = np.arange(5, 101, SPACING)
    window = np.hanning(length + 1)[:-1]
    spectra = np.fft.rfft(rng.standard_normal((count, length)) * window)[:, bins] / np.sqrt(0.5 * np.sum(window**2))
    beyond = np.mean(np.sum(abs(spectra) ** 2, axis=1) > bound_of(2.0 * len(bins), rate))
    assert beyond == pytest.approx(rate, abs=5 * np.sqrt(rate * (1 - rate) / count))


def test_one_sliding_finger_on_a_wrong_plate_is_one(noise):
    """The statistic is that of noise: with up to 11 degrees of freedom less, for the errors that were in fact none."""
    plate, finger = wrong(lambda time: 0.02 * np.sin(4.0 * time), 1), hr.Finger.sliding(0.08, 0.8)
    rendering = hr.prepare(hr.Scene(texture=noise, finger=finger, duration=3.0), driver=plate)
    recording = hr.run(rendering)
    assert not (recording.flags & hr.Flag.TWO_TOUCHES).any()
    found = [each for _, each in windows_under_touch(recording, rendering.model)]
    assert len(found) >= 6
    mean, freedom = np.mean([each.statistic for each in found]), found[0].freedom
    spread = 5 * np.sqrt(2 * CORRELATION * freedom / len(found))
    assert freedom - 11 - spread < mean < freedom + spread
    assert max(abs(each.offset) for each in found) < 5 * 2e-3


def test_a_delay_that_is_a_sample_longer_than_stated_is_no_second_finger():
    """Half a radian of the drive's force at 400 Hz, which nothing but the law's own drive has excited in rocking."""
    scene = hr.Scene(texture=hr.Grating(frequency=400.0, amplitude=50e-6), finger=hr.Finger.absent(), duration=2.0)
    rendering = hr.prepare(scene, driver=wrong(27.5e-3, 0))
    recording = hr.run(rendering)
    assert not (recording.flags & hr.Flag.TWO_TOUCHES).any()
    for _, each in windows_under_touch(recording, rendering.model):
        assert each.statistic < each.freedom + 5 * np.sqrt(2 * CORRELATION * each.freedom)


def test_a_finger_behind_a_slow_touch_panel_is_one():
    """60 Hz, 25 ms late, predicted: swipes at 3 Hz and 100 mm/s; its error is along velocity and acceleration."""

    class Located(StrangersPlate):
        def play(self, drive):
            sensed = super().play(drive)
            return sensed._replace(position=self.reader(sensed.position))

    plate = wrong(lambda time: 0.1 / (6 * np.pi) * np.sin(6 * np.pi * time), 1, Located)
    plate.reader = PanelReader(PANELS["panel, 60 Hz, 25 ms"], RATE, 1)
    texture, finger = hr.Grating(frequency=120.0, amplitude=5e-6), hr.Finger.sliding(0.08, 0.8)
    recording = hr.render(hr.Scene(texture=texture, finger=finger, duration=3.0), driver=plate)
    assert np.isfinite(recording.position).sum() > 7 * 0.25 * RATE
    assert not (recording.flags & hr.Flag.TWO_TOUCHES).any()


def rendered(texture, fingers, duration=2.4, **plate):
    """Recording, and the plate."""
    device = TwoFingers(*fingers, **plate)
    finger = hr.Finger.still(fingers[0][1], fingers[0][2], mechanics="light")
    return hr.render(hr.Scene(texture=texture, finger=finger, duration=duration), driver=device), device


def test_a_second_finger_is_flagged_and_the_plate_plays_as_well_as_without_feedback(noise):
    """Flagged from the second whole window after it came until the lift; then the law is as good as before."""
    second = LIGHT, 40e-3, 0.3, 1.0, 1.9
    recording, plate = rendered(noise, (PAIR[0], second))
    flagged = np.flatnonzero(recording.flags & hr.Flag.TWO_TOUCHES) / RATE
    assert 1.0 < flagged[0] < 1.0 + 2 * 0.25 + 0.06
    assert 1.9 < flagged[-1] < 1.9 + 2 * 0.25 + 0.06
    assert len(flagged) == round((flagged[-1] - flagged[0]) * RATE) + 1
    assert not recording.flags[recording.flags != int(hr.Flag.TWO_TOUCHES)].any()
    _, blind = rendered(noise, (PAIR[0], second), senses=False)
    reference = noise.waveform(np.arange(len(recording)) / RATE, np.zeros(len(recording)))
    slowed, open_loop = (np.linalg.norm(each.error(reference, 1.6, 1.9)) for each in (plate, blind))
    # each is the rms of 0.3 s of 380 Hz: 2 B T = 228 numbers, to 3 sigma of the ratio
    assert slowed < open_loop * (1 + 3 / np.sqrt(228))
    assert plate.error(reference, 2.2, 2.4).max() < 0.1  # on the free plate, 0.3 s after the lift


def test_what_one_finger_explains_is_not_flagged(noise):
    """Two alike at the same distance from the place that is reported load the plate as one between them would."""
    first = (HEAVY, -20e-3, 0.8, 0.6, 9.0)
    recording, _ = rendered(noise, (first, (HEAVY, 20e-3, 0.8, 0.6, 9.0)), 1.6, place=0.0)
    assert not (recording.flags & hr.Flag.TWO_TOUCHES).any()


@pytest.mark.parametrize("fingers", [1, 2])
def test_live_play_flags_two_touches_and_no_single_one(fingers, tmp_path):
    device = TwoFingers(*((*each[:3], 0.6, 9.0) for each in PAIR[:fingers]))
    with hr.Player("vt-plate", device, paced=False) as player:
        player.play(hr.Grating(frequency=120.0, amplitude=5e-6))
        player.sleep(0.6)
        player.record(tmp_path / "two.au")
        for _ in range(40):
            player.finger(-20e-3, 0.0, 0.8)
            player.sleep(0.02)
        expected = fingers == 2
        assert bool(player.state().flags & hr.Flag.TWO_TOUCHES) == expected
        assert bool((player.end_recording().flags & hr.Flag.TWO_TOUCHES).any()) == expected


def test_devices_without_force_and_moment_are_not_watched():
    model = hr.prepare(hr.Scene(texture=hr.Grating(frequency=50.0, amplitude=1e-6), duration=1.0, profile={"coils": 1}))
    assert not measures_moment(model.model)
    with pytest.raises(ValueError, match="1 coordinates: must be a plate with 2"):
        TouchMonitor(model.model)


def test_the_length_of_the_pieces_changes_nothing(rng):
    """A touch near a window's end: the margin after it, of 60 ms, reaches beyond what has come by then."""
    model, count = PlateParameters().device_model(RATE, 1), 2 * round(RATE)
    drive, sensed = rng.standard_normal((count, 2)), 1e-6 * rng.standard_normal((count, 2))
    position, flags, found = np.where(np.arange(count) < 0.24 * RATE, np.nan, 0.01), np.zeros(count, int), []
    for piece in (1, 100, count):
        monitor, rows = TouchMonitor(model), [slice(start, start + piece) for start in range(0, count, piece)]
        found.append(np.concatenate([monitor.update(drive[r], sensed[r], position[r], flags[r]) for r in rows]))
    assert found[0].any()
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
