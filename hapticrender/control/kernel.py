"""The step of the law by bands: a block of M >= 1 samples from sensors to drive; sample by sample is M = 1.

A block: sensors, carriers and targets, contact, prediction, innovation, observer and integral, adaptation, law, drive.
Over a block the envelopes are held, and the innovations of the sample-by-sample observer found by a triangular solution
(docs/theory.md, "Blocks of M samples"); with M = 1 there is nothing to solve.  The drive runs linearly from one block's
force to the next's.  The inner damper needs the next sample and runs with M = 1 only.
"""

import numpy as np
from numba import carray

from hapticrender.control.adaptation import (
    ADAPTATION_SAMPLES,
    adapt_finger,
    note_commands,
    reset_finger,
)
from hapticrender.control.carriers import (
    FARTHEST,
    REFRESH,
    advance_carriers,
    crowding,
    track_finger,
    update_targets,
)
from hapticrender.control.laws import apply_law, follow_resonance, update_law
from hapticrender.control.peak_limit import NEAR_LIMIT, NONFINITE, SENSOR_CLIPPED, UNLOCKED, largest_drive, limit_drive
from hapticrender.control.records import (
    ANALYSIS,
    CONTROLLER_T,
    COORDINATE_T,
    LEAK,
    PAST,
    PAST_MASK,
    POSITION,
    STEP,
    SUM,
    TILE_T,
    TOEPLITZ,
    WAVEFORM,
    WORK_T,
    Y,
    coordinates_of,
    samples_of,
)
from hapticrender.control.sums import correlate, invert, solve, sum_bands, turn_tables
from hapticrender.jit import F8, I8, SIGNALS_T, kernel, pointer, record, step
from hapticrender.vectors import conj, get, imag, maximum, pair, put, real, some, square, total, zeros

LEAST_LOAD = 0.03  # N: a smaller load shows no place
CONFIDENCE_FADE = 0.02  # s: within this the drive fades out while a sensor's samples are implausible


@kernel
def sense_block(c, io, first, block):
    """Convert the block's sensors to coordinates; returns 1 where a sensor's sample is invalid.

    That is one that is not finite, or not inside the sensor's range: its coordinates are NaN, and the innovation takes
    the prediction in their place.  It is flagged, as a position or a waveform that is no number is.
    """
    samples, p = samples_of(c), c.p
    sensed, flags = pointer(io.sensed, F8), pointer(io.flags, I8)
    position, waveform = pointer(io.position, F8), pointer(io.waveform, F8)
    reads, implausible = p.reads_waveform > 0.0 or p.modulated > 0.0, 0
    for m in range(block):
        n = first + m
        raised = 0
        y0 = y1 = 0.0
        for s in range(p.sensors):
            value = sensed[n * p.sensors + s]
            if abs(value) < p.sensor_limit:
                y0 += p.coordinate_from_sensor[0, s] * value
                y1 += p.coordinate_from_sensor[1, s] * value
            else:  # NaN included
                y0, y1 = np.nan, np.nan
                raised |= SENSOR_CLIPPED if abs(value) < np.inf else NONFINITE
        samples[Y, m], samples[Y + 1, m] = y0, y1 if p.coordinates > 1 else 0.0
        implausible |= raised > 0
        value = waveform[n] if reads else 0.0
        sane = abs(value) <= FARTHEST
        samples[WAVEFORM, m] = value if sane else 0.0
        if raised > 0 or abs(position[n]) > FARTHEST or not sane:
            flags[n] |= raised | NONFINITE
        if c.locked > 0:
            track_finger(c, position[n])
        samples[POSITION, m] = c.held_position
    return implausible


@kernel
def update_confidence(c, implausible):
    """Fade the confidence in the sensors out within 20 ms while samples are implausible, and in again; True at none."""
    change = c.p.block / (CONFIDENCE_FADE * c.p.rate)
    c.confidence = max(c.confidence - change, 0.0) if implausible > 0 else min(c.confidence + change, 1.0)
    return c.confidence == 0.0


@kernel
def analyse_sample(c):
    """Update the envelopes of the target's waveform by the residual observer."""
    found = zeros()
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        found = found + real(get(b, "raw") * get(b, "carrier"))
    gain = c.p.waveform_gain * crowding(c) * (samples_of(c)[WAVEFORM, 0] - total(found))
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        put(b, "raw", get(b, "raw") + gain * conj(get(b, "carrier")))


