"""Records that the compiled controllers work on: tiles of sixteen bands, settings, and state.

A band's numbers are lanes of a *tile*: every field of a tile is `W` bands wide and lies at a constant offset, so that a
plain loop over ``range(W)`` becomes vector instructions.  Symbols, for a band with the carrier e^(j phi):

    r        reference envelope R as the sensors show it; target: the same in the device's unit
    e        error envelope E, estimated minus reference         v        integral part v of the command V = R + v
    d, s     dynamic stiffness D(j w), finger included, turned ahead by delay and hold; its slope D'(j w) alike

The fields of both coordinates, and of the law between them, lie in the same tile: loops over fields of two records do
not vectorise, as the compiler has to assume that they overlap.  A device of one coordinate leaves the other's at zero.
"""

from __future__ import annotations

import numba
import numpy as np

from hapticrender.protocols import Array

W = 8  # bands a tile
MOST_SENSORS = MOST_CHANNELS = 8
MOST_TAPS = 16
FIXED, FADING, LOCKED = range(3)  # modes of a tile: nothing changes; its targets do; its carriers follow the finger
SETPOINT_ROWS = 7  # frequency (Hz), wavenumber (1/m), phase (turns), target (re, im), sensor response (re, im)


def _complex(*names: str) -> list[str]:
    return [f"{name}_{part}" for name in names for part in ("re", "im")]


TILE_FIELDS = [
    "active",  # 1, or 0 in a lane without a band
    "frequency",  # Hz, the fixed part
    "wavenumber",  # 1/m
    "phase",  # turns
    *_complex("setpoint", "response"),  # setpoint; what the sensor shows per target
    "turns",  # fixed part of the phase; of fixed carriers at the next refresh
    *("cos", "sin"),  # the carrier at the sample, or at the block's start
    *("turn_cos", "turn_sin"),  # its turn a sample
    "omega",  # rad/s
    "sweep",  # rad/s^2
    "fade",  # 0..1: how far its target has faded in
    "weight",  # 0..1: weight of the target
    "feedback",  # 0..1: weight of the feedback
    *_complex(
        "target", "r", "expected", "slope", "raw"
    ),  # expected: R in the block's middle; raw: envelope of the waveform
    *_complex("ahead"),  # rho: the turn by delay and hold
    *_complex("remainder"),  # stiffness of the finger beyond its three numbers
    # adaptation: the finger's force, R and omega, delayed and filtered like the observer
    *_complex("finger_force", "filtered_r"),
    *("filtered_omega", "complete"),
    *_complex("contact_motion", "residual"),  # adaptation: motion at the finger, force that the finger takes
    *("amount", "sounds", "direction"),  # polar law: |R|, whether that is no silence, sign of the carrier's frequency
    *_complex("heading"),  # R/|R|, the last one in silence
    # of each coordinate: slope0 is dV/dt; fast, slow the detectors' low passes; work, rise: what a block sums up, and
    # its rise over the block; last_force, force: envelopes at the end of the last block and of this one; command,
    # filtered (command), last (deviation): see `adaptation`
    *_complex(
        *(
            f"{n}{i}"
            for i in (0, 1)
            for n in "e v slope fast slow work rise last_force force command filtered last".split()
        )
    ),
    *_complex("command_force"),  # the finger's part of the force
    *_complex(*(f"{n}{i}{j}" for i in (0, 1) for j in (0, 1) for n in "ds")),  # the law, to and from a coordinate
]
LOW_PASS_FIELDS = [
    *_complex("x", "low1", "low2", "law1", "law2", "v", "slope"),
    *("drive", "lag", "amplitude", "theta"),
]
"""Of a tile in a coordinate of a method with low passes: envelope X; states of low pass and loop controller, of which
the polar law has amplitude (re) and phase (im); V and dV/dt; drive per metre and lag (rad) of the free device;
amplitude and phase (rad), of X and then commanded."""
COMMAND_FIELDS = _complex("command0", "command1", "command_force")


def _record(names: list[str]) -> np.dtype:
    return np.dtype([(name, np.float64, (W,)) for name in names])


TILE = np.dtype([("mode", np.int64, (8,)), *((name, np.float64, (W,)) for name in TILE_FIELDS)])
LOW_PASS, COMMAND = _record(LOW_PASS_FIELDS), _record(COMMAND_FIELDS)
"""Commands are ordered [step, tile]."""

_SETTINGS = """
rate lead reference middle extrapolation fade_in lowest highest highest_edge modulated differentiated analysed
needs_contact least_speed sensor_delay contact_lag corrected sensor_limit drive_limit drive_step peak_decay
back_calculation observer observer_high crowd_speed dc dc_drift dc_fast dc_drift_fast
integral integral_medium integral_high damper damper_high
detects fast_pole slow_pole fast_level slow_level fast_time slow_time release
contact_on contact_off contact_damping typical_speed lock
adaptation adaptation_high rest rest_high age least_motion typical_mass typical_stiffness
least_mass most_mass least_damping most_damping least_stiffness most_stiffness
polar clamped subtracted feedback forward deviation dynamic table_step
""".split()
SETTINGS = np.dtype(
    [
        *((name, np.float64) for name in _SETTINGS),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        ("shape", np.float64, (2,)),
        ("added_damping", np.float64, (2,)),
        ("taps", np.float64, (2, MOST_TAPS)),
        ("coordinate_from_sensor", np.float64, (2, MOST_SENSORS)),
        ("drive_from_force", np.float64, (MOST_CHANNELS, 2)),
        ("low_pass", np.float64, (5,)),
        ("loop", np.float64, (5,)),
        *((name, np.int64) for name in ("coordinates", "block", "sensors", "channels", "n_taps", "window", "table")),
    ]
)
"""Settings of a controller, as its design derived them; `hapticrender.control.controller` says what each is."""

_STATE = """
held_position smooth_position velocity acceleration finger_seen fresh speed table_velocity
load lever contact known_contact known_lever finger_mass finger_damping finger_stiffness
fast_timer slow_timer fast_open slow_open peak scale confidence shift unlocked response_gain
gain damping_gain quick idle
""".split()
CONTROLLER = np.dtype(
    [
        ("p", SETTINGS),
        *((name, np.float64) for name in _STATE),
        *((name, np.float64, (2,)) for name in ("dc", "dc_drift", "deviation")),
        ("past", np.float64, (2, MOST_TAPS)),
        ("shaper", np.float64, (2, MOST_CHANNELS)),
        *((name, np.int64) for name in ("sample", "tiles", "bands", "history", "moving", "stale", "implausible")),
        *(
            (name, np.int64)
            for name in (
                "tiles_at",
                "loops_at",
                "commands_at",
                "setpoints_at",
                "work_at",
                "tables_at",
                "samples_at",
                "window_at",
                "gains_at",
            )
        ),
    ]
)
"""Settings and state of a controller, and the addresses of its arrays."""
CONTROLLER_T, TILE_T, LOW_PASS_T, COMMAND_T = map(numba.from_dtype, (CONTROLLER, TILE, LOW_PASS, COMMAND))


def aligned(shape: int | tuple[int, ...], dtype: type | np.dtype = np.float64) -> Array:
    """Array of zeros that starts at a multiple of 64 bytes, where vector loads are fastest."""
    dtype = np.dtype(dtype)
    size = int(np.prod(shape)) * dtype.itemsize
    memory = np.zeros(size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + size].view(dtype).reshape(shape)


def lanes(tiles: Array, name: str, bands: int) -> Array:
    """Copy of a field of all tiles, band after band, shape (bands,)."""
    return np.ascontiguousarray(tiles[name]).reshape(-1)[:bands]
