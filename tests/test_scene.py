"""Scenes: TOML in and out without loss, and one clear line for whatever is wrong."""

import os
import pickle
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from hypothesis import example, given
from hypothesis import strategies as st

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.errors import SceneError
from hapticrender.touch import toml_text
from hapticrender.touch.builtin_scenes import builtin_scenes
from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.mechanics import FingerMechanics
from hapticrender.touch.recorded import Recorded
from hapticrender.touch.scene import MOTIONS, TEXTURES, Scene

GOOD = """
duration = 2.0
[texture]
kind = "grating"
amplitude = 1e-5
wavelength = 1e-3
[finger]
motion = "sliding"
speed = 0.08
normal_load = 0.4
[device]
kind = "vt-plate"
mass = 0.035
[simulation]
seed = 3
sensor_noise = 0.0
[render]
tolerance = 0.05
"""

TONE = Grating(amplitude=1 / 3 * 1e-5, frequency=np.pi * 20)
FINGERS = {
    "absent": Finger.absent(),
    "still": Finger.still(0.01, mechanics="heavy-2nd-order", touches=[]),
    "sliding": Finger.sliding(0.08, normal_load=[[0, 1.5], [0.2, 1 / 7]], mechanics="heavy", load_scaling=True),
    "swiping": Finger.swiping(3, stroke=0.02, touches=[(0, 1), (1, 2.5)], mechanics="auto"),
    "sampled": Finger.sampled([0.1 / 3, -0.01], times=[0, 2], mechanics=FingerMechanics(order=2, damping=1 / 3)),
}
TEXTURE_CASES = {
    "tone": TONE,
    "partials": Grating(amplitude=1e-6, wavelength=1e-3, partials=[(1, 1, 0), (2.5, -1 / 3, 0.1)]),
    "by velocity": Grating(velocity=np.float64(1 / 30), wavelength=1e-3, speed=0.07, shape="square", phase=-0.3),
    "samples": Recorded(samples=[0, 1 / 3], rate=np.uint16(1000), speed=0.08, amplitude=1e-6),
}


@pytest.mark.parametrize("name", builtin_scenes())
def test_built_in_scenes_survive_toml(name):
    scene = builtin_scenes()[name]
    assert scene.name == name
    assert Scene.from_toml_text(scene.to_toml()) == scene


PAIRS = [*zip(TEXTURE_CASES, ["still", "sliding", "swiping", "sampled"], strict=True), ("tone", "absent")]


@pytest.mark.parametrize(("texture", "finger"), PAIRS)
def test_every_scene_survives_toml_to_the_last_bit(texture, finger):
    scene = Scene(
        texture=TEXTURE_CASES[texture],
        finger=FINGERS[finger],
        device="vt-plate",
        duration=1 / 3,
        tolerance=0.1 + 0.2,
        settle=0.0,
        keep_unfelt=texture == "tone",
        name='π "quoted" \x20name',
        method="paper",
        seed=2**40,
        gradient=-1 / 7,
        profile={"sensor_noise": 1e-300, "shaped": True, "count": 3, "level of\x7f\n": 'a "b"\x7f\n\\'},
        simulation={"mass": 1 / 3},
        rendering={"crossover": 120.0},
    )
    again = Scene.from_toml_text(scene.to_toml())
    assert again == scene
    assert again.to_toml() == scene.to_toml()
    assert pickle.loads(pickle.dumps(scene)) == scene
    assert hash(again) == hash(scene)


def test_a_scene_file_has_its_stem_for_a_name_and_finds_files_beside_it(tmp_path):
    soundfile.write(tmp_path / "denim.wav", np.sin(np.arange(4000.0)), 8000)
    path = tmp_path / "my scene.toml"
    path.write_text('duration = 1\n[texture]\nkind = "recorded"\nfile = "denim.wav"\namplitude = 1e-5\n')
    scene = Scene.from_toml(path)
    assert scene.name == "my scene"
    assert scene.texture == Recorded(file=tmp_path / "denim.wav", amplitude=1e-5)
    assert Scene.from_toml_text(scene.to_toml()) == scene


class Own:
    """A texture of the user's own."""

    def bands(self, rate):
        return Bands(frequency=np.array([50.0]), wavenumber=np.zeros(1), phase=np.zeros(1))

    def waveform(self, time, position):
        return np.zeros(np.shape(time))

    def __repr__(self):
        return "Own\n(3)"


