"""Compile kernels: numba's options in one place, and kernels as C functions that call each other by address.

Every kernel of the loop, of a controller or of a plant, has one C signature::

    int64_t step(int64_t state, int64_t signals, int64_t start, int64_t count)

`state` is the address of the owner's record, `signals` that of a `SIGNALS` record, which holds the addresses of the
signals' arrays (C-contiguous, time first); the step reads and writes their rows `start` to `start + count - 1`.
A plant, a controller and an audio callback therefore meet without knowing each other's types: a loop over two
addresses closes any plant with any controller, and a third party may give a step written in C.
"""

import hashlib
import sys
import threading
import time
from collections.abc import Callable
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NoReturn

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from hapticrender.errors import HapticError
from hapticrender.second_core import EXPECTED, await_child, expect, start_child

# no fast mathematics: rounding would depend on what is inlined where, and a process that compiles runs other copies of
# a part than one that loads from the cache; `hapticrender.vectors` fuses products and sums explicitly
OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}
ANNOUNCED_AFTER = 1.0  # s of processor time: a load from the cache takes less, on a busy machine too
ANNOUNCED = threading.Event()
F8, I8, C16 = types.float64, types.int64, types.complex128
STEP = types.int64(types.int64, types.int64, types.int64, types.int64)
UNSIGNED_LONG = types.uint32 if sys.platform == "win32" else types.uint64
CALLBACK = types.int32(I8, I8, UNSIGNED_LONG, I8, UNSIGNED_LONG, I8)  # PortAudio's

SIGNALS = np.dtype(
    [
        (name, np.int64)
        for name in ("drive", "inputs", "noise", "sensed", "motion", "position", "waveform", "target", "flags")
    ]
)
"""Addresses of float64 arrays with a row a sample; `flags` is int64, `target` complex128 with a row a block."""
SIGNALS_T = numba.from_dtype(SIGNALS)
CONVERSION = np.dtype([(name, np.int64) for name in ("drive", "played", "raw", "sensed", "finger", "flags", "lost")])
"""Addresses of what is converted between a controller and its device: the controller's drive and what the device plays
for it, what the device senses (`raw`) and what the controller gets for that (`sensed`), the finger's load (N) and speed
(m/s, NaN while lifted), the device's flags; rows of `played` and `raw` are the device's samples.  `lost` says whether
samples were lost before."""
CONVERSION_T = numba.from_dtype(CONVERSION)


