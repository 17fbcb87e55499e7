"""Two controllers as one, for a device whose two parts add up to one skin velocity: a plate and a friction device.

Each part has a controller of its own, of the same method, for its own bands; their channels lie side by side, and
their targets add up to the target of the skin's velocity, V = j w X + (v/F) F.
"""

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba import carray

from hapticrender.bands import Bands
from hapticrender.control.controller import BankController
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.records import CONTROLLER_T, MOST_CHANNELS, TILE_T, W
from hapticrender.control.supervisor import Fault, SupervisedController, supervised
from hapticrender.jit import C16, F8, I8, SIGNALS_T, Addressed, addresses, call, pointer, record, record_of, step
from hapticrender.protocols import Array, Method


@dataclass(frozen=True, kw_only=True, eq=False)
class CombinedModel(DeviceModel):
    """Device model of a device of two parts, which have a model and a controller each."""

    plate: DeviceModel  # of the part that moves the skin (m)
    friction: DeviceModel | None  # of the part that makes friction (N); None: it has no target
    velocity_per_force: float  # m/(N s): skin velocity that feels as strong as a newton of friction


@dataclass(frozen=True, kw_only=True, eq=False)
class CombinedBands(Bands):
    """Bands of a device of two parts, their envelopes the target displacement (m), and the share of each part."""

    plate: Bands  # targets (m)
    friction: Bands  # targets (N)
    plate_index: Array  # int: which of all bands those of the plate are
    friction_index: Array  # alike


PART = np.dtype(
    [
        *((name, np.int64) for name in ("step", "state", "bank", "signals", "sensors", "channels", "bands", "index")),
        ("scale", np.complex128),  # target of the skin's velocity per target of the part; 0: j w
        ("scale_waveform", np.float64),  # of the part per waveform of both
        ("heat", np.float64, (MOST_CHANNELS,)),  # of a part without target: means of the squares of its drives,
        ("heat_decay", np.float64),  # and the share of them that a block leaves
    ]
)
COMBINED = np.dtype([*((name, np.int64) for name in ("bands", "channels", "sensors", "block")), ("parts", PART, (2,))])
COMBINED_T = numba.from_dtype(COMBINED)


