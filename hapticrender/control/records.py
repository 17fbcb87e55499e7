"""Records that the compiled controllers work on: tiles of eight bands, settings, and state.

A band's numbers are lanes of a *tile*: every field of a tile is `W` bands wide, so that `hapticrender.vectors` works
on eight bands at a time.  Symbols, for a band with the carrier e^(j phi):

    r        reference envelope R as the sensors show it; target: the same in the device's unit
    e        error envelope E, estimated minus reference         v        integral part v of the command V = R + v
    d, s     dynamic stiffness D(j w), finger included, turned ahead by delay and hold; its slope D'(j w) alike

Fields of a coordinate, and of the law between two, are numbered in a tile (``e0_re``); kernels reach them as records of
their own, see `coordinates_of`.  A device of one coordinate leaves the other's at zero.
"""

import numba
import numpy as np
from numba import carray

from hapticrender.jit import F8, kernel, pointer
from hapticrender.jit import aligned as aligned
from hapticrender.protocols import Array
from hapticrender.vectors import W, tile_type

MOST_SENSORS = MOST_CHANNELS = 8
MOST_TAPS = 64  # of the inner damper, a power of two
MOST_STRIDE = 16  # samples from one of its taps to the next, a power of two
PAST = MOST_TAPS * MOST_STRIDE  # deviations in its ring
PAST_MASK = PAST - 1  # of an index of that
LEAK = 50.0  # 1/s: error and integral of a carrier that has faded out decay at this rate
FIXED, FADING, LOCKED = range(3)  # modes of a tile: nothing changes; its targets do; its carriers follow the finger
SETPOINT_ROWS = 7  # frequency (Hz), wavenumber (1/m), phase (turns), target (re, im), sensor response (re, im)


def _complex(*names: str) -> list[str]:
    return [f"{name}_{part}" for name in names for part in ("re", "im")]


# of each coordinate: error and integral envelopes, dV/dt; low passes of the detectors; force envelopes at the end of
# the last block and of this one; command and deviation, see `adaptation`
COORDINATE_NAMES = "e v slope fast slow last_force force filtered last".split()
STIFFNESS_NAMES = "ds"  # D and D' of the law, of each pair of coordinates
TILE_FIELDS = [
    "active",  # 1, or 0 in a lane without a band
    "frequency",  # Hz, the fixed part
    "wavenumber",  # 1/m
    "phase",  # turns
    *_complex("setpoint", "response"),  # target as set; what the sensor shows per target
    "turns",  # fixed part of the phase; of fixed carriers at the next refresh
    *_complex("carrier"),  # e^(j phi) at the sample, or at the block's start without the finger's part
    *_complex("turn"),  # of the carrier a sample
    "omega",  # rad/s
    "sweep",  # rad/s^2
    "fade",  # 0..1: how far the target has faded in
    "weight",  # 0..1, of the target
    "feedback",  # 0..1: weight of the feedback
    *_complex("target", "r", "slope"),  # target; reference R and dR/dt
    *_complex("expected", "raw"),  # R in the block's middle, or `late` samples ago; envelope of the waveform
    *_complex("ahead"),  # rho: the turn by delay and hold
    *_complex("remainder"),  # stiffness of the finger beyond its three numbers
    *_complex("finger_force", "filtered_r"),  # adaptation: the finger's force, R and omega, delayed and filtered like
    *("filtered_omega", "complete"),  # the observer; share of a carrier's own history in them
    *("r_magnitude", "r_nonzero", "omega_sign"),  # polar law: |R|, whether it is above `SILENCE`, sign of the frequency
    *_complex("r_phasor"),  # R/|R|, the last one in silence
    *_complex(*(f"{name}{i}" for i in (0, 1) for name in COORDINATE_NAMES)),
    *_complex(*(f"{name}{i}{j}" for i in (0, 1) for j in (0, 1) for name in STIFFNESS_NAMES)),
]
WORK_FIELDS = _complex("x", "rise", "y", "up")
"""Of a tile and coordinate in a block: an envelope and its rise over the block; the same turned to a group."""
LOW_PASS_FIELDS = [*_complex("low1", "low2", "law1", "law2", "v"), *("drive", "lag")]
"""Of a tile in a coordinate of a method with low passes: states of low pass and loop controller, of which the polar
law has amplitude (re) and phase (im); V; drive per metre and lag (rad) of the free device."""


def _record(names: list[str]) -> np.dtype:
    return np.dtype([(name, np.float64, (W,)) for name in names])


TILE = np.dtype([("mode", np.int64, (8,)), *((name, np.float64, (W,)) for name in TILE_FIELDS)])
LOW_PASS, WORK, PAIR = map(_record, (LOW_PASS_FIELDS, WORK_FIELDS, _complex("z")))
"""Work is ordered [tile, coordinate]; a pair is a complex number for each band of a tile."""

