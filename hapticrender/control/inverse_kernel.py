"""The waveform law's step: exact inverse dynamics of the reference, and a Kalman filter that learns what they lack.

With the reference r = s r(t) (s the pattern over the coordinates) the believed device takes the force
F_nom = M r'' + C r' + K r.  The true one moves by r + e (docs/theory.md)::

    (D + dD + z h h^T) e = F_dev - (dD + z h h^T) r - F_load,       F_dev = F_played - F_nom

Everything that is not known is linear in parameters th_i: the finger z on r, r', r'' and on r through one pair of
poles, the device's errors dD of stiffness, damping, mass and delay, and the finger's load.  With G the loaded device,

    e = w - sum_i th_i psi_i + noise,       psi_i = G [s_i phi_i],   w = G [F_dev]

holds whatever was played, and a Kalman filter finds th; no stability limit follows from how fast it learns.  What it
finds is played ahead, F = F_nom + sum_i th_i s_i phi_i, with the inner damper on e for a while after a contact.
The delay d is that of samples: a block of M samples is the same law with a longer delay.
"""

from __future__ import annotations

import numba
import numpy as np
from numba import carray

from hapticrender.control.carriers import advance_carriers, track_finger, update_targets
from hapticrender.control.kernel import sense_block, update_confidence
from hapticrender.control.laws import contact_damping
from hapticrender.control.limiter import NONFINITE, SATURATED, drive_of, shape_noise
from hapticrender.control.records import (
    CONTROLLER_T,
    LOCKED,
    MOST_CHANNELS,
    TILE_T,
    Y,
    samples_of,
)
from hapticrender.jit import F8, I8, SIGNALS_T, kernel, pointer, record, step
from hapticrender.mathx import TURN, unit
from hapticrender.vectors import get, put, real, total, zeros

TAPS = 12  # of the derivatives' filters, 6 of them ahead
BASIS = 6  # r, r'/w_n, r''/w_n^2, r through the pair of poles and its derivative/w_p, D_00 r' T
FINGER, HEAVE, ROCKING, LOAD, INITIAL, PARAMETERS = np.array([0, 5, 9, 12, 14, 18])  # first of each set; their number
ROWS = int(PARAMETERS) + 1  # regressors psi_i, and w
REFRESH = 25  # samples between two discretisations of the loaded device
REVERSION = 20  # samples between two steps of the parameters' reversion to their mean

INVERSE = np.dtype(
    [
        # settings
        *((name, np.int64) for name in ("delay", "ahead", "spatial", "learns")),
        *((name, np.float64) for name in ("lever_per_metre", "hertz_scale", "pole", "pole_damping", "fade_step")),
        *(
            (name, np.float64)
            for name in (
                "settling",
                "joining",
                "joined",
                "awake",
                "notice",
                "patience",
                "level",
                "high_pass",
                "mean_square",
            )
        ),
        *((name, np.float64) for name in ("hold", "decay", "smoothing", "levelling", "slowly")),
        ("filters", np.float64, (4, TAPS)),
        ("sensor_filter", np.float64, (TAPS,)),
        ("pair", np.float64, (2, 4)),  # step of the pair of poles: two states, r now and next
        ("force_from_drive", np.float64, (2, MOST_CHANNELS)),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        ("noise", np.float64, (2,)),
        ("model_error", np.float64),
        ("prior", np.float64, (ROWS - 1,)),
        ("spread", np.float64, (ROWS - 1, ROWS - 1)),
        ("kept", np.float64, (ROWS - 1,)),
        ("start", np.float64, (4,)),
        # state
        *((name, np.float64) for name in ("fade", "peak", "held", "scale", "smooth_scale", "lever", "contact")),
        *(
            (name, np.float64)
            for name in ("since", "away", "slow", "power", "reference", "moment", "asked", "added", "heard", "given")
        ),
        *((name, np.int64) for name in ("sample", "ring_at", "reference_at")),
        ("window", np.float64, (TAPS,)),  # references around the moment at which this sample's drive acts, oldest first
        ("shown", np.float64, (TAPS,)),  # around now
        ("size", np.float64, (2,)),  # mean squares of the deviation and of what the drive explains of it
        ("poles", np.float64, (2,)),
        ("basis", np.float64, (BASIS,)),
        ("theta", np.float64, (ROWS - 1,)),
        ("covariance", np.float64, (ROWS - 1, ROWS - 1)),
        ("earlier", np.float64, (2, 8, 7)),  # the device's own parameters and covariance, 10-20 ms and 0-10 ms ago
        ("states", np.float64, (4, ROWS)),
        ("moved", np.float64, (4, ROWS)),
        ("inputs", np.float64, (2, ROWS)),
        *(
            (name, np.float64, (4, 6)) for name in ("flow", "power_of_flow", "following", "step")
        ),  # [A, B] T; [Phi, Gamma]
    ]
)
"""Settings and state of the waveform law beside those of the controller."""
INVERSE_T = numba.from_dtype(INVERSE)
LARGEST_MOMENT = 1.0  # N, of the levelling: a hard press may tilt the device
FARTHEST_LEVER = 2.0  # no surface is longer
MOST_NEEDED = 20.0  # of the drive's limit; a reference that is scaled by more teaches nothing
HUGE = 1e6  # drive unit: no drive
SCALED = 0.999  # a reference scaled by less is saturated
RING = BASIS + 2  # of a sample: basis and deviation force, until they act


