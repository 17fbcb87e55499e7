"""The benchmarks' own parts: C references agree with the library, pairing counts right, verdicts go the right way."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture
def benchmarks(monkeypatch):
    """Import path of the benchmarks, and a clean table of modules after them."""
    monkeypatch.syspath_prepend(str(FOLDER))
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if str(FOLDER) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.mark.parametrize(("precision", "bound"), [("double", 1e-9), ("single", 1e-4)])
def test_the_c_references_are_the_same_controller(benchmarks, precision, bound, rng):
    """Drive of 20 bands over 1000 samples of noise: library, C tuned by hand, and naive C."""
    import native
    import scenes

    try:
        native.compiler()
    except native.NoCompiler as missing:
        pytest.skip(str(missing))
    controller = scenes.polar(20, precision)
    sensed, nothing = 1e-6 * rng.standard_normal((1000, 2)), np.zeros(1000)
    sides = np.ascontiguousarray(sensed @ controller.tables.listen.T)
    tuned = native.TunedPolar(controller, {"double": np.float64, "single": np.float32}[precision])
    expected = native.NaivePolar(controller).run(sides)
    assert abs(expected).max() > 0
    for found in (controller.run(sensed, nothing, nothing)[0], tuned.run(sides)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=bound * abs(expected).max())


@pytest.mark.parametrize(("precision", "bound"), [("double", 1e-6), ("single", 1e-3)])
def test_the_c_reference_in_blocks_is_the_same_controller(benchmarks, precision, bound, rng):
    """Drive of 20 bands over 100 blocks of noise, from the second block on; the drive's steps are made negligible."""
    import native
    import scenes

    try:
        native.compiler()
    except native.NoCompiler as missing:
        pytest.skip(str(missing))
    controller = scenes.in_blocks(20, precision, drive_step=1e-12)
    block, nothing = scenes.BLOCK, np.zeros(100 * scenes.BLOCK)
    controller.run(np.zeros((block, 2)), nothing[:block], nothing[:block])
    tuned = native.TunedBlock(controller)
    sensed = 1e-9 * rng.standard_normal((len(nothing), 2))
    found = controller.run(sensed, nothing, nothing)[0]
    assert abs(found).max() > 0
    np.testing.assert_allclose(tuned.run(sensed), found, rtol=0, atol=bound * abs(found).max())


def test_the_lock_in_of_scipy_is_the_same_analysis(benchmarks, rng):
    """Envelopes of 20 bands in four blocks of noise."""
    from peers import ScipyLockIn

    from hapticrender.control.analyser import Analyser

    frequency, samples = np.linspace(0.0, 1000.0, 20), rng.standard_normal((256, 2))
    found, filters = Analyser(frequency, 10.0, 48_000.0, channels=2), ScipyLockIn(frequency, 10.0, 48_000.0, 2)
    for part in np.split(samples, 4):
        expected = filters.run(part)
        np.testing.assert_allclose(found.run(part), expected, rtol=0, atol=1.3e-10 * abs(expected).max())


def test_a_sliding_dft_hears_the_same_tone(benchmarks):
    """Unit tones on a bin in the middle: half of the amplitude there, as `sdft` counts both halves of the spectrum."""
    pytest.importorskip("sdft")
    from peers import SlidingDFT

    tone = np.cos(np.pi * 8 / 16 * np.arange(640))
    for found in SlidingDFT(16, 2).run(np.stack([tone, tone], axis=1)):
        assert abs(found[-1]) == pytest.approx(0.5 * (np.arange(16) == 8), abs=1e-9)


def test_the_plate_of_python_control_is_the_same_plate(benchmarks, rng):
    pytest.importorskip("control")
    import scenes
    from numpy_loop import NumpyPlate
    from peers import PythonControl

    peer, plate, current = PythonControl(scenes.PLATE), NumpyPlate(scenes.PLATE), 0.1 * rng.standard_normal((500, 2))
    expected = np.empty_like(current)
    for n, each in enumerate(current):
        expected[n] = plate.state[:2]
        plate.advance(each)
    for found in (peer.forced(current), peer.stepped(current)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())


