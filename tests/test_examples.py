"""Every example runs in a process of its own, and the number on its last line is what it says it is."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

# (number, tolerance): where the number comes from, and what may move it.
EXPECTED = {
    # The paper's loop holds an amplitude to 0.3 % over at least 4 s [the baseline's own test].
    "temporal_grating": (10e-6, 0.003 * 10e-6),
    # 30 mm hold 30 ridges of 1 mm; at either end the target fades with the velocity's 40 Hz pole, where up to one
    # period of 12.5 ms each may be lost or be made by the plate's own decay.
    "spatial_grating_swipe": (30.0, 2.0),
    # Twice the speed is twice the frequency; the ridges' uneven height (8 Hz as felt, a third of it) and the loop's
    # changing lag move the peak of a 0.7 s stroke by a small part of the window's width of 4/0.7 Hz.
    "recorded_texture": (2.0, 0.1 * 4 / 0.7 / 50),
    # Two judged seconds of a settled loop: as above, with half the averaging time of its 0.3 %.
    "your_own_driver": (10e-6, 0.006 * 10e-6),
    # Root mean squares of a height that grows from 2 to 12 um: 8.67 to 12 um against 2 to 5.33 um; the loop's lag
    # of some 0.1 s rounds it off where the finger turns, by less than the 10 % that nobody feels [FACTS 7].
    "your_own_texture": (2.738, 0.274),
    # 10 um of a settled loop over 1 s, as `your_own_driver`.
    "realtime_callback": (10e-6, 0.006 * 10e-6),
    # Anything up to 2 %, the bound of the accuracy suite for a touch at the centre, as an rms over two touches.
    "made_up_device": (0.01, 0.01),
    # Anything up to 5 %, how far devices may differ in skin velocity [issue D, 7].
    "one_texture_three_devices": (0.025, 0.025),
    # Mean of the eight figures of FACTS 4 (0.796 1.094 0.910 0.574 0.484 0.545 0.606 0.625), each rounded to 0.0005.
    "velocity_per_force": (0.70425, 0.0005),
    # Anything up to 0.4 %, the bound of the accuracy suite for a finger that even slides.
    "sweep_of_fingers": (0.0055, 0.002),
    # (1 + sin)^2 is 1.5 + 2 sin - cos(2)/2: a quarter, to the rounding; with the root at most the 0.1 %.
    "electroadhesion_square_root": (0.25, 0.001),
    # 10 K at -100 ppm/K of 30 kHz, and a finger of 0.4 N at -30 Hz (0.4/0.5)^(1/3) [FACTS 6]; the phase of the sensor's
    # noise, 2 nm of some 0.7 um before it is averaged, is less than 1/250 of the 230 Hz to either side of a resonance.
    "ultrasonic_lock": (-30.0 - 30.0 * 0.8 ** (1 / 3), 1.0),
}

LONGEST = {"made_up_device": 80}  # lines: plant and renderer in one


def test_every_example_is_listed():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_an_example_is_short_and_says_what_its_figure_is(name):
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LONGEST.get(name, 60)
    assert "The figure is" in ast.get_docstring(ast.parse(text))


@pytest.mark.parametrize("name", EXPECTED)
def test_an_example_returns_its_figure(name, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", EXAMPLES / f"{name}.py"],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    number, tolerance = EXPECTED[name]
    assert float(done.stdout.splitlines()[-1]) == pytest.approx(number, abs=tolerance)
    assert not list(tmp_path.iterdir())
