"""Motion estimators against what they predict of themselves, on simulated fingers and sensors and a recorded one."""

from dataclasses import replace

import numpy as np
import pytest
from live_devices import Blind
from plate_swipes import followed_on_a_plate

import hapticrender as hr
from benchmarks.panels import PANELS
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch import latency_budget as budget
from hapticrender.touch.motion import SineMotion, TriangleMotion
from hapticrender.touch.motion_estimator import ANYWHERE, MotionEstimator, jerk_covariance, transition
from hapticrender.touch.touch_panel import PanelReader, TouchPanel

PLAIN = {"jitter": 0.0, "dropouts": 0.0}
OMEGA = 2 * np.pi * 3.0


def frequency_response(estimator, rate, frequency, ahead=0.0, order=0):
    """Estimate over position at `frequency` (Hz, below rate/2), complex, of samples at `rate` (Hz).

    `order` 0 is the position `ahead` (s) of the last sample, which without error is ``exp(j w ahead)``; 1 the velocity
    there, per position, which is ``j w exp(j w ahead)``.
    """
    a, b = budget._system(budget.settled_gain(estimator, rate), 1.0 / rate)
    z = np.exp(2j * np.pi * np.atleast_1d(np.asarray(frequency, float)) / rate)
    states = np.linalg.solve(z[:, None, None] * np.eye(3) - a[:3, :3], z[:, None, None] * b[:3, None])
    return np.asarray(transition(ahead)[order] @ states[..., 0].T)


def bandwidth(estimator, rate):
    """Frequency (Hz) at which the position's power is down to half; rate/2 where it never is."""
    grid = np.linspace(0.0, 0.5 * rate, 4001)[1:]
    below = np.flatnonzero(abs(frequency_response(estimator, rate, grid)) ** 2 < 0.5)
    return float(grid[below[0]]) if below.size else 0.5 * rate


def followed(estimator, rate, positions, ahead=0.0, gated=False):
    """Estimates `ahead` of every sample; where they are `gated`, the estimator may ignore one."""
    found = []
    for n, position in enumerate(positions):
        assert estimator.update(n / rate, position) or gated
        found.append(estimator.at(n / rate + ahead)[:2])
    return np.array(found)


@pytest.mark.parametrize(("rate", "noise", "ahead"), [(60.0, 1e-4, 0.02), (120.0, 5e-5, 0.0), (1000.0, 1e-6, 0.02)])
def test_the_filter_passes_what_it_predicts(rate, noise, ahead):
    """Complex response of position and velocity at three frequencies, the half-power one among them."""
    estimator = MotionEstimator(noise)
    half = bandwidth(estimator, rate)
    frequencies = np.array([3.0, half, 0.4 * rate])
    predicted = [frequency_response(estimator, rate, frequencies, ahead, order) for order in (0, 1)]
    for i, frequency in enumerate(frequencies):
        wave = noise * np.exp(2j * np.pi * frequency * np.arange(600) / rate)  # small: inside the gate, so linear
        seen = [followed(MotionEstimator(noise), rate, part, ahead) for part in (wave.real, wave.imag)]
        found = (seen[0] + 1j * seen[1])[-100:] / wave[-100:, None]
        for order in (0, 1):
            np.testing.assert_allclose(found[:, order], predicted[order][i], rtol=1e-6)
    if half < 0.5 * rate:  # to the steps of the grid on which it is looked for
        assert abs(frequency_response(estimator, rate, half)[0]) ** 2 == pytest.approx(0.5, abs=2e-3)
    slow = frequency_response(estimator, rate, np.array([0.1]), ahead)[0]
    assert slow == pytest.approx(np.exp(0.2j * np.pi * ahead), abs=1e-4)  # no lag at low frequencies