def test_a_peer_that_is_not_there_is_left_out(benchmarks, monkeypatch, capsys):
    import cases
    import run

    for name in ("sdft", "control"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(run, "keep_to_one_core", lambda: None)
    monkeypatch.setattr(run, "core_pace", lambda pairs: 1.0)
    monkeypatch.setattr(run, "every_case", lambda short: [("peers analysis 8", lambda: cases.analysis(8, 1))])
    monkeypatch.setattr(sys, "argv", ["run.py"])
    assert run.main() == 0
    assert "peers analysis 8: left out: the package sdft is not installed" in capsys.readouterr().out
    assert "python-control left out: the package control is not installed" in cases.beside_control(1.0, 1)


def test_pairs_are_taken_in_turns(benchmarks):
    from pairing import interleave

    order = []
    found = interleave(lambda: order.append("a"), lambda: order.append("b"), 3)
    assert order == ["a", "b"] * 4
    assert found.candidate > 0
    assert found.ratio > 0


def test_a_settled_run_follows_one_of_its_own(benchmarks):
    from pairing import interleave

    order, times = [], iter(range(12))
    interleave(lambda: order.append("a"), lambda: order.append("b"), 3, lambda: order.append("|") or next(times), True)
    assert "".join(order) == "ab" + "a|a|b|b|" * 3


def test_the_spread_of_pairs_is_that_of_their_quarters(benchmarks):
    from pairing import interleave

    def nothing():
        pass

    times = iter([0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 2.0, 0.0, 1.0, 0.0, 3.0])  # candidate 1 s, reference 1, 2, 3 s
    found = interleave(nothing, nothing, 3, lambda: next(times))
    assert (found.candidate, found.reference, found.ratio) == (1.0, 2.0, 2.0)
    assert (found.low, found.high) == (1.5, 2.5)


@pytest.mark.parametrize(
    ("measured", "at_least", "met", "within"),
    [(1.1, False, True, True), (1.5, False, False, True), (3.1, False, False, False), (0.2, True, False, False)],
)
def test_verdicts(benchmarks, measured, at_least, met, within):
    from cases import Figure

    figure = Figure("each", measured, "x", 1.2 if not at_least else 1.0, at_least, "other")
    assert figure.met == met
    assert figure.within(2.0) == within


def test_what_does_not_decide_is_told_so(benchmarks):
    from cases import Figure

    share = Figure("share", 1.1, "% of a core", 1.0, False, "", decides=False)
    assert (share.verdict, replace(share, measured=0.9).verdict) == ("(missed)", "(met)")
    assert replace(share, decides=True).verdict == "MISSED"


@pytest.mark.parametrize("slower", [1.5, None])
def test_what_goes_with_the_core_is_told_for_a_faster_one_as_well(benchmarks, capsys, slower):
    """A core that takes 1.5 times as long: more seconds a second on theirs, a smaller share, the same ratio."""
    import run
    from cases import Figure

    for measured, unit, at_least in ((1000.0, "s/s", True), (3.0, "% of a core", False), (3.0, "x", False)):
        run.show(Figure("each", measured, unit, 2.0, at_least, "who"), slower)
    loop, share, ratio = capsys.readouterr().out.splitlines()
    told = "some {} on a core of the targets' pace" if slower else "who"
    assert "1e+03 s/s" in loop
    assert loop.endswith(told.format("1.5e+03 s/s"))
    assert "3 % of" in share
    assert share.endswith(told.format("2 % of a core"))
    assert ratio.endswith("who")


def test_the_pace_of_a_core_is_that_of_naive_c(benchmarks, monkeypatch):
    """The median run, 1.25 times as long as on the other core, whatever else meets the others."""
    import cases

    spent = iter([factor * 55e-9 * 4000 * 64 * 2 for factor in (1.25, 9.0, 1.2)])
    monkeypatch.setattr(cases, "time_of", lambda run, clock, settled: next(spent) if settled else 0.0)
    assert cases.core_pace(3) == pytest.approx(1.25)


def test_a_machine_without_a_compiler_has_no_pace(benchmarks, monkeypatch, capsys):
    import run

    def missing(pairs):
        raise run.NoCompiler("no C compiler")

    monkeypatch.setattr(run, "core_pace", missing)
    assert run.told_pace(short=True) is None
    assert "left out: no C compiler" in capsys.readouterr().out


def test_a_closed_loop_plays_all_that_it_is_asked_for(benchmarks, monkeypatch):
    """Also where the last piece is a shorter one."""
    import scenes

    played = []
    monkeypatch.setattr(scenes.Plate, "closed_loop", lambda self, controller, wanted: played.append(len(wanted)))
    scenes.closed_loop("paper", 1, 25_000)()
    assert played == [20_000, 5000]
