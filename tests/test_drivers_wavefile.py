"""The file driver: what is played is what the file holds, whatever interrupts it."""

import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from waves import read_back

from hapticrender.drivers.wavefile import FORMATS, WaveFileDriver
from hapticrender.errors import DriverError
from hapticrender.protocols import Driver

FULL_SCALE = 2.5  # A


def played(driver, blocks):
    """Play all `blocks`, close, and return what the file holds without the closing block of zeros."""
    with driver:
        for block in blocks:
            driver.play(block)
    held = read_back(driver.path, full_scale=driver.full_scale)
    assert not held[len(held) - driver.block :].any()
    return held[: len(held) - driver.block]


@pytest.mark.parametrize("ending", FORMATS)
def test_a_file_holds_the_drive_within_half_a_step(tmp_path, rng, ending):
    """Half a step of float32 between half and full scale; what is beyond is held alike."""
    channels = 3
    blocks = rng.uniform(-FULL_SCALE, FULL_SCALE * (1 - 2.0**-15), (3, 16, channels))
    blocks[0, 0, 0] = 4 * FULL_SCALE
    driver = WaveFileDriver(tmp_path / f"drive{ending}", full_scale=FULL_SCALE, drive_channels=channels, block=16)
    assert isinstance(driver, Driver)
    assert (driver.sensed_channels, driver.delay) == (0, 16)
    error = np.abs(played(driver, blocks) - blocks.reshape(-1, channels))
    rounding = 4 * np.finfo(float).eps * FULL_SCALE  # of scaling there and back
    half = 0.5 * FULL_SCALE * 2.0**-24
    assert error[1:].max() <= half + rounding
    assert error[1:].max() > 0.5 * half  # float32, not a finer form
    assert error[0, 0] <= 8 * half + rounding


def test_a_file_that_cannot_be_opened_says_why(tmp_path):
    (folder := tmp_path / "a.wav").mkdir()
    with pytest.raises(DriverError, match="a.wav: open: .*Is a directory"), WaveFileDriver(folder):
        pass


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
@pytest.mark.parametrize("ending", FORMATS)
def test_a_killed_process_leaves_what_it_played(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    script = f"""
        import os, signal
        import numpy as np
        from hapticrender.drivers.wavefile import WaveFileDriver
        with WaveFileDriver({str(path)!r}, full_scale=1.0, block=1000) as driver:
            for number in range(100):
                driver.play(np.full((1000, 2), number / 128))
            os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], timeout=120)
    assert done.returncode == -signal.SIGKILL
    played = np.repeat(np.arange(100) / 128, 1000)[:, None] * np.ones(2)
    np.testing.assert_array_equal(read_back(path, full_scale=1.0), played)
