"""Profiles: TOML in and out, scenes that take them, whose overrides win, and runs that contradict them."""

import re
from contextlib import nullcontext
from datetime import date

import pytest

import hapticrender as hr
from hapticrender import cli
from hapticrender.errors import SceneError
from hapticrender.plants.plate import PlateParameters
from hapticrender.recordings.recording import Recording
from hapticrender.touch.mechanics import HEAVY_SECOND
from hapticrender.touch.scene import Scene

PLATE = {
    "kind": "vt-plate",
    "name": "plate 3",
    "measured_by": "A. Smith",
    "measured_with": "two laser vibrometers",
    "measured_on": "2026-11-22",
    "device": {"mass": 0.0321, "coils": 2, "delay": 1},
    "uncertainty": {"mass": 1e-5},
    "calibration": {
        "drive_per_full_scale": 3.0,
        "sensed_per_full_scale": (2e-4, 2.1e-4),
        "delay": 5.25,
        "gain_uncertainty": 0.02,
    },
    "limits": {"peak_drive": 2.0, "rms_drive": 0.5, "rms_time": 20.0, "displacement": 4e-4},
}
KIND, DEVICE = '[profile]\nkind = "vt-plate"\n', '[device]\nkind = "vt-plate"\n'
SCENE = """
duration = 1.0
{}
[texture]
kind = "grating"
amplitude = 1e-5
frequency = 72.0
"""


@pytest.fixture
def plate(tmp_path):
    (tmp_path / "devices").mkdir()
    path = tmp_path / "devices" / "plate.toml"
    hr.DeviceProfile(**PLATE).save(path)
    return path


def tone(**fields):
    return hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=1e-5), duration=1.0, **fields)


def test_a_profile_survives_its_file(plate):
    found = hr.DeviceProfile.load(plate)
    assert found == hr.DeviceProfile(**PLATE)
    assert found.measured_on == date(2026, 11, 22)
    assert str(found) == "plate 3 (A. Smith, 2026-11-22)"
    assert "measured_on = 2026-11-22\n" in plate.read_text()  # a date, not a text
    least = hr.DeviceProfile(kind="ultrasonic")
    assert hr.DeviceProfile.from_table({"profile": {"kind": "ultrasonic"}}) == least
    assert str(least) == "ultrasonic"


def test_a_scene_takes_what_the_file_says_and_what_it_says_itself_wins(plate, tmp_path):
    scene = tone(device=str(plate), profile={"mass": 0.04}, limits={"rms_drive": 0.4})
    assert (scene.device, scene.source) == ("vt-plate", "plate 3 (A. Smith, 2026-11-22)")
    assert scene.profile == {"mass": 0.04, "coils": 2, "delay": 1}
    assert scene.limits == PLATE["limits"] | {"rms_drive": 0.4}
    assert scene.calibration == PLATE["calibration"]
    assert Scene.from_toml_text(scene.to_toml()) == scene  # the file is no longer needed
    for name, line in (
        ("short", 'device = "devices/plate.toml"\n[limits]\nrms_drive = 0.4'),
        ("long", '[device]\nprofile = "devices/plate.toml"\nmass = 0.04\n[limits]\nrms_drive = 0.4'),
    ):
        (tmp_path / f"{name}.toml").write_text(SCENE.format(line))
        found = Scene.from_toml(tmp_path / f"{name}.toml")  # from the scene's folder, not from that of the process
        assert found.limits == scene.limits
        assert found.source == scene.source
        assert found.profile["mass"] == (0.0321 if name == "short" else 0.04)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('device = "none.toml"', "none.toml: must be a readable file"),
        (
            '[device]\nprofile = "vt-plate"',
            "device.profile = 'vt-plate': must be the name of a file that ends in .toml",
        ),
        ('[device]\nprofile = "a.toml"\nkind = "hybrid"', "device.kind = 'hybrid': must be left out beside profile"),
        (DEVICE + "[limits]\nrms_drive = 0", "limits.rms_drive = 0: must be a finite number > 0"),
        (DEVICE + "[calibration]\ngain = 1", "calibration.gain = 1: unknown key; known: delay"),
    ],
)
def test_a_scene_with_a_wrong_profile_gets_one_line(tmp_path, line, message):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.format(line))
    with pytest.raises(SceneError, match=rf"^{path}: .*{message}"):
        Scene.from_toml(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[device]\nmass = 0.03", "profile.kind is missing: must be the name of a renderer, such as 'vt-plate'"),
        (KIND + '[device]\nkind = "hybrid"', "device.kind = 'hybrid': must be 'vt-plate', as in"),
        (KIND + 'measured_on = "yesterday"', "measured_on = 'yesterday': must be a date such as"),
        (KIND + "from = 1", "profile.from = 1: unknown key; known: kind, measured_by"),
        (KIND + "[uncertainty]\nmass = 1.0", r"uncertainty.mass: must be of a parameter in \[dev"),
        (KIND + "[texture]", "texture = {}: must be one of the tables profile, device"),
        (KIND + "[limits]\nrms_time = 0.0", "limits.rms_time = 0.0: must be a finite .* >= 0.1"),
        ("kind = ", "must be TOML"),
    ],
)
def test_a_wrong_profile_gets_one_line(tmp_path, text, message):
    path = tmp_path / "plate.toml"
    path.write_text(text)
    with pytest.raises(SceneError, match=rf"^{path}: .*{message}"):
        hr.DeviceProfile.load(path)