@kernel
def bands_ahead(controller, lead):
    """Sum of the bands' targets `lead` seconds from now."""
    c = record(controller, CONTROLLER_T, 0)
    found = zeros()
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        if (b.mode[0] == LOCKED and c.finger_seen > 0.0) or c.stale > 0:  # a lifted finger keeps its turn
            put(b, "ahead", unit((lead / TURN) * (get(b, "omega") + (0.5 * lead) * get(b, "sweep"))))
        found = found + real(get(b, "target") * get(b, "ahead") * get(b, "carrier"))
    c.stale = 0
    return total(found)


@kernel
def take_reference(controller, inverse, waveform):
    """Put the reference `ahead` samples from now into the window; find what the sensors should show of it now."""
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    if c.p.analysed > 0.0:
        if abs(waveform) <= c.p.sensor_limit:  # else it is held
            v.given = waveform
        value = v.given
        wanted = 1.0 if v.contact > 0.0 or (v.spatial == 0 and c.p.needs_contact == 0.0) else 0.0
        v.fade = min(max(v.fade + (v.fade_step if wanted > 0.0 else -v.fade_step), 0.0), 1.0)
        value *= v.fade * v.fade * (3.0 - 2.0 * v.fade)
    else:
        value = bands_ahead(controller, v.ahead / c.p.rate)
    value *= v.smooth_scale
    window, shown, ring = v.window, v.shown, carray(pointer(v.reference_at, F8), v.delay)
    at = v.sample % v.delay
    for i in range(TAPS - 1):
        window[i], shown[i] = window[i + 1], shown[i + 1]
    window[TAPS - 1], shown[TAPS - 1], ring[at] = value, ring[at], value
    v.reference = 0.0
    for i in range(TAPS):
        v.reference += v.sensor_filter[i] * shown[i]


@kernel
def find_basis(controller, inverse):
    """Basis of the forces at the moment at which this sample's drive acts: derivatives of r by the filters."""
    v = record(inverse, INVERSE_T, 0)
    window, filters, basis, poles, pair = v.window, v.filters, v.basis, v.poles, v.pair
    d0 = d1 = d2 = d3 = 0.0
    for i in range(TAPS):
        d0 += filters[0, i] * window[i]
        d1 += filters[1, i] * window[i]
        d2 += filters[2, i] * window[i]
        d3 += filters[3, i] * window[i]
    last = basis[0]
    first = pair[0, 0] * poles[0] + pair[0, 1] * poles[1] + pair[0, 2] * last + pair[0, 3] * d0
    poles[1] = pair[1, 0] * poles[0] + pair[1, 1] * poles[1] + pair[1, 2] * last + pair[1, 3] * d0
    poles[0] = first
    w = v.hertz_scale
    basis[0], basis[1], basis[2] = d0, d1 / w, d2 / (w * w)
    basis[3], basis[4] = v.pole * v.pole * first, v.pole * poles[1]
    damping = v.damping[0, 0] + contact_damping(controller)
    basis[5] = (v.mass[0, 0] * d3 + damping * d2 + v.stiffness[0, 0] * d1) / record(controller, CONTROLLER_T, 0).p.rate
    return d1, d2