@kernel
def analyse_block(c):
    """Update the envelopes of the target's waveform as exactly as those of the sensors."""
    samples = samples_of(c)
    for t in range(c.tiles):
        b, w = record(c.tiles_at, TILE_T, t), record(c.work_at, WORK_T, 2 * t)
        put(w, "x", get(b, "raw") * get(b, "carrier"))
    sum_bands(c, 1, False)
    for m in range(c.p.block):
        samples[WAVEFORM, m] -= samples[SUM, m]
    solve(c, WAVEFORM, ANALYSIS)
    correlate(c, WAVEFORM, 1)
    for t in range(c.tiles):
        b, w = record(c.tiles_at, TILE_T, t), record(c.work_at, WORK_T, 2 * t)
        put(b, "raw", get(b, "raw") + c.p.waveform_gain * conj(get(w, "x") * get(b, "carrier")))


@kernel
def predict(c, i):
    """Sums over the bands of a coordinate: what the sensors should show, and the commanded motion."""
    shown, command = zeros(), zeros()
    for t in range(c.tiles):
        b, x = record(c.tiles_at, TILE_T, t), record(coordinates_of(c, t), COORDINATE_T, i)
        carrier = get(b, "carrier")
        reference = c.p.pattern[i] * real(get(b, "expected") * carrier)
        shown = shown + (reference + real(get(x, "e") * carrier))
        command = command + (reference + real(get(x, "v") * carrier))
    return total(shown), total(command)


@kernel
def innovate_sample(c):
    """Innovation of a sample, DC estimates of type 2, and the inner damper's force into the row STEP.

    The damper is F = -sum c_j dev[n - j], `damper_force` before its gain; `past` is a ring of deviations from the
    command.
    """
    samples, now, p = samples_of(c), c.sample & PAST_MASK, c.p
    for i in range(p.coordinates):
        shown, command = predict(c, i)
        if samples[Y + i, 0] != samples[Y + i, 0]:  # invalid: hold the prediction
            samples[Y + i, 0] = shown + c.dc[i]
        deviation = samples[Y + i, 0] - c.scale * command
        c.past[i, now], c.deviation[i] = deviation, deviation - c.dc[i]
        force = 0.0
        if c.damping_gain > 0.0 or c.damper_scale < 1.0:
            for j in range(p.n_taps):
                force -= p.taps[i, j] * c.past[i, (now - j) & PAST_MASK]
        c.damper_force[i], samples[STEP + i, 0] = force, c.damping_gain * force
        error = samples[Y + i, 0] - shown - c.dc[i]
        samples[Y + i, 0] = error
        c.dc[i] += c.dc_drift[i] + c.dc_gain * error
        c.dc_drift[i] += c.dc_drift_gain * error


@kernel
def innovate_block(c):
    """Innovations of every sample of a block, solved exactly; the DC estimates of type 2 after it; correlations x."""
    samples, block, p = samples_of(c), c.p.block, c.p
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for i in range(p.coordinates):
            envelope = p.pattern[i] * get(b, "expected") + get(record(coordinates_of(c, t), COORDINATE_T, i), "e")
            put(record(c.work_at, WORK_T, 2 * t + i), "x", envelope * get(b, "carrier"))
    sum_bands(c, p.coordinates, False)
    for i in range(p.coordinates):
        for m in range(block):
            samples[Y + i, m] -= samples[SUM + i, m] + c.dc[i] + m * c.dc_drift[i]
            if samples[Y + i, m] != samples[Y + i, m]:  # invalid: hold the prediction
                samples[Y + i, m] = 0.0
        solve(c, Y + i, TOEPLITZ)
        gained = steeper = 0.0
        for m in range(block):
            gained += (c.dc_gain + (block - 1 - m) * c.dc_drift_gain) * samples[Y + i, m]
            steeper += c.dc_drift_gain * samples[Y + i, m]
        c.dc[i] += block * c.dc_drift[i] + gained
        c.dc_drift[i] += steeper
    correlate(c, Y, p.coordinates)
    for t in range(c.tiles):
        carrier = get(record(c.tiles_at, TILE_T, t), "carrier")
        for i in range(p.coordinates):
            w = record(c.work_at, WORK_T, 2 * t + i)
            put(w, "x", conj(get(w, "x") * carrier))


