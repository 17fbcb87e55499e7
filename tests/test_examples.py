"""Every example runs as a program, and the number on its last line is what it says it is."""

import runpy
import shutil
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

# (number, tolerance): where the number comes from, and what may move it.
EXPECTED = {
    "temporal_grating": (10e-6, 0.003 * 10e-6),  # the paper's loop holds 0.3 % over at least 4 s
    # 30 mm hold 30 ridges; at either end up to one period may be lost or be made by the plate's own decay.
    "spatial_grating_swipe": (30.0, 2.0),
    # Twice the speed is twice the frequency; a peak of a 0.7 s stroke moves by a part of the window's width, 4/0.7 Hz.
    "recorded_texture": (2.0, 0.1 * 4 / 0.7 / 50),
    "your_own_driver": (10e-6, 0.006 * 10e-6),  # as the first, with half the averaging time
    "your_own_texture": (2.738, 0.274),  # rms heights of 8.67 to 12 um over 2 to 5.33 um, rounded off by the loop's lag
    "play_live": (5e-6, 0.02 * 5e-6),  # a sliding finger, new to the law: 1 % must, and the state's own noise
    "realtime_callback": (10e-6, 0.006 * 10e-6),
    "sound_card": (0.0, 0.0),  # no card is named
    "made_up_device": (0.01, 0.01),  # up to 2 %, the accuracy suite's bound for a touch at the centre
    "one_texture_three_devices": (0.025, 0.025),  # up to 5 %, how far devices may differ in skin velocity
    "measure_a_finger": (200.0, 3 * 12.2),  # three of its own standard errors
    "velocity_per_force": (0.70425, 0.0005),  # mean of the eight figures of test_finger, each rounded to 0.0005
    "sweep_of_fingers": (0.0034, 0.002),
    "electroadhesion_square_root": (0.25, 0.001),  # (1 + sin)^2 is 1.5 + 2 sin - cos(2)/2
    # 10 K at -100 ppm/K of 30 kHz, and a finger of 0.4 N at -30 Hz (0.4/0.5)^(1/3).
    "ultrasonic_lock": (-30.0 - 30.0 * 0.8 ** (1 / 3), 1.0),
    # Noise of 1 um through windows of two periods, and a finger that the board is sent every few ms.
    "microcontroller": (10e-6, 0.03 * 10e-6),
}

NEEDS = {"microcontroller": ("make", "cc")}  # programs; an example that cannot run is skipped


def test_every_example_is_listed():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_an_example_returns_its_figure(name, tmp_path, monkeypatch, capsys):
    for program in NEEDS.get(name, ()):
        if shutil.which(program) is None:
            pytest.skip(f"{name} needs {program}: install make and a C compiler")
    program = str(EXAMPLES / f"{name}.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [program])
    runpy.run_path(program, run_name="__main__")
    number, tolerance = EXPECTED[name]
    assert float(capsys.readouterr().out.splitlines()[-1]) == pytest.approx(number, abs=tolerance)
    assert not list(tmp_path.iterdir())