@kernel
def corrected(value, change):
    """Move a positive number by a change that leaves it between 0.3 and 5 times what it was."""
    return value + min(max(change, -0.7 * value), 4.0 * value)


@kernel
def discretise(controller, inverse):
    """Exact step of the loaded device over a sample, from a series of ten terms; states are coordinates, velocities.

    The finger counts by its mass and damping at 180 Hz, the device with what was learned of its heave.
    """
    v = record(inverse, INVERSE_T, 0)
    theta, w, period = v.theta, TURN * 180.0, 1.0 / record(controller, CONTROLLER_T, 0).p.rate
    turn, pole = w / v.hertz_scale, v.pole
    low = complex(pole * pole - w * w, 2.0 * v.pole_damping * pole * w)
    z = complex(theta[0] - theta[2] * turn * turn, theta[1] * turn)
    z += (theta[3] * pole * pole + complex(0.0, theta[4] * pole * w)) / low
    mass = min(max(-z.real / (w * w), -min(2e-3, 0.2 * v.mass[0, 0])), 10e-3) * v.contact
    damping = min(max(z.imag / w, 0.0), 12.0) * v.contact
    h, per_c, per_m = v.lever, 1.0 / v.hertz_scale, 1.0 / (v.hertz_scale * v.hertz_scale)
    m00 = corrected(v.mass[0, 0], per_m * theta[HEAVE + 2]) + mass
    m01, m11 = v.mass[0, 1] + h * mass, corrected(v.mass[1, 1], per_m * theta[ROCKING + 2]) + h * h * mass
    c00 = corrected(v.damping[0, 0] + contact_damping(controller), per_c * theta[HEAVE + 1]) + damping
    c01, c11 = v.damping[0, 1] + h * damping, corrected(v.damping[1, 1], per_c * theta[ROCKING + 1]) + h * h * damping
    k00, k01 = corrected(v.stiffness[0, 0], theta[HEAVE]), v.stiffness[0, 1]
    k11 = corrected(v.stiffness[1, 1], theta[ROCKING])
    scale, size = 1.0 / (m00 * m11 - m01 * m01), 0.0
    i00, i01, i11 = scale * m11, -scale * m01, scale * m00
    # rates (1/s) that bound the norm; the step is halved until the series converges, and doubled again after it
    size = (abs(i00) + abs(i01) + abs(i11)) * (c00 + abs(c01) + c11 + period * (k00 + abs(k01) + k11)) * period
    halvings = 0
    while size > 0.5 and halvings < 30:
        size, period, halvings = 0.5 * size, 0.5 * period, halvings + 1
    i00, i01, i11 = period * i00, period * i01, period * i11
    flow, power, following, found = v.flow, v.power_of_flow, v.following, v.step
    flow[0, 2] = flow[1, 3] = period
    flow[2, 0], flow[3, 0] = -i00 * k00 - i01 * k01, -i01 * k00 - i11 * k01
    flow[2, 1], flow[3, 1] = -i00 * k01 - i01 * k11, -i01 * k01 - i11 * k11
    flow[2, 2], flow[3, 2] = -i00 * c00 - i01 * c01, -i01 * c00 - i11 * c01
    flow[2, 3], flow[3, 3] = -i00 * c01 - i01 * c11, -i01 * c01 - i11 * c11
    flow[2, 4], flow[3, 4], flow[2, 5], flow[3, 5] = i00, i01, i01, i11
    for i in range(4):
        for j in range(6):
            power[i, j] = flow[i, j]
            found[i, j] = flow[i, j] + (1.0 if i == j else 0.0)
    for term in range(2, 11):
        for i in range(4):
            for j in range(6):
                following[i, j] = 0.0
            for k in range(4):
                for j in range(6):
                    following[i, j] += flow[i, k] * power[k, j] / term
        for i in range(4):
            for j in range(6):
                power[i, j] = following[i, j]
                found[i, j] += following[i, j]
    for _ in range(halvings):  # Phi(2 h) = Phi Phi, Gamma(2 h) = Phi Gamma + Gamma
        for i in range(4):
            for j in range(6):
                following[i, j] = found[i, j] if j >= 4 else 0.0
            for k in range(4):
                for j in range(6):
                    following[i, j] += found[i, k] * found[k, j]
        for i in range(4):
            for j in range(6):
                found[i, j] = following[i, j]


