"""The command line as a user meets it: the verbs, one line for each trouble, and nothing written where it said no.

And as a shell runs it: redirected, piped, closed, in a folder of its own.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace

import hypothesis
import numpy as np
import pytest
import soundfile
from hypothesis import strategies as st
from other_plate import OtherPlate
from test_player_faults import full_disk

from hapticrender import cli, defaults
from hapticrender.recordings.recording import Recording
from hapticrender.touch.builtin_scenes import DEVICES, builtin_scenes
from hapticrender.touch.scene import Scene

TINY = """\
name = "tiny"
duration = 0.1

[texture]
kind = "grating"
amplitude = 10e-6
frequency = 47.0

[device]
kind = "vt-plate"
"""
SCENE_FILES = {"scene.toml", "recording.au", "drive.wav", "sensed.wav", "summary.json"}


@pytest.fixture
def command(capsys):
    """Run the command line: status, output, and the lines of its errors without that it compiles, on a slow machine."""

    def run(*arguments):
        status = cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        lines = captured.err.splitlines()
        return status, captured.out, [line for line in lines if line != "compiling for this machine (once)"]

    return run


@pytest.fixture
def run(command, empty_pictures):
    """The same, which draws nothing."""
    return command


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


@pytest.fixture
def two_tiny_scenes(monkeypatch):
    """A demo of two short scenes."""
    scenes = {name: Scene.from_toml_text(TINY.replace("tiny", name), where=name) for name in ("one", "two")}
    monkeypatch.setattr("hapticrender.verbs.builtin_scenes", lambda **_: scenes)
    return scenes


@pytest.fixture
def no_matplotlib(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "hapticrender.report.picture", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)


def complaint(result):
    """The one line of a refused command."""
    status, out, errors = result
    assert (status, out, len(errors)) == (2, "", 1), errors
    assert errors[0].startswith("hapticrender: ")
    return errors[0]


def test_the_demo_leaves_one_page_and_all_its_parts(run, tmp_path, monkeypatch):
    names = ["one-texture-vt-plate", "one-texture-electroadhesion"]
    scenes = {name: replace(builtin_scenes()[name], duration=1.0) for name in names}
    monkeypatch.setattr("hapticrender.verbs.builtin_scenes", lambda **_: scenes)
    status, out, errors = run("demo", "--out", tmp_path / "out")
    assert status == 0
    assert errors == [f"{i + 1}/{len(names)} {name}" for i, name in enumerate(names)]
    assert out.endswith(f"page: {tmp_path / 'out' / 'index.html'}\n")
    report = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert [scene["scene"] for scene in report["scenes"]] == names
    html = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    for name in names:
        folder = tmp_path / "out" / name
        assert {path.name for path in folder.iterdir()} == SCENE_FILES | {"picture.png"}
        assert f'src="{name}/picture.png"' in html
        assert Scene.from_toml(folder / "scene.toml") == scenes[name]


def test_without_matplotlib_all_else_is_there_and_one_line_says_how(command, two_tiny_scenes, no_matplotlib, tmp_path):
    status, _, errors = command("demo", "--out", tmp_path / "out")
    assert status == 0
    assert 'pip install "hapticrender[plot]"' in errors[0]  # before the first scene runs
    for name in two_tiny_scenes:
        assert {path.name for path in (tmp_path / "out" / name).iterdir()} == SCENE_FILES
    assert "picture.png" not in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")


def test_render_prints_figures_and_the_recording_shows_the_same(run, tiny, tmp_path):
    status, out, errors = run("render", tiny, "--out", tmp_path / "out", "--seed", 3, "--method", "paper-common")
    assert (status, errors) == (0, [f"1/1 {tiny}"])
    verdict, note, *files = out.splitlines()
    assert verdict == "tiny on vt-plate: not judged: the run is too short: needs >= 0.2 s"
    assert note == "the run is shorter than twice the settling time: its second half is judged"
    assert {line.split()[-1] for line in files} == {str(path) for path in (tmp_path / "out").iterdir()}
    _, verbose, _ = run("render", tiny, "--out", tmp_path / "out", "--seed", 3, "--method", "paper-common", "-v")
    figures = verbose.partition("wrote ")[0]
    assert figures.startswith("tiny on vt-plate, method paper-common, seed 3: 100 ms, judged from 50 ms")
    assert run("show", tmp_path / "out") == (0, figures, [])
    assert run("show", tmp_path / "out" / "recording.au") == (0, figures, [])


def test_the_least_model_runs_on_request(run, tiny, tmp_path):
    _, out, _ = run("render", tiny, "--out", tmp_path / "out", "--least-model")
    assert out.splitlines()[-2:] == [
        "least model within 1 %:",
        "  one coordinate (heave): not taken, predicted difference 3.3 %",
    ]


def test_a_file_is_played_live(run, tiny, tmp_path):
    """What the page's recording has as drive is what the file has from where the recording began."""
    played = tmp_path / "played.wav"
    arguments = ["--out", tmp_path / "out", "--seconds", "0.2", "--driver", f"wavefile:{played}"]
    status, out, _ = run("play", tiny, *arguments)
    assert status == 0
    assert "page: " in out
    recording = Recording.load(tmp_path / "out" / "tiny" / "recording.au")
    samples, rate = soundfile.read(played)
    drive, n = recording.drive, len(recording)
    assert rate == recording.rate == 48000
    assert not (tmp_path / "out" / "tiny" / "sensed.wav").exists()
    assert n >= 0.15 * rate
    assert abs(drive).max() > 0.0
    starts = range(len(samples) - n + 1)
    assert any(abs(3.0 * samples[start : start + n] - drive).max() < 3.0 * 2.0**-23 for start in starts)