def test_standard_errors_are_right_under_irregular_times(rng):
    """On fingers of white jerk: 68.3 % of the errors within one, of 600 independent ones, 5 sigma allowed."""
    noise, latency, inside, scale = 50e-6, 15e-3, [], []
    for _ in range(150):
        estimator = MotionEstimator(noise, latency=latency)
        root = np.linalg.cholesky(np.diag([1e-12, *estimator._prior[1:]]))
        state, time = root @ rng.standard_normal(3), 0.0
        for n in range(40):
            step = rng.uniform(2e-3, 14e-3) + (40e-3 if rng.random() < 0.05 else 0.0)
            shape = np.linalg.cholesky(jerk_covariance(step, estimator.density))
            state, time = transition(step) @ state + shape @ rng.standard_normal(3), time + step
            estimator.update(time + latency, state[0] + noise * rng.standard_normal())
            if n % 10 == 9:
                shape = np.linalg.cholesky(jerk_covariance(latency, estimator.density))
                now = transition(latency) @ state + shape @ rng.standard_normal(3)
                found = estimator.at(time + latency)
                inside.append(np.abs(now[:2] - found[:2]) < found[2:])
                scale.append((now[:2] - found[:2]) / found[2:])
    assert np.mean(inside, axis=0) == pytest.approx(0.683, abs=5 * np.sqrt(0.683 * 0.317 / len(inside)))
    assert np.std(scale, axis=0) == pytest.approx(1.0, abs=5 / np.sqrt(2 * len(scale)))


@pytest.mark.parametrize(("name", "speed"), list(zip(list(PANELS)[1:], (0.01, 0.05, 0.05), strict=True)))
def test_the_latency_budget_is_what_a_panel_does(name, speed):
    """Error of the played position on 3 Hz swipes; the budget is exact but for the gate."""
    panel, rate, seconds = replace(PANELS[name], **PLAIN), 1000.0, 16.0
    truth = SineMotion(frequency=3.0, speed=speed).position(np.arange(round(seconds * rate)) / rate)
    found = np.concatenate([PanelReader(panel, rate, seed=1)(truth)])
    seen = np.sqrt(np.mean((found - truth)[1000:] ** 2))
    predicted = budget.position_error(panel, speed)
    independent = (seconds - 1.0) * bandwidth(panel.estimator(), panel.rate)
    assert seen == pytest.approx(predicted, rel=5 / np.sqrt(2 * independent))
    assert budget.position_error(panel, speed, predicted=False) == pytest.approx(
        np.sqrt(panel.noise**2 + panel.resolution**2 / 12 + np.mean(held(panel, speed) ** 2)), rel=0.01
    )


def held(panel, speed):
    """Error of a position that is held from a sample on, over a swipe and over ages."""
    time, age = np.meshgrid(np.linspace(0, 1, 500, endpoint=False), (np.arange(40) + 0.5) / 40 / panel.rate)
    motion = SineMotion(frequency=3.0, speed=speed)
    return motion.position((time - panel.latency - age).ravel() + 10.0) - motion.position(time.ravel() + 10.0)


def test_dropouts_outliers_and_jitter_cost_no_more_than_the_budget_says(rng):
    panel, rate = TouchPanel(dropouts=0.05, jitter=1e-3), 1000.0
    truth = SineMotion(frequency=3.0, speed=0.05).position(np.arange(20_000) / rate)
    found = PanelReader(panel, rate, seed=2)(truth)
    predicted = budget.position_error(panel, 0.05)
    assert np.sqrt(np.mean((found - truth)[1000:] ** 2)) == pytest.approx(predicted, rel=0.2)  # irregular: not exact
    estimator, errors = panel.estimator(), []
    for n in range(1200):
        sample = truth[n * 8] + panel.noise * rng.standard_normal() + (0.02 if n % 20 == 19 else 0.0)
        assert estimator.update(n * 8e-3 + panel.latency, sample) == (n % 20 != 19)
        errors.append(estimator.at(n * 8e-3).position - truth[n * 8])
    assert np.std(errors[100:]) < 2 * panel.noise  # an outlier of 20 mm leaves nothing