@kernel
def forget(inverse, first, last):
    """Set parameters back to their prior; nothing else is known of them."""
    v = record(inverse, INVERSE_T, 0)
    theta, covariance, spread, states = v.theta, v.covariance, v.spread, v.states
    for i in range(first, last):
        theta[i] = v.prior[i]
        for j in range(PARAMETERS):
            inside = first <= j < last
            covariance[i, j] = spread[i, j] if inside else 0.0
            covariance[j, i] = covariance[i, j]
        for k in range(4):
            states[k, i] = 0.0


@kernel
def note_device(inverse):
    """Note the device's own parameters and their covariance, and keep the last note."""
    v = record(inverse, INVERSE_T, 0)
    theta, covariance, earlier = v.theta, v.covariance, v.earlier
    for i in range(7):
        for j in range(8):
            earlier[0, j, i] = earlier[1, j, i]
            earlier[1, j, i] = theta[HEAVE + i] if j == 7 else covariance[HEAVE + j, HEAVE + i]


@kernel
def restore_device(inverse):
    """Set the device's own parameters back to the earlier note: a contact is reported after it happened."""
    v = record(inverse, INVERSE_T, 0)
    theta, covariance, earlier = v.theta, v.covariance, v.earlier
    forget(inverse, HEAVE, LOAD)
    for i in range(7):
        theta[HEAVE + i] = earlier[0, 7, i]
        for j in range(7):
            covariance[HEAVE + j, HEAVE + i] = earlier[0, j, i]
            earlier[1, j, i] = earlier[0, j, i]
        earlier[1, 7, i] = earlier[0, 7, i]


@kernel
def restart(inverse):
    """Learn afresh from here on, with the deviation of now as four more parameters; the estimates stay.

    The covariance returns to the prior: what the ringing of a contact taught through a model without the finger is not
    as certain as it seemed.
    """
    v = record(inverse, INVERSE_T, 0)
    theta, covariance, states = v.theta, v.covariance, v.states
    restore_device(inverse)
    for i in range(PARAMETERS):
        within = i < HEAVE or i >= LOAD
        for j in range(PARAMETERS):
            if within or j < HEAVE or j >= LOAD:
                covariance[i, j] = v.spread[i, j]
    for k in range(4):
        for i in range(ROWS):
            states[k, i] = 0.0
        states[k, INITIAL + k] = 1.0
        theta[INITIAL + k], covariance[INITIAL + k, INITIAL + k] = 0.0, v.start[k]


@kernel
def follow_contact(controller, inverse):
    """Reset what belongs to a contact when one begins or ends, and learn afresh: at once, and when its ringing is over.

    Returns whether there is anything to learn from.
    """
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    if c.finger_seen > 0.0:
        v.lever = min(max(v.lever_per_metre * c.held_position, -FARTHEST_LEVER), FARTHEST_LEVER)
    v.since += 1.0
    sticks = c.p.needs_contact > 0.0 and c.speed < c.p.least_speed
    touching = 0.0 if sticks else c.finger_seen
    v.away = 0.0 if touching > 0.0 else v.away + 1.0
    if v.contact > 0.0 and v.away < v.patience:  # a position that is missing for so short is no lift-off
        touching = 1.0
    if touching != v.contact:
        v.contact, v.since = touching, 0.0
        forget(inverse, FINGER, HEAVE)
        forget(inverse, LOAD, PARAMETERS)
        c.fast_timer = v.awake
        discretise(controller, inverse)
    elif v.since == v.settling or v.since == v.joining:
        restart(inverse)
    elif v.since == v.joined:
        forget(inverse, INITIAL, PARAMETERS)
    elif v.since > v.joined and v.sample % int(v.notice) == 0:
        note_device(inverse)
    return v.since >= v.settling


