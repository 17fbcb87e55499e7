"""Scenarios side by side: the same as one by one, whatever their fingers and plates do."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest

import hapticrender as hr
from hapticrender import batch
from hapticrender.accuracy.plate import SLIDING, tones
from hapticrender.batch import LANES, Scenario, simulate
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.recordings.judge import fit
from hapticrender.sweep import errors, sweep, worst_error
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, LIGHT_SECOND

IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0)  # no rounding that would tell 1e-16 from 0
BANDS = tones([50.0, 178.0, 261.0], 20e-6)
FINGERS = (
    hr.Finger.absent(),
    replace(SLIDING, touches=((0.1, 0.4),)),
    replace(SLIDING, touches=((0.05, 0.2), (0.3, 9.0)), mechanics=LIGHT, normal_load=0.3),
    hr.Finger.still(normal_load=0.5, mechanics=HEAVY),
    hr.Finger.still(20e-3, normal_load=0.3, mechanics=LIGHT_SECOND),
    hr.Finger.sliding(speed=0.3, normal_load=0.2, mechanics=HEAVY_SECOND),
    replace(SLIDING, normal_load=((0.0, 0.25, 0.5), (0.2, 0.9, 0.4)), touches=None, load_scaling=True),
)


def alone(scenario, seconds, method="h2"):
    return batch._alone(scenario, scenario.design(method), seconds)


def scenarios(plate=IDEAL, **changes):
    """A finger each, on plates that differ in mass and stiffness from the one that is known."""
    return [
        Scenario(
            bands=BANDS,
            finger=finger,
            plate=replace(plate, mass=0.032 * (1 + 0.002 * i), stiffness_1=22.4e3 + 20.0 * i, **changes),
            known=replace(plate, **changes),
            seed=i,
        )
        for i, finger in enumerate(FINGERS)
    ]


def assert_alike(found, expected):
    """Rounding differs, 1e-16 a sample and state, and a loop keeps it small."""
    np.testing.assert_array_equal(found.position, expected.position)
    np.testing.assert_array_equal(found.flags, expected.flags)
    for name in ("motion", "sensed", "drive"):
        right = getattr(expected, name)
        np.testing.assert_allclose(getattr(found, name), right, rtol=0, atol=1e-9 * abs(right).max())


@pytest.mark.parametrize("method", ["h", "h2", "paper"])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"delay": 4},
        {"bending_frequency": 1250.0, "bending_coil": 0.1},
        {"degrees_of_freedom": 1},
        {"finger_dynamics": 0},
    ],
    ids=lambda changes: next(iter(changes), "as it is"),
)
def test_a_lane_is_the_run_of_its_scenario(method, changes):
    """Motion, drive and flags of 0.5 s."""
    wanted = scenarios(**changes)
    for scenario, found in zip(wanted, simulate(wanted, 0.5, method=method), strict=True):
        assert found.scenario is scenario
        assert_alike(found, alone(scenario, 0.5, method))


@pytest.mark.parametrize("changes", [{}, {"bending_frequency": 1250.0, "bending_coil": 0.1}], ids=["rigid", "bending"])
def test_fingers_that_rest_keep_what_a_sample_does(changes):
    """Each in a place of its own, some lifted and put down again: all rest most of the time."""
    resting = [
        hr.Finger.still(place, normal_load=0.5, mechanics=mechanics, touches=touches)
        for place, mechanics, touches in (
            (0.0, HEAVY, None),
            (15e-3, LIGHT_SECOND, ((0.05, 0.2), (0.202, 9.0))),
            (-20e-3, LIGHT, ((0.1, 9.0),)),
        )
    ]
    plate = replace(IDEAL, **changes)
    wanted = [Scenario(bands=BANDS, finger=finger, plate=plate) for finger in resting]
    for scenario, found in zip(wanted, simulate(wanted, 0.4), strict=True):
        assert_alike(found, alone(scenario, 0.4))


@pytest.mark.parametrize("fingers", [FINGERS, FINGERS[:1] * 2, FINGERS[3:5]], ids=["all", "absent", "resting"])
def test_the_length_of_a_piece_does_not_matter(fingers, monkeypatch):
    """What is handed over piece by piece: fingers, those that stay at once, and noise."""
    wanted = [Scenario(bands=BANDS, finger=finger, seed=i) for i, finger in enumerate(fingers)]
    expected = simulate(wanted, 0.5)
    monkeypatch.setattr(batch, "CHUNK", 700)
    for found, right in zip(simulate(wanted, 0.5), expected, strict=True):
        for name in ("position", "motion", "drive", "sensed", "flags"):
            np.testing.assert_array_equal(getattr(found, name), getattr(right, name))


@pytest.mark.parametrize("method", ["paper-common", "boxcar"])
def test_the_other_polar_methods_run_side_by_side(method, monkeypatch):
    """Other targets in every lane, and devices known better or worse: look-ups differ."""
    wanted = [
        replace(each, bands=tones([50.0 + i, 178.0, 261.0], (10 + i) * 1e-6), known=replace(each.plate, mass=0.032))
        for i, each in enumerate(scenarios())
    ]
    expected = [alone(each, 0.5, method) for each in wanted]
    monkeypatch.setattr(batch, "_alone", None)
    for found, right in zip(simulate(wanted, 0.5, method=method), expected, strict=True):
        assert_alike(found, right)


@pytest.mark.parametrize("method", ["h2", "paper"])
def test_a_finger_locked_carrier_is_followed_in_its_lane(method):
    bands = hr.Grating(wavelength=2e-3, amplitude=10e-6).bands(5000.0)
    fingers = [hr.Finger.sliding(speed=speed, normal_load=0.4) for speed in (0.06, 0.08, 0.1)]
    fingers.append(replace(SLIDING, touches=((0.1, 0.3), (0.35, 9.0))))
    wanted = [Scenario(bands=bands, finger=finger, plate=IDEAL) for finger in fingers]
    for scenario, found in zip(wanted, simulate(wanted, 0.6, method=method), strict=True):
        right = alone(scenario, 0.6, method).motion
        assert abs(right).max() > 5e-6
        np.testing.assert_allclose(found.motion, right, rtol=0, atol=1e-9 * abs(right).max())


@pytest.mark.parametrize("method", ["h2", "paper"])
def test_a_sensor_is_doubted_in_its_own_lane(method):
    """A controller that is told of +-65 um: more is not believed, and its loops start anew."""
    told = replace(IDEAL, sensor_range=130e-6)
    wanted = [replace(each, known=told) for each in scenarios()]
    played = simulate(wanted, 0.5, method=method)
    doubted = [bool((each.flags & 2).any()) for each in played]
    assert any(doubted)
    assert not all(doubted)
    for scenario, found in zip(wanted, played, strict=True):
        assert_alike(found, alone(scenario, 0.5, method))


@pytest.mark.parametrize("method", ["h2", "paper"])
def test_noise_and_rounding_are_those_of_the_scenario(method):
    """With 1 um of noise and its seed; a step of sensor or drive may fall the other way, and is felt no further."""
    wanted = scenarios(PlateParameters())
    for scenario, found in zip(wanted, simulate(wanted, 0.5, method=method), strict=True):
        expected = alone(scenario, 0.5, method)
        steps = scenario.plate.sensor_step
        assert abs(found.sensed[:50] - expected.sensed[:50]).max() <= 1e-12
        assert np.sqrt(np.mean((found.motion - expected.motion) ** 2)) < 0.2 * steps


@pytest.mark.parametrize("method", ["h2", "paper"])
def test_overload_saturates_its_own_lane_only(method):
    loud = [replace(each, bands=tones([400.0], 1e-3 if i == 1 else 1e-5)) for i, each in enumerate(scenarios()[:3])]
    found = simulate(loud, 0.4, method=method)
    assert [bool((each.flags & 1).any()) for each in found] == [False, True, False]
    assert all(abs(each.drive).max() <= IDEAL.current_limit for each in found)


def test_what_does_not_fit_runs_on_its_own():
    """Other bands have other numbers, other rates other samples; order stays."""
    mixed = [
        Scenario(bands=tones([50.0], 1e-5), plate=IDEAL),
        Scenario(bands=tones([50.0, 90.0], 1e-5), plate=IDEAL),
        Scenario(bands=tones([50.0], 2e-5), plate=IDEAL),
        Scenario(bands=tones([50.0], 1e-5), plate=replace(IDEAL, rate=10_000.0)),
    ]
    found = simulate(mixed, 0.2)
    assert [each.scenario for each in found] == mixed
    assert [len(each.motion) for each in found] == [1000, 1000, 1000, 2000]
    for each in found:
        right = alone(each.scenario, 0.2).motion
        np.testing.assert_allclose(each.motion, right, rtol=0, atol=1e-9 * abs(right).max())


def test_more_than_the_lanes_and_other_methods():
    many = [Scenario(bands=BANDS, plate=IDEAL, seed=i) for i in range(2 * LANES + 3)]
    assert len(simulate(many, 0.01)) == len(many)
    for one in simulate(many[:2], 0.05, method="stiffness"):
        np.testing.assert_array_equal(one.motion, alone(one.scenario, 0.05, "stiffness").motion)


@pytest.mark.parametrize(("method", "designs"), [("h2", 3), ("paper", 3), ("stiffness", 6)])
def test_the_same_device_and_targets_are_designed_for_once(method, designs, monkeypatch):
    """Where they run side by side; every scenario starts at rest, and one that runs alone has a design of its own.

    Who knows another device, or wants something else, is designed for as well.
    """
    many = [Scenario(bands=tones([50.0], 1e-5), finger=finger, plate=IDEAL) for finger in FINGERS[:4]]
    many.append(Scenario(bands=tones([50.0], 2e-5), plate=IDEAL))
    many.append(Scenario(bands=tones([50.0], 1e-5), plate=IDEAL, known=replace(IDEAL, mass=0.033)))
    expected, made, design = [alone(each, 0.1, method) for each in many], [], Scenario.design
    monkeypatch.setattr(Scenario, "design", lambda self, name: made.append(self) or design(self, name))
    played = simulate(many, 0.1, method=method)
    assert len(made) == designs
    for found, right in zip(played, expected, strict=True):
        assert_alike(found, right)


def test_one_that_runs_alone_leaves_the_design_at_rest_for_others():
    """The first plate bends and has to run by itself, with what is known of the others."""
    bends = replace(IDEAL, bending_frequency=1250.0, bending_coil=0.1)
    many = [Scenario(bands=BANDS, plate=plate, known=IDEAL) for plate in (bends, IDEAL, IDEAL, bends, bends)]
    for found, scenario in zip(simulate(many, 0.1), many, strict=True):
        assert_alike(found, alone(scenario, 0.1))


@pytest.mark.parametrize("locked", [False, True])
def test_errors_are_those_of_windows_with_phases_of_their_own(locked):
    """Fixed carriers are fitted in all windows at once, as the first one's: phases of 300 turns know 1e-13 of one."""
    bands = hr.Grating(wavelength=2e-3, amplitude=10e-6).bands(5000.0) if locked else BANDS
    finger = hr.Finger.swiping(frequency=1.3, speed=0.12, normal_load=0.4)
    (played,) = simulate([Scenario(bands=bands, finger=finger, plate=IDEAL)], 1.13)
    index = np.arange(2500, 5500, 500)[:, None] + np.arange(500)
    phase = bands.carrier_phase(np.arange(5650) / 5000.0, played.position)[index]
    off = abs(fit(phase, played.motion[index])[0]) / abs(bands.envelope) - 1.0
    np.testing.assert_allclose(errors(played), np.sqrt(np.mean(off**2, axis=0)), rtol=0, atol=1e-12)
    few = replace(played, motion=played.motion[:, :2])
    np.testing.assert_allclose(errors(few), errors(played)[:2], rtol=0, atol=1e-12)