def test_reversals_and_stops_are_caught_up_with():
    """Instant reversals at 100 mm/s: within 6 samples (two poles of the filter each) the error is below 1 mm/20."""
    motion, rate = TriangleMotion(speed=0.1, span=0.04), 240.0
    time = np.arange(480) / rate
    found = followed(MotionEstimator(20e-6), rate, motion.position(time), gated=True)
    since = np.mod(time - 0.2, 0.4) * rate  # samples since the last reversal, at 0.2, 0.6 ... s
    settled = (since > 12) & (time > 0.1)
    assert abs(found[settled, 0] - motion.position(time)[settled]).max() < 0.1e-3
    stop = np.minimum(0.04 * time, 0.02)
    found = followed(MotionEstimator(20e-6), rate, stop, gated=True)
    assert abs(found[-50:, 1]).max() < 1e-3


@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0])
def test_a_flick_is_followed_though_no_swipe_is_so_fast(speed):
    """Two samples beyond the gate make a new start, with the velocity between them; it is right from then on."""
    rate = 120.0
    time = np.arange(60) / rate
    truth = speed * np.maximum(time - 0.25, 0.0)
    found = followed(MotionEstimator(50e-6), rate, truth, gated=True)
    assert abs(found[-20:, 0] - truth[-20:]).max() < 5 * 50e-6
    assert found[-20:, 1] == pytest.approx(speed, rel=0.05)


def test_the_plate_alone_says_where_a_finger_of_400_mN_is_now(rng):
    """Errors of position and velocity are what is stated, to 3 sigma of the share of some 270 independent ones."""
    errors, stated = followed_on_a_plate(0.4, 10.0, rng)
    one, two = ((np.abs(errors) < times * stated).mean(axis=0) for times in (1, 2))
    assert ((one > 0.60) & (one < 0.76)).all(), one
    assert ((two > 0.90) & (two < 0.98)).all(), two
    assert np.sqrt(np.mean(errors[:, 0] ** 2)) < 0.5e-3  # of 1.9 mm rms of the swipes


def test_lift_return_and_patience():
    estimator = MotionEstimator(50e-6, latency=5e-3)
    assert np.isnan(estimator.at(0.0).position)
    for n in range(30):
        estimator.update(n / 120 + 5e-3, 0.05 * n / 120)
    last = 29 / 120
    assert estimator.at(last).velocity == pytest.approx(0.05, rel=0.02)
    patience = ANYWHERE / OMEGA
    assert np.isfinite(estimator.at(last + 0.99 * patience).position)
    gone = estimator.at(last + 1.01 * patience)
    assert np.isnan(gone.position)
    assert gone.velocity == 0.0
    assert estimator.update(0.3, np.nan)  # lifted
    assert np.isnan(estimator.at(0.3).position)
    assert estimator.update(0.31, -0.01)
    back = estimator.at(0.305)
    assert back.position == -0.01
    assert back.velocity_error == pytest.approx(0.05)  # nothing is known of it but how fingers move
    assert not estimator.update(0.31, -0.01)  # not later than the last one


@pytest.mark.parametrize(("bits", "first"), [(32, 2**32 - 500), (16, 2**16 - 500), (16, 300)])
def test_counts_wrap_both_ways(bits, first):
    encoder = hr.Encoder(resolution=0.5e-6, bits=bits, origin=0.01)
    motion = SineMotion(frequency=3.0, speed=0.16)
    for n in range(500):
        encoder.update(n * 1e-3, (first + round(motion.position(n * 1e-3) / 0.5e-6)) % 2**bits)
    found = encoder.at(0.499)
    assert found.position - 0.01 == pytest.approx(motion.position(0.499), abs=5 * found.position_error)
    assert found.velocity == pytest.approx(0.16 * np.cos(OMEGA * 0.499), abs=5 * found.velocity_error)