_SETTINGS = """
rate lead waveform_gain middle extrapolation fade_in lowest highest highest_edge modulated differentiated reads_waveform
needs_contact least_speed sensor_delay contact_length corrected sensor_limit drive_limit drive_step peak_decay
back_calculation observer observer_high crowd_speed dc dc_drift dc_fast dc_drift_fast
integral integral_medium integral_high damper damper_high damper_limit
detects fast_smoothing slow_smoothing fast_threshold slow_threshold fast_time slow_time release
contact_on contact_off contact_damping typical_speed lock
adaptation adaptation_high rest rest_high age least_motion typical_mass typical_stiffness
polar clamped subtracted feedback forward deviation dynamic table_step
""".split()
SETTINGS = np.dtype(
    [
        *((name, np.float64) for name in _SETTINGS),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        *((f"{name}_range", np.float64, (2,)) for name in ("mass", "damping", "stiffness")),  # of a finger
        ("pattern", np.float64, (2,)),
        ("added_damping", np.float64, (2,)),
        ("damper_noise", np.float64, (2,)),  # N rms beyond `RINGING`, of `damper_force` by sensor noise; 0: unknown
        ("taps", np.float64, (2, MOST_TAPS)),
        ("coordinate_from_sensor", np.float64, (2, MOST_SENSORS)),
        ("drive_from_force", np.float64, (MOST_CHANNELS, 2)),
        ("low_pass", np.float64, (5,)),
        ("loop", np.float64, (5,)),
        *(
            (name, np.int64)
            for name in "coordinates block group groups sensors channels n_taps tap_stride window table late".split()
        ),
    ]
)
"""Settings of a controller, as its design derived them; `hapticrender.control.controller_design` derives them."""

_STATE = """
held_position held_prediction smooth_position velocity acceleration finger_seen fresh speed smooth_speed table_velocity
load lever contact law_contact law_lever finger_mass finger_damping finger_stiffness
fast_timer slow_timer fast_open slow_open peak_squared scale confidence shift unlocked response_gain
gain damping_gain damper_scale dc_gain dc_drift_gain feedback_off
""".split()
_ARRAYS = "tiles loops law commands setpoints work table phasors samples window gains references"
CONTROLLER = np.dtype(
    [
        ("p", SETTINGS),
        *((name, np.float64) for name in _STATE),
        *((name, np.float64, (2,)) for name in ("dc", "dc_drift", "deviation", "damper_force")),
        ("shaper", np.float64, (2, MOST_CHANNELS)),
        ("past", np.float64, (2, PAST)),
        *((name, np.int64) for name in ("sample", "tiles", "bands", "history", "locked", "stale", "implausible")),
        *((f"{name}_at", np.int64) for name in _ARRAYS.split()),
    ]
)
"""Settings and state of a controller, and the addresses of its arrays; kernels take it as `c`, by reference."""
CONTROLLER_T = numba.from_dtype(CONTROLLER)
TILE_T, LOW_PASS_T, WORK_T, PAIR_T = map(tile_type, (TILE, LOW_PASS, WORK, PAIR))
COORDINATE_T, STIFFNESS_T = (tile_type(_record(_complex(*names))) for names in (COORDINATE_NAMES, STIFFNESS_NAMES))
TILE_SIZE = TILE.itemsize
COORDINATES_AT, STIFFNESSES_AT = (TILE.fields[name][1] for name in ("e0_re", "d00_re"))  # type: ignore[index]

# rows of the samples' work array (rows, M): coordinates, then innovations; sums over the bands and their steps; finger
# position; waveform; response r, first columns of Q for the innovation and for the waveform; what was solved; sums and
# differences of samples at equal distances from a group's middle
Y, SUM, STEP, POSITION, WAVEFORM, RESPONSE, TOEPLITZ, ANALYSIS, SOLVED, FOLDED = 0, 2, 4, 6, 7, 8, 9, 10, 11, 12
SAMPLE_ROWS = 14


@kernel
def coordinates_of(c, t):
    """Address of the records of a tile's coordinates, of type `COORDINATE_T`."""
    return c.tiles_at + t * TILE_SIZE + COORDINATES_AT


@kernel
def stiffnesses_of(c, t):
    """Address of the records of the law between a tile's coordinates i and j, number 2 i + j of type `STIFFNESS_T`."""
    return c.tiles_at + t * TILE_SIZE + STIFFNESSES_AT


@kernel
def samples_of(c):
    """Work array of the samples, shape (rows, groups g); samples beyond M stay zero but for the sums."""
    return carray(pointer(c.samples_at, F8), (SAMPLE_ROWS, c.p.groups * c.p.group))


def lanes(tiles: Array, name: str, bands: int) -> Array:
    """Copy of a field of all tiles, band after band, shape (bands,)."""
    return np.ascontiguousarray(tiles[name]).reshape(-1)[:bands]
