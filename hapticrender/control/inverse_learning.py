"""What the waveform law learns: a Kalman filter for finger, device and load, and the loaded device's model behind it.

Symbols and equations are those of `inverse_kernel`: dev = dev_u - sum_i theta_i psi_i + noise.  The regressors psi_i
and dev_u are states of the loaded device G, discretised anew as the estimate moves; a contact resets them.
"""

from numba import carray

from hapticrender.control.carriers import contact_lag
from hapticrender.control.inverse_records import (
    BASIS,
    COUPLING,
    FINGER,
    HEAVE,
    INITIAL,
    LAW_T,
    LOAD,
    PARAMETERS,
    RING,
    ROWS,
)
from hapticrender.control.records import CONTROLLER_T
from hapticrender.jit import F8, kernel, pointer, record
from hapticrender.mathx import TURN

LOADED = 180.0  # Hz, E: of the finger's mass and damping in G, which is largest there, at a plate's resonance under it
FARTHEST_LEVER = 2.0  # no surface is longer
UNREPORTED = 15e3  # N/m, of the coupling, for a finger whose place is not known yet: 12 N s/m or 10 g, the prior's most


@kernel
def corrected(value, change):
    """Move a positive number by a change that leaves it between 0.3 and 5 times what it was."""
    return value + min(max(change, -0.7 * value), 4.0 * value)


@kernel
def coupled(value, change):
    """Bound a change of a coupling to a fifth of rocking's own: determinants stay positive."""
    return min(max(change, -0.2 * value), 0.2 * value)


@kernel
def discretise(controller, law):
    """Exact step of the loaded device over a sample, from a series of ten terms; states are coordinates, velocities.

    The finger counts by its mass and damping at `LOADED`, the device with what was learned of its heave and coupling:
    springs and dampers at the two sides change rocking by as much as heave, and couple both by their difference.
    """
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    theta, w, period = v.theta, TURN * LOADED, 1.0 / c.p.rate
    turn, pole = w / v.omega_n, v.pole
    low = complex(pole * pole - w * w, 2.0 * v.pole_damping * pole * w)
    z = complex(theta[0] - theta[2] * turn * turn, theta[1] * turn)
    z += (theta[3] * pole * pole + complex(0.0, theta[4] * pole * w)) / low
    mass = min(max(-z.real / (w * w), -min(2e-3, 0.2 * v.mass[0, 0])), 10e-3) * v.contact
    damping = min(max(z.imag / w, 0.0), 12.0) * v.contact
    h, per_c, per_m = v.lever, 1.0 / v.omega_n, 1.0 / (v.omega_n * v.omega_n)
    lag = v.behind * contact_lag(c)
    k00 = corrected(v.stiffness[0, 0], theta[HEAVE])
    m00 = corrected(v.mass[0, 0] + lag * v.damping[0, 0], per_m * theta[HEAVE + 2]) + mass
    m01 = v.mass[0, 1] + coupled(v.mass[1, 1], per_m * theta[COUPLING + 2]) + h * mass
    m11 = v.mass[1, 1] + h * h * mass
    c00 = corrected(v.damping[0, 0] + lag * k00, per_c * theta[HEAVE + 1]) + damping
    c01 = v.damping[0, 1] + coupled(v.damping[1, 1], per_c * theta[COUPLING + 1]) + h * damping
    c11 = corrected(v.damping[1, 1], per_c * theta[HEAVE + 1]) + h * h * damping
    k01 = v.stiffness[0, 1] + coupled(v.stiffness[1, 1], theta[COUPLING])
    k11 = corrected(v.stiffness[1, 1], theta[HEAVE])
    scale = 1.0 / (m00 * m11 - m01 * m01)
    i00, i01, i11 = scale * m11, -scale * m01, scale * m00
    # T |M^-1| (|C| + T |K|), without unit; the step is halved until the series converges, and doubled again after it
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
def reset_parameters(law, first, last):
    """Set parameters back to their prior; nothing else is known of them."""
    v = record(law, LAW_T, 0)
    theta, covariance, prior_covariance, states = v.theta, v.covariance, v.prior_covariance, v.states
    for i in range(first, last):
        theta[i] = v.prior[i]
        for j in range(PARAMETERS):
            inside = first <= j < last
            covariance[i, j] = prior_covariance[i, j] if inside else 0.0
            covariance[j, i] = covariance[i, j]
        for k in range(4):
            states[k, i] = 0.0