RAISED = [
    (lambda *_: {}["usb"], "hapticrender: other_plate:OtherPlate: KeyError: 'usb'"),
    (lambda *_: 1 / 0, "hapticrender: other_plate:OtherPlate: ZeroDivisionError: division by zero"),
    (lambda *_: sys.exit(0), "hapticrender: the driver, or what it uses, ended the program: SystemExit(0)"),
]


@pytest.mark.parametrize("ending", [".wav", ".w64"])
def test_a_drive_replaces_its_own_file_and_by_force_any_but_the_texture(run, tmp_path, ending):
    """A W64 file has no room to say whose it is."""
    played, scene = tmp_path / f"mine{ending}", tmp_path / "scene.toml"
    soundfile.write(played, np.sin(np.arange(4000) / 10.0), 5000, subtype="DOUBLE")
    tone = 'kind = "grating", frequency = 47.0, amplitude = 1e-5'
    file = f'kind = "sum", parts = [[{{kind = "recorded", file = "{played.name}", amplitude = 1e-5}}, 1.0]]'
    again = "" if ending == ".wav" else "no file of this driver"
    for texture, force, words in (
        (file, ["--force"], "would overwrite the scene's texture"),
        (tone, [], "no file of this driver"),
        (tone, ["--force"], ""),
        (tone, [], again),
    ):
        before = played.read_bytes()
        duration = 0.3 if force else 0.4
        scene.write_text(f"duration = {duration}\ntexture = {{{texture}}}\n[render]\nsettle = 0.1\n")
        status, _, error = run("render", scene, "--out", tmp_path / "out", "--driver", f"wavefile:{played}", *force)
        assert status == (2 if words else 0), error
        assert words in "".join(error)
        assert (played.read_bytes() == before) == bool(words)


VERBS = "render {tiny} --out {out}", "play {tiny}", "identify"
WHERE = [(verb, "play", RAISED[0]) for verb in VERBS]
WHERE += [(VERBS[0], "__enter__", RAISED[1]), (VERBS[1], "__enter__", RAISED[2]), (VERBS[2], "play", RAISED[2])]