@step
def combined_step(state, signals, start, count):
    """Advance both controllers by `count` samples, block by block; their targets add up to a skin velocity (m/s)."""
    c, io = record(state, COMBINED_T, 0), record(signals, SIGNALS_T, 0)
    block, stop = c.block, start + count
    sensed, drive = carray(pointer(io.sensed, F8), (stop, c.sensors)), carray(pointer(io.drive, F8), (stop, c.channels))
    waveform, target = carray(pointer(io.waveform, F8), stop), carray(pointer(io.target, C16), (stop // block, c.bands))
    for first in range(start, stop, block):
        sensor = channel = 0
        row = first // block
        for k in range(c.bands):
            target[row, k] = 0.0
        for i in range(2):
            p = c.parts[i]
            own = record(p.signals, SIGNALS_T, 0)
            part_sensed = carray(pointer(own.sensed, F8), (block, p.sensors))
            part_drive = carray(pointer(own.drive, F8), (block, p.channels))
            goal, index = carray(pointer(own.target, C16), (1, p.bands)), carray(pointer(p.index, I8), p.bands)
            part_waveform = carray(pointer(own.waveform, F8), block)
            own.position, own.flags = io.position + 8 * first, io.flags + 8 * first
            for m in range(block):
                for s in range(p.sensors):
                    part_sensed[m, s] = sensed[first + m, sensor + s]
                part_waveform[m] = p.scale_waveform * waveform[first + m]
            if p.step != 0:
                call(p.step, (p.state, p.signals, 0, block))
            for k in range(MOST_CHANNELS):
                p.heat[k] *= p.heat_decay
            for m in range(block):
                for k in range(p.channels):
                    drive[first + m, channel + k] = part_drive[m, k]
            for k in range(p.bands):
                scale = p.scale
                if scale == 0.0:
                    scale = complex(0.0, record(record(p.bank, CONTROLLER_T, 0).tiles_at, TILE_T, k // W).omega[k % W])
                target[row, index[k]] += scale * goal[0, k]
            sensor, channel = sensor + p.sensors, channel + p.channels
    return 0


class CombinedController(Addressed):
    """Controllers of one method for plate and friction device, with their shares of the targets, as one `Controller`.

    A part is None where it has no target and stays without drive; a whole waveform is the plate's alone.  Without
    feedback both drive open loop.  A ValueError where `bands` share nothing out, or the method plays no whole waveform.
    """

    def __init__(self, method: Method, model: CombinedModel, bands: CombinedBands, *, feedback: bool = True) -> None:
        if not isinstance(bands, CombinedBands):
            raise ValueError("bands: must be CombinedBands, which share out what a device of two parts plays")
        self.method, self.bands, self.n_bands, self.step = getattr(method, "name", ""), bands, len(bands), combined_step
        shares = (model.plate, bands.plate, bands.whole), (model.friction, bands.friction, False)
        self.parts = tuple(_designed(method, *share, feedback) for share in shares)
        sensors = (model.plate.coordinate_from_sensed.shape[1], 1) if feedback else (0, 0)
        self.part_channels = channels = (model.plate.force_from_drive.shape[1], 1)
        self.channels, self.sensors = sum(channels), sum(sensors)
        self.lookahead = int(getattr(self.parts[0], "lookahead", 0)) if bands.whole else 0
        self.rate = next((part.rate for part in self.parts if part is not None), 0.0)
        self.block = max(part.block if part is not None else 1 for part in self.parts)
        self.state = record_of(COMBINED, self, bands=self.n_bands)
        self._buffers: list[Array] = []
        # of a part without target the heat decays, see `supervisor_kernel.limit_rms_drive`; limits are the plate's
        heat_decay = math.exp(-self.block / (model.plate.rms_time * model.rate)), 1.0
        scales = (0.0, 1.0), (model.velocity_per_force, 1.0 / model.velocity_per_force)
        indices = [np.ascontiguousarray(each, np.int64) for each in (bands.plate_index, bands.friction_index)]
        for i, (part, (scale, per_target)) in enumerate(zip(self.parts, scales, strict=True)):
            count = 0 if part is None else part.n_bands
            arrays = {
                "sensed": np.zeros((self.block, sensors[i])),
                "drive": np.zeros((self.block, channels[i])),
                "waveform": np.zeros(self.block),
                "target": np.zeros((1, count), complex),
            }
            signals = addresses(**arrays)
            self._buffers += [*arrays.values(), indices[i], signals]
            values: dict[str, Any] = {}
            if part is not None:
                bank = getattr(part, "controller", part)
                values = {"step": part.step.address, "state": part.state, "bank": bank.state}
            own = record_of(
                PART,
                **values,
                signals=signals,
                index=indices[i],
                bands=count,
                sensors=sensors[i],
                channels=channels[i],
                scale=scale,
                scale_waveform=per_target if bands.envelope is None else 1.0,
                heat_decay=heat_decay[i],
            )
            self.state["parts"][0, i] = own[0]

    @property
    def mismatch(self) -> float:
        """Share of a target that the integral parts add on the untouched device; see `BankController.mismatch`."""
        return max((part.mismatch for part in self.parts if part is not None), default=0.0)

    @property
    def damper_scale(self) -> float:
        """Least gain to which a ringing inner damper of a part has been turned down; see `SupervisedController`."""
        return min(getattr(part, "damper_scale", 1.0) for part in self.parts)

    @property
    def fault(self) -> Fault | None:
        """Why and when the drive of a part has been stopped; see `SupervisedController`."""
        parts: tuple[Any, ...] = self.parts
        found = (part.fault for part in parts if isinstance(part, SupervisedController))
        return next((fault for fault in found if fault is not None), None)

    def unplayed(self, samples: Array) -> None:
        """Compare motion with no drive where that of both parts was not played; see `SupervisedController`."""
        for part in self.parts:
            if isinstance(part, SupervisedController):
                part.unplayed(samples)

    run = BankController.run
    _kept: Any = None  # by it


def _designed(method: Method, model: DeviceModel | None, bands: Bands, whole: bool, feedback: bool) -> Any:
    """Return a supervised controller of one part; None where it has no target."""
    if model is None or not (len(bands) or whole):
        return None
    return supervised(method.design(model, bands, feedback=feedback), model, feedback=feedback)
