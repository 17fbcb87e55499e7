"""What was computed before is found again by what its arguments hold, and by nothing less."""

from dataclasses import dataclass

import numpy as np
import pytest

from hapticrender.control import remembered as memory
from hapticrender.control.remembered import contents, remembered


@dataclass(frozen=True)
class Device:
    mass: np.ndarray
    name: str = "plate"
    inner: "Device | None" = None


def counted():
    calls = []

    @remembered
    def double(device, *, times=2):
        """Say how much."""
        calls.append(device)
        return times * device.mass

    return double, calls


def test_equal_contents_are_computed_once():
    double, calls = counted()
    first = double(Device(np.array([1.0, 2.0])))
    assert double(Device(np.array([1.0, 2.0]))) is first
    assert double(Device(np.array([1.0, 2.0])), times=3) is not first
    assert len(calls) == 2
    assert double.__doc__ == "Say how much."


@pytest.mark.parametrize(
    "other",
    [
        Device(np.array([1.0, 2.5])),
        Device(np.array([[1.0, 2.0]])),
        Device(np.array([1, 2])),
        Device(np.array([1.0, 2.0]), "screen"),
        Device(np.array([1.0, 2.0]), inner=Device(np.array([1.0]))),
    ],
    ids=["number", "shape", "type", "text", "inner"],
)
def test_whatever_differs_is_told(other):
    double, calls = counted()
    double(Device(np.array([1.0, 2.0])))
    double(other)
    assert len(calls) == 2


def test_a_truth_is_no_number_and_minus_zero_no_zero():
    """What a design makes of them may differ."""
    assert contents((True, 1)) != contents((1, 1))
    assert contents(np.array([0.0])) != contents(np.array([-0.0]))


def test_not_too_much_is_kept(monkeypatch):
    monkeypatch.setattr(memory, "MOST", 3)
    double, calls = counted()
    for number in (1.0, 2.0, 3.0, 4.0, 4.0, 1.0):
        double(Device(np.array([number])))
    assert len(calls) == 5
