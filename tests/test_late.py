"""Parts of kernels that are compiled when they are first needed, and beforehand where something is live."""

import ctypes
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from hapticrender.compiled import late as module
from hapticrender.compiled.jit import callback, kernel, late

KERNELS = """
from hapticrender.compiled.jit import kernel, late, simulation

@late
def deep(x):
    x[0] += 100.0

@late
def deeper(x, gain):
    for i in range(x.shape[0]):
        x[i] += gain * x[i] + 0.1
    deep(x)

def source(x, n):
    for i in range(n):
        if i == 3:
            deeper(x, 2.0)

calm, ready = simulation(source), kernel(source)

@late
def wrong(x):
    return x[0]

@simulation
def calls_wrong(x):
    wrong(x)

@simulation
def spins(x, n):
    swing = 1.0
    for i in range(n):
        swing = swing * 0.999999 + 1e-9 * i
    if swing > 1e-30 and n > 0:
        deeper(x, 2.0)
"""
COUNT = """
import numpy as np
import late_kernels as k
found = lambda: (len(k.deeper.part.overloads), len(k.deep.part.overloads))
x = np.ones(3)
"""


@pytest.fixture
def play(tmp_path):
    """Run lines beside `KERNELS` in a process of its own, with one cache for all of a test's."""
    (tmp_path / "late_kernels.py").write_text(KERNELS)

    def run(lines, check=True):
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{COUNT}{lines}"
        environment = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
        return subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=check, env=environment, timeout=120
        )

    return run


def test_a_simulation_compiles_what_it_comes_to(play):
    """Nothing before it is called, what it calls and that calls then; the same from the cache."""
    lines = "k.calm(x, 3); print(found()); k.calm(x, 4); print(found(), x)"
    first, again = play(lines).stdout, play(lines).stdout
    assert first == again == "(0, 0)\n(1, 1) [103.1   3.1   3.1]\n"


def test_what_is_live_has_compiled_everything_before_it_runs(play):
    """Its late parts and theirs, compiled anew and from the cache; nothing goes to Python later."""
    lines = """
import hapticrender.compiled.late as late
k.ready(x, 0); print(found()); late._part = None; k.ready(x, 4); print(x)
"""
    first, again = play(lines).stdout, play(lines).stdout
    assert first == again == "(1, 1)\n[103.1   3.1   3.1]\n"


def test_one_late_part_serves_every_caller(play):
    """Two kernels of one process share its code."""
    assert play("k.calm(x, 4); k.ready(x, 4); print(found(), x)").stdout.startswith("(1, 1) ")


def test_threads_that_need_the_same_part_at_once(play):
    lines = """
from concurrent.futures import ThreadPoolExecutor
many = [np.ones(3) for _ in range(8)]
with ThreadPoolExecutor(8) as pool:
    list(pool.map(lambda x: k.calm(x, 4), many))
print(found(), np.ptp(many, axis=0).max(), many[0])
"""
    assert play(lines).stdout == "(1, 1) 0.0 [103.1   3.1   3.1]\n"


def test_code_that_holds_the_interpreters_lock_lets_go_of_it_meanwhile(play):
    """Plain numba keeps it; the thread that compiles needs it."""
    lines = """
import numba
@numba.njit
def caller(x, n):
    k.calm(x, n)
caller(x, 3); print(found()); caller(x, 4); print(found(), x)
"""
    assert play(lines).stdout == "(0, 0)\n(1, 1) [103.1   3.1   3.1]\n"


INTERRUPT = """
import os, signal, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # who started the tests may ignore it
made = k.deeper.compiled
def compiled(args):
    for _ in range(3):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
    return made(args)
k.deeper.compiled = compiled
try:
    k.spins(x, 10**8)
    time.sleep(5.0)
    print("never heard")
except KeyboardInterrupt:
    print("heard", x)
k.calm(x, 4)
print(found(), x)
"""


