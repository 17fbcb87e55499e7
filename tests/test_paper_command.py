"""`hapticrender paper`: its numbers against FACTS, its verdicts where a number is wrong, and what it writes."""

import csv
import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from hapticrender import cli
from hapticrender.paper import finger as paper_finger
from hapticrender.paper import formulas as paper_formulas
from hapticrender.paper import reproduce as paper
from hapticrender.paper import runs as paper_runs
from hapticrender.paper.claims import Claim, Item, Missing
from hapticrender.plants.vibrotactile import PlateParameters


@pytest.fixture(scope="module")
def items():
    """Every item, computed once."""
    return {name: compute() for name, compute in paper.ITEMS.items()}


def claim(items, name, words):
    """The one claim of an item whose quantity begins with `words`."""
    (found,) = [each for each in items[name].claims if each.what.startswith(words)]
    return found


def column(items, name, table, words):
    """The one column of an item's table whose name begins with `words`."""
    (found,) = [values for key, values in items[name].tables[table].items() if key.startswith(words)]
    return found


EXAMPLE = {"what": "order", "paper": 6.0, "ours": 4.0, "within": 0.5}


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"ours": 6.5}, "reproduced"),
        ({"ours": 6.51}, "not reproducible"),
        ({"check": 4.5}, "corrected"),
        ({"check": 4.51}, "not reproducible"),
        ({"ours": 6.0, "check": 0.0}, "reproduced"),
        ({"ours": float("nan"), "check": float("nan")}, "not reproducible"),
        ({"relation": "<="}, "reproduced"),
        ({"relation": "<=", "ours": 6.1}, "not reproducible"),
        ({"relation": ">="}, "not reproducible"),
        ({"relation": ">=", "check": 4.0}, "corrected"),
    ],
)
def test_a_verdict_is_a_comparison(changes, verdict):
    assert Claim(**EXAMPLE | changes).verdict == verdict


def test_an_item_is_as_good_as_its_worst_claim():
    good, mended, bad = Claim(**EXAMPLE | {"ours": 6.0}), Claim(**EXAMPLE, check=4.0), Claim(**EXAMPLE)
    for claims, verdict in (((good,), 0), ((good, mended), 1), ((bad, mended, good), 2)):
        item = Item(name="x", title="", where="", claims=claims, tables={})
        assert item.verdict == ("reproduced", "corrected", "not reproducible")[verdict]
    assert item.reason == "1 of 3 as printed; not reproducible: order; corrected: order"
    assert Missing(where="", title="", needs="13 participants").reason == "needs 13 participants"


def test_what_cannot_be_judged_is_refused():
    with pytest.raises(ValueError, match="within=nan Hz must be finite and >= 0"):
        Claim(**EXAMPLE | {"within": float("nan"), "unit": "Hz"})
    with pytest.raises(ValueError, match="relation='<' must be one of =, <=, >="):
        Claim(**EXAMPLE | {"relation": "<"})
    with pytest.raises(ValueError, match="x: claims must not be empty"):
        Item(name="x", title="", where="", claims=(), tables={})
    with pytest.raises(ValueError, match="columns of table 'a' must be of one length"):
        Item(name="x", title="", where="", claims=(Claim(**EXAMPLE),), tables={"a": {"b": np.ones(2), "c": np.ones(3)}})


CORRECTED = {  # FACTS section 1, "Corrections to the paper", those that are a number; and one of the printed p values
    "controller": {"order of the exact C", '"sensitivity function" at 0 Hz'},
    "commanded": {"accuracy: wobble of the plate through the loop"},
    "frequencies": {"amplitude at 170 Hz off by, centre, free plate"},
    "press": {"1 µm at 20 Hz, off by", "10 µm at 20 Hz, off by"},
    "plate": {"rocking mode by the equations of F1, F2", "heave mode by the equations of F1, F2"},
    "loaded": {
        "largest gain under a finger over that without",
        "bandwidth lost to an equal load, at 20 Hz",
    },
    "admittance": {"|V_s/F| at 72 Hz by the force balance"},
    "statistics": {"log10 p of similarity over frequency, t(104) = 4.03"},
}


def test_all_is_reproduced_but_the_corrections_of_the_facts(items):
    for name, item in items.items():
        verdicts = {each.what: each.verdict for each in item.claims}
        assert {what for what, verdict in verdicts.items() if verdict == "corrected"} == CORRECTED.get(name, set())
        assert "not reproducible" not in verdicts.values()