@kernel
def update_envelopes(c, integral, block):
    """Update error envelopes, integral parts and slopes of the commands of all bands, and run the detectors.

    Returns whether demodulated deviations exceed the levels of the two detectors in any band.  Sample by sample the
    deviation itself is demodulated; in blocks it is E - v and what the innovations add to it.
    """
    p, samples, period, back = c.p, samples_of(c), block / c.p.rate, c.p.back_calculation * (1.0 - c.scale)
    over, above = zeros(), zeros()
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        carrier, feedback, reference, rise = conj(get(b, "carrier")), get(b, "feedback"), get(b, "r"), get(b, "slope")
        gain, fading = c.gain * feedback, LEAK * (get(b, "active") - feedback)
        for i in range(p.coordinates):
            x = record(coordinates_of(c, t), COORDINATE_T, i)
            e, v = get(x, "e"), get(x, "v")
            if block > 1:
                found = get(record(c.work_at, WORK_T, 2 * t + i), "x")
                deviation = e - v + (2.0 / block) * found
            else:
                found, deviation = samples[Y + i, 0] * carrier, 2.0 * c.deviation[i] * carrier
            if p.detects > 0.0:
                fast, slow = get(x, "fast"), get(x, "slow")
                fast = fast + p.fast_smoothing * (deviation - fast)
                slow = slow + p.slow_smoothing * (fast - slow)
                over, above = maximum(square(fast), over), maximum(square(slow), above)
                put(x, "fast", fast)
                put(x, "slow", slow)
            e = (1.0 - period * fading) * e + gain * found
            pull = slope = -integral * e - fading * v
            put(x, "e", e)
            if back > 0.0:  # no part of dV/dt: else law and limiter would form an algebraic loop
                pull = slope - back * (v + p.pattern[i] * reference)
            put(x, "v", v + period * pull)
            put(x, "slope", slope + p.pattern[i] * rise)
    return some(over > p.fast_threshold), some(above > p.slow_threshold)


@kernel
def synthesise_block(c):
    """Forces of every sample into the rows Y of `samples`, linear from the last block's envelopes to these.

    Returns the largest drive over its limit, squared; of the samples, and of their envelope where the limit is near.
    """
    samples = samples_of(c)
    peak = c.p.peak_decay * c.p.peak_decay * c.peak_squared
    for quadrature in range(2):
        if quadrature > 0 and peak <= NEAR_LIMIT:
            break
        for t in range(c.tiles):
            carrier = get(record(c.tiles_at, TILE_T, t), "carrier")
            if quadrature > 0:
                carrier = pair(imag(carrier), -1.0 * real(carrier))
            for i in range(c.p.coordinates):
                x, w = record(coordinates_of(c, t), COORDINATE_T, i), record(c.work_at, WORK_T, 2 * t + i)
                put(w, "x", get(x, "last_force") * carrier)
                put(w, "rise", (get(x, "force") - get(x, "last_force")) * carrier)
        sum_bands(c, c.p.coordinates, True)
        if quadrature == 0:
            for m in range(c.p.block):
                samples[Y, m], samples[Y + 1, m] = samples[SUM, m], samples[SUM + 1, m]
        peak = max(peak, largest_drive(c, samples, quadrature > 0, c.p.block))
    for t in range(c.tiles):
        for i in range(c.p.coordinates):
            x = record(coordinates_of(c, t), COORDINATE_T, i)
            put(x, "last_force", get(x, "force"))
    return peak


@kernel
def reset_loop(c):
    """Reset the loop's state: no confidence in the sensors is left."""
    for t in range(c.tiles):
        for i in range(c.p.coordinates):
            x = record(coordinates_of(c, t), COORDINATE_T, i)
            put(x, "e", 0.0)
            put(x, "v", 0.0)
            put(x, "slope", 0.0)
            put(x, "fast", 0.0)
            put(x, "slow", 0.0)
    for i in range(2):
        c.dc[i] = c.dc_drift[i] = 0.0
        for j in range(PAST):
            c.past[i, j] = 0.0


@kernel
def begin(c, io, first, block):
    """Sensors and carriers of a block, and the gains of the observer and of the DC estimate."""
    p = c.p
    c.implausible = sense_block(c, io, first, block)
    if p.lock > 0.0 and (block > 1 or c.sample % REFRESH == 0):
        follow_resonance(c)
    advance_carriers(c)
    fast = p.needs_contact > 0.0 and (c.finger_seen <= 0.0 or c.fresh > 0.0)
    c.dc_gain, c.dc_drift_gain = (p.dc_fast, p.dc_drift_fast) if fast else (p.dc, p.dc_drift)
    c.feedback_off = 1.0 if fast or (p.needs_contact > 0.0 and c.speed < p.least_speed) else 0.0
    c.gain = crowding(c) * (p.observer + c.fast_open * (p.observer_high - p.observer)) * (1.0 - c.feedback_off)