@pytest.mark.parametrize("early", [False, True])
def test_an_interrupt_is_heard_when_the_samples_are_played(play, early):
    """Ctrl-C three times while a late part is compiled, or once in the samples before: they are right, then heard."""
    lines = INTERRUPT
    if early:
        lines = lines.replace("k.deeper.compiled = compiled", "threading.Timer(0.02, signal.raise_signal, [2]).start()")
        lines = lines.replace("10**8", "10**9")
    assert play("k.spins(np.ones(1), 0)\n" + lines).stdout == "heard [103.1   3.1   3.1]\n(1, 1) [409.4   9.4   9.4]\n"


def test_a_late_kernel_that_returns_something_is_refused(play):
    """By the simulation that comes to it, each time, and by a live kernel before it runs."""
    lines = """
from hapticrender.compiled.jit import kernel
for each in (k.calls_wrong, kernel(k.calls_wrong.py_func)):
    for _ in range(2):
        try:
            each(x)
        except (RuntimeError, TypeError) as error:
            print(type(error).__name__, error)
"""
    why = "late kernel 'wrong' returns float64: must be nothing"
    told = [f"RuntimeError TypeError: {why}"] * 2 + [f"TypeError {why}"] * 2
    assert play(lines).stdout.splitlines() == told


def test_a_late_kernel_is_called_with_all_it_takes(play):
    lines = """
from numba.core.errors import TypingError
from hapticrender.compiled.jit import kernel
def fewer(x):
    k.deeper(x)
try:
    kernel(fewer)(x)
except TypingError:
    print("refused")
"""
    assert play(lines).stdout == "refused\n"


def test_a_cache_that_fails_in_the_middle_costs_nothing_but_time(play, tmp_path):
    """No room for a part that is compiled while samples are played, and one whose files a killed process left torn."""
    full = """
import resource, signal
k.calm(x, 3)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
k.calm(x, 4)
print(found(), x)
"""
    right = "(1, 1) [103.1   3.1   3.1]\n"
    assert play(full).stdout == right
    assert play("k.calm(x, 4); print(found(), x)").stdout == right
    torn = [path for path in (tmp_path / "cache").rglob("*") if path.is_file() and "part" in path.name]
    assert len(torn) > 2
    for path in torn:
        path.write_bytes(path.read_bytes()[:50])
    assert play("k.calm(x, 4); print(found(), x)").stdout == right


def test_a_late_kernel_has_a_name_in_its_module():
    def local(x):
        x[0] = 1.0

    with pytest.raises(ValueError, match="local.*must be found by its name"):
        late(local)


@late
def halve(x):
    x[0] *= 0.5


@kernel
def halve_twice(x):
    halve(x)
    halve(x)


def quarter(at):
    """For C."""
    halve_twice(at)


def test_a_callback_for_c_has_nothing_left_to_compile():
    """Every cell of its code is full before it is called."""
    compiled = callback(quarter, numba.types.void, numba.types.CPointer(numba.types.float64))
    found = list(module.cells(compiled._library))
    assert found
    assert all(cell.value for cell, _ in found)
    x = np.array([12.0, 4.0])
    compiled.ctypes(x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)))
    np.testing.assert_array_equal(x, [3.0, 4.0])


FIRST = """
import numpy as np
import hapticrender as hr
from hapticrender.control.bank import carriers, kernels, law, targets
from hapticrender.plants import kernels as plate
parts = dict(settled=kernels.settled_sample, meet=kernels.meet_finger, learn=kernels.learn, lost=kernels.begin_anew,
             follow=carriers.follow_finger, resonance=carriers.follow_resonance, retune=law.retune,
             waveform=targets.found_targets, slides=plate.open_window)
def play(duration, **what):
    before = {name for name, each in parts.items() if each.part.overloads}
    hr.render(hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=duration, **what))
    print(*sorted(name for name, each in parts.items() if each.part.overloads and name not in before))
play(0.001)
play(0.5)
play(0.5, finger=hr.Finger.sliding(0.05))
"""


def test_a_scene_compiles_what_it_needs(tmp_path):
    """The first sample nothing that is late, the free plate settled samples, a sliding finger what learns it."""
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path))
    ran = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True, env=environment)
    assert ran.stdout.splitlines() == ["", "settled", "learn meet retune slides"]