@kernel
def learn(inverse, coordinate, error):
    """Update the parameters by a sensed deviation from the reference: a scalar step of the Kalman filter."""
    v = record(inverse, INVERSE_T, 0)
    states, theta, covariance, gain = v.states, v.theta, v.covariance, v.inputs
    explained = states[coordinate, PARAMETERS]
    v.size[coordinate] += v.mean_square * (error * error + explained * explained - v.size[coordinate])
    innovation, scatter = error - explained, v.noise[coordinate] + v.model_error * v.size[coordinate]
    for i in range(PARAMETERS):
        innovation += states[coordinate, i] * theta[i]
    for i in range(PARAMETERS):
        found = 0.0
        for j in range(PARAMETERS):
            found += covariance[i, j] * states[coordinate, j]
        gain[0, i] = found
        scatter += found * states[coordinate, i]
    for i in range(PARAMETERS):
        share = gain[0, i] / scatter
        theta[i] -= share * innovation
        for j in range(PARAMETERS):
            covariance[i, j] -= share * gain[0, j]


@kernel
def revert(inverse):
    """Let the parameters return to their mean, and their covariance to its prior."""
    v = record(inverse, INVERSE_T, 0)
    kept, theta, covariance, spread = v.kept, v.theta, v.covariance, v.spread
    for i in range(PARAMETERS):
        theta[i] = v.prior[i] + kept[i] * (theta[i] - v.prior[i])
        for j in range(PARAMETERS):
            share = kept[i] * kept[j]
            covariance[i, j] = share * covariance[i, j] + (1.0 - share) * spread[i, j]


@kernel
def open_gate(controller, inverse, deviation):
    """Gain of the inner damper: open after a contact, and while the deviation is more than noise.

    `damper_scale` is the supervisor's: it turns a ringing damper down.
    """
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    v.slow += v.high_pass * (deviation - v.slow)
    above = deviation - v.slow
    v.power += v.mean_square * (above * above - v.power)
    if v.power > v.level:
        c.fast_timer = max(c.fast_timer, 1.0)
    c.fast_open = 1.0 if c.fast_timer > 0.0 else max(c.fast_open - c.p.release, 0.0)
    c.fast_timer -= 1.0
    c.damping_gain = c.damper_scale * (c.p.damper + c.fast_open * (c.p.damper_high - c.p.damper))


@kernel
def damp(controller, coordinate, deviation):
    """Force of the inner damper, F = -sum taps eps[n - j], and `damper_force` before its gain; `past` is a ring."""
    c = record(controller, CONTROLLER_T, 0)
    now, force = c.sample & 15, 0.0
    c.past[coordinate, now] = deviation
    if c.damping_gain > 0.0 or c.damper_scale < 1.0:
        for j in range(c.p.n_taps):
            force -= c.p.taps[coordinate, j] * c.past[coordinate, (now - j) & 15]
    c.damper_force[coordinate] = force
    return c.damping_gain * force


