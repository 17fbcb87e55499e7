"""Recordings of other programs: columns by name, with scales, from every format; what does not fit is refused."""

import zipfile
from contextlib import nullcontext

import h5py
import numpy as np
import pytest
from scipy.io import savemat

import hapticrender as hr
from hapticrender.recordings.columns import read_columns

N, RATE = 400, 5000.0
MEANING = {"drive": {"volt 1": -0.2, "volt 2": -0.2}, "sensed": {"adc 1": (122e-9, 8192), "adc 2": (122e-9, 8192)}}


@pytest.fixture
def theirs(rng):
    """Volts, counts, times, a counter that wraps both ways, and a load that is unknown at times."""
    counts = (2**32 - 50 + np.cumsum(rng.integers(-3, 4, N))).astype(np.uint32)
    return {
        "t": np.arange(N) / RATE + 7.0,
        "volt 1": rng.standard_normal(N),
        "volt 2": rng.standard_normal(N),
        "adc 1": rng.integers(0, 16384, N),
        "adc 2": rng.integers(0, 16384, N).astype(np.uint16).astype(np.int16),
        "encoder": counts,
        "load": np.where(np.arange(N) < 9, np.nan, 0.3),
    }


def write(path, columns):
    if path.suffix == ".npz":
        np.savez(path, **columns, note="a text")
    elif path.suffix == ".mat":
        savemat(path, {name.replace(" ", "_"): values for name, values in columns.items()} | {"note": "a text"})
    elif path.suffix in (".h5", ".hdf5"):
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[name] = values
            file["note"] = "a text"
    else:
        between = {".csv": ",", ".txt": "\t"}[path.suffix]
        head = between.join(columns)
        table = np.column_stack([np.asarray(values, float) for values in columns.values()])
        np.savetxt(path, table, "%.17g", between, header=f"# made by another program\n{head}", comments="")


@pytest.mark.parametrize("ending", [".csv", ".txt", ".mat", ".npz", ".h5", ".hdf5"])
def test_every_format_gives_the_columns_in_si(theirs, tmp_path, ending):
    path = tmp_path / f"theirs{ending}"
    write(path, theirs)
    under = (lambda name: name.replace(" ", "_")) if ending == ".mat" else str
    meaning = {key: {under(name): scale for name, scale in of.items()} for key, of in MEANING.items()}
    made = hr.Recording.from_columns(path, time="t", normal_load="load", carriers=[111.0], **meaning)
    for i in range(2):
        np.testing.assert_array_equal(made.drive[:, i], -0.2 * theirs[f"volt {i + 1}"])
        np.testing.assert_array_equal(made.sensed[:, i], 122e-9 * (theirs[f"adc {i + 1}"] - 8192.0))
    np.testing.assert_array_equal(made.normal_load, theirs["load"])
    assert np.isnan(made.position).all()
    assert made.rate == pytest.approx(RATE, rel=1e-12)
    assert (made.header.name, made.bands.frequency.tolist(), made.header.motion_source) == (
        "theirs",
        [111.0],
        "sensors",
    )


def test_it_is_a_recording_like_any_other(theirs, tmp_path):
    fields = {"rate": RATE, "name": "theirs", "sensed_noise": 1e-6, "carriers": np.int64(111)}
    made = hr.Recording.from_columns(theirs, **fields, **MEANING)
    assert made.bands.frequency.tolist() == [111.0]  # one carrier needs no list
    made.save(tmp_path / "ours.npz")
    again = hr.Recording.load(tmp_path / "ours.npz")
    assert again.header.to_json() == made.header.to_json()
    np.testing.assert_array_equal(again.frames[:], made.frames)
    assert again.summary()["verdict"] == "not judged"
    assert again.scene.device == "vt-plate"
    with pytest.raises(hr.SceneError, match="what was made in Python cannot be played"):
        hr.render(again.scene)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_a_counter_is_unwrapped_both_ways(rng, kind):
    steps = rng.integers(-100, 101, 3000)
    true = np.cumsum(steps)
    table = {"count": true.astype(kind), "x": np.zeros(3000)}
    made = hr.Recording.from_columns(table, rate=RATE, drive=[], sensed="x", position={"count": 5e-7})
    np.testing.assert_allclose(np.diff(made.position), 5e-7 * steps[1:], atol=1e-18)
    assert abs(true).max() > np.iinfo(kind).max or kind is not np.uint8  # it did wrap
    assert made.drive.shape == (3000, 0)


