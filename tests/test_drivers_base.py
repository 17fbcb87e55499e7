"""The duties every driver shares: order, checks, and rest whatever happens."""

from contextlib import nullcontext

import numpy as np
import pytest

from hapticrender.driver_checks import check_sensed
from hapticrender.drivers.base import BaseDriver, check_driver, checked_drive
from hapticrender.errors import DeviceLost, DriverError, ProtocolError
from hapticrender.protocols import Sensed


class Diary(BaseDriver):
    """Writes down all that it is asked to do; fails at what it is told to fail at."""

    def __init__(self, fails_at=(), **numbers):
        super().__init__(**{"rate": 5000.0, "drive_channels": 2, "sensed_channels": 1, "block": 4} | numbers)
        self.fails_at = fails_at
        self.entries = []

    def _note(self, entry):
        self.entries.append(entry)
        if entry in self.fails_at:
            raise DeviceLost(f"{self}: {entry}: gone")

    def _open(self):
        self._note("open")

    def _play(self, drive):
        self._note("play" if drive.any() else "rest")
        return Sensed(np.full((len(drive), 1), drive.sum()))

    def _close(self):
        self._note("close")


ONES = np.ones((4, 2))


@pytest.mark.parametrize("nested", [False, True])
def test_with_opens_plays_rests_and_closes_in_this_order_and_once(nested):
    with Diary() as driver, driver if nested else nullcontext():
        assert driver.play(ONES).sensed.tolist() == [[8.0]] * 4
    assert driver.entries == ["open", "play", "rest", "close"]


def test_an_error_in_the_body_still_brings_the_device_to_rest():
    driver = Diary()
    with pytest.raises(ZeroDivisionError), driver:
        raise ZeroDivisionError
    assert driver.entries == ["open", "rest", "close"]


def test_close_carries_on_past_a_failure_and_raises_the_first():
    driver = Diary(fails_at=("rest", "close")).open()
    with pytest.raises(DeviceLost, match="Diary: rest: gone") as caught:
        driver.close()
    assert driver.entries == ["open", "rest", "close"]
    assert caught.value.__notes__ == ["and then: Diary: close: gone"]


def test_close_releases_the_device_after_a_signal_in_its_zeros():
    """Of a driver that nothing guards against signals."""

    class Interrupted(Diary):
        def _play(self, drive):
            self._note("rest")
            raise KeyboardInterrupt

    driver = Interrupted().open()
    with pytest.raises(KeyboardInterrupt):
        driver.close()
    assert driver.entries == ["open", "rest", "close"]


def test_a_failure_to_close_does_not_hide_the_error_of_the_body():
    with pytest.raises(ZeroDivisionError) as caught, Diary(fails_at=("rest",)):
        raise ZeroDivisionError
    assert caught.value.__notes__ == ["and while closing: Diary: rest: gone"]


def test_a_driver_that_failed_to_open_can_be_tried_again_and_is_not_played():
    driver = Diary(fails_at=("open",))
    with pytest.raises(DeviceLost, match="open: gone"):
        driver.open()
    driver.close()
    assert driver.entries == ["open"]


@pytest.mark.parametrize(("steps", "state"), [([], "new"), (["open", "close"], "closed")])
def test_playing_needs_an_open_driver(steps, state):
    driver = Diary()
    for step in steps:
        getattr(driver, step)()
    with pytest.raises(DriverError, match=f"Diary: play: it is {state}"):
        driver.play(ONES)


@pytest.mark.parametrize("shape", [(3, 2), (4, 1), (8,)])
def test_a_block_of_another_shape_is_refused_unplayed(shape):
    with Diary() as driver:
        with pytest.raises(ValueError, match=r"must be \(4, 2\)"):
            driver.play(np.ones(shape))
        assert driver.entries == ["open"]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_drive_that_is_not_finite_is_refused_and_pointed_at(value):
    drive = np.zeros((4, 2))
    drive[2, 1] = value
    with pytest.raises(ValueError, match=rf"drive\[2, 1\]={value} must be finite"):
        checked_drive(drive, 4, 2)


def test_an_object_that_is_no_driver_hears_what_it_lacks():
    class Half:
        rate, drive_channels, sensed_channels, block = 5000.0, 2, 2, 1

    with pytest.raises(TypeError, match="Half is no driver: it lacks delay, play, __enter__, __exit__"):
        check_driver(Half())


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"flags": np.full(4, 1.5)}, "Diary: play: flags is no array of whole numbers: it has fractions, NaN or inf"),
        ({"flags": np.full(4, np.nan)}, "flags is no array of whole numbers"),
        (
            {"flags": np.array([0, 256, 8, 2**40])},
            f"flags has bits {2**40 + 256}, must be of hapticrender.Flag, 0 to 255",
        ),
        ({"flags": np.full(4, -1)}, "flags has bits -256, must be of hapticrender.Flag"),
        ({"sensed": np.ones((1, 4))}, r"sensed has shape \(1, 4\), must be \(4, 1\)"),
        ({"sensed": np.ones((4, 1)) + 0j}, "sensed is no array of numbers: it is complex"),
        ({"position": np.array([0.0, np.nan, np.inf, 0.0])}, "position is inf m: must be within 2 m of the middle"),
        ({"position": np.array([0.0, np.nan, 0.0, -20.0])}, "position is -20 m: must be within 2 m .* in m and not mm"),
        (
            {"normal_load": np.array([0.0, np.nan, 0.4, -5.0])},
            "normal_load is -5 N: must be from -1 to 100 N, NaN where",
        ),
        ({"normal_load": np.array([0.0, 400.0, 0.4, 1.0])}, "normal_load is 400 N: must be from -1 to 100 N"),
        ({"normal_load": np.array([0.0, np.inf, 0.4, 1.0])}, "normal_load is inf N"),
    ],
)
def test_a_column_that_would_lose_something_is_refused(columns, message):
    assert check_sensed(Diary(), Sensed(np.ones((4, 1)), flags=np.full(4, 8.0)), 0).flags.dtype == np.int64
    with pytest.raises(ProtocolError, match=message):
        check_sensed(Diary(), Sensed(**{"sensed": np.ones((4, 1))} | columns), 0)


def test_a_load_may_have_an_offset_or_be_unknown():
    load = np.array([-1.0, 0.0, np.nan, 100.0])
    np.testing.assert_array_equal(check_sensed(Diary(), Sensed(np.ones((4, 1)), normal_load=load), 0).normal_load, load)


@pytest.mark.parametrize("found", [np.ones((4, 1)), (np.ones((4, 1)),), None])
def test_what_is_no_sensed_block_is_named_by_its_kind(found):
    kind = type(found).__name__
    with pytest.raises(ProtocolError, match=f"^Diary: play returned {kind}: must return a hapticrender.Sensed$"):
        check_sensed(Diary(), found, 0)