@kernel
def advance_regressors(controller, inverse):
    """Advance the regressors by a sample, under the basis and the deviation force that act in it."""
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    states, moved, inputs, phi = v.states, v.moved, v.inputs, v.step
    ring = carray(pointer(v.ring_at, F8), (v.delay + 1, RING))
    at = (v.sample + 1) % (v.delay + 1)  # what was computed `delay` samples ago
    touched, along = v.contact, v.contact * (c.p.shape[0] + v.lever * c.p.shape[1])
    for i in range(ROWS):
        inputs[0, i] = inputs[1, i] = 0.0
    for i in range(5):
        inputs[0, FINGER + i] = along * ring[at, i]
        inputs[1, FINGER + i] = along * v.lever * ring[at, i]
    for i in range(3):
        inputs[0, HEAVE + i] = c.p.shape[0] * ring[at, i]
        inputs[1, ROCKING + i] = ring[at, i]
    inputs[0, HEAVE + 3] = c.p.shape[0] * ring[at, 5]
    inputs[0, LOAD], inputs[1, LOAD] = 1.0, touched * v.lever
    inputs[1, LOAD + 1] = 1.0
    inputs[0, PARAMETERS], inputs[1, PARAMETERS] = ring[at, BASIS], ring[at, BASIS + 1]
    for k in range(4):
        for i in range(ROWS):
            moved[k, i] = phi[k, 4] * inputs[0, i] + phi[k, 5] * inputs[1, i]
        for j in range(4):
            for i in range(ROWS):
                moved[k, i] += phi[k, j] * states[j, i]
    for k in range(4):
        for i in range(ROWS):
            states[k, i] = moved[k, i]


@kernel
def learned_force(controller, inverse):
    """What was learned of finger and device, as the forces that it takes in heave and rocking."""
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    theta, basis = v.theta, v.basis
    finger = heave = rocking = 0.0
    for i in range(5):
        finger += theta[FINGER + i] * basis[i]
    for i in range(3):
        heave += theta[HEAVE + i] * basis[i]
        rocking += theta[ROCKING + i] * basis[i]
    finger *= v.contact * (c.p.shape[0] + v.lever * c.p.shape[1])
    return finger + c.p.shape[0] * (heave + theta[HEAVE + 3] * basis[5]), v.lever * finger + rocking


@kernel
def compare(inverse, nominal, learned):
    """Mean squares over a second of what the untouched device is asked for in heave, and of what was learned of it."""
    v = record(inverse, INVERSE_T, 0)
    free = 1.0 - v.contact
    v.heard += v.slowly * (free * v.reference * v.reference - v.heard)
    v.asked += v.slowly * (free * nominal * nominal - v.asked)
    v.added += v.slowly * (free * learned * learned - v.added)


@kernel
def level(inverse):
    """Rocking force that slowly levels the device under the load: a moving finger would else tilt it to and fro."""
    v = record(inverse, INVERSE_T, 0)
    wanted = v.contact * min(max(v.lever * v.theta[LOAD] + v.theta[LOAD + 1], -LARGEST_MOMENT), LARGEST_MOMENT)
    v.moment += v.levelling * (wanted - v.moment)
    return v.moment


@kernel
def scale_reference(inverse, needed):
    """Scale the reference so that the drive stays within its limit; `needed` is that of the whole reference, over it.

    The largest need is held for a while and then falls; two poles smooth the scale, so that it makes no edges.
    """
    v = record(inverse, INVERSE_T, 0)
    v.held -= 1.0
    if needed >= 0.98 * v.peak:
        v.peak, v.held = min(max(v.peak, needed), MOST_NEEDED), v.hold
    elif v.held < 0.0:
        v.peak *= v.decay
    v.scale += v.smoothing * (1.0 / max(v.peak, 1.0) - v.scale)
    v.smooth_scale += v.smoothing * (v.scale - v.smooth_scale)


@kernel
def recover(controller, inverse):
    """Start afresh from the prior, with nothing learned: a number got out of hand."""
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    forget(inverse, FINGER, PARAMETERS)
    note_device(inverse)
    note_device(inverse)
    v.moment = v.slow = v.power = v.asked = v.added = v.peak = v.size[0] = v.size[1] = v.poles[0] = v.poles[1] = 0.0
    v.scale = v.smooth_scale = 1.0
    for k in range(4):
        v.states[k, PARAMETERS] = 0.0
    for i in range(2):
        c.shaper[i, 0] = c.shaper[i, 1] = 0.0
        for j in range(16):
            c.past[i, j] = 0.0
    discretise(controller, inverse)