@pytest.mark.parametrize(
    ("name", "words", "printed", "digit"),
    [
        ("controller", "order of the exact C", 4, 1),
        ("controller", "bandwidth of T, C exact", 5.00, 0.01),
        ("controller", "bandwidth of T, C 2nd order", 4.87, 0.01),
        ("controller", "sensing error in the drive at 20 Hz, C exact", 0.097, 0.001),
        ("controller", "sensing error in the drive at 20 Hz, C 2nd order", 0.122, 0.001),
        ("plate", "rocking mode", 147.27, 0.01),
        ("plate", "resonance", 189.38, 0.01),
        ("loaded", "largest gain", 1.94, 0.01),
        ("loaded", "the same at the resonance", 0.26, 0.01),
        ("admittance", "|V_s/F| at 72 Hz", 0.574, 0.001),
        ("press", "1 µm at 20 Hz", -100, 1),
        ("commanded", "mean line of the spectrum", 0.0102, 0.0001),
    ],
)
def test_numbers_are_those_of_the_facts(items, name, words, printed, digit):
    """FACTS sections 1, 3 and 4, to their last printed digit."""
    assert abs(claim(items, name, words).ours - printed) <= digit / 2


@pytest.mark.parametrize(
    ("name", "words", "printed", "digit"),
    [("plate", "rocking mode", 185.0, 0.1), ("admittance", "|V_s/F| at 72 Hz", 0.574 * (1 - 0.35), 0.574 * 0.01)],
)
def test_the_printed_equations_err_as_the_facts_say(items, name, words, printed, digit):
    """FACTS section 1: rocking at 185.0 Hz; V_s/F off by up to 35 %."""
    assert abs(claim(items, name, words).paper - printed) <= digit / 2


def test_an_equal_load_costs_half_the_bandwidth_at_the_resonance_only(items):
    """FACTS section 1: 3.98 to 2.06 Hz, a simulation: 48.2 %, to half a percent; unchanged elsewhere."""
    assert claim(items, "loaded", "bandwidth lost to an equal load, at the res").ours == pytest.approx(48.2, abs=0.5)
    assert claim(items, "loaded", "bandwidth lost to an equal load, at 20").ours == pytest.approx(0, abs=0.05)


def test_velocities_and_impedances_are_those_of_the_facts(items):
    """FACTS section 4; at 261 Hz it prints 0.606, 0.60546 rounded twice."""
    printed = [0.796, 1.094, 0.910, 0.574, 0.484, 0.545, 0.605, 0.625]
    found = column(items, "admittance", "at the eight frequencies", "V_s/F")
    np.testing.assert_allclose(found, printed, rtol=0, atol=0.0005)
    stiffness = [each.ours for each in items["admittance"].claims if each.what.startswith("stiffness")]
    assert stiffness == pytest.approx([158, 158], abs=0.5)
    light, second = (
        column(items, "impedance", "at the eight frequencies", f"light, {order}") for order in ("4th", "2nd")
    )
    beyond = dict(zip(paper_formulas.FREQUENCIES, second / light - 1, strict=True))
    assert [beyond[111], beyond[170], beyond[400]] == pytest.approx([0.31, 1.29, 5.27], abs=0.005)
    assert claim(items, "impedance", "2nd order for 4th, heavy").ours == pytest.approx(11, abs=0.5)


def test_simulated_amplitudes_are_those_of_the_facts(items):
    """FACTS section 2 row 4: centre +129 %, far end +419 %, without noise; here with 1 um on 10 um over 2 s.

    The mean amplitude of each side wobbles by 0.045 um over sqrt(2 B 2 s) = 4.5: 0.1 %, times the 2.3 and 5.2 of the
    centre and the far end, 3 sigma: 1 and 2 %.
    """
    off = [column(items, "frequencies", "free", f"paper, {place}")[5] for place in ("centre", "end 1", "end 2")]
    assert off[0] == pytest.approx(129, abs=1)
    assert max(off) == pytest.approx(419, abs=2)
    wobble = claim(items, "commanded", "accuracy")
    assert 0.041 <= wobble.ours <= 0.049  # FACTS section 1 has 0.041 to 0.045; 60 s of it are known to 4 %, 2 sigma
    assert claim(items, "press", "10 µm at 20 Hz").ours == pytest.approx(-7.9, abs=0.3)  # as tests/test_paper.py has it


def test_default_holds_every_frequency_under_a_heavy_finger(items):
    """FACTS section 7: errors up to 10 % lie under every just noticeable difference."""
    for place in ("centre", "end 1", "end 2"):
        assert np.abs(column(items, "frequencies", "heavy", f"h2, {place}")).max() < 10


def verdict(item, words):
    (found,) = [each.verdict for each in item.claims if each.what.startswith(words)]
    return found