def test_whole_numbers_are_numbers():
    """Plates may be given in integers, and run beside others that are not."""
    plates = [IDEAL, replace(IDEAL, current_limit=3, force_constant=8, bending_coil=0)]
    found = simulate([Scenario(bands=BANDS, plate=plate, known=IDEAL) for plate in plates], 0.05)
    assert len(found) == 2


def test_silent_bands_and_lifted_fingers_are_not_judged():
    """A finger that was away for 100 ms is judged like one that stayed: what is off is where it turns round."""
    silent = replace(BANDS, envelope=np.array([20e-6, 0.0, 20e-6], complex))
    (played,) = simulate([Scenario(bands=silent, plate=IDEAL)], 1.0)
    assert np.isnan(errors(played)[0]).tolist() == [False, True, False]
    assert worst_error(played) < 1e-3
    ridges = hr.Grating(wavelength=2e-3, amplitude=10e-6).bands(5000.0)
    finger = replace(hr.Finger.sliding(speed=0.1, normal_load=0.4), touches=((0.0, 1.05), (1.15, 9.0)))
    fingers = (finger, replace(finger, touches=None))
    away, stayed = simulate([Scenario(bands=ridges, finger=each, plate=IDEAL) for each in fingers], 1.5)
    assert worst_error(stayed) < 0.006
    assert worst_error(away) == pytest.approx(worst_error(stayed), rel=0.2)  # 1 in each window without it, if judged


