"""What happened is kept while it happens, and leaves in formats that other tools open."""

import json
import os
import pickle
import re
import signal
import subprocess
import sys

import hypothesis
import numpy as np
import pytest
import soundfile
from hypothesis import strategies as st
from synthetic import RATE, make_bands, make_recorder, make_signals, times

import hapticrender as hr
from hapticrender.recordings import formats, journal
from hapticrender.recordings.formats import MissingExtra
from hapticrender.recordings.journal import Header
from hapticrender.recordings.recording import Recording

UM = 1e-6
SIGNALS = ("drive", "sensed", "motion", "position", "normal_load", "target", "flags", "reference")


@pytest.fixture
def bands():
    return make_bands([170.0, 0.0], [10 * UM, 3e-6 * np.exp(1j / 3)], wavenumber=[0.0, 1 / 3e-4], phase=[0.1, 2 / 3])


@pytest.fixture
def signals(bands, rng):
    """Half a second of everything, with a lifted finger and numbers that use all their digits."""
    time = times(0.5)
    position = np.where(time < 0.3, 0.02 * np.sin(7 * time), np.nan)
    noise = UM * rng.standard_normal((len(time), 3))
    made = make_signals(bands, bands.envelope, duration=0.5, position=position, extra=noise)
    made["flags"][100:200] = 5
    return made


@pytest.fixture
def recording(bands, signals):
    recorder = make_recorder(None, bands)
    recorder.append(**signals)
    return recorder.finish()


def assert_same(one, other, names=SIGNALS):
    for name in names:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.header.to_json() == other.header.to_json()


@pytest.mark.parametrize("journal", [None, "run.au"])
def test_any_split_into_blocks_gives_the_same_recording(recording, bands, signals, tmp_path, rng, journal):
    with make_recorder(journal and tmp_path / journal, bands) as recorder:
        edges = [0, *np.sort(rng.integers(0, 2500, 20)).tolist(), 2500]
        for start, stop in zip(edges[:-1], edges[1:], strict=True):
            recorder.append(**{name: values[start:stop] for name, values in signals.items()})
        assert_same(recorder.finish(), recording)


def test_the_annotation_is_json_that_names_every_column(bands, signals, tmp_path):
    with make_recorder(tmp_path / "run.au", bands) as recorder:
        recorder.append(**signals)
    data = (tmp_path / "run.au").read_bytes()
    assert data[:4] == b".snd"
    offset, size, encoding, rate, columns = (int.from_bytes(data[i : i + 4], "big") for i in range(4, 24, 4))
    assert (size, encoding, rate, columns) == (0xFFFFFFFF, 7, 5000, 15)
    assert offset % 8 == 0
    note = json.loads(data[24:offset].rstrip(b"\0"))
    names = [channel["name"] for channel in note["channels"]]
    assert names == [
        *("drive 1", "drive 2", "sensed 1", "sensed 2", "motion centre", "motion end 1", "motion end 2"),
        *("position", "normal load", "flags", "reference", "target 1 re", "target 1 im", "target 2 re", "target 2 im"),
    ]
    units = dict.fromkeys(names, "m") | {"drive 1": "A", "drive 2": "A", "normal load": "N", "flags": "1"}
    assert [channel["unit"] for channel in note["channels"]] == list(units.values())
    assert (note["method"], note["seed"], note["drive_limit"]) == ("paper", 7, 3.0)