@kernel
def play(controller, inverse, drive, flags, n, nominal0, nominal1):
    """Write the drive of a sample; what of it is not the nominal force goes into the ring with the basis."""
    c, v = record(controller, CONTROLLER_T, 0), record(inverse, INVERSE_T, 0)
    samples, limit, basis = samples_of(controller), c.p.drive_limit, v.basis
    ring = carray(pointer(v.ring_at, F8), (v.delay + 1, RING))
    at = v.sample % (v.delay + 1)
    played0 = played1 = most = 0.0
    for i in range(c.p.channels):
        exact = c.confidence * drive_of(controller, samples, Y, 0, i)
        if not abs(exact) < HUGE:
            exact = 0.0
            flags[n] |= NONFINITE
            recover(controller, inverse)
        most = max(most, abs(exact) / limit)
        if c.confidence == 0.0:
            c.shaper[0, i] = c.shaper[1, i] = exact = 0.0
        elif c.p.drive_step > 0.0:
            exact = shape_noise(controller, exact, i)
        value = min(max(exact, -limit), limit)
        drive[n, i] = value
        played0 += v.force_from_drive[0, i] * value
        played1 += v.force_from_drive[1, i] * value
    if most > 1.0 or v.smooth_scale < SCALED:
        flags[n] |= SATURATED
    scale_reference(inverse, most / v.smooth_scale)
    for i in range(BASIS):
        ring[at, i] = basis[i]
    sane = abs(nominal0) + abs(nominal1) < HUGE
    ring[at, BASIS] = played0 - nominal0 if sane else 0.0
    ring[at, BASIS + 1] = played1 - nominal1 if sane else 0.0


@step
def inverse_step(state, signals, start, count):
    """Advance the waveform law by `count` samples; see `hapticrender.jit`."""
    c, io = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0)
    inverse, samples, stop = c.loops_at, samples_of(state), start + count
    v = record(inverse, INVERSE_T, 0)
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    position, waveform = carray(pointer(io.position, F8), stop), carray(pointer(io.waveform, F8), stop)
    for n in range(start, stop):
        implausible = sense_block(state, signals, n)
        if c.moving == 0:
            track_finger(state, position[n])
        y0, y1 = samples[Y, 0], samples[Y + 1, 0]
        if c.bands > 0:
            advance_carriers(state)
            update_targets(state, signals, n)
        else:
            c.sample += 1
        settled = follow_contact(state, inverse)
        take_reference(state, inverse, waveform[n] if c.p.analysed > 0.0 else 0.0)
        error0, error1 = y0 - c.p.shape[0] * v.reference, y1 - c.p.shape[1] * v.reference
        samples[Y, 0] = samples[Y + 1, 0] = 0.0
        if update_confidence(state, implausible):
            forget(inverse, 0, PARAMETERS)
        elif implausible == 0 and v.learns > 0:
            open_gate(state, inverse, error0)
            for i in range(c.p.coordinates):
                error = error0 if i == 0 else error1
                if settled:
                    learn(inverse, i, error)
                samples[Y + i, 0] = damp(state, i, error)
        if v.sample % REVERSION == 0:
            revert(inverse)
        if v.sample % REFRESH == 0:
            discretise(state, inverse)
        d1, d2 = find_basis(state, inverse)
        s0, s1, d0 = c.p.shape[0], c.p.shape[1], v.basis[0]
        along = v.stiffness[0, 0] * d0 + (v.damping[0, 0] + contact_damping(state)) * d1 + v.mass[0, 0] * d2
        across = v.stiffness[0, 1] * d0 + v.damping[0, 1] * d1 + v.mass[0, 1] * d2
        other = v.stiffness[1, 1] * d0 + v.damping[1, 1] * d1 + v.mass[1, 1] * d2
        nominal0, nominal1 = s0 * along + s1 * across, s0 * across + s1 * other
        learned0, learned1 = learned_force(state, inverse)
        compare(inverse, nominal0, learned0)
        samples[Y, 0] += nominal0 + learned0
        samples[Y + 1, 0] += nominal1 + learned1 + level(inverse)
        play(state, inverse, drive, flags, n, nominal0, nominal1)
        advance_regressors(state, inverse)
        v.sample += 1
    return 0
