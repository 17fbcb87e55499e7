"""Where the finger is, in closed form."""

import numpy as np
import pytest

from hapticrender.touch.motion import Nowhere, Sampled, SineMotion, Still, TriangleMotion

TIME = np.arange(0, 4, 1e-3)


def test_a_still_finger_stays_and_no_finger_is_nowhere():
    assert set(Still(0.01).position(TIME)) == {0.01}
    assert np.isnan(Nowhere().position(TIME)).all()


def test_sliding_keeps_its_speed_and_its_ends():
    motion = TriangleMotion(speed=0.08, span=0.05, centre=0.01)
    position = motion.position(TIME)
    speed = np.abs(np.diff(position)) / 1e-3
    assert position[0] == pytest.approx(0.01, abs=1e-15)
    assert position[1] > position[0]
    assert [position.min(), position.max()] == pytest.approx([-0.015, 0.035], abs=0.08 * 1e-3)
    turning = speed < 0.08 * (1 - 1e-9)
    assert turning.sum() <= 4 * 0.08 / 0.05 + 1  # one sample a reversal
    np.testing.assert_allclose(speed[~turning], 0.08, rtol=1e-9)


def test_swiping_reaches_its_peak_speed():
    motion = SineMotion(frequency=3.0, speed=0.05)
    speed = np.abs(np.diff(motion.position(TIME))) / 1e-3
    assert speed.max() == pytest.approx(0.05, rel=(np.pi * 3 * 1e-3) ** 2)
    by_stroke = SineMotion(frequency=3.0, stroke=0.05 / (np.pi * 3.0))
    np.testing.assert_allclose(by_stroke.position(TIME), motion.position(TIME), atol=1e-15)


def test_sampled_positions_are_joined_and_held():
    by_rate = Sampled(positions=np.array([0.0, 0.01, -0.01]), rate=2.0)
    by_time = Sampled(positions=[0.0, 0.01, -0.01], times=[0.0, 0.5, 1.0])
    for motion in (by_rate, by_time):
        assert motion.position(np.array([0.25, 0.5, 0.75, 3.0])) == pytest.approx([0.005, 0.01, 0.0, -0.01], abs=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TriangleMotion(speed=-0.1), r"speed = -0.1: must be .* > 0 and <= 10 m/s"),
        (lambda: SineMotion(frequency=3.0), r"speed, stroke: exactly one must be given"),
        (lambda: Sampled(positions=[0.0, np.nan], rate=1.0), r"positions\[1\] = nan: must be a finite number"),
        (lambda: Sampled(positions=[0.0, 0.1], times=[1.0, 1.0]), r"times = .*: must be 2 rising times in s"),
    ],
)
def test_wrong_motions_are_refused_with_bound_and_unit(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()
