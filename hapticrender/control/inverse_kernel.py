"""The waveform law's step: exact inverse dynamics of the reference, and a Kalman filter that learns what they lack.

With the reference r and its pattern alpha over the coordinates the modelled device takes the force
F_nom = (M r'' + C r' + K r) alpha.  The true one moves by alpha r + dev (docs/theory.md, "The waveform law")::

    (D + dD + z h h^T) dev = F_dev - (dD + z h h^T) alpha r - F_load,       F_dev = F_played - F_nom

Everything that is not known is linear in parameters theta_i: the finger z on r, r', r'' and on r through one pair of
poles, the device's errors dD of stiffness, damping, mass and delay, and the finger's load.  With G the loaded device,

    dev = dev_u - sum_i theta_i psi_i + noise,       psi_i = G [gamma_i beta_i],   dev_u = G [F_dev]

holds whatever was played, and a Kalman filter finds theta; while G and the delay are right, no stability limit follows
from how fast it learns.  What it finds is played ahead, F = F_nom + sum_i theta_i gamma_i beta_i, with the inner damper
on dev while its gate is open: 100 ms after a contact begins or ends, and while dev exceeds noise.
The delay d is that of samples: a block of M samples is the same law with a longer delay.
"""

from numba import carray

from hapticrender.control.carriers import advance_carriers, contact_lag, track_finger, update_targets
from hapticrender.control.inverse_learning import (
    advance_regressors,
    discretise,
    follow_contact,
    learn,
    note_device,
    reset_parameters,
    revert,
    suspect_change,
)
from hapticrender.control.inverse_records import (
    BASIS,
    COUPLING,
    FINGER,
    HEAVE,
    LAW_T,
    LOAD,
    PARAMETERS,
    RING,
    TAPS,
)
from hapticrender.control.kernel import sense_block, update_confidence
from hapticrender.control.peak_limit import NONFINITE, SATURATED, drive_of, shape_noise
from hapticrender.control.records import CONTROLLER_T, LOCKED, PAST, PAST_MASK, SUM, TILE_T, Y, samples_of
from hapticrender.jit import F8, I8, SIGNALS_T, kernel, pointer, record, step
from hapticrender.mathx import TURN, unit
from hapticrender.vectors import get, put, real, total, zeros