@lru_cache
def digest() -> str:
    """Hash of all sources with kernels, and of the options: a part of the names under which machine code is cached.

    numba compiles cached code anew when its own file changes, but not when a part of it in another file does.
    """
    found = hashlib.sha256(repr(OPTIONS).encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"numba" in source or b"hapticrender.jit" in source:
            found.update(source)
    return found.hexdigest()[:12]


def keyed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Name a function by the state of the sources, where numba caches it."""
    function.__qualname__ = f"{function.__name__}_{digest()}"
    return function


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function on its first call, into the code of the kernels and steps that call it."""
    return numba.njit(function, forceinline=True, **OPTIONS)


def entry(function: Callable[..., Any]) -> Any:
    """Compile a kernel that Python calls; the machine code is cached on disk where a place for it can be written.

    A part is not: it lies in the code of all that call it, and storing each took a third of a cold start.
    """
    try:
        return numba.njit(keyed(function), cache=True, **OPTIONS)
    except RuntimeError:  # neither the package nor the user's cache folder can be written
        return numba.njit(function, **OPTIONS)


def announce(done: threading.Event, begun: float) -> None:
    """Start compiling on a second core too, and print once a process that something is being compiled.

    Not before `ANNOUNCED_AFTER` of processor time from `begun` on, unless it is `done` by then.
    """
    while (left := begun + ANNOUNCED_AFTER - time.process_time()) > 0.0:
        if done.wait(left):
            return
    start_child()
    if not ANNOUNCED.is_set():
        ANNOUNCED.set()
        print("compiling for this machine (once)", file=sys.stderr, flush=True)


class CFunction:
    """A kernel as a C function, compiled (or loaded from the cache) when its address is first needed.

    Parameters
    ----------
    function : callable
        Of scalars and addresses; nothing else crosses a C interface.
    signature : numba signature
        By default that of a step.
    """

    def __init__(self, function: Callable[..., Any], signature: Any = STEP) -> None:
        self.function, self.signature = function, signature
        self.__doc__ = function.__doc__

    @cached_property
    def _compiled(self) -> Any:
        await_child(self.function)
        done = threading.Event()
        threading.Thread(target=announce, args=(done, time.process_time()), daemon=True).start()
        try:
            return numba.cfunc(self.signature, cache=True, **OPTIONS)(keyed(self.function))
        except RuntimeError:
            EXPECTED.clear()  # without a cache a child's work is of no use
            return numba.cfunc(self.signature, **OPTIONS)(self.function)
        finally:
            done.set()

    def expect(self) -> None:
        """Announce that the address is needed soon, for it to be compiled beside what is needed before."""
        if "_compiled" not in self.__dict__:
            expect(self.function)

    @property
    def address(self) -> int:
        """Address of the machine code."""
        return int(self._compiled.address)

    def __call__(self, *values: int) -> int:
        """Call the machine code from Python, without its lock."""
        return int(self._compiled.ctypes(*values))


step = CFunction  # the decorator of a step; see the module


@intrinsic
def pointer(typingctx: Any, address: Any, dtype: Any) -> Any:
    """Pointer to numbers or records of `dtype` (a numba type) at an address; `numba.carray` makes an array of it."""
    result = types.CPointer(dtype.instance_type)

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.inttoptr(values[0], context.get_value_type(signature.return_type))

    return result(types.int64, dtype), build


@intrinsic
def record(typingctx: Any, address: Any, dtype: Any, index: Any) -> Any:
    """Record of `dtype` (a numba type) number `index` of those that lie at an address; reads and writes go there.

    Kernels hand each other records or addresses, not arrays of records: a call then costs no more than its numbers.
    """
    kind = dtype.instance_type

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        size = ir.Constant(ir.IntType(64), kind.size)
        address = builder.add(values[0], builder.mul(values[2], size))
        return builder.inttoptr(address, context.get_value_type(kind))

    return kind(types.int64, dtype, types.int64), build


@intrinsic
def call(typingctx: Any, function: Any, values: Any) -> Any:
    """Call the C function at an address with a tuple of numbers; it returns an int64."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        items = [builder.extract_value(arguments[1], i) for i in range(len(signature.args[1]))]
        kind = ir.FunctionType(ir.IntType(64), [item.type for item in items])
        return builder.call(builder.inttoptr(arguments[0], ir.PointerType(kind)), items)

    return types.int64(types.int64, values), build


def atomic(operation: str) -> Any:
    """Change the int64 at an address and return what was there, in one indivisible step that orders memory.

    `operation` is one of LLVM's ``atomicrmw``: "xchg" stores a value, "add" adds it.
    """

    @intrinsic
    def change(typingctx: Any, address: Any, value: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            place = builder.inttoptr(values[0], ir.PointerType(ir.IntType(64)))
            return builder.atomic_rmw(operation, place, values[1], "acq_rel")

        return types.int64(types.int64, types.int64), build

    return change


swap, fetch_add = atomic("xchg"), atomic("add")


def aligned(shape: int | tuple[int, ...], dtype: type | np.dtype[Any] = np.float64) -> np.ndarray[Any, Any]:
    """Array of zeros that starts at a multiple of 64 bytes, as vectors in its fields require."""
    dtype = np.dtype(dtype)
    size = int(np.prod(shape)) * dtype.itemsize
    memory = np.zeros(size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + size].view(dtype).reshape(shape)


def record_of(dtype: np.dtype[Any], *sources: object, **values: Any) -> np.ndarray[Any, Any]:
    """Record of `dtype`, shape (1,), with numbers of the same name from `sources`, then these values; the rest is zero.

    An array for an int64 becomes its address: the caller keeps it alive.

    Raises
    ------
    ValueError
        Such an array is not C-contiguous.
    """
    record = aligned(1, dtype)
    for name in dtype.names or ():
        for source in sources:
            value = getattr(source, name, None)
            if isinstance(value, (int, float, complex)):
                record[name] = value
    for name, value in values.items():
        by_address = isinstance(value, np.ndarray) and dtype[name] == np.int64
        record[name] = address_of(name, value) if by_address else value
    return record


def address_of(name: str, array: np.ndarray[Any, Any]) -> int:
    """Address of an array that the caller keeps alive; a ValueError where it is not C-contiguous."""
    if not array.flags.c_contiguous:
        raise ValueError(f"{name} of shape {array.shape}: must be C-contiguous (use numpy.ascontiguousarray)")
    return int(array.__array_interface__["data"][0])  # a third of the time of `array.ctypes.data`, in every block


class Addressed:
    """Base of what holds addresses of arrays of its own, or what else `_held` says, which a copy would use, too."""

    _held = "addresses"

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise TypeError(f"{type(self).__name__}: cannot be copied or pickled, it holds {self._held}: make a new one")


def addresses(**arrays: np.ndarray[Any, Any] | None) -> np.ndarray[Any, Any]:
    """Record of the addresses of some signals, shape (1,); made anew for every block, so not by `record_of`."""
    record = np.zeros(1, SIGNALS)
    for name, array in arrays.items():
        if array is not None:
            record[name] = address_of(name, array)
    return record


@entry
def close_loop(plant, control, count, block):
    """Advance plant and controller in turns of `block` samples; each is (step, state, signals), as addresses."""
    for start in range(0, count, block):
        call(plant[0], (plant[1], plant[2], start, block))
        call(control[0], (control[1], control[2], start, block))


if not hasattr(close_loop, "py_func"):  # numba has compiled nothing
    raise HapticError("NUMBA_DISABLE_JIT is set, must not be: the kernels run as compiled code only: unset it")