def test_the_recorded_swipe_slides_at_40_mm_s(shared_data):
    with np.load(shared_data / "swipe_40mm_s.npz") as data:
        counts, rate, step = data["encoder"], float(data["rate"]), float(data["metre_per_count"])
    assert (np.diff(counts.astype(float)) > 2**31).any()  # it wraps
    encoder, pick = hr.Encoder(resolution=step), 10  # 1 kHz
    times, found = np.arange(0, len(counts), pick) / rate, []
    for time, count in zip(times, counts[::pick], strict=True):
        encoder.update(time, int(count))
        found.append(encoder.at(time))
    position, velocity, position_error, velocity_error = np.array(found).T
    travelled = np.concatenate([[0], np.cumsum(np.diff(counts).view(np.int32).astype(int))])[::pick] * step
    assert abs(position - travelled).max() < step + 5 * position_error.max()
    slide = (times > 4.7) & (times < 6.8)
    mean = (travelled[slide][-1] - travelled[slide][0]) / (times[slide][-1] - times[slide][0])
    assert velocity[slide].mean() == pytest.approx(mean, abs=5 * velocity_error.max() / np.sqrt(slide.sum()))
    assert mean == pytest.approx(0.04, rel=0.005)
    moving = times[(velocity > 0.02) & (times > 4.0)]
    raw = times[1:][(np.diff(travelled) > 0.5 * 0.04e-3) & (times[1:] > 4.0)]  # more than half the steps of the slide
    assert [moving[0], moving[-1]] == pytest.approx([raw[0], raw[-1]], abs=5e-3)
    rest = (times > 3.2) & (times < 4.2)
    assert abs(velocity[rest]).max() < 1e-3


def test_a_scene_with_a_touch_panel_is_played_at_the_estimated_position():
    scene = hr.Scene(
        texture=hr.Grating(wavelength=2e-3, amplitude=5e-6),
        finger=hr.Finger.swiping(3.0, 0.05, touches=[(0.1, 1.4)]),
        duration=1.6,
        profile={"rate": 2500.0},
        touch_panel={"rate": 240.0, "latency": 8e-3},
    )
    assert hr.Scene.from_toml_text(scene.to_toml()) == scene
    recording = hr.render(scene)
    assert any(
        "texture at the recorded position, which the touch panel" in each for each in recording.summary()["notes"]
    )
    truth = scene.finger.position(np.arange(len(recording)) / recording.rate)
    late = np.flatnonzero(np.isfinite(recording.position))[[0, -1]] / recording.rate
    assert late == pytest.approx([0.1, 1.4], abs=0.008 + 1 / 240 + 0.002)
    error = (recording.position - truth)[round(0.4 * recording.rate) : round(1.39 * recording.rate)]
    predicted = budget.position_error(scene.panel, 0.05)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(predicted, rel=5 / np.sqrt(2 * 40))  # 1 s of 40 Hz


def test_an_application_behind_a_panel_is_within_the_budget(tmp_path, rng):
    """Panel of 120 Hz, estimator, `Player.finger` 240 times a second: the error of the position that is played."""
    panel, motion, done = replace(TouchPanel(), **PLAIN), SineMotion(frequency=3.0, speed=0.05), 0
    estimator = panel.estimator()
    device = Blind(Plate(PlateParameters(delay=5), hr.Finger.absent(), block=5))
    with hr.Player("vt-plate", device, paced=False) as player:
        player.play(hr.Grating(wavelength=2e-3, amplitude=5e-6))
        player.record(tmp_path / "panel.au")
        start = player.time
        while (now := player.time) < start + 2.5:
            while done / panel.rate + panel.latency <= now:
                sample = motion.position(done / panel.rate) + panel.noise * rng.standard_normal()
                estimator.update(done / panel.rate + panel.latency, sample)
                done += 1
            player.finger(*estimator.at(now)[:2])
            player.sleep(1 / 240)
        played = player.end_recording().position
    error = (played - motion.position(start + np.arange(len(played)) / device.rate))[round(0.5 * device.rate) :]
    independent = 2.0 * bandwidth(panel.estimator(), panel.rate)
    expected = budget.position_error(panel, 0.05)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(expected, rel=5 / np.sqrt(2 * independent))


@pytest.mark.parametrize("panel", PANELS.values(), ids=PANELS)
def test_the_finest_wavelength_has_the_phase_error_that_it_is_for(panel):
    """Without a warning of numbers that cannot be told apart, either, which an encoder's would be in SI units."""
    finest = hr.finest_wavelength(panel, 0.1)
    assert hr.phase_error(panel, 0.1, finest) == pytest.approx(30.0, rel=1e-3)