@kernel
def note_device(law):
    """Note the device's own parameters and their covariance, and keep the last note."""
    v = record(law, LAW_T, 0)
    theta, covariance, earlier = v.theta, v.covariance, v.earlier
    for i in range(7):
        for j in range(8):
            earlier[0, j, i] = earlier[1, j, i]
            earlier[1, j, i] = theta[HEAVE + i] if j == 7 else covariance[HEAVE + j, HEAVE + i]


@kernel
def restore_device(law):
    """Set the device's own parameters back to the earlier note: a contact is reported after it happened."""
    v = record(law, LAW_T, 0)
    theta, covariance, earlier = v.theta, v.covariance, v.earlier
    reset_parameters(law, HEAVE, LOAD)
    for i in range(7):
        theta[HEAVE + i] = earlier[0, 7, i]
        for j in range(7):
            covariance[HEAVE + j, HEAVE + i] = earlier[0, j, i]
            earlier[1, j, i] = earlier[0, j, i]
        earlier[1, 7, i] = earlier[0, 7, i]


@kernel
def restart_regressors(law):
    """Start the regressors from rest, with the deviation of now as four more parameters."""
    v = record(law, LAW_T, 0)
    theta, covariance, states = v.theta, v.covariance, v.states
    for k in range(4):
        for i in range(ROWS):
            states[k, i] = 0.0
        states[k, INITIAL + k] = 1.0
        theta[INITIAL + k], covariance[INITIAL + k, INITIAL + k] = 0.0, v.initial_variance[k]


@kernel
def restart(law):
    """Learn afresh from here on, with the deviation of now as four more parameters.

    Estimates of finger and load stay, with the prior's covariance: what the ringing of a contact taught through a model
    without the finger is not as certain as it seemed.  Those of the device return to what was noted before the contact.
    """
    v = record(law, LAW_T, 0)
    covariance = v.covariance
    restore_device(law)
    for i in range(PARAMETERS):
        within = i < HEAVE or i >= LOAD
        for j in range(PARAMETERS):
            if within or j < HEAVE or j >= LOAD:
                covariance[i, j] = v.prior_covariance[i, j]
    restart_regressors(law)


@kernel
def suspect_change(law):
    """Learn at once from a deviation that no report explains: a touch and a lift are reported late.

    An untouched device counts as touched in the middle, until the report is due; that the finger may be elsewhere makes
    the coupling and the moment uncertain.  Of a finger that may have left all of its estimate is uncertain alike.
    """
    v = record(law, LAW_T, 0)
    theta, covariance = v.theta, v.covariance
    for i in range(LOAD, PARAMETERS):
        for j in range(PARAMETERS):
            covariance[i, j] = covariance[j, i] = v.prior_covariance[i, j]
    if v.contact > 0.0:
        v.since = v.relearning_delay
        for i in range(FINGER, HEAVE):
            for j in range(FINGER, HEAVE):
                covariance[i, j] += theta[i] * theta[j]
    else:
        v.contact, v.lever, v.away, v.since = 1.0, 0.0, -v.report_delay, v.learning_delay
        for i in range(COUPLING, LOAD):
            covariance[i, i] += UNREPORTED * UNREPORTED
        covariance[LOAD + 1, LOAD + 1] = v.prior_covariance[LOAD, LOAD]
    restart_regressors(law)


