"""What was computed before is found again by what its arguments hold, and by nothing less."""

from collections import namedtuple
from dataclasses import dataclass

import numpy as np
import pytest

from hapticrender.control import remembered as memory
from hapticrender.control.damping import choose_damping
from hapticrender.control.remembered import contents, remembered
from hapticrender.plants.vibrotactile import PlateParameters


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


@dataclass(frozen=True)
class Other:
    mass: np.ndarray
    name: str = "plate"
    inner: None = None


Pair = namedtuple("Pair", "first second")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (True, 1),
        (1, 1.0),
        (np.array([0.0]), np.array([-0.0])),
        (np.array([1.0]), np.array([1.0]).view(np.int64)),
        (Device(np.array([1.0])), Other(np.array([1.0]))),
        ((1.0, 2.0), Pair(1.0, 2.0)),
        ((1.0, 2.0), [1.0, 2.0]),
        ([1.0, [2.0]], [1.0, [3.0]]),
        (Device, Other),
    ],
)
def test_what_looks_alike_is_told_apart(one, other):
    assert contents(one) == contents(one)
    assert contents(one) != contents(other)


def test_what_cannot_be_told_is_computed_anew():
    """A set may hold anything; it is no error to be asked about one."""
    double, calls = counted()
    for _ in range(2):
        double(Device(np.array([1.0]), name={"plate"}))
    assert len(calls) == 2


def test_a_damping_is_its_owners():
    """What one does to it is not what the next one gets."""
    model = PlateParameters().band_model(5000.0, 1)
    first = choose_damping(model)
    kept = first.taps.copy()
    first.taps[:] = first.grip[:] = 0.0
    assert abs(kept).max() > 0.0
    np.testing.assert_array_equal(choose_damping(model).taps, kept)
    assert (choose_damping(model).grip > 0.0).all()


def test_not_too_much_is_kept(monkeypatch):
    monkeypatch.setattr(memory, "MOST", 3)
    double, calls = counted()
    for number in (1.0, 2.0, 3.0, 4.0, 4.0, 1.0):
        double(Device(np.array([number])))
    assert len(calls) == 5
