"""Profiles that a run on a board contradicts: by what the board's own law has learned of the plate behind it."""

from contextlib import nullcontext

import numpy as np
import pytest
from board import SLOW, BoardProcess, SlowClock, SteppedBoard, build_board

import hapticrender as hr
from hapticrender.drivers.serial import SerialDriver
from hapticrender.loop import differences
from hapticrender.plants.plate import PlateParameters

STIFFER = {"stiffness_1": 23.5e3 / 22.4e3, "stiffness_2": 24e3 / 22.9e3}  # than its profile, as in test_device_profile
NAMED = r"differs from its model, profile plate 3 \(A. Smith, 2026-11-22\): the controller adds \d"


@pytest.fixture(scope="module", params=[False, True], ids=["right", "wrong"])
def profiled(request, tmp_path_factory):
    """Scene by a profile that the board's plate contradicts or not, program of the board, and whether it does."""
    folder, wrong = tmp_path_factory.mktemp("board"), request.param
    springs = {name: getattr(PlateParameters(), name) / ratio**wrong for name, ratio in STIFFER.items()}
    stated = {"name": "plate 3", "measured_by": "A. Smith", "measured_on": "2026-11-22"}
    hr.DeviceProfile(kind="vt-plate", device=springs, **stated).save(folder / "plate.toml")
    tone = hr.Grating(frequency=143.0, amplitude=30e-6)
    scene = hr.Scene(texture=tone, duration=1.5, device=str(folder / "plate.toml"), rendering={"probe": False})
    return scene, build_board(folder / "firmware", hr.prepare(scene), "-O2"), wrong


def test_a_profile_that_the_board_contradicts_is_named_by_render_and_live(profiled, tmp_path):
    scene, program, wrong = profiled
    with SteppedBoard(tmp_path, program=program) as board:
        with pytest.warns(hr.PlateMismatch, match=NAMED) if wrong else nullcontext():
            assert len(hr.render(scene, driver=board.driver()).warnings) == wrong
        driver = board.driver()
        loop = driver.loop(hr.prepare(scene, driver=driver))
        with driver:
            loop.start()
            board.run(driver.client, 0.9)
            early = loop.learned.mismatch  # in less than a second little is learned
            board.run(driver.client, 0.6)
            assert (early, len(differences(loop.rendering, loop.learned, 0))) == (0.0, wrong)
            driver.client.finger(0.0, 0.0, 0.4)
            board.run(driver.client, 0.1)
            assert loop.learned.mismatch == 0.0  # it is touched
            board.pulled = np.inf
            with pytest.raises(hr.DeviceLost):
                board.run(driver.client, 0.6)
            assert loop.learned is None


def test_a_player_names_the_profile_that_its_board_contradicts(profiled, tmp_path):
    scene, program, wrong = profiled
    with (
        BoardProcess(program, tmp_path, *SLOW) as board,
        pytest.warns(hr.PlateMismatch, match=NAMED) if wrong else nullcontext(),
        hr.Player(scene, SerialDriver(str(board.port), clock=SlowClock())) as player,
    ):
        player.play(scene.texture)
        player.record(tmp_path / "board.au")
        player.sleep(1.2)
        assert len(player.end_recording().warnings) == wrong