def test_identify_writes_a_profile_that_keeps_the_limits(plate, tmp_path, capsys):
    """The simulated plate is 5 % lighter than the profile says; its limits and calibration are not what is measured."""
    (tmp_path / "scene.toml").write_text(
        SCENE.format('device = "devices/plate.toml"\n[simulation]\nmass = 0.0305\nsensor_noise = 1e-7')
    )
    out = tmp_path / "new.toml"
    assert cli.main(["identify", "--scene", str(tmp_path / "scene.toml"), "--out", str(out), "--by", "me"]) == 0
    found = hr.DeviceProfile.load(out)
    assert found.device["mass"] == pytest.approx(0.0305, rel=1e-3)
    assert 0 < found.uncertainty["mass"] < 1e-3 * 0.0305
    assert abs(found.device["mass"] - 0.0305) < 5 * found.uncertainty["mass"]
    assert (found.name, found.measured_by, found.measured_on) == ("new", "me", date.today())
    assert found.measured_with.endswith("identify, driver simulated")
    assert (found.limits, found.calibration) == (
        hr.DeviceProfile(**PLATE).limits,
        hr.DeviceProfile(**PLATE).calibration,
    )
    hr.prepare(tone(device=str(out)))
    assert cli.main(["identify", "--out", str(out)]) == 0  # over a file that has them, for a scene that has none
    again = hr.DeviceProfile.load(out)
    assert again.device["mass"] == pytest.approx(PlateParameters().mass, rel=1e-3)
    assert (again.limits, again.calibration) == (found.limits, found.calibration)
    assert cli.main(["identify", "--scene", "one-texture-ultrasonic", "--out", str(out)]) == 2
    assert hr.DeviceProfile.load(out) == again
    assert "is the profile of a vt-plate, must be that of a ultrasonic" in capsys.readouterr().err


STIFF = {"stiffness_1": 23.5e3, "stiffness_2": 24e3}
CONTRADICTED = r"differs from its model, profile plate 3 \(A. Smith, 2026-11-22\): the"


@pytest.mark.parametrize(
    ("simulation", "method", "warned"), [(STIFF, "inverse", CONTRADICTED), (STIFF, "h2", CONTRADICTED), ({}, "h2", "")]
)
def test_a_profile_that_a_run_contradicts_is_named_and_live_once_with_the_figure_of_render(
    plate, tmp_path, simulation, warned, method
):
    """At the session's end, and in every recording; what the controller adds is stated to 0.2 %, as by `render`."""
    scene = hr.Scene(**fields(plate), simulation=simulation, method=method)
    named, noted = (pytest.warns(hr.PlateMismatch, match=warned) if warned else nullcontext() for _ in range(2))
    with named:
        rendered = hr.render(scene)
    with noted as caught, hr.Player(scene, paced=False) as player:
        player.play(scene.texture)
        player.record(tmp_path / "live.au")
        player.sleep(2.0)
        live = player.end_recording()
    assert len(live.warnings) == len(rendered.warnings) == bool(warned)
    if warned:
        [warning] = caught
        assert (str(warning.message),) == live.warnings
        stated, expected = (
            [float(x) for x in re.findall(r"([-+]?[\d.]+) %", each.warnings[0])] for each in (live, rendered)
        )
        assert stated == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize("live", [False, True])
def test_an_inner_damper_that_was_turned_down_is_named(live):
    """By `render`, and live on a hybrid: a bending mode at 900 Hz that the model lacks; see test_supervisor."""
    fields = {"method": "h2", "simulation": {"bending_frequency": 900.0, "bending_coil": -0.1}}
    texture = hr.Grating(frequency=50.0 if live else 72.0, amplitude=50e-6)
    finger = hr.Finger.still(normal_load=0.8, touches=((0.5, 5.0),), mechanics=HEAVY_SECOND)

    def play():
        if not live:
            return hr.render(hr.Scene(texture=texture, finger=finger, duration=2.0, **fields))
        with hr.Player("hybrid", paced=False, **fields) as player:
            player.finger(0.0, 0.0, 0.8)
            player.play(texture)
            player.sleep(2.0)

    with pytest.warns(hr.PlateMismatch, match="inner damper rang above 500 Hz and was turned down to 0"):
        play()


def fields(plate):
    return {"texture": hr.Grating(frequency=143.0, amplitude=30e-6), "duration": 2.0, "device": str(plate)}


def test_the_gains_uncertainty_reaches_the_verdict(plate, tmp_path):
    hr.render(tone(device=str(plate)), journal=tmp_path / "run.au")
    assert Recording.load(tmp_path / "run.au").header.calibration == 0.02
