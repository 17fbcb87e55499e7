"""The lag of a contact behind what is inferred, against its closed form."""

import numpy as np
import pytest

from hapticrender.inferred import ContactLag

LENGTH, SPEED, RATE = 12e-6, 0.05, 12e3


@pytest.mark.parametrize("sizes", [[1] * 600, [25] * 24, [600]])
def test_a_ramp_is_followed_late_by_the_length_over_the_speed(sizes):
    """u = t gives y = t - tau + tau exp(-t/tau), tau = length/speed, however it is split."""
    time, lag, parts = np.arange(600) / RATE, ContactLag(LENGTH), []
    for part in np.split(time, np.cumsum(sizes)[:-1]):
        parts.append(lag.run(part[:, None], SPEED * part))
    tau = LENGTH / SPEED
    np.testing.assert_allclose(np.concatenate(parts)[:, 0], time - tau * -np.expm1(-time / tau), rtol=1e-9, atol=1e-15)


def test_a_lifted_finger_leaves_nothing_and_a_resting_one_changes_nothing():
    position = np.r_[0.0, np.nan, 0.01, np.full(3, 0.01)]
    values = np.array([1.0, 0.0, 5.0, 7.0, 9.0, 9.0])[:, None]
    np.testing.assert_allclose(ContactLag(LENGTH).run(values, position)[:, 0], [1.0, 0.0, 5.0, 5.0, 5.0, 5.0])
    np.testing.assert_array_equal(ContactLag(0.0).run(values, position), values)
