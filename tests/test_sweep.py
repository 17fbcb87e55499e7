"""Sweeps: any device, any executor, the same results in the order of the scenes, failures named."""

import pickle
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import pytest

import hapticrender as hr
from hapticrender.loop import render
from hapticrender.sweep import SweepError, sweep, worst_error
from hapticrender.touch.builtin_scenes import one_texture

SCENES = [
    *(replace(scene, duration=0.6, settle=0.2, name=kind) for kind, scene in one_texture().items() if kind != "hybrid"),
    *(hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=0.6, seed=seed) for seed in (1, 2)),
]
WRONG = replace(SCENES[-1], texture=hr.Grating(frequency=400.0, amplitude=1e-3), name="too much")


@pytest.fixture(scope="module")
def expected():
    return [worst_error(render(scene)) for scene in SCENES]


@pytest.mark.parametrize("pool", [None, ThreadPoolExecutor, lambda _: ProcessPoolExecutor(1, get_context("spawn"))])
def test_any_executor_gives_the_same(pool, expected):
    if pool is None:
        found = sweep(SCENES, worst_error)
    else:
        with pool(2) as executor:
            found = sweep(SCENES, worst_error, executor=executor, at_a_time=2)
    assert found == expected  # noise is seeded, and a process that compiles makes the code that others load
    assert len(set(found)) == len(found)


def test_a_cluster_gives_the_same(expected):
    """dask.distributed on this machine alone, an executor like any other."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as client:
        assert sweep(SCENES, worst_error, executor=client.get_executor(), at_a_time=2) == expected


def test_an_executor_is_handed_so_many_scenes_at_once():
    class Noting(ThreadPoolExecutor):
        def map(self, *arguments, chunksize=1, **options):
            self.chunksize = chunksize
            return super().map(*arguments, **options)

    with Noting(1) as executor:
        sweep(SCENES[-1:], worst_error, executor=executor, at_a_time=3)
    assert executor.chunksize == 3


def test_the_method_is_that_of_each_scene_unless_given():
    scenes = [replace(SCENES[-1], method=method) for method in ("h2", "paper")]
    assert [each["method"] for each in sweep(scenes)] == ["h2", "paper"]
    assert [each["method"] for each in sweep(scenes, method="h")] == ["h", "h"]


@pytest.mark.parametrize("threads", [0, 1])
def test_a_failing_scene_is_named(threads):
    scenes = [SCENES[-1], WRONG, SCENES[-2]]
    executor = ThreadPoolExecutor(threads) if threads else None
    with pytest.raises(SweepError, match=r"^scenes\[1\] \('too much'\): ValueError: texture.amplitude = 0.001 m"):
        sweep(scenes, worst_error, executor=executor)


@pytest.mark.parametrize("error", [hr.WatchdogTimeout(0.1, 0.5), hr.WatchdogTimeout(0.1), hr.DeviceFault("gone", 0.2)])
def test_an_error_comes_out_of_another_process_as_it_was(error):
    """One that cannot be unpickled ends a `ProcessPoolExecutor`."""
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), again.time) == (type(error), str(error), error.time)