@kernel
def follow_contact(controller, law):
    """Reset what belongs to a contact when one begins or ends, and learn afresh, once and when its ringing is over.

    Returns whether there is anything to learn from.
    """
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    if c.finger_seen > 0.0:
        v.lever = min(max(v.lever_per_metre * c.held_position, -FARTHEST_LEVER), FARTHEST_LEVER)
    v.since += 1.0
    sticks = c.p.needs_contact > 0.0 and c.speed < c.p.least_speed
    touching, suspected = 0.0 if sticks else c.finger_seen, v.away < 0.0
    v.away = 0.0 if touching > 0.0 else v.away + 1.0
    if suspected and touching > 0.0:  # what was learned of the finger stays
        v.since, c.fast_timer = 0.0, v.damper_time
        restore_device(law)
    if v.contact > 0.0 and v.away < (0.0 if suspected else v.loss_time):  # a position missing so short is no lift-off
        touching = 1.0
    if touching != v.contact:
        v.contact, v.since = touching, 0.0
        reset_parameters(law, FINGER, HEAVE)
        reset_parameters(law, LOAD, PARAMETERS)
        c.fast_timer = v.damper_time
        discretise(controller, law)
    elif v.since == v.learning_delay or v.since == v.relearning_delay:
        restart(law)
    elif v.since == v.initial_end:
        reset_parameters(law, INITIAL, PARAMETERS)
    elif v.since > v.initial_end and v.sample % int(v.report_delay) == 0:
        note_device(law)
    return v.since >= v.learning_delay


@kernel
def learn(law, coordinate, deviation):
    """Update the parameters by a sensed deviation from the reference: a scalar step of the Kalman filter."""
    v = record(law, LAW_T, 0)
    states, theta, covariance, p_psi = v.states, v.theta, v.covariance, v.p_psi
    explained = states[coordinate, PARAMETERS]
    innovation = deviation - explained
    for i in range(PARAMETERS):
        innovation += states[coordinate, i] * theta[i]
    square = explained * explained + v.deviations * deviation * deviation + v.innovations * innovation * innovation
    v.model_power[coordinate] += v.mean_square_smoothing * (square - v.model_power[coordinate])
    variance = v.noise[coordinate] + v.model_error * v.model_power[coordinate]
    heave = uncertain = 0.0
    for i in range(PARAMETERS):
        found = 0.0
        for j in range(PARAMETERS):
            found += covariance[i, j] * states[coordinate, j]
        p_psi[i] = found
        variance += found * states[coordinate, i]
        if HEAVE <= i < COUPLING:
            heave += theta[i] * states[coordinate, i]
            uncertain += found * states[coordinate, i]
    v.heave_power += v.power_smoothing * (heave * heave - v.heave_power)
    v.heave_noise += v.power_smoothing * (v.noise_share * uncertain - v.heave_noise)
    for i in range(PARAMETERS):
        kalman_gain = p_psi[i] / variance
        theta[i] -= kalman_gain * innovation
        for j in range(PARAMETERS):
            covariance[i, j] -= kalman_gain * p_psi[j]


@kernel
def revert(law):
    """Move the parameters and their covariance a step back towards the prior."""
    v = record(law, LAW_T, 0)
    factor, theta, covariance, prior_covariance = v.reversion_factor, v.theta, v.covariance, v.prior_covariance
    for i in range(PARAMETERS):
        theta[i] = v.prior[i] + factor[i] * (theta[i] - v.prior[i])
        for j in range(PARAMETERS):
            share = factor[i] * factor[j]
            covariance[i, j] = share * covariance[i, j] + (1.0 - share) * prior_covariance[i, j]


@kernel
def advance_regressors(controller, law):
    """Advance the regressors by a sample, under the basis and the deviation force that act in it."""
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    states, moved, inputs, phi = v.states, v.moved, v.inputs, v.step
    ring = carray(pointer(v.ring_at, F8), (v.delay + 1, RING))
    at = (v.sample + 1) % (v.delay + 1)  # what was computed `delay` samples ago
    touched, along = v.contact, v.contact * (c.p.pattern[0] + v.lever * c.p.pattern[1])
    for i in range(ROWS):
        inputs[0, i] = inputs[1, i] = 0.0
    for i in range(5):
        inputs[0, FINGER + i] = along * ring[at, i]
        inputs[1, FINGER + i] = along * v.lever * ring[at, i]
    for i in range(3):
        inputs[0, HEAVE + i] = c.p.pattern[0] * ring[at, i]
        inputs[1, COUPLING + i] = ring[at, i]
    inputs[0, HEAVE + 3] = c.p.pattern[0] * ring[at, 5]
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