def test_tables_and_untitled_columns_have_numbers(tmp_path):
    np.savez(tmp_path / "table.npz", sensed=np.arange(6.0).reshape(2, 3), rate=5000.0)
    (tmp_path / "bare.csv").write_text("0;1\n2;3\n;4\n", encoding="utf-8")
    table, bare = read_columns(tmp_path / "table.npz"), read_columns(tmp_path / "bare.csv")
    assert {name: values.tolist() for name, values in table.items()} == {
        "sensed[0]": [0.0, 1.0, 2.0], "sensed[1]": [3.0, 4.0, 5.0], "rate": [5000.0],
    }  # fmt: skip
    np.testing.assert_array_equal(bare["1"], [0.0, 2.0, np.nan])
    np.testing.assert_array_equal(bare["2"], [1.0, 3.0, 4.0])
    (tmp_path / "tabs.txt").write_text("x\ty\n1\t2\n\t\n \n3\t4 # the last\n", encoding="utf-8")
    np.testing.assert_array_equal(read_columns(tmp_path / "tabs.txt")["y"], [2.0, np.nan, 4.0])  # a row without values


@pytest.mark.parametrize("between", [",", ";", "\t"])
def test_rows_without_values_at_the_end_are_left_out(between, tmp_path):
    """As spreadsheets write them; before the last row with a value they count."""
    rows = ["x y", "1 2", " ", "3 ", " ", " "]
    (tmp_path / "a.csv").write_text("\n".join(rows).replace(" ", between) + "\n \n", encoding="utf-8")
    np.testing.assert_array_equal(read_columns(tmp_path / "a.csv")["x"], [1.0, np.nan, 3.0])


@pytest.mark.parametrize(
    ("text", "titles"),
    [
        ("force, N\tplace, mm\n1\t2\n", ["force, N", "place, mm"]),
        ("a;b,c\n1,2\n", ["a;b", "c"]),
        ("x, m;y, m\n1;2\n", ["x, m", "y, m"]),
        ('"a,b",c\n1,2 # the first\n', ["a,b", "c"]),
    ],
)
def test_the_separator_is_the_one_that_splits_into_numbers(text, titles, tmp_path):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    found = read_columns(tmp_path / "a.csv")
    assert {name: values.tolist() for name, values in found.items()} == dict(zip(titles, [[1.0], [2.0]], strict=True))


SMALL = {"t": np.arange(50) / RATE, "i": np.ones(50), "x": np.ones(50)}
GAP, LEAP = np.delete(np.arange(51), 20) / RATE, np.delete(np.arange(100), slice(30, 80)) / RATE


def without(row, value):
    """A column of ones but for one row."""
    return np.where(np.arange(50) == row, value, 1.0)


@pytest.mark.parametrize(
    ("columns", "meaning", "message"),
    [
        ({}, {"sensed": "y"}, "column 'y' is missing: there are t, i, x"),
        ({"x": np.ones(49)}, {}, "columns differ in length: i 50, x 49 samples"),
        ({"x": without(9, np.nan)}, {}, "sensed: column x: 1 values are not finite, first in row 9"),
        ({"i": np.full(50, "a")}, {}, "column i = .*: must be numbers, one a sample"),
        ({"x": np.ma.masked_less(np.arange(50.0), 3.0)}, {}, "column x = .*: must be numbers, .* none of them masked"),
        ({}, {"rate": None}, "rate is missing: must be a sampling rate in Hz"),
        ({"t": GAP}, {"time": "t", "rate": RATE}, "row 20 is 1 samples off an even grid of 5000 Hz"),
        ({"t": LEAP}, {"time": "t", "rate": None}, "row 30 is 50 samples off an even grid of 5000 Hz"),
        ({"t": SMALL["t"][::-1]}, {"time": "t"}, "time: must rise, but row 1 has 0.0096 s after 0.0098 s"),
        ({}, {"time": "t", "rate": 5100.0}, "off an even grid of 5100 Hz .mean rate 5000 Hz"),
        ({}, {"sensed": {"x": (1, 2, 3)}}, "must be a scale, or a scale and an offset"),
        ({}, {"sensed": {"x": np.nan}}, "scale of x = nan: must be a finite number"),
    ],
)
def test_what_does_not_fit_is_refused(columns, meaning, message):
    with pytest.raises(ValueError, match=message):
        hr.Recording.from_columns(SMALL | columns, **{"drive": "i", "sensed": "x", "rate": RATE} | meaning)


