"""The file driver: what is played is what the file holds, whatever interrupts it."""

import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import soundfile
from waves import read_back

from hapticrender.drivers.wavefile import FORMATS, SUBTYPES, WaveFileDriver
from hapticrender.protocols import Driver, Flag

FULL_SCALE = 2.5  # A
FORMS = [
    (ending, subtype)
    for ending, kind in FORMATS.items()
    for subtype in SUBTYPES
    if soundfile.check_format(kind, subtype)
]
STEP = {"PCM_16": 2.0**-15, "PCM_24": 2.0**-23, "PCM_32": 2.0**-31, "FLOAT": 2.0**-24, "DOUBLE": 0.0}


def played(driver, blocks):
    """Play all `blocks`, close, and return what the file holds without the closing block of zeros."""
    with driver:
        for block in blocks:
            driver.play(block)
    held = read_back(driver.path, full_scale=driver.full_scale)
    assert not held[len(held) - driver.block :].any()
    return held[: len(held) - driver.block]


def largest_error(subtype):
    """Half a step: of the integers, of float32 between half and full scale; nothing for float64."""
    return 0.5 * FULL_SCALE * STEP[subtype]


@pytest.mark.parametrize(("ending", "subtype"), FORMS)
def test_a_file_holds_the_drive_within_half_a_step(tmp_path, rng, ending, subtype):
    channels = 3
    blocks = rng.uniform(-FULL_SCALE, FULL_SCALE * (1 - 2.0**-15), (3, 16, channels))
    driver = WaveFileDriver(
        tmp_path / f"drive{ending}", full_scale=FULL_SCALE, subtype=subtype, drive_channels=channels, block=16
    )
    assert isinstance(driver, Driver)
    assert (driver.sensed_channels, driver.delay) == (0, 16)
    held = played(driver, blocks)
    error = np.abs(held - blocks.reshape(-1, channels)).max()
    rounding = 4 * np.finfo(float).eps * FULL_SCALE  # of scaling there and back
    assert error <= largest_error(subtype) + rounding
    assert subtype == "DOUBLE" or error > 0.5 * largest_error(subtype)  # the form asked for, not a finer one
    assert driver.clipped == 0


def test_integers_cut_what_is_beyond_full_scale_and_say_so(tmp_path):
    driver = WaveFileDriver(tmp_path / "a.flac", full_scale=1.0, subtype="PCM_16", block=2)
    with driver:
        assert driver.play(np.array([[1.0, -1.0], [0.5, 0.0]])).flags is None
        assert driver.play(np.array([[0.25, 0.5], [1.5, -4.0]])).flags.tolist() == [0, Flag.SATURATED]
    assert driver.clipped == 2
    top = 1 - 2.0**-15
    assert read_back(driver.path, full_scale=driver.full_scale).tolist() == [
        [top, -1.0],
        [0.5, 0.0],
        [0.25, 0.5],
        [top, -1.0],
        [0.0, 0.0],
        [0.0, 0.0],
    ]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
@pytest.mark.parametrize("ending", [".wav", ".flac", ".rf64"])
def test_a_killed_process_leaves_what_it_played(tmp_path, ending):
    """All in WAV; FLAC's encoder holds back a block of 4096; RF64 counts frames when closed."""
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
    held = read_back(path, full_scale=1.0)
    if ending == ".rf64":
        assert held.shape == (0, 2)
    else:
        assert len(played) - len(held) <= (4096 if ending == ".flac" else 0)
        np.testing.assert_array_equal(held, played[: len(held)])
