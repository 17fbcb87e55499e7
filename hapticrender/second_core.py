"""Compile on two cores: a child process compiles into numba's cache what this process needs next.

numba compiles one function at a time.  Whoever will need a C function of this library soon announces it by `expect`.
Where another one takes longer than a load from the cache does, a child process starts on all that is expected
(`start_child`); `await_child` waits for it where one of them is needed, which is then loaded from the cache.  Whatever
becomes of the child (killed, no right to write, no second core), what is not in the cache is compiled here.
"""

import atexit
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

TIMEOUT = 60.0  # s that a child may take
EXPECTED: set[tuple[str, str]] = set()  # module and name
CHILDREN: dict[tuple[str, str], Any] = {}  # those that a child process compiles, and the process
CODE = """
import sys
sys.path[:] = {path!r}
from importlib import import_module
for module, name in {names!r}:
    getattr(import_module(module), name).address
"""


def expect(*functions: Callable[..., Any]) -> None:
    """Announce functions of modules of this library, in which a `CFunction` has their name: they are needed soon."""
    EXPECTED.update((f.__module__, f.__name__) for f in functions if f.__module__.startswith("hapticrender."))


def await_child(function: Callable[..., Any]) -> None:
    """Wait for the child that compiles this function, if there is one; its work is in the cache then."""
    name = (function.__module__, function.__name__)
    EXPECTED.discard(name)
    if child := CHILDREN.pop(name, None):
        end(child, TIMEOUT)


def start_child() -> None:
    """Start a child on what is expected; there is none in one of many processes, which would start as many."""
    import multiprocessing
    import subprocess

    names = sorted(EXPECTED.copy())  # a timer's thread calls this
    python = re.fullmatch(r"pythonw?[\d.]*t?(\.exe)?", Path(sys.executable or "").name.lower())
    own = not python or hasattr(sys, "frozen")  # a program with Python inside
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not names or own or multiprocessing.parent_process() or cores < 2:
        return
    EXPECTED.clear()
    command, silent = [sys.executable, "-c", CODE.format(path=sys.path, names=names)], subprocess.DEVNULL
    with suppress(OSError):  # no process to be had
        child = subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent)
        CHILDREN.update(dict.fromkeys(names, child))
        atexit.register(end, child, 0.0)


def end(child: Any, timeout: float) -> None:
    """Wait for a child process, and kill it where it takes too long."""
    import subprocess

    try:
        child.wait(timeout)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