@pytest.mark.parametrize(
    ("jitter", "good"), [(0.45, True), (0.55, False)], ids=["within half a sample", "beyond half a sample"]
)
def test_times_may_jitter_by_half_a_sample(jitter, good):
    columns = SMALL | {"t": SMALL["t"] + np.where(np.arange(50) == 30, jitter / RATE, 0.0)}
    with nullcontext() if good else pytest.raises(ValueError, match="time: row 30 is 0.55 samples off"):
        assert hr.Recording.from_columns(columns, time="t", drive="i", sensed="x").rate == pytest.approx(RATE)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xls", b"", "must be a file that ends in .csv"),
        ("a.npz", b"no such thing", "not an NPZ file"),
        ("a.csv", b"", "a.csv: the file is empty, or has comments alone: must be lines of numbers"),
        ("a.csv", b"x,y\n,\n", "a.csv: nothing follows the titles in line 1: must be lines of numbers"),
        ("a.csv", b"x,x\n1,2\n", "one different one for each column"),
        ("a.csv", b"x,y\n1,2,3\n", "a.csv, line 2: 3 fields: must be 2, one a column"),
        ("a.csv", b"x,y\n1,2\n3\n", "a.csv, line 3: 1 fields: must be 2, one a column"),
        ("a.csv", b"# of mine\nx,y\n1,2\n\n3,4.l\n", "a.csv, line 5, column y: '4.l': must be a number, or empty"),
        ("a.csv", b"x;y\n1;2\n3;4,5\n", "a.csv, line 3, column y: '4,5': must be a number, or empty"),
        ("a.csv", b"x;y\n1,5;2\n", "a.csv, line 2, column x: '1,5': must be a number, .*, decimals after a point"),
        ("a.csv", b"x,y\n1,1_0\n", "a.csv, line 2, column y: '1_0': must be a number, or empty"),
        ("a.csv", "x,y\n1,2\n".encode("utf-16"), "a.csv: byte 0 is no UTF-8 text: save the table as text in UTF-8"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_columns(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        read_columns(tmp_path / "missing.csv")


@pytest.mark.parametrize("ending", [".npz", ".mat", ".h5"])
def test_a_file_that_was_cut_is_refused(theirs, tmp_path, ending):
    path = tmp_path / f"cut{ending}"
    write(path, theirs)
    whole = path.read_bytes()
    path.write_bytes(whole[:-600])
    with pytest.raises(ValueError, match=f"cut{ending}: damaged, or not an?"):
        read_columns(path)
    if ending == ".npz":  # one bit of the data: the checksum of the archive
        path.write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])
        with pytest.raises(ValueError, match="cut.npz: damaged, or not an NPZ file of arrays .Bad CRC-32"):
            read_columns(path)


def test_only_counters_wrap(tmp_path):
    """Offset-binary samples of a converter swing about the middle of their range; an encoder goes round."""
    raw = np.array([32768, 32769, 32770, 0, 65535, 32768], ">u2")
    table = {"dac": raw, "adc": raw.astype(np.uint16), "turns": np.array([65534, 65535, 0, 1, 0, 65535], ">u2")}
    made = hr.Recording.from_columns(
        table, rate=RATE, drive={"dac": (1.0, 32768)}, sensed={"adc": (1.0, 32768)}, position={"turns": 1.0}
    )
    for signal in (made.drive, made.sensed):
        np.testing.assert_array_equal(signal[:, 0], [0, 1, 2, -32768, 32767, 0])
    np.testing.assert_array_equal(made.position - made.position[0], [0, 1, 2, 3, 2, 1])


def test_what_is_no_array_and_what_lies_elsewhere_is_no_reason_to_refuse_a_file(tmp_path):
    """A note in an NPZ file, and a virtual data set of an HDF5 file; a recording of our own may have neither."""
    path = tmp_path / "a.npz"
    np.savez(path, x=np.arange(4.0))
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("readme.txt", "four numbers")
    assert list(read_columns(path)) == ["x"]
    with h5py.File(tmp_path / "source.h5", "w") as file:
        file["t"] = np.arange(5.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        layout = h5py.VirtualLayout(shape=(5,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "source.h5"), "t", shape=(5,))
        file.create_virtual_dataset("t", layout)
        file["x"] = np.ones(5)
    np.testing.assert_array_equal(read_columns(tmp_path / "a.h5")["t"], np.arange(5.0))