@pytest.mark.parametrize(("verb", "method", "raised"), WHERE)
def test_what_a_driver_raises_is_one_line(run, tiny, tmp_path, monkeypatch, verb, method, raised):
    fails, line = raised
    monkeypatch.setattr(OtherPlate, method, fails)
    status, _, errors = run(*verb.format(tiny=tiny, out=tmp_path / "out").split(), "--driver", "other_plate:OtherPlate")
    assert (status, errors[-1]) == (2, line)


def test_python_in_development_mode_shows_the_traceback():
    command = [sys.executable, "-X", "dev", "-m", "hapticrender", "render", "a", "--out", "b", "--method", "magic"]
    assert "Traceback" in subprocess.run(command, capture_output=True, text=True, check=False).stderr


def test_nothing_of_others_is_overwritten(run, tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    (own / "scene.toml").write_text(TINY)
    assert "would overwrite the scene itself" in complaint(run("render", own / "scene.toml", "--out", own))
    other = tmp_path / "other"
    other.mkdir()
    (other / "drive.wav").write_bytes(b"mine")
    assert "is there and from no earlier run" in complaint(run("render", own / "scene.toml", "--out", other))
    assert (other / "drive.wav").read_bytes() == b"mine"
    assert "is a scene, must be another file" in complaint(
        run("validate", own / "scene.toml", "--json", own / "scene.toml")
    )
    assert (own / "scene.toml").read_text() == TINY
    assert run("render", own / "scene.toml", "--out", other, "--force")[0] == 0
    assert run("render", own / "scene.toml", "--out", other)[0] == 0  # over an earlier run of its own


PLAY = OtherPlate.play


@pytest.mark.parametrize(
    ("fails", "probe"), [(lambda driver, drive: PLAY(driver, -drive), True), (lambda *_: 1 / 0, False)]
)
def test_a_run_that_never_starts_leaves_the_earlier_one_and_refuses_no_other(
    run, tiny, tmp_path, monkeypatch, fails, probe
):
    """The probe refuses it, or its first block fails."""
    tiny.write_text(TINY + f"[render]\nprobe = {str(probe).lower()}\n")
    out, command = tmp_path / "out", ("render", tiny, "--out", tmp_path / "out", "--driver", PLATE)
    with monkeypatch.context() as patch:
        patch.setattr(OtherPlate, "play", fails)
        assert run(*command)[0] == 2
        assert not out.exists()
    assert run(*command)[0] == 0
    before = {path: path.read_bytes() for path in out.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(OtherPlate, "play", fails)
        assert run(*command)[0] == 2
        assert not probe or {path: path.read_bytes() for path in out.iterdir()} == before
    assert run(*command)[0] == 0
    (out / "recording.au").write_text("mine")
    assert "from no earlier run" in complaint(run(*command))
    assert run(*command, "--force")[0] == 0


def test_scenes_are_listed_and_printed(run):
    status, out, errors = run("scenes")
    assert (status, errors) == (0, [])
    assert [line.split()[0] for line in out.splitlines()] == list(builtin_scenes())
    assert all(len(line.split()) > 3 for line in out.splitlines())
    assert "recorded 13.97 µm; finger" in out
    for name in "sliding", "recorded-texture":
        _, out, _ = run("scenes", name)
        assert Scene.from_toml_text(out, where=name) == builtin_scenes()[name]
        assert max(map(len, out.splitlines())) <= 110


def test_devices_are_listed_with_what_each_needs(run):
    status, out, errors = run("devices")
    assert (status, errors) == (0, [])
    for value in ("vibrotactile:VibrotactileRenderer", "simulated:SimulatedDriver", "wavefile:WaveFileDriver"):
        (line,) = [line for line in out.splitlines() if line.endswith(f".{value})")]
        assert "broken" not in line
    assert {line.split()[0] for line in out.partition("\n\n")[0].splitlines()} >= set(DEVICES)
    assert "2 coils (A), 2 displacement sensors (m), a current source" in out


def test_a_broken_package_is_shown_as_broken_and_hides_no_other(run, tmp_path, monkeypatch):
    (tmp_path / "third_party.py").write_text("raise SystemExit('no licence')")
    (tmp_path / "third_party-1.dist-info").mkdir()
    (tmp_path / "third_party-1.dist-info" / "METADATA").write_text("Name: third_party\nVersion: 1\n")
    entry = "[hapticrender.drivers]\ntheirs = third_party:Driver\n"
    (tmp_path / "third_party-1.dist-info" / "entry_points.txt").write_text(entry)
    monkeypatch.syspath_prepend(tmp_path)
    test_devices_are_listed_with_what_each_needs(run)
    _, out, _ = run("devices")
    (line,) = [line for line in out.splitlines() if line.split()[:1] == ["theirs"]]
    assert line.endswith("broken  cannot be loaded from third_party:Driver (SystemExit: no licence)")


def test_the_methods_that_help_lists_are_those_there_are():
    from hapticrender.control.methods import METHODS

    assert set(defaults.METHODS) == set(METHODS)


def test_help_waits_for_no_heavy_import_and_numpy_gets_one_thread():
    """Unless the user has set their number; it is set before numpy is there."""
    code = "import os, sys, hapticrender.cli as c; c.main([]); print(os.environ['OPENBLAS_NUM_THREADS']); "
    code += "sys.exit(bool({'numba', 'scipy', 'numpy'} & set(sys.modules)))"
    for given, threads in ({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3"):
        environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"} | given
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == threads


PLATE = "other_plate:OtherPlate"
BAD_ARGUMENTS = [
    (
        ["render", "{fast}", "--out", "{out}"],
        "{fast}: texture.amplitude = 1e-05 m at 2e+03 Hz needs 3.38 A: must be <= 3 A",
    ),
    (["render", "{tiny}", "--out", "{out}", "--method", "magic"], "--method = 'magic': must be one of paper, "),
    (["render", "{tiny}", "--out", "{tiny}/below"], "is a file, must be a folder"),
    (["render", "no-such-scene", "--out", "{out}"], "no-such-scene: no such file, nor a built-in scene"),
    (["render", "{binary}", "--out", "{out}"], "{binary}: "),
    (["scenes", "no-such-scene"], "no-such-scene: no such built-in scene; there are "),
    (["validate", "{tiny}", "--json", "{out}", "--junit", "{folder}/../out"], "--json, --junit = '{out}': must be two"),
    (["validate", "{tiny}", "--json", "{folder}"], "--json = '{folder}': is a folder, must be a file"),
    (["show", "{missing}"], "{missing}: no such file"),
    (["show", "{cut}"], "{cut}: not a recording (File is not a zip file)"),
    (["render", "{tiny}", "--out", "{out}", "--driver", "tea"], "driver 'tea' is not installed: must be one of"),
    (["latency", "--driver", "wavefile:{out}.wav"], "senses nothing: a round trip needs an input"),
    (["latency", "--driver", "audio:no such card"], "audio:"),
    (["export", "ultrasonic-swiping", "--out", "{out}"], "device.kind = 'ultrasonic': no board plays it"),
    (["validate", "{tiny}", "--driver", PLATE, "--jobs", "2"], f"must be 1 process where driver = '{PLATE}'"),
    *(
        ([*verb.split(), option, value], f"argument {option}{short}: '{value}': must be a whole number from {bound}")
        for verb, option, short, value, bound in (
            ("identify", "--seed", "", "-1", "0 to 999999999999999999"),
            ("validate --suite accuracy", "--seed", "", "-1", "0 to 999999999999999999"),
            ("validate {tiny}", "--jobs", "/-j", "100000000", "1 to 999"),
            ("export grating-47 --out {out}", "--bands", "", "0", "1 to 64"),
            ("latency --driver tea", "--runs", "", "2.5", "1 to 999"),
        )
    ),
    (["validate", "--suite", "accuracy", "--jobs", "2"], "--suite runs in one process, and writes --json only"),
    (
        ["validate", "--suite", "accuracy", "tea"],
        "['tea']: must be names of cases, or parts of them; there are white, ",
    ),
    (["validate", "--suite", "accuracy", "--driver", "other_plate:no"], "module 'other_plate' has no attribute 'no'"),
]


def test_the_accuracy_suite_plays_chosen_cases_on_a_plate_of_the_users(run, tmp_path):
    """Its callable gets parameters and a finger; one that takes neither is named."""
    report = tmp_path / "a.json"
    suite = ("validate", "--suite", "accuracy", "--driver")
    status, out, _ = run(*suite, "hapticrender.accuracy.plate:SimulatedPlate", "modul", "--json", report)
    assert status == 0
    assert "MISSED" not in out
    figures = json.loads(report.read_text(encoding="utf-8"))["figures"]
    assert [each["case"] for each in figures] == ["modulation"]
    status, _, errors = run(*suite, PLATE, "modulation", "overload")
    assert (status, "overload" in errors[-1]) == (2, True), "it plays on a plate of its own"
    status, _, errors = run(*suite, PLATE, "white")
    assert status == 2
    assert errors[-1].startswith(f"hapticrender: {PLATE}: TypeError: ")


@pytest.mark.parametrize(("arguments", "words"), BAD_ARGUMENTS, ids=range(len(BAD_ARGUMENTS)))
def test_bad_arguments_get_one_line_and_nothing_is_written(run, tiny, tmp_path, arguments, words):
    places = {name: tmp_path / name for name in ("out", "folder", "missing", "binary", "fast")}
    places |= {"tiny": tiny, "cut": tmp_path / "cut.npz"}
    np.savez(places["cut"], header=np.zeros(100))
    os.truncate(places["cut"], 300)
    places["folder"].mkdir()
    places["binary"].write_bytes(bytes(range(256)))
    places["fast"].write_text(TINY.replace("47.0", "2000.0"))
    before = sorted(tmp_path.rglob("*"))
    assert words.format(**places) in complaint(run(*(argument.format(**places) for argument in arguments)))
    assert sorted(tmp_path.rglob("*")) == before
    assert tiny.read_text() == TINY


def test_latency_says_where_a_delay_is_stated(run, tmp_path):
    said = "simulated: nothing is measured or written: the delay is stated in [device] of the scene\n"
    assert run("latency", "--driver", "simulated", "--out", tmp_path / "plate.toml") == (0, said, [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("verb", "folder"), [("render", "out"), ("validate", "out/tiny")])
def test_a_full_disk_gets_one_line_with_the_folder(run, tiny, tmp_path, verb, folder):
    assert run("render", tiny, "--out", tmp_path / "compiled")[0] == 0  # nothing is, while the disk is full
    tiny.write_text(TINY.replace("duration = 0.1", "duration = 5.0"))
    with full_disk(600_000):
        status, _, errors = run(verb, tiny, "--out", tmp_path / "out")
    assert status == 2
    (line,) = [line for line in errors if not line.startswith("1/1")]
    assert line.startswith("hapticrender: ")
    assert "File too large" in line
    assert str(tmp_path / folder) in line
    assert 0 < len(Recording.load(tmp_path / folder / "recording.au")) < 5.0 * 5000


def shell(line, folder, **environment):
    """A command line as a shell runs the console script, without the current folder on Python's path."""
    command = ["bash", "-c", f"{sys.executable} -P -m hapticrender {line}"]
    environment = os.environ | environment
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


REDIRECTED = pytest.mark.skipif(sys.platform == "win32", reason="no such redirections on this system")


@REDIRECTED
def test_status_and_reports_do_not_depend_on_the_output(tmp_path, tiny, monkeypatch):
    """A pipe that nobody reads, and a full disk, which is an error."""
    tiny.write_text(TINY.replace("0.1", "0.5") + "[render]\ntolerance = 1e-6\nsettle = 0.2\n")
    verb = f"validate {tiny} --json {tmp_path}/{{0}}/r.json --junit {tmp_path}/{{0}}/r.xml"
    done = shell(f"{verb.format('pipe')} 2>&1 | true; exit ${{PIPESTATUS[0]}}", tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (1, False)
    with open("/dev/full", "w", buffering=1, encoding="utf-8") as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        assert cli.main(verb.format("full").split()) == 2
    for folder in (tmp_path / "pipe", tmp_path / "full"):
        assert json.loads((folder / "r.json").read_text())["scenes"][0]["verdict"] == "failed"
        assert (folder / "r.xml").exists()


@REDIRECTED
def test_closed_streams_are_no_error_and_a_driver_may_be_a_module_in_the_current_folder(tmp_path, tiny):
    """With -P, and so in the console script, that folder is no part of Python's path."""
    (tmp_path / "mine.py").write_text("from other_plate import OtherPlate as driver")
    done = shell(f"render {tiny} --out out --driver mine:driver <&- >&- 2>&-", tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    assert {path.name for path in (tmp_path / "out").iterdir()} == SCENE_FILES | {"picture.png"}
    assert (tmp_path / "out" / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_kernels_are_not_played_by_python(tmp_path, tiny):
    done = shell(f"render {tiny} --out out", tmp_path, NUMBA_DISABLE_JIT="1")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "NUMBA_DISABLE_JIT is set" in done.stderr


values = st.one_of(
    st.floats().map(repr),
    st.integers().map(str),
    st.sampled_from(["true", "[]", "{}", "[1.0]", '""', '"x"', "1e-6", "0.05", "1e9", "-1", "2000-01-01", "[[]]", "="]),
    st.text(max_size=8).map(json.dumps),
)
scene_texts = st.sampled_from([TINY, builtin_scenes()["sliding"].to_toml()])


@st.composite
def mangled(draw):
    """A scene's TOML with some of its lines changed, doubled, moved or lost."""
    lines = draw(scene_texts).splitlines()
    for _ in range(draw(st.integers(1, 3))):
        i = draw(st.integers(0, len(lines) - 1))
        key = lines[i].partition("=")[0].strip()
        new = draw(st.one_of(values.map(lambda value, key=key: f"{key} = {value}"), st.sampled_from(["", *lines])))
        lines[i] = new
    return "\n".join(shortened(line) for line in lines)


def shortened(line):
    """The same line, with a duration that does not keep a test waiting where it is a sensible one."""
    key, _, value = line.partition("=")
    try:
        long = key.strip() == "duration" and 0.05 < float(value) < 1e5
    except ValueError:
        return line
    return "duration = 0.05" if long else line


@hypothesis.settings(max_examples=30, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture])
@hypothesis.given(text=st.one_of(mangled(), st.text(), st.binary()))
def test_no_scene_file_ever_makes_a_traceback(run, tmp_path_factory, text):
    folder = tmp_path_factory.mktemp("fuzz")
    path = folder / "scene.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    result = run("render", path, "--out", folder / "out")
    if result[0] == 0:
        assert {entry.name for entry in (folder / "out").iterdir()} >= SCENE_FILES
    else:
        assert complaint(result).startswith(f"hapticrender: {path}: ")
        assert not (folder / "out").exists()


def test_a_script_beside_a_clone_finds_the_package(tmp_path):
    """The clone's folder has the package's name, and is none."""
    (tmp_path / "hapticrender").mkdir()
    (tmp_path / "script.py").write_text("import hapticrender; hapticrender.Grating, hapticrender.Player")
    subprocess.run([sys.executable, "-E", "script.py"], cwd=tmp_path, check=True)  # without the tests' PYTHONPATH