@pytest.mark.parametrize("cut", [1, 120])
def test_a_frame_cut_short_is_left_out(bands, signals, tmp_path, cut):
    path = tmp_path / "run.au"
    with make_recorder(path, bands) as recorder:
        recorder.append(**signals)
    os.truncate(path, path.stat().st_size - cut)  # a frame has 15 columns, 120 bytes
    kept = 2500 - -(-cut // 120)
    loaded = Recording.load(path)
    assert len(loaded) == kept
    np.testing.assert_array_equal(loaded.drive, signals["drive"][:kept])
    assert len(soundfile.read(path)[0]) == kept


CHILD = """
import sys
from synthetic import make_bands, make_recorder, make_signals
bands = make_bands(100.0, 1e-5)
signals = make_signals(bands, bands.envelope, duration=0.01)
recorder = make_recorder(sys.argv[1], bands, duration=1000.0)
done = 0
while True:
    signals["drive"][:, 0] = range(done, done + 50)
    done += 50
    recorder.append(**signals)
    print(done, flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_killed_process_leaves_all_but_its_last_quarter_second(tmp_path):
    path = tmp_path / "run.au"
    command = [sys.executable, "-c", CHILD, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        appended = 0
        while appended < 3 * RATE:
            line = child.stdout.readline()
            assert line, "the child died before it was killed"
            appended = int(line)
        child.kill()
    loaded = Recording.load(path)
    assert len(loaded) > appended - RATE / 4
    np.testing.assert_array_equal(loaded.drive[:, 0], np.arange(len(loaded)))
    heard, _ = soundfile.read(path)
    np.testing.assert_array_equal(heard[:, 0], np.arange(len(heard)))
    assert len(heard) == len(loaded)
    assert loaded.summary()["bands"][0]["target"] == pytest.approx(1e-5)
    assert loaded.summary()["notes"][0].startswith("the run ended after ")


def test_what_is_not_in_the_file_is_a_quarter_second_at_most_with_the_block_that_comes(bands, signals, tmp_path):
    path, block, left = tmp_path / "run.au", 60, []
    with make_recorder(path, bands) as recorder:
        for count in range(block, 2500, block):
            recorder.append(**{name: values[:block] for name, values in signals.items()})
            left.append(count - len(Recording.load(path)))
    assert RATE / 4 - 2 * block < max(left) <= RATE / 4 - block


def test_an_older_journal_stays_until_a_run_has_begun(bands, signals, tmp_path):
    path = tmp_path / "run.au"
    with make_recorder(path, bands) as recorder:
        recorder.append(**{name: values[:5] for name, values in signals.items()})
    older = path.read_bytes()
    with pytest.raises(RuntimeError, match="bad input"), make_recorder(path, bands):
        raise RuntimeError("bad input")
    assert path.read_bytes() == older
    with make_recorder(path, bands) as recorder:
        with pytest.raises(ValueError, match=r"drive has shape \(2500, 1\), expected 2500 samples, 2 columns"):
            recorder.append(**signals | {"drive": signals["drive"][:, :1]})
        assert path.read_bytes() == older
        recorder.append(**signals)
    assert len(Recording.load(path)) == 2500


@pytest.mark.parametrize("held", [b"notes of mine", b".snd" + bytes(99)])
def test_what_is_no_journal_is_not_replaced(bands, tmp_path, held):
    path = tmp_path / "mine.au"
    path.write_bytes(held)
    with pytest.raises(ValueError, match=r"mine\.au: is there and no recording of this library: choose another name"):
        make_recorder(path, bands)
    assert path.read_bytes() == held


@pytest.mark.parametrize("damage", [lambda whole: whole[:200].replace(b'"version": 2', b'"version": 1'), lambda _: b""])
def test_an_empty_a_damaged_or_an_older_journal_is_replaced(recording, bands, signals, tmp_path, damage):
    path = tmp_path / "run.au"
    recording.save(path)
    path.write_bytes(damage(path.read_bytes()))
    with make_recorder(path, bands) as recorder:
        recorder.append(**signals)
    assert_same(recorder.finish(), recording)


def test_a_journal_that_is_being_written_is_not_replaced(recording, bands, signals, tmp_path):
    path = tmp_path / "live.au"
    with make_recorder(path, bands) as recorder:
        recorder.append(**signals)
        read, words = Recording.load(path), "is being recorded: end that first"
        for act in (lambda: read.save(path), lambda: recording.save(path), make_recorder(path, bands).begin):
            with pytest.raises(ValueError, match=words):
                act()
        read.save(tmp_path / "other.au")
        recorder.append(**signals)
    assert len(recorder.finish()) == 5000
    read.save(path)
    assert len(Recording.load(path)) == 2500


def test_a_journal_that_is_the_texture_is_not_replaced(tmp_path):
    path = tmp_path / "run.au"
    hr.render(hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=1e-5), duration=0.2), journal=path)
    before, scene = path.read_bytes(), hr.Scene(texture=hr.Recorded(file=path, amplitude=1e-5), duration=0.2)
    with pytest.raises(ValueError, match=r"run\.au: would overwrite the scene's texture: choose another name"):
        hr.render(scene, journal=path)
    with hr.Player(paced=False) as player:
        player.play(scene.texture)
        with pytest.raises(ValueError, match="would overwrite the scene's texture"):
            player.record(path)
    assert path.read_bytes() == before


def test_a_new_run_leaves_an_open_recording_of_the_old_one_alone(bands, signals, tmp_path):
    for count in (2500, 5):
        with make_recorder(tmp_path / "run.au", bands) as recorder:
            recorder.append(**{name: values[:count] for name, values in signals.items()})
        if count == 2500:
            old = recorder.finish()
    assert (len(old), len(recorder.finish())) == (2500, 5)
    np.testing.assert_array_equal(old.drive, signals["drive"])


@pytest.mark.parametrize("suffix", [".au", ".npz", ".h5", ".mat", ".HDF5"])
def test_what_is_saved_loads_the_same(recording, tmp_path, suffix):
    if suffix.lower() in (".h5", ".hdf5"):
        pytest.importorskip("h5py", reason="HDF5 is an extra")
    recording.save(tmp_path / f"run{suffix}")
    loaded = Recording.load(tmp_path / f"run{suffix}")
    assert_same(loaded, recording)
    assert loaded.summary() == recording.summary()


def test_a_sound_file_of_a_run_is_not_loaded_but_its_journal(tmp_path):
    with pytest.raises(
        ValueError, match=r"'\.wav' cannot be read \(load the \.au of the run instead\), known are \.au"
    ):
        Recording.load(tmp_path / "run.wav")


@pytest.mark.parametrize("verb", ["save", "load"])
def test_an_unknown_suffix_lists_the_known_ones_and_a_missing_folder_is_named(recording, tmp_path, verb):
    with pytest.raises(ValueError, match=r"'\.mp3' cannot be .*, known are \.au,.* \.npz"):
        getattr(recording, verb)(tmp_path / "run.mp3")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError) as refused:
        recording.save(tmp_path / "no" / "run.npz")
    assert refused.value.filename == str(tmp_path / "no" / "run.npz")


def test_hdf5_without_h5py_names_the_extra(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "old.h5").touch()
    for deed, name in ((recording.save, "run.h5"), (Recording.load, "old.h5")):
        with pytest.raises(MissingExtra, match=r"pip install 'hapticrender\[hdf5\]'"):
            deed(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["old.h5"]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("left", [0.0, 0.999])
def test_a_truncated_file_is_refused_by_name(recording, tmp_path, suffix, left):
    if suffix == ".h5":
        pytest.importorskip("h5py", reason="HDF5 is an extra")
    path = tmp_path / f"run{suffix}"
    recording.save(path)
    os.truncate(path, int(left * path.stat().st_size))
    with pytest.raises(ValueError, match=rf"run\{suffix}: not a recording \(\S") as refused:
        Recording.load(path)
    assert len(str(refused.value).splitlines()) == 1


def test_sound_for_listening_states_its_scale_and_is_silent_where_it_is_no_number(tmp_path):
    wave = np.r_[0.3 * np.sin(0.1 * np.arange(1000)), np.nan, np.inf][:, None]
    path = tmp_path / "drive.wav"
    assert formats.write_sound(path, wave, 4009.8, "A") == 0.5
    with soundfile.SoundFile(path) as file:
        assert (file.comment, file.samplerate, file.subtype) == ("full scale = 0.5 A", 4010, "PCM_24")
        np.testing.assert_allclose(0.5 * file.read(), np.nan_to_num(wave, posinf=0.0)[:, 0], atol=0.5 * 2.0**-23)


def test_csv_has_a_header_names_units_and_ten_digits(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "CHUNK_VALUES", 999)
    recording.save(tmp_path / "run.csv")
    comment, titles = (tmp_path / "run.csv").read_text(encoding="utf-8").splitlines()[:2]
    assert Header.from_json(comment[2:]).to_json() == recording.header.to_json()
    assert titles.split(",")[:3] == ["time (s)", "drive 1 (A)", "drive 2 (A)"]
    loaded = Recording.load(tmp_path / "run.csv")
    np.testing.assert_allclose(loaded.frames, recording.frames, rtol=1e-9)
    assert loaded.scene == recording.scene


def test_foreign_tools_find_time_and_rate(recording, tmp_path):
    h5py = pytest.importorskip("h5py", reason="HDF5 is an extra")
    from scipy.io import loadmat

    recording.save(tmp_path / "run.mat")
    mat = loadmat(tmp_path / "run.mat")
    recording.save(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5") as file:
        assert (file["time"].attrs["unit"], file["rate"].attrs["unit"]) == ("s", "Hz")
        for found in (mat, file):
            np.testing.assert_array_equal(np.ravel(found["time"]), recording.time)
            assert np.ravel(found["rate"])[0] == RATE
            for name in SIGNALS:
                np.testing.assert_array_equal(np.squeeze(found[name]), np.squeeze(getattr(recording, name)))


def test_a_journal_cut_while_it_is_open_is_an_error_not_a_crash(bands, signals, tmp_path):
    with make_recorder(tmp_path / "run.au", bands) as recorder:
        recorder.append(**signals)
    recording = recorder.finish()
    os.truncate(tmp_path / "run.au", 5000)
    with pytest.raises(ValueError, match=r"run\.au: was cut to fewer than 2500 samples while it was open"):
        recording.drive  # noqa: B018


@pytest.mark.parametrize(("start", "step"), [(0, 1), (7, 3), (2400, 900), (3000, 1)])
def test_pieces_of_a_journal_are_those_of_memory(recording, tmp_path, monkeypatch, start, step):
    monkeypatch.setattr(journal, "CHUNK_VALUES", 1400)
    recording.save(tmp_path / "run.au")
    loaded = Recording.load(tmp_path / "run.au")
    for name in SIGNALS:
        for stop in (None, 2450, 9999):
            expected = getattr(recording, name)[start:stop:step]
            np.testing.assert_array_equal(loaded.read(name, start, stop, step), expected)
            np.testing.assert_array_equal(recording.read(name, start, stop, step), expected)
    assert_same(pickle.loads(pickle.dumps(loaded)), recording)


CHANGES = [
    ({"drive_channels": 2**31}, "drive_channels = 2147483648: must be an integer >= 0 and <= 1024"),
    ({"rate": 1e400}, "rate = inf: must be a finite number >= 0.001 and <= 1e+09 Hz"),
    ({"name": "a\x1b[2J"}, "name = 'a\\x1b[2J': must be a text of printable characters"),
    ({"tolerance": None}, "tolerance is missing"),
    ({"bands": {"frequency": [1], "wavenumber": [0, 1], "phase": [0]}}, "wavenumber has shape (2,)"),
    *(
        ({"bands": {"frequency": [100.0], "wavenumber": [0], "phase": [0]} | bad}, message)
        for bad, message in (
            ({"frequency": ["100"]}, "bands.frequency = ['100']: must be a list of"),
            ({"frequency": [True]}, "bands.frequency = [True]: must be a list of"),
            ({"frequency": [1e300]}, "bands.frequency[0] = 1e+300: must be a finite number >= -1e+12 and <= 1e+12"),
            ({"phase": None}, "bands.phase is missing: must be a list of"),
            ({"envelope": [1.0, 0.0]}, "bands.envelope = [1.0, 0.0]: must be pairs of real and imaginary part"),
            ({"envelope": [[1.0]]}, "bands.envelope = [[1.0]]: must be pairs of real and imaginary part"),
        )
    ),
    ({"sensed_noise": [0.0, 1.0]}, "sensed_noise = (0.0, 1.0): must be one number, or one a place"),
    ({"version": 99}, "version = 99: must be 2"),
    ({"format": "theirs"}, "(format = "),
    ({"colour": 1}, "colour = 1: unknown key"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=range(len(CHANGES)))
def test_every_field_of_a_header_is_checked(recording, change, message):
    values = json.loads(recording.header.to_json()) | change
    with pytest.raises(ValueError, match=re.escape(message)) as refused:
        Header.from_json(json.dumps(values), "x.au")
    assert str(refused.value).startswith("x.au: not a recording of this library (")
    assert len(str(refused.value)) < 300


junk = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.integers(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)  # fmt: skip


@hypothesis.settings(max_examples=60, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture])
@hypothesis.given(data=st.data())
def test_no_header_makes_anything_but_a_header_or_a_value_error(recording, data):
    values = json.loads(recording.header.to_json())
    place = values if data.draw(st.booleans()) else values["bands"]
    place[data.draw(st.sampled_from(sorted(place)))] = data.draw(junk)
    try:
        header = Header.from_json(json.dumps(values))
    except ValueError:
        return
    assert Header.from_json(header.to_json()).to_json() == header.to_json()


def test_files_that_would_grow_in_memory_or_do_not_fit_their_header_are_refused(recording, tmp_path):
    h5py = pytest.importorskip("h5py", reason="HDF5 is an extra")
    header = recording.header.to_json()
    np.savez_compressed(tmp_path / "bomb.npz", header=np.array(header), drive=np.zeros((1_000_000, 2)))
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file["header"] = header
        file.create_dataset("drive", (10**8, 2), "f8", chunks=(1000, 2), compression="gzip")  # 1.6 GB of nothing
        file["unasked"] = np.zeros(3)
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["header"] = header
        file["drive"] = h5py.ExternalLink("bomb.h5", "/unasked")
    from scipy.io import savemat

    savemat(tmp_path / "bomb.mat", {"header": header, "drive": np.zeros((1_000_000, 2))}, do_compression=True)
    signals = {name: recording.read(name) for name in recording.header.slices} | {"header": np.array(header)}
    np.savez(tmp_path / "shape.npz", **signals | {"motion": np.zeros((5, 3))})
    for name, message in (
        ("bomb.npz", "drive has .* bytes, the file"),
        ("bomb.h5", "drive has .* bytes, the file"),
        ("bomb.mat", "drive has .* bytes, the"),
        ("link.h5", "drive: is missing, or no data set of this file"),
        ("shape.npz", "motion has shape"),
    ):
        with pytest.raises(ValueError, match=f"{name}: not a recording .{message}"):
            Recording.load(tmp_path / name)