@kernel
def find_contact(c, adapt_now):
    """Load, lever arm and contact of the finger by the DC estimate, and the gain of the inner damper.

    A contact that begins or ends raises the gains for a while.  `damper_scale` is the supervisor's: it turns a ringing
    damper down.  Returns whether the finger is to be adapted.
    """
    p, k = c.p, c.p.stiffness
    load = -(k[0, 0] * c.dc[0] + k[0, 1] * c.dc[1])
    on = 1.0 if load > (p.contact_off if c.contact > 0.0 else p.contact_on) else 0.0
    changed = on != c.contact
    c.load, c.contact = load, on
    if on > 0.0 and (adapt_now or changed):
        moment = -(k[1, 0] * c.dc[0] + k[1, 1] * c.dc[1])
        c.lever = min(max(moment / max(load, LEAST_LOAD), -2.0), 2.0)
    if changed:
        c.fast_timer, c.fast_open = p.fast_time, 1.0
        reset_finger(c)
    c.damping_gain = 0.0 if c.scale < 1.0 else c.damper_scale * (p.damper + c.fast_open * (p.damper_high - p.damper))
    return c.contact > 0.0 and p.adaptation >= 0.0


@kernel
def close_block(c, touching, adapt_now, block):
    """Envelopes from the innovations, adaptation, law, and the gain schedule.

    A detector over its level raises the gains for a while; then they fall slowly.
    """
    p = c.p
    integral = p.integral + c.slow_open * (p.integral_medium - p.integral)
    integral = (integral + c.fast_open * (p.integral_high - integral)) * (1.0 - c.feedback_off)
    fast, slow = update_envelopes(c, integral, block)
    if update_confidence(c, c.implausible):
        reset_loop(c)
    if touching and adapt_now:
        if block == 1:
            note_commands(c)
        adapt_finger(c, c.gain, c.damping_gain)
    update_law(c, touching, adapt_now)
    if touching and block > 1:
        note_commands(c)
    if fast:
        c.fast_timer = p.fast_time
    if slow:
        c.slow_timer = p.slow_time
    c.fast_open = 1.0 if c.fast_timer > 0.0 else max(c.fast_open - p.release, 0.0)
    c.slow_open = 1.0 if c.slow_timer > 0.0 else max(c.slow_open - p.release, 0.0)
    c.fast_timer -= 1.0
    c.slow_timer -= 1.0


@step
def error_step(state, signals, start, count):
    """Advance the law by bands by `count` samples, sample by sample; see `hapticrender.jit`."""
    c, io = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0)
    samples, stop = samples_of(c), start + count
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    for n in range(start, stop):
        begin(c, io, n, 1)
        if c.p.reads_waveform > 0.0:
            analyse_sample(c)
        update_targets(c, io, n, 1)
        adapt_now = c.sample % ADAPTATION_SAMPLES == 0
        touching = find_contact(c, adapt_now)
        innovate_sample(c)
        close_block(c, touching, adapt_now, 1)
        apply_law(c)
        peak = max(c.p.peak_decay * c.p.peak_decay * c.peak_squared, largest_drive(c, samples, True, 1))
        limit_drive(c, samples, peak, drive, flags, n, 1)
        if c.p.lock > 0.0 and c.unlocked > 0.0:
            flags[n] |= UNLOCKED
    return 0


@step
def block_step(state, signals, start, count):
    """Advance the law by bands by `count` samples, in blocks of M > 1; see `hapticrender.jit`."""
    c, io = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0)
    samples, block, stop = samples_of(c), c.p.block, start + count
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    for first in range(start, stop, block):
        begin(c, io, first, block)
        if c.stale > 0 or c.locked > 0 or c.gain != c.response_gain:
            turn_tables(c)
            invert(c, c.gain)
        if c.p.reads_waveform > 0.0:
            analyse_block(c)
        update_targets(c, io, first, block)
        touching = find_contact(c, True)
        innovate_block(c)
        close_block(c, touching, True, block)
        apply_law(c)
        peak = synthesise_block(c)
        limit_drive(c, samples, peak, drive, flags, first, block)
        if c.p.lock > 0.0 and c.unlocked > 0.0:
            for m in range(block):
                flags[first + m] |= UNLOCKED
    return 0


@kernel
def observed_envelope(state):
    """Observed envelope (re, im) of band 0 in coordinate 0 of the controller at an address."""
    c = record(state, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, 0)
    return b.expected_re[0] + b.e0_re[0], b.expected_im[0] + b.e0_im[0]
