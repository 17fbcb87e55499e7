"""State that a controller hands on to another one of the same device: all that is not of its bands.

Where the control works by bands, each texture has a controller.  What the running one has found of finger, load and
device, and its supervisor's memory (tests, heat, a stop), lie in blocks of memory that are laid out alike in the next
one; `transfer` copies them when that one takes over.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import carray

from hapticrender.control.carriers import FRESH_TIME
from hapticrender.control.combined import CombinedController
from hapticrender.control.gain_faults import GAINS
from hapticrender.control.inverse import WaveformController
from hapticrender.control.inverse_records import LAW, LAW_T, RING
from hapticrender.control.records import CONTROLLER, CONTROLLER_T
from hapticrender.control.supervisor import SupervisedController
from hapticrender.control.supervisor_kernel import SUPERVISOR
from hapticrender.jit import F8, I8, kernel, pointer, record
from hapticrender.protocols import Array

PARTS = 2  # of a device
BLOCKS = (  # of a part: of its supervisor, of every controller, of the law by bands, of the waveform law
    *("tests", "heat", "sensors", "forces", "gains"),
    "tracker",
    "finger",
    *("contact", "learned", "window", "ring", "reference"),
)
ROWS = PARTS * len(BLOCKS)

Block = tuple[int, int]  # address, 8-byte words


@kernel
def transfer(source, target):
    """Copy the state from one table of `state_table` to another; a block that either lacks is left as it is."""
    old, new = carray(pointer(source, I8), (ROWS, 2)), carray(pointer(target, I8), (ROWS, 2))
    for k in range(ROWS):
        if old[k, 1] == new[k, 1]:
            words, copies = carray(pointer(old[k, 0], I8), old[k, 1]), carray(pointer(new[k, 0], I8), old[k, 1])
            for i in range(old[k, 1]):
                copies[i] = words[i]


def state_table(controller: Any) -> Array:
    """Address and number of 8-byte words of every block of state, shape (`ROWS`, 2); zeros where there is none.

    The controller has to outlive the table.
    """
    parts = [_blocks(part) for part in _parts(controller)]
    for i, part in enumerate(_parts(controller)):
        if part is None:  # what it has to be left to cool is the combination's
            heat = controller.state["parts"]["heat"][0, i]
            parts[i]["heat"] = heat.ctypes.data, len(heat)
    if len(parts) > 1 and "tracker" in parts[0]:  # both parts have one finger
        parts[1].setdefault("tracker", parts[0]["tracker"])
    rows = [part.get(name, (0, 0)) for part in parts for name in BLOCKS]
    return np.array(rows + [(0, 0)] * (ROWS - len(rows)), np.int64)


@kernel
def settle_damper(controller, sensed):
    """Let what is `sensed` (an address) be no step to the inner damper of a waveform law that comes in."""
    c = record(controller, CONTROLLER_T, 0)
    v, values = record(c.law_at, LAW_T, 0), carray(pointer(sensed, F8), c.p.sensors)
    for i in range(c.p.coordinates):
        sag = 0.0
        for j in range(c.p.sensors):
            sag += c.p.coordinate_from_sensor[i, j] * values[j]
        if not abs(sag) <= c.p.sensor_limit:
            sag = 0.0
        c.past[i, :] = sag
        if i == 0:
            v.slow = sag


def damper_of(controller: Any) -> int:
    """Address of the first part's state, which `settle_damper` takes; 0 where that has no waveform law."""
    part = _parts(controller)[0]
    bank = getattr(part, "controller", part)
    return int(bank.state.ctypes.data) if isinstance(bank, WaveformController) else 0


def ready(controller: Any) -> None:
    """Prepare a controller at rest to take over under a finger: its targets are there, and what it has yet to find.

    A part that nothing is transferred to first finds the steady friction, as after a touch.
    """
    for part in _parts(controller):
        bank = getattr(part, "controller", part)
        if bank is not None:
            bank.tiles["fade"], bank.state["fresh"] = 1.0, FRESH_TIME * bank.rate
        if isinstance(bank, WaveformController):
            bank.law["fade"] = 1.0


def drive_limits(controller: Any) -> Array:
    """Limit of the drive in every channel (unit of the drive), shape (channels,).

    It is 0 where a part does not play, infinite where its controller states none.
    """
    parts = _parts(controller)
    channels = controller.part_channels if isinstance(controller, CombinedController) else (controller.channels,)
    limits = [
        0.0 if each is None else float(each.settings["drive_limit"]) if hasattr(each, "settings") else np.inf
        for each in parts
    ]
    return np.repeat(limits, channels)


def _parts(controller: Any) -> Sequence[Any]:
    return controller.parts if isinstance(controller, CombinedController) else (controller,)


def _blocks(part: Any) -> dict[str, Block]:
    """Blocks of a part by name: of its supervisor, of its controller, and what the waveform law has learned."""
    found: dict[str, Block] = {}
    if isinstance(part, SupervisedController):
        p, at = part.state["p"][0], part.state.ctypes.data
        for name, ends in {"tests": ("fade", "heat"), "heat": ("heat", "last"), "sensors": ("last", None)}.items():
            found[name] = _fields(at, SUPERVISOR, *ends)
        found["forces"] = int(p["forces_at"]), 3 * (int(p["delay"]) + 1)
        if p["gains"]:
            found["gains"] = _fields(int(p["gains"]), GAINS, "models")
        part = part.controller
    state = getattr(part, "state", None)
    if state is None or state.dtype != CONTROLLER:
        return found
    at = state.ctypes.data
    found["tracker"] = _fields(at, CONTROLLER, "held_position", "fresh")
    if not isinstance(part, WaveformController):
        return found | {"finger": _fields(at, CONTROLLER, "fresh", "past")}  # and the rounding
    # the same fields, which mean other things there, and what the damper remembers
    found |= {"contact": _fields(at, CONTROLLER, "fresh", "sample")}
    law, at, delay = part.law, int(state["law_at"][0]), int(part.law["delay"])
    found |= {"learned": _fields(at, LAW, "peak", "ring_at"), "window": _fields(at, LAW, "window")}
    return found | {"ring": (int(law["ring_at"]), RING * (delay + 1)), "reference": (int(law["reference_at"]), delay)}


def _fields(address: int, kind: np.dtype, first: str, end: str | None = None) -> Block:
    """Fields of a record of 8-byte numbers at `address`, from `first` on and before `end`."""
    offsets = {name: place[1] for name, place in (kind.fields or {}).items()}
    start, stop = offsets[first], kind.itemsize if end is None else offsets[end]
    return address + start, (stop - start) // 8