def test_a_texture_of_ones_own_is_described_but_not_played_again():
    again = Scene.from_toml_text(Scene(texture=Own(), duration=1.0).to_toml())
    assert again.texture.description == "Own (3)"
    with pytest.raises(SceneError, match=r"description = 'Own \(3\)': what was made in Python cannot be played"):
        again.texture.bands(5000.0)


REFUSED = [  # text of GOOD, what stands there instead, message
    ("duration = 2.0", "", r"duration is missing: must be a finite number > 0 and <= 360000 s"),
    ("duration = 2.0", "duration = " + "9" * 6000, r"must be TOML"),
    ("duration = 2.0", "duration = 2.0\nlength = 1", r"length = 1: unknown key; known: calibration, device, duration"),
    ('kind = "grating"', 'kind = "gratin"', r"texture.kind = 'gratin': must be one of grating"),
    ("wavelength = 1e-3", "wavelenght = 1e-3", r"texture.wavelenght = 0.001: unknown key; known: amplitude, frequency"),
    ('motion = "sliding"\nspeed = 0.08', 'motion = "none"', r"finger.motion = 'none': a texture over position needs"),
    ("[device]", "[plant]", r"plant = .*: must be three tables: \[device\], \[simulation\].*\[render\]"),
    ("tolerance = 0.05", "tolerance = 5.0", r"tolerance = 5.0: must be .* > 0 and <= 1 \(a share: 0.05 is 5 %\)"),
    ("duration = 2.0", "duration = 2.0\ntolerance = 0.1", r"tolerance = 0.1: must be in the table \[render\]"),
    (GOOD, 'duration = 1.0\ndevice = "vt-plate"', r"device = 'vt-plate': must be a table: \[device\] with kind ="),
]


@pytest.mark.parametrize(("good", "bad", "message"), REFUSED, ids=range(len(REFUSED)))
def test_a_malformed_scene_is_refused_in_one_line(good, bad, message):
    assert good in GOOD
    assert Scene.from_toml_text(GOOD).finger == Finger.sliding(0.08, normal_load=0.4)
    with pytest.raises(SceneError, match=f"^scene.toml: ({message})") as refused:
        Scene.from_toml_text(GOOD.replace(good, bad), "scene.toml")
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"duration = \n", r"must be TOML \(Invalid value \(at line 1"),
        (b'device = "plate.toml"\n[device]\nmass = 0.1\n', r"must be TOML \(.*\): a key is there .* as a table\)"),
        (b"\xff\xfe\x00", r"byte 0: must be UTF-8 text"),
        (b"a = " + b"[" * 5000, r"must be TOML \("),
        (
            b'duration = 1\n[texture]\nkind = "recorded"\nfile = "none.wav"\namplitude = 1e-6',
            r"texture.file = '.*none.wav': must be an existing sound file",
        ),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=f"scene.toml: {message}") as refused:
        Scene.from_toml(path)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["absent.toml", ".", "a\0b", "x" * 5000, "pipe"])
def test_what_is_no_file_is_refused_at_once(tmp_path, name):
    if name == "pipe" and hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SceneError, match=r"must be a (readable|regular) file"):
        Scene.from_toml(f"{tmp_path}/{name}")


NUMBERS = st.one_of(
    st.floats(), st.integers(), st.floats(0, 1), st.sampled_from([0.0, -0.0, 5e-324, 1e308, 1e-9, 0.5, 2, 2**70])
)
NAMES = st.sampled_from([*TEXTURES, *MOTIONS, "light", "heavy", "auto", "sine", "square", "vt-plate", ".", "/", "a\0"])
LEAVES = st.one_of(NUMBERS, NAMES, st.booleans(), st.text(st.characters(exclude_categories=["Cs"]), max_size=5))
KEYS = st.sampled_from(
    "kind amplitude velocity level gain frequency wavelength shape harmonics partials phase file channel speed "
    "carriers spacing passband components seed motion at span centre stroke positions rate times start normal_load "
    "touches mechanics load_scaling description order mass damping".split()
)
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=3))