def test_a_wrong_plate_loses_its_verdicts(monkeypatch):
    """Inertia 10 % off in the model only: the equations of F1 and F2 no longer back it; mass 10 % off: 180 Hz."""
    wrong = PlateParameters(mass=35.2e-3)
    monkeypatch.setattr(paper_formulas, "PlateParameters", lambda: wrong)
    assert verdict(paper_formulas.plate(), "resonance") == "not reproducible"
    right = PlateParameters()
    monkeypatch.setattr(paper_formulas, "PlateParameters", lambda: right)
    stray = PlateParameters(inertia=4.4e-5).modes()
    monkeypatch.setattr(PlateParameters, "modes", lambda self: stray)
    assert verdict(paper_formulas.plate(), "rocking") == "not reproducible"


def test_a_wrong_finger_loses_its_verdicts(monkeypatch):
    """A phalanx of double damping in ours alone: the paper's polynomials no longer back it, nor give its impedance."""
    printed = paper_finger._printed_admittances
    right = paper_finger.LIGHT
    monkeypatch.setattr(paper_finger, "_printed_admittances", lambda _, frequency: printed(right, frequency))
    monkeypatch.setattr(paper_finger, "LIGHT", replace(right, phalanx_damping=2.0))
    assert verdict(paper_finger.admittance(), "|V_s/F| at 72 Hz") == "not reproducible"
    assert verdict(paper_finger.impedance(), "printed Z_s") == "not reproducible"


def test_a_wrong_controller_loses_its_verdicts(monkeypatch):
    wrong = paper_formulas.reduced_controller(7.0, 10.0)
    monkeypatch.setattr(paper_formulas, "exact_controller", lambda *_: wrong)
    item = paper_formulas.controller()
    assert verdict(item, "order") == "not reproducible"
    assert verdict(item, "bandwidth of T, C exact") == "not reproducible"


def test_a_method_that_misses_loses_its_verdict(monkeypatch):
    """A tenth of every amplitude lost, beyond the 5 % that "precise" is read as."""
    honest = paper_runs._amplitudes
    monkeypatch.setattr(paper_runs, "_amplitudes", lambda *arguments: 0.9 * honest(*arguments))
    monkeypatch.setattr(paper_runs, "FREQUENCIES", np.array([111.0]))
    assert paper_runs.frequencies().verdict == "not reproducible"


@pytest.fixture
def run(capsys):
    def run(*arguments):
        status = cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def test_the_command_writes_numbers_pictures_and_a_page(tmp_path, run):
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    status, told, _ = run("paper", "--out", out)
    assert status == 0
    assert f"page: {out / 'index.html'}" in told
    report = json.loads((out / "paper.json").read_text(encoding="utf-8"))
    page = (out / "index.html").read_text(encoding="utf-8")
    assert [item["name"] for item in report["items"]] == list(paper.ITEMS)
    for item in report["items"]:
        assert (out / f"{item['name']}.png").read_bytes().startswith(b"\x89PNG")
        assert f'<img src="{item["name"]}.png"' in page
        for table in item["tables"]:
            head, *rows = csv.reader((out / table).read_text(encoding="utf-8").splitlines())
            assert rows
            assert {len(row) for row in rows} == {len(head)}
            assert f'href="{table}"' in page
    assert {each["verdict"] for each in report["missing"]} == {"not reproducible"}
    assert told.count("needs 13 participants") == 6
    left = {path.name for path in out.iterdir()} - {f"{item['name']}.png" for item in report["items"]}
    assert left == {"index.html", "paper.json"} | {table for item in report["items"] for table in item["tables"]}


def test_without_matplotlib_the_numbers_are_written_and_a_hint_is_given(tmp_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(paper.reproduce, "__kwdefaults__", {"names": ("plate",), "progress": None})
    (tmp_path / "plate.png").write_bytes(b"of an earlier run")
    status, told, _ = run("paper", "--out", tmp_path)
    assert status == 0
    assert cli.PICTURES_HINT in told
    assert not (tmp_path / "plate.png").exists()
    assert (tmp_path / "plate-response.csv").exists()
    assert "No picture: matplotlib is not installed." in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_what_it_cannot_do_is_refused_before_anything_is_written(tmp_path, run):
    (tmp_path / "file").write_text("")
    status, _, error = run("paper", "--out", tmp_path / "file")
    assert status == 2
    assert "is a file, must be a folder" in error
    with pytest.raises(ValueError, match="'figure': must be one of controller, transform"):
        paper.reproduce(tmp_path / "new", names=("figure",))
    assert not (tmp_path / "new").exists()
