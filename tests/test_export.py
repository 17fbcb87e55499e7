"""The verb export: what it writes, refuses and ships."""

import fnmatch
import tomllib

import pytest
from board import FIRMWARE, ROOT
from laws import FINGERS, TEXTURES

import hapticrender as hr
from hapticrender import cli
from hapticrender.export import board_design, export, sources


def test_export_says_what_it_writes_and_keeps_what_was_changed(exports, tmp_path):
    rendering = exports.rendering("tones")
    written = export(rendering, tmp_path, bands=12)
    assert {path.name for path in written} == {path.name for path in sources()} | {"design.c", "design.h"}
    assert "#define LAW_BANDS 12\n" in (tmp_path / "design.h").read_text()
    assert export(rendering, tmp_path) == written
    for name in ("law.c", "design.c"):
        (tmp_path / name).write_text("mine\n")
        with pytest.raises(ValueError, match=f"{name}.*not as it was written.*--force"):
            export(rendering, tmp_path)
        assert (tmp_path / name).read_text() == "mine\n"
        export(rendering, tmp_path, force=True)


def refused(**changes):
    scene = hr.Scene(**{"texture": TEXTURES["tones"], "finger": hr.Finger.absent(), "duration": 1.0} | changes)
    board_design(hr.prepare(scene))


def test_export_refuses_what_a_board_cannot_play(exports):
    with pytest.raises(ValueError, match="device.kind = 'electroadhesion': a board plays vt-plate only"):
        refused(device="electroadhesion", texture=hr.Grating(velocity=8e-3, frequency=80.0), finger=FINGERS["sweep"])
    with pytest.raises(ValueError, match="method = 'h2': a board plays \"inverse\" only"):
        refused(method="h2")
    with pytest.raises(ValueError, match="texture Synthetic: a board plays a whole waveform, without `carriers`"):
        refused(texture=hr.Synthetic(amplitude=20e-6, speed=0.08), finger=FINGERS["sweep"])
    with pytest.raises(ValueError, match="delay = 65 samples: must be <= 64"):
        refused(profile={"delay": 65})
    rendering = exports.rendering("tones")
    assert board_design(rendering, 2)[0]["BANDS"] == 2
    assert board_design(rendering, 64)[0]["BANDS"] == 64
    for bands in (1, 65):
        with pytest.raises(ValueError, match=f"bands = {bands}: must be 2 .* to 64"):
            board_design(rendering, bands)


def test_the_command_line_exports(tmp_path, capsys):
    assert cli.main(["export", "grating-47", "--out", str(tmp_path / "board")]) == 0
    assert "build them with: make -C" in capsys.readouterr().out
    assert cli.main(["export", "screen-spatial", "--out", str(tmp_path / "other")]) == 2
    assert "a board plays vt-plate only" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_every_source_is_shipped():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = project["tool"]["setuptools"]["package-data"]["hapticrender.drivers"]
    names = [f"firmware/{path.name}" for path in FIRMWARE.iterdir()]
    assert not [name for name in names if not any(fnmatch.fnmatch(name, each) for each in patterns)]
    assert {path.name for path in sources()} == {path.name for path in FIRMWARE.iterdir()}