def accept_or_refuse(text):
    """A scene that survives TOML, or a SceneError of one line; anything else is a traceback for the user."""
    refused = ""
    try:
        scene = Scene.from_toml_text(text)
    except SceneError as problem:
        refused = str(problem)
    if refused:
        assert refused.isprintable() or "must be TOML" in refused
        assert len(refused.splitlines()) == 1
    else:
        assert Scene.from_toml_text(scene.to_toml()) == scene
        play(scene)


def play(scene):
    """Whatever was accepted gives finite numbers, tiny ones included."""
    time = np.array([0.0, 0.3, 1.0, 3.6e5])
    with np.errstate(under="ignore"):
        try:
            position = scene.finger.position(time)
            curves = [*scene.finger.touch(time)[:, 1:].T, scene.texture.waveform(time, position)]
        except SceneError as refused:
            curves = [0.0 if "made in Python" in str(refused) else np.nan]
    assert np.isfinite(curves).all()


POSITIVE = st.floats(0, 1e-2) | st.floats(0, 10) | NUMBERS
GOOD_TEXTURES = [
    {"kind": "grating", "amplitude": 1e-6, "frequency": 20.0},
    {"kind": "grating", "amplitude": 1e-6, "wavelength": 1e-3, "shape": "square"},
    {"kind": "grating", "velocity": 0.01, "wavelength": 1e-3, "speed": 0.1},
    {"kind": "grating", "level": 20, "frequency": 70.0},
    {"kind": "recorded", "samples": [0.0, 1.0], "rate": 1e3, "amplitude": 1e-6, "speed": 0.1},
    {"kind": "custom", "description": "own"},
    {"kind": "recorded", "amplitude": 1e-6, "file": "absent.wav"},
]
GOOD_FINGERS = [
    {"motion": "none"},
    {"motion": "still", "normal_load": 0.4},
    {"motion": "sliding", "speed": 0.1, "mechanics": "heavy"},
    {"motion": "swiping", "frequency": 3.0, "stroke": 0.05, "load_scaling": True, "mechanics": "light"},
    {"motion": "sampled", "positions": [0.0, 0.1], "times": [0.0, 1.0], "mechanics": "auto"},
]


def spoiled(tables):
    """One of the good tables with one of its entries made another number, or anything."""

    def spoil(table):
        return st.tuples(st.sampled_from(list(table)), POSITIVE | POSITIVE | VALUES).map(
            lambda new: table | dict([new])
        )

    return st.sampled_from(tables).flatmap(spoil) | st.sampled_from(tables) | VALUES


@given(spoiled(GOOD_TEXTURES), spoiled(GOOD_FINGERS))
def test_no_nearly_good_scene_is_a_traceback(texture, finger):
    accept_or_refuse(toml_text.dumps({"duration": 1.0, "texture": texture, "finger": finger}))


@given(st.text(max_size=60) | st.text(alphabet="=[]{}\"'.,#\n ae0-", max_size=60))
@example("\ufeffduration = 1")
@example('a = "\\uD800"')
def test_no_random_text_is_a_traceback(text):
    accept_or_refuse(text)


def test_what_cannot_be_felt_is_played_unless_it_is_left_out():
    """3 um at 21 Hz cannot be felt, and are most of this texture: left out, they are its error."""
    texture = hr.Grating(frequency=21.0, amplitude=3e-6) + hr.Grating(frequency=120.0, amplitude=2e-6)
    scene = hr.Scene(texture=texture, duration=1.5, settle=0.5)
    assert hr.render(scene).summary()["passed"]
    less = hr.render(replace(scene, keep_unfelt=False)).summary()
    missing = 3.0 / np.hypot(3.0, 2.0)
    assert (less["verdict"], less["worst"]["value"]) == ("failed", pytest.approx(missing, rel=0.02))


def test_long_lists_take_several_lines_and_read_the_same_inside_other_tables():
    long = np.linspace(-1.0, 1.0, 400).tolist()
    part = {"kind": "recorded", "samples": long, "rate": 1000.0, "gain": 1e-6}
    table = {"texture": {"samples": long, "kind": "sum", "parts": [[part, 1.0], [{"file": "a, b " * 30}, 2.0]]}}
    text = toml_text.dumps(table)
    assert toml_text.loads(text) == table
    assert text.index("kind") < text.index("samples")
    assert "\n" not in toml_text.dumps({"short": long[:4]}).strip()