def test_what_it_refuses():
    with pytest.raises(ValueError, match="seconds=0: must be > 0 s"):
        simulate([], 0)
    with pytest.raises(ValueError, match="seconds=inf: must be > 0 s and finite"):
        simulate([], np.inf)
    with pytest.raises(ValueError, match="known.rate=10000 Hz: must be that of the plate, 5000 Hz"):
        Scenario(bands=BANDS, plate=IDEAL, known=replace(IDEAL, rate=10_000.0))
    with pytest.raises(ValueError, match=r"scenarios\[0\].bands: must have constant envelopes"):
        simulate([Scenario(bands=replace(BANDS, envelope=None))], 1.0)
    with pytest.raises(ValueError, match="at_a_time=0: must be >= 1"):
        sweep([], 1.0, worst_error, at_a_time=0)
    with pytest.raises(ValueError, match="start=-0.1: must be >= 0 s"):
        errors(alone(scenarios()[0], 0.3), -0.1)
    with pytest.raises(ValueError, match="must be >= 0.6 s to be judged"):
        errors(alone(scenarios()[0], 0.3))


def processes(count):
    return ProcessPoolExecutor(count, get_context("spawn"))


@pytest.mark.parametrize("pool", [None, ThreadPoolExecutor, processes])
def test_any_executor_gives_the_same(pool):
    wanted = [replace(each, seed=seed) for each in scenarios() for seed in range(2)]
    expected = [worst_error(each) for each in simulate(wanted, 1.0)]
    assert max(expected) < 0.1
    assert len(set(expected)) > 3
    if pool is None:
        found = sweep(wanted, 1.0, worst_error, at_a_time=5)
    else:
        with pool(2) as executor:
            found = sweep(wanted, 1.0, worst_error, executor=executor, at_a_time=5)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_cluster_gives_the_same():
    """dask.distributed on this machine alone, an executor like any other."""
    distributed = pytest.importorskip("distributed")
    wanted = scenarios()[:4]
    expected = [worst_error(each) for each in simulate(wanted, 1.0)]
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        found = sweep(wanted, 1.0, worst_error, executor=client.get_executor(), at_a_time=2)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_failure_in_a_task_comes_back():
    with ThreadPoolExecutor(1) as pool, pytest.raises(ValueError, match="must have constant envelopes"):
        sweep([Scenario(bands=replace(BANDS, envelope=None))], 1.0, worst_error, executor=pool)


def test_a_plate_with_one_coil_is_refused():
    """Its coil moves heave alone; side by side there are two."""
    with pytest.raises(ValueError, match=r"plate.coils=1: must be 2"):
        Scenario(bands=BANDS, plate=PlateParameters(coils=1))