DISCRETISATION = 25  # samples between two discretisations of the loaded device
REVERSION = 20  # samples between two steps of the parameters' reversion to their mean
LARGEST_MOMENT = 1.0  # N, of the levelling: a hard press may tilt the device
MOST_NEEDED = 20.0  # of the drive's limit; a reference that is scaled by more teaches nothing
HUGE = 1e6  # drive unit: no drive
TINY = 1e-300  # m^2 or N^2: nothing was learned
NOISE_SMOOTHING = 4e-3 / 0.3  # of the sensors' noise at the gate, over that of the mean square over 4 ms
MOST_NOISE = 25.0  # of the sensors' stated one, as mean squares
SCALED = 0.999  # a reference scaled by less is saturated


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
def take_reference(controller, law, waveform):
    """Put the reference of the look-ahead into the window; find what the sensors should show of it now."""
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    if c.p.reads_waveform > 0.0:
        if abs(waveform) <= c.p.sensor_limit:  # else it is held
            v.last_waveform = waveform
        value = v.last_waveform
        touched = v.contact > 0.0 or (v.spatial == 0 and c.p.needs_contact == 0.0)
        v.fade = min(max(v.fade + (v.fade_step if touched else -v.fade_step), 0.0), 1.0)
        value *= v.fade * v.fade * (3.0 - 2.0 * v.fade)
    else:
        value = bands_ahead(controller, (v.delay + TAPS // 2) / c.p.rate)
    value *= v.smooth_scale
    # the value is of d + TAPS/2 samples ahead; d later, tap TAPS/2 - 1 of `expected` is of now
    window, expected, ring = v.window, v.sensor_window, carray(pointer(v.reference_at, F8), v.delay)
    at = v.sample % v.delay
    for i in range(TAPS - 1):
        window[i], expected[i] = window[i + 1], expected[i + 1]
    window[TAPS - 1], expected[TAPS - 1], ring[at] = value, ring[at], value
    v.reference, lag = 0.0, contact_lag(c)
    for i in range(TAPS):
        v.reference += (v.sensor_filter[i] + lag * v.sensor_rate_filter[i]) * expected[i]


@kernel
def find_basis(controller, law):
    """Basis of the forces at the moment at which this sample's drive acts: derivatives of r by the filters."""
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    window, filters, basis, poles, pair = v.window, v.filters, v.basis, v.poles, v.pole_step
    d0 = d1 = d2 = d3 = 0.0
    for i in range(TAPS):
        d0 += filters[0, i] * window[i]
        d1 += filters[1, i] * window[i]
        d2 += filters[2, i] * window[i]
        d3 += filters[3, i] * window[i]
    lag = contact_lag(c)  # what has to be made is r + lag r', for the contact to follow r
    d0, d1, d2 = d0 + lag * d1, d1 + lag * d2, d2 + lag * d3
    last = basis[0]
    first = pair[0, 0] * poles[0] + pair[0, 1] * poles[1] + pair[0, 2] * last + pair[0, 3] * d0
    poles[1] = pair[1, 0] * poles[0] + pair[1, 1] * poles[1] + pair[1, 2] * last + pair[1, 3] * d0
    poles[0] = first
    w = v.omega_n
    basis[0], basis[1], basis[2] = d0, d1 / w, d2 / (w * w)
    basis[3], basis[4] = v.pole * v.pole * first, v.pole * poles[1]
    basis[5] = (v.mass[0, 0] * d3 + v.damping[0, 0] * d2 + v.stiffness[0, 0] * d1) / c.p.rate
    return d1, d2


@kernel
def open_gate(controller, law, deviation):
    """Gain of the inner damper: open after a contact, and while the deviation is more than noise.

    The threshold is (2 sigma)^2 as stated, or four times the mean square of second differences over sqrt 6 (mean over
    0.3 s), at most 25 times as stated: a damper that a noisier sensor keeps open passes its noise on.
    `damper_scale` is the supervisor's: it turns a ringing damper down.  Returns whether a deviation opens the gate.
    """
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    v.slow += v.high_pass_smoothing * (deviation - v.slow)
    above = deviation - v.slow
    v.power += v.mean_square_smoothing * (above * above - v.power)
    second = deviation - 2.0 * c.past[0, (v.sample - 1) & PAST_MASK] + c.past[0, (v.sample - 2) & PAST_MASK]
    v.sensed_noise += NOISE_SMOOTHING * v.mean_square_smoothing * (second * second / 6.0 - v.sensed_noise)
    noise = max(v.gate_threshold, min(4.0 * v.sensed_noise, MOST_NOISE * v.gate_threshold))
    large, closed = v.power > noise, c.fast_open == 0.0
    if large:
        c.fast_timer = max(c.fast_timer, 1.0)
    c.fast_open = 1.0 if c.fast_timer > 0.0 else max(c.fast_open - c.p.release, 0.0)
    c.fast_timer -= 1.0
    c.damping_gain = c.damper_scale * (c.p.damper + c.fast_open * (c.p.damper_high - c.p.damper))
    return large and closed


@kernel
def damp(controller, law, coordinate, deviation):
    """Force of the inner damper, F = -sum c_j dev[n - j s] within its limit; `damper_force` is before limit and gain.

    s is the distance of its taps in samples; `past` is a ring.
    """
    c = record(controller, CONTROLLER_T, 0)
    now, force = record(law, LAW_T, 0).sample & PAST_MASK, 0.0
    c.past[coordinate, now] = deviation
    if c.damping_gain > 0.0 or c.damper_scale < 1.0:
        for j in range(c.p.n_taps):
            force -= c.p.taps[coordinate, j] * c.past[coordinate, (now - j * c.p.tap_stride) & PAST_MASK]
    c.damper_force[coordinate] = force
    return c.damping_gain * min(max(force, -c.p.damper_limit), c.p.damper_limit)


@kernel
def learned_force(controller, law):
    """What was learned of finger and device, less what the sensor's noise taught, as forces in heave and rocking."""
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    theta, basis = v.theta, v.basis
    finger = heave = rocking = 0.0
    for i in range(5):
        finger += theta[FINGER + i] * basis[i]
    for i in range(3):
        heave += theta[HEAVE + i] * basis[i]
        rocking += theta[COUPLING + i] * basis[i]
    finger *= v.contact * (c.p.pattern[0] + v.lever * c.p.pattern[1])
    heave = (heave + theta[HEAVE + 3] * basis[5]) * (1.0 - min(max(v.heave_noise / max(v.heave_power, TINY), 0.0), 1.0))
    return finger + c.p.pattern[0] * heave, v.lever * finger + rocking


@kernel
def update_powers(law, nominal, learned):
    """Mean squares over a second of the free device's nominal force in heave, and of what was learned beside it."""
    v = record(law, LAW_T, 0)
    free = 1.0 - v.contact
    v.reference_power += v.power_smoothing * (free * v.reference * v.reference - v.reference_power)
    v.nominal_power += v.power_smoothing * (free * nominal * nominal - v.nominal_power)
    v.learned_power += v.power_smoothing * (free * learned * learned - v.learned_power)


@kernel
def levelling_force(law):
    """Rocking force that slowly levels the device under the load: a moving finger would else tilt it to and fro."""
    v = record(law, LAW_T, 0)
    target = v.contact * min(max(v.lever * v.theta[LOAD] + v.theta[LOAD + 1], -LARGEST_MOMENT), LARGEST_MOMENT)
    v.moment += v.levelling_smoothing * (target - v.moment)
    return v.moment


@kernel
def scale_reference(law, needed):
    """Scale the reference so that the drive stays within its limit; `needed` is that of the whole reference, over it.

    The largest need is held for a while and then falls; two poles smooth the scale, so that it makes no edges.
    """
    v = record(law, LAW_T, 0)
    v.hold_left -= 1.0
    if needed >= 0.98 * v.peak:
        v.peak, v.hold_left = min(max(v.peak, needed), MOST_NEEDED), v.hold
    elif v.hold_left < 0.0:
        v.peak *= v.decay
    v.scale += v.scale_smoothing * (1.0 / max(v.peak, 1.0) - v.scale)
    v.smooth_scale += v.scale_smoothing * (v.scale - v.smooth_scale)
    v.least_scale = min(v.least_scale, v.smooth_scale)


@kernel
def recover(controller, law):
    """Start afresh from the prior, with nothing learned: a number got out of hand."""
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    reset_parameters(law, FINGER, PARAMETERS)
    note_device(law)
    note_device(law)
    v.moment = v.slow = v.power = v.nominal_power = v.learned_power = v.heave_power = v.heave_noise = v.peak = 0.0
    v.model_power[0] = v.model_power[1] = v.poles[0] = v.poles[1] = 0.0
    v.scale = v.smooth_scale = 1.0
    for k in range(4):
        v.states[k, PARAMETERS] = 0.0
    for i in range(2):
        c.shaper[i, 0] = c.shaper[i, 1] = 0.0
        for j in range(PAST):
            c.past[i, j] = 0.0
    discretise(controller, law)


@kernel
def play(controller, law, drive, flags, n, nominal0, nominal1):
    """Write the drive of a sample; what of it is not the nominal force goes into the ring with the basis."""
    c, v = record(controller, CONTROLLER_T, 0), record(law, LAW_T, 0)
    samples, limit, basis = samples_of(c), c.p.drive_limit, v.basis
    ring = carray(pointer(v.ring_at, F8), (v.delay + 1, RING))
    at = v.sample % (v.delay + 1)
    played0 = played1 = most = 0.0
    for i in range(c.p.channels):
        exact = c.confidence * drive_of(c, samples, SUM, 0, i)
        if not abs(exact) < HUGE:
            exact = 0.0
            flags[n] |= NONFINITE
            recover(controller, law)
        most = max(most, abs(exact) / limit)
        if c.confidence == 0.0:
            c.shaper[0, i] = c.shaper[1, i] = exact = 0.0
        elif c.p.drive_step > 0.0:
            exact = shape_noise(c, exact, i)
        value = min(max(exact, -limit), limit)
        drive[n, i] = value
        played0 += v.force_from_drive[0, i] * value
        played1 += v.force_from_drive[1, i] * value
    if most > 1.0 or v.smooth_scale < SCALED:
        flags[n] |= SATURATED
    scale_reference(law, most / v.smooth_scale)
    for i in range(BASIS):
        ring[at, i] = basis[i]
    sane = abs(nominal0) + abs(nominal1) < HUGE
    ring[at, BASIS] = played0 - nominal0 if sane else 0.0
    ring[at, BASIS + 1] = played1 - nominal1 if sane else 0.0


@step
def inverse_step(state, signals, start, count):
    """Advance the waveform law by `count` samples; see `hapticrender.jit`."""
    c, io = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0)
    law, samples, stop = c.law_at, samples_of(c), start + count
    v = record(law, LAW_T, 0)
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    position, waveform = carray(pointer(io.position, F8), stop), carray(pointer(io.waveform, F8), stop)
    for n in range(start, stop):
        implausible = sense_block(c, io, n, 1)
        if c.locked == 0:  # else `sense_block` has
            track_finger(c, position[n])
        y0, y1 = samples[Y, 0], samples[Y + 1, 0]
        if c.bands > 0:
            advance_carriers(c)
            update_targets(c, io, n, 1)
        else:
            c.sample += 1
        learning = follow_contact(state, law)
        take_reference(state, law, waveform[n] if c.p.reads_waveform > 0.0 else 0.0)
        dev0, dev1 = y0 - c.p.pattern[0] * v.reference, y1 - c.p.pattern[1] * v.reference
        samples[SUM, 0] = samples[SUM + 1, 0] = 0.0  # of the forces: the damper's, first
        if update_confidence(c, implausible):
            reset_parameters(law, FINGER, PARAMETERS)
            c.past[0, v.sample & PAST_MASK] = c.past[1, v.sample & PAST_MASK] = 0.0
        elif v.learns > 0:
            if implausible > 0:  # the damper takes the last deviations: those of the samples before have to be in place
                dev0, dev1 = c.past[0, (v.sample - 1) & PAST_MASK], c.past[1, (v.sample - 1) & PAST_MASK]
            elif open_gate(state, law, dev0) and v.since > v.initial_end and c.p.needs_contact == 0.0:
                suspect_change(law)
            for i in range(c.p.coordinates):
                deviation = dev0 if i == 0 else dev1
                if learning and implausible == 0:
                    learn(law, i, deviation)
                samples[SUM + i, 0] = damp(state, law, i, deviation)
        if v.sample % REVERSION == 0:
            revert(law)
        if v.sample % DISCRETISATION == 0:
            discretise(state, law)
        d1, d2 = find_basis(state, law)
        s0, s1, d0 = c.p.pattern[0], c.p.pattern[1], v.basis[0]
        along = v.stiffness[0, 0] * d0 + v.damping[0, 0] * d1 + v.mass[0, 0] * d2
        across = v.stiffness[0, 1] * d0 + v.damping[0, 1] * d1 + v.mass[0, 1] * d2
        other = v.stiffness[1, 1] * d0 + v.damping[1, 1] * d1 + v.mass[1, 1] * d2
        nominal0, nominal1 = s0 * along + s1 * across, s0 * across + s1 * other
        learned0, learned1 = learned_force(state, law)
        update_powers(law, nominal0, learned0)
        samples[SUM, 0] += nominal0 + learned0
        samples[SUM + 1, 0] += nominal1 + learned1 + levelling_force(law)
        play(state, law, drive, flags, n, nominal0, nominal1)
        advance_regressors(state, law)
        v.sample += 1
    return 0
