"""A bank of bands behind the `Controller` protocol: settings, state and a compiled step."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.carriers import predict_positions
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.records import (
    CONTROLLER,
    FADING,
    LOW_PASS,
    MOST_CHANNELS,
    MOST_SENSORS,
    PAIR,
    SAMPLE_ROWS,
    SETPOINT_ROWS,
    TILE,
    WORK,
    W,
    aligned,
    lanes,
)
from hapticrender.jit import Addressed, CFunction, addresses, record_of
from hapticrender.protocols import Array

LARGEST_GROUP = 16  # samples of a block whose carriers are taken from the middle of them,
LONGEST_GROUP = 0.5e-3  # s: an acceleration of 10 m/s2 moves the finger by 0.3 um from its mean motion in it
SETTLED = 0.05  # of a target: below it an error counts as settled
LEAST_TARGET = 3e-3  # of the sensors' range: below it noise adds more than a wrong device model


class BankController(Addressed):
    """A bank of bands behind the `Controller` protocol: settings, state and a compiled step, designed by `method`.

    `settings` are fields of `records.SETTINGS`, zero where left out; `history` counts the steps of adaptation whose
    commands are kept; `arrays` are further ones of the step by the name of their address; the waveform handed to `run`
    is to be `lookahead` samples ahead.
    """

    _kept: tuple[dict[str, Array], Array, tuple[int, ...]] | None = None  # signals, record, arguments of the last run

    def __init__(
        self,
        method: str,
        step: CFunction,
        settings: Mapping[str, Any],
        bands: Bands,
        *,
        history: int = 1,
        arrays: dict[str, Array] | None = None,
        lookahead: int = 0,
    ) -> None:
        self.lookahead = lookahead
        self.method, self.step, self.bands = method, step, bands
        self.n_bands = len(bands)
        self.block = int(settings["block"])  # samples that `step` takes at once; `run` takes any multiple
        self.channels, self.sensors = int(settings["channels"]), int(settings["sensors"])
        self.rate = float(settings["rate"])  # Hz
        tiles = max(-(-self.n_bands // W), 1)
        self.tiles = aligned(tiles, TILE)
        self.tiles["mode"] = FADING
        self.tiles["turn_re"] = self.tiles["r_phasor_re"] = self.tiles["omega_sign"] = 1.0
        self.tiles["active"] = (np.arange(tiles * W) < self.n_bands).reshape(tiles, W)
        self.setpoints = setpoint_rows(bands)
        most = min(max(int(LONGEST_GROUP * self.rate), 1), LARGEST_GROUP)
        group = min(most, self.block)
        groups = -(-self.block // group)  # the last one may be filled in part
        loops = int(settings["coordinates"]) * tiles
        memory = {
            "tiles": self.tiles,
            "loops": aligned(loops, LOW_PASS),
            "window": aligned((int(settings.get("window", 0)), loops), PAIR),
            "references": aligned(int(settings.get("late", 0)) * tiles, PAIR),
            "commands": aligned(history * tiles * 3, PAIR),  # of both coordinates; the finger's force
            "setpoints": self.setpoints,
            "work": aligned(2 * tiles, WORK),
            "table": aligned((group + 1) // 2 * tiles, PAIR),
            "phasors": aligned(groups * tiles, PAIR),
            "samples": np.zeros((SAMPLE_ROWS, groups * group)),
        } | (arrays or {})
        self._arrays = memory
        places = {f"{name}_at": array for name, array in memory.items() if f"{name}_at" in (CONTROLLER.names or ())}
        start: dict[str, float] = {"tiles": tiles, "bands": self.n_bands, "history": history, "stale": 1, "locked": 1}
        start |= {"scale": 1.0, "confidence": 1.0, "damper_scale": 1.0, "unlocked": 1.0, "response_gain": math.nan}
        self.state = record_of(CONTROLLER, **start, **places)
        for name, value in {**settings, "group": group, "groups": groups}.items():
            self.state["p"][name][0] = value

    @property
    def settings(self) -> Any:
        """Settings as designed (a record; see `records.SETTINGS`)."""
        return self.state["p"][0]

    def field(self, name: str) -> Array:
        """Copy of a field of every band's tile, shape (bands,)."""
        return lanes(self.tiles, name, self.n_bands)

    def largest(self, name: str) -> Array:
        """Largest magnitude over the coordinates of a complex field of the loops, shape (bands,)."""
        return np.max([np.hypot(self.field(f"{name}{i}_re"), self.field(f"{name}{i}_im")) for i in (0, 1)], axis=0)

    @property
    def mismatch(self) -> float:
        """Largest share of a settled, fixed target that the integral part adds on the untouched device, else 0.

        There the law alone should do: what the integral has to make up for is what the device model lacks.
        """
        state = self.state[0]
        touched = state["contact"] != 0.0 or state["confidence"] < 1.0 or state["scale"] < 1.0
        if touched or not self.settings["observer"] > 0.0:
            return 0.0
        size = np.hypot(self.field("r_re"), self.field("r_im")) * (self.field("wavenumber") == 0.0)
        error, integral = self.largest("e"), self.largest("v")
        counts = (size > LEAST_TARGET * self.settings["sensor_limit"]) & (error < SETTLED * size)
        return float((integral[counts] / size[counts]).max(initial=0.0))

    def run(self, sensed: Array, position: Array, waveform: Array) -> tuple[Array, Array, Array]:
        """Advance by n samples; see `Controller`.  A ValueError where n is no multiple of the block."""
        n = len(sensed)
        if n % self.block:
            raise ValueError(f"{n} samples: must be a multiple of the block of {self.block} samples")
        found, must = (sensed.shape, position.shape, waveform.shape), ((n, self.sensors), (n,), (n,))
        if found != must:
            raise ValueError(f"sensed, position and waveform of shapes {found}: must be {must}")
        kept = self._kept  # of blocks of this length: their addresses take longer than the step
        if kept is None or len(kept[0]["flags"]) != n:
            signals = {"sensed": np.zeros((n, self.sensors)), "position": np.zeros(n), "waveform": np.zeros(n)}
            signals |= {"drive": np.zeros((n, self.channels)), "flags": np.zeros(n, np.int64)}
            signals["target"] = np.zeros((n // self.block, self.n_bands), complex)
            record = addresses(**signals)
            self._kept = kept = signals, record, (self.state.ctypes.data, record.ctypes.data, 0, n)
        signals, _, arguments = kept
        signals["sensed"][:], signals["position"][:], signals["waveform"][:] = sensed, position, waveform
        signals["flags"][:] = 0
        self.step(*arguments)
        target = signals["target"].copy() if self.block == 1 else np.repeat(signals["target"], self.block, axis=0)
        return signals["drive"].copy(), target, signals["flags"].copy()


class PositionPredictor:
    """Positions of the finger (m) `ahead` samples from now, by the velocity and acceleration observed."""

    def __init__(self, rate: float, ahead: int) -> None:
        self.ahead, self._tracker = float(ahead), np.zeros(1, CONTROLLER)
        self._tracker["p"]["rate"], self._tracker["held_prediction"] = rate, math.nan

    def __call__(self, position: Array) -> Array:
        """Predict from the next positions (n,), NaN while lifted, where the last prediction holds; shape (n,)."""
        position, predicted = np.ascontiguousarray(position, float), np.empty(len(position))
        predict_positions(self._tracker.ctypes.data, position, self.ahead, predicted)
        return predicted


def setpoint_rows(bands: Bands) -> Array:
    """Setpoints of a compiled step: frequency, wavenumber, phase (turns), target and sensor response (re, im).

    The shape is (7, lanes), with zeros in lanes beyond the bands.
    """
    n = len(bands)
    rows = aligned((SETPOINT_ROWS, max(-(-n // W), 1) * W))
    rows[0, :n], rows[1, :n], rows[2, :n] = bands.frequency, bands.wavenumber, bands.phase / (2 * np.pi)
    rows[5, :n] = 1.0
    if bands.envelope is not None:
        rows[3, :n], rows[4, :n] = bands.envelope.real, bands.envelope.imag
    if bands.sensor_response is not None:
        rows[5, :n], rows[6, :n] = np.real(bands.sensor_response), np.imag(bands.sensor_response)
    return rows


def spacing(bands: Bands) -> float:
    """Least distance between two fixed carriers (Hz); infinite where there is one or none."""
    return float(np.diff(np.sort(bands.frequency[bands.wavenumber == 0.0])).min(initial=np.inf))


def ridge_spacing(bands: Bands) -> float:
    """Least distance between two carriers that follow the finger (1/m); infinite where there is one or none."""
    return float(np.diff(np.sort(bands.wavenumber[bands.wavenumber > 0.0])).min(initial=math.inf))


def lowest_carrier(model: DeviceModel, bands: Bands) -> float:
    """Lowest carrier (Hz): of the fixed ones, and of what a moving finger makes of the others."""
    fixed = bands.frequency[bands.wavenumber == 0.0]
    return float(fixed.min(initial=math.inf if len(fixed) == len(bands) else model.lowest_frequency))


def refuse_whole_waveform(bands: Bands) -> None:
    """Refuse a texture without carriers, in a method that works band by band."""
    if bands.whole:
        playable = "use 'inverse', or a grating, or a recording with carriers >= 1"
        raise ValueError(f"texture: this method plays bands, no whole waveform: {playable}")


def shared_settings(
    model: DeviceModel, bands: Bands, sensor_map: Array, drive_map: Array, feedback: bool
) -> dict[str, Any]:
    """Settings that every method has, sample by sample; a ValueError where the device has too many channels.

    `sensor_map` (c, s) takes sensors to controlled coordinates, `drive_map` (d, c) what the law commands in each
    coordinate to drive channels.  Without feedback nothing is sensed.
    """
    sensor_map = sensor_map[:, : None if feedback else 0]
    counts = {"coordinates": len(sensor_map), "channels": len(drive_map), "sensors": sensor_map.shape[1]}
    for (name, count), most in zip(counts.items(), (2, MOST_CHANNELS, MOST_SENSORS), strict=True):
        if count > most:
            raise ValueError(f"the device model has {count} {name}: must be <= {most}")
    return {
        **counts,
        "block": 1,
        "coordinate_from_sensor": padded(sensor_map, 2, MOST_SENSORS),
        "drive_from_force": padded(drive_map, MOST_CHANNELS, 2),
        "rate": float(model.rate),
        "lead": (model.delay + 0.5) / model.rate,
        "middle": 1.0,
        "lowest": float(model.lowest_frequency),
        "highest": float(min(model.highest_frequency, 0.4 * model.rate)),
        "reads_waveform": bands.envelope is None,
        "modulated": bands.modulated,
        "differentiated": bands.differentiated,
        "sensor_limit": float(model.sensed_limit),
        "drive_limit": float(model.drive_limit),
    }


def device_settings(model: DeviceModel) -> dict[str, Any]:
    """Settings of the methods that invert the device's dynamic stiffness."""
    return {
        **{name: padded(getattr(model, name), 2, 2) for name in ("mass", "damping", "stiffness")},
        "pattern": np.append(model.pattern, [0.0])[:2],
        "dynamic": True,
        "needs_contact": model.finger.needs_contact,
        "least_speed": model.finger.least_speed,
    }


def padded(matrix: Array, rows: int, columns: int) -> Array:
    """Matrix of shape (rows, columns) with zeros below and beside what is given."""
    found = np.zeros((rows, columns))
    found[: matrix.shape[0], : matrix.shape[1]] = matrix
    return found
