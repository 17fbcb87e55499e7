"""The default controller's step: a block of M >= 1 samples from sensors to drive; sample by sample is M = 1.

Over a block the envelopes are held.  The residuals e_h that follow from them and those e of the observer that runs
sample by sample are related by a unit lower-triangular Toeplitz matrix, whatever the number of bands (docs/theory.md)::

    e[m] + sum_(j<m) r[m-j] e[j] = e_h[m],   r[d] = g_dc + (d - 1) g_drift + g sum_k cos(w_k d)

so that e = Q e_h with Q of one column; with M = 1 there is nothing to solve.  Then every envelope is updated once, the
law is taken at the block's end, and the drive runs linearly from one block's force to the next's.  The inner damper
needs the next sample and runs with M = 1 only.

A block: carriers and targets, prediction, innovation, observer and integral, adaptation, law, drive.
"""

from __future__ import annotations

from numba import carray

from hapticrender.control.adaptation import TURN_SAMPLES, adapt_finger, detect_contact, note_commands, reset_finger
from hapticrender.control.carriers import (
    FARTHEST,
    REFRESH,
    advance_carriers,
    analysed_target,
    crowding,
    given_target,
    put_targets,
    set_reference,
    track_finger,
)
from hapticrender.control.laws import apply_law, follow_resonance, update_law
from hapticrender.control.limiter import (
    NEAR_LIMIT,
    NONFINITE,
    UNLOCKED,
    largest_drive,
    limit_drive,
    sense,
    update_confidence,
)
from hapticrender.control.records import CONTROLLER_T, FIXED, TILE_T, W
from hapticrender.control.sums import (
    ANALYSIS,
    INVERSE,
    POSITION,
    STEP,
    SUM,
    WAVEFORM,
    Y,
    correlate,
    gather,
    invert,
    samples_of,
    scatter,
    solve,
    sum_bands,
    turn_tables,
)
from hapticrender.jit import C16, F8, I8, SIGNALS_T, kernel, pointer, record, step

FORGET = 50.0  # 1/s: error and integral of a carrier that has faded out decay at this rate


@kernel
def sense_block(controller, signals, first):
    """Coordinates of every sample, the finger's positions, and flags of what is no number; 1 where a sensor is not."""
    c = record(controller, CONTROLLER_T, 0)
    io, samples = record(signals, SIGNALS_T, 0), samples_of(controller)
    p, block = c.p, c.p.block
    rows, implausible = first + block, 0
    sensed, flags = carray(pointer(io.sensed, F8), (rows, p.sensors)), carray(pointer(io.flags, I8), rows)
    position, waveform = carray(pointer(io.position, F8), rows), carray(pointer(io.waveform, F8), rows)
    reads = p.analysed > 0.0 or p.modulated > 0.0
    for m in range(block):
        n = first + m
        raised = sense(controller, sensed, n, m, samples)
        implausible |= raised
        value = waveform[n] if reads else 0.0
        sane = abs(value) <= FARTHEST
        samples[WAVEFORM, m] = value if sane else 0.0
        if raised > 0 or abs(position[n]) > FARTHEST or not sane:
            flags[n] |= NONFINITE
        if c.moving > 0:
            track_finger(controller, position[n])
        samples[POSITION, m] = c.held_position
    return implausible


@kernel
def analyse_sample(controller):
    """Update the envelopes of the target's waveform by the residual observer."""
    c = record(controller, CONTROLLER_T, 0)
    error = samples_of(controller)[WAVEFORM, 0]
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            error -= b.raw_re[k] * b.cos[k] - b.raw_im[k] * b.sin[k]
    error *= c.p.reference * crowding(controller)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            b.raw_re[k] += error * b.cos[k]
            b.raw_im[k] -= error * b.sin[k]


@kernel
def analyse_block(controller):
    """Update the envelopes of the target's waveform as exactly as those of the sensors."""
    c = record(controller, CONTROLLER_T, 0)
    samples, g = samples_of(controller), c.p.reference
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            b.work0_re[k] = b.raw_re[k] * b.cos[k] - b.raw_im[k] * b.sin[k]
            b.work0_im[k] = b.raw_re[k] * b.sin[k] + b.raw_im[k] * b.cos[k]
        gather(controller, t)
    sum_bands(controller)
    for m in range(c.p.block):
        samples[WAVEFORM, m] -= samples[SUM, m]
    solve(controller, WAVEFORM, ANALYSIS)
    correlate(controller, WAVEFORM)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        scatter(controller, t)
        for k in range(W):
            b.raw_re[k] += g * (b.work0_re[k] * b.cos[k] - b.work0_im[k] * b.sin[k])
            b.raw_im[k] -= g * (b.work0_re[k] * b.sin[k] + b.work0_im[k] * b.cos[k])


@kernel
def update_targets(controller, signals, first):
    """Targets and references of all bands for a block; a row of the log a block."""
    c = record(controller, CONTROLLER_T, 0)
    p, samples, io = c.p, samples_of(controller), record(signals, SIGNALS_T, 0)
    factor, row = samples[WAVEFORM, p.block - 1] if p.modulated > 0.0 else 1.0, first // p.block
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        if b.mode[0] == FIXED:
            continue
        if p.analysed > 0.0:
            analysed_target(controller, t)
        else:
            given_target(controller, t, factor)
        set_reference(controller, t)
    put_targets(controller, carray(pointer(io.target, C16), (row + 1, c.bands)), row)


@kernel
def predict(controller):
    """Sums over the bands of both coordinates: what the sensors should show, and the commanded motion."""
    c = record(controller, CONTROLLER_T, 0)
    shape0, shape1 = c.p.shape[0], c.p.shape[1]
    seen0 = seen1 = command0 = command1 = 0.0
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            cos, sin = b.cos[k], b.sin[k]
            reference = b.expected_re[k] * cos - b.expected_im[k] * sin
            seen0 += shape0 * reference + b.e0_re[k] * cos - b.e0_im[k] * sin
            seen1 += shape1 * reference + b.e1_re[k] * cos - b.e1_im[k] * sin
            reference = b.r_re[k] * cos - b.r_im[k] * sin
            command0 += shape0 * reference + b.v0_re[k] * cos - b.v0_im[k] * sin
            command1 += shape1 * reference + b.v1_re[k] * cos - b.v1_im[k] * sin
    return seen0, seen1, command0, command1


@kernel
def predict_block(controller):
    """What the sensors should show in every sample of a block, into the rows SUM of `samples`."""
    c = record(controller, CONTROLLER_T, 0)
    shape0, shape1 = c.p.shape[0], c.p.shape[1]
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            cos, sin = b.cos[k], b.sin[k]
            re, im = shape0 * b.expected_re[k] + b.e0_re[k], shape0 * b.expected_im[k] + b.e0_im[k]
            b.work0_re[k], b.work0_im[k] = re * cos - im * sin, re * sin + im * cos
            re, im = shape1 * b.expected_re[k] + b.e1_re[k], shape1 * b.expected_im[k] + b.e1_im[k]
            b.work1_re[k], b.work1_im[k] = re * cos - im * sin, re * sin + im * cos
        gather(controller, t)
    sum_bands(controller)


@kernel
def innovate_block(controller):
    """Innovations of every sample of a block, solved exactly; the DC estimates of type 2 after it; correlations."""
    c = record(controller, CONTROLLER_T, 0)
    samples, block = samples_of(controller), c.p.block
    predict_block(controller)
    gain = c.p.dc_fast if c.quick > 0.0 else c.p.dc
    drift = c.p.dc_drift_fast if c.quick > 0.0 else c.p.dc_drift
    for i in range(2):
        for m in range(block):
            samples[Y + i, m] -= samples[SUM + i, m] + c.dc[i] + m * c.dc_drift[i]
        solve(controller, Y + i, INVERSE)
        gained = steeper = 0.0
        for m in range(block):
            gained += (gain + (block - 1 - m) * drift) * samples[Y + i, m]
            steeper += drift * samples[Y + i, m]
        c.dc[i] += block * c.dc_drift[i] + gained
        c.dc_drift[i] += steeper
    correlate(controller, Y)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        scatter(controller, t)
        for k in range(W):
            cos, sin, r0, i0, r1, i1 = b.cos[k], b.sin[k], b.work0_re[k], b.work0_im[k], b.work1_re[k], b.work1_im[k]
            b.work0_re[k], b.work0_im[k] = r0 * cos - i0 * sin, -r0 * sin - i0 * cos
            b.work1_re[k], b.work1_im[k] = r1 * cos - i1 * sin, -r1 * sin - i1 * cos


@kernel
def innovate_sample(controller):
    """Innovation of a sample, DC estimates of type 2, correlations, and the inner damper's force into the row STEP.

    The damper is F = -sum taps eps[n - j]; `past` is a ring of 16 deviations eps from the command.
    """
    c = record(controller, CONTROLLER_T, 0)
    samples, now, scale, damper = samples_of(controller), c.sample & 15, c.scale, c.damping_gain
    samples[SUM, 0], samples[SUM + 1, 0], command0, command1 = predict(controller)
    gain = c.p.dc_fast if c.quick > 0.0 else c.p.dc
    drift = c.p.dc_drift_fast if c.quick > 0.0 else c.p.dc_drift
    for i in range(2):
        deviation = samples[Y + i, 0] - scale * (command0 if i == 0 else command1)
        c.past[i, now], c.deviation[i] = deviation, deviation - c.dc[i]
        force = 0.0
        for j in range(c.p.n_taps):
            force -= c.p.taps[i, j] * c.past[i, (now - j) & 15]
        samples[STEP + i, 0] = damper * force
        error = samples[Y + i, 0] - samples[SUM + i, 0] - c.dc[i]
        samples[Y + i, 0] = error
        c.dc[i] += c.dc_drift[i] + gain * error
        c.dc_drift[i] += drift * error
    one0, one1 = samples[Y, 0], samples[Y + 1, 0]
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            cos, sin = b.cos[k], b.sin[k]
            b.work0_re[k], b.work0_im[k] = one0 * cos, -one0 * sin
            b.work1_re[k], b.work1_im[k] = one1 * cos, -one1 * sin


@kernel
def low_passed(low, value, pole):
    """Next value of a low pass of first order."""
    return low + pole * (value - low)


@kernel
def detect(controller):
    """Low-pass the demodulated deviations; returns what exceeds the levels of the fast and of the slow detector.

    Sample by sample the deviation itself is demodulated.  In blocks it is E - v and what the innovations add to it;
    `held` is their correlation with the carrier.
    """
    c = record(controller, CONTROLLER_T, 0)
    p, over, above = c.p, 0.0, 0.0
    whole, share = (1.0, 2.0 / p.block) if p.block > 1 else (0.0, 0.0)
    twice0, twice1 = (1.0 - whole) * 2.0 * c.deviation[0], (1.0 - whole) * 2.0 * c.deviation[1]
    fast, slow, fast_level, slow_level = p.fast_pole, p.slow_pole, p.fast_level, p.slow_level
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            re = whole * (b.e0_re[k] - b.v0_re[k]) + share * b.work0_re[k] + twice0 * b.cos[k]
            im = whole * (b.e0_im[k] - b.v0_im[k]) + share * b.work0_im[k] - twice0 * b.sin[k]
            fr, fi = low_passed(b.fast0_re[k], re, fast), low_passed(b.fast0_im[k], im, fast)
            sr, si = low_passed(b.slow0_re[k], fr, slow), low_passed(b.slow0_im[k], fi, slow)
            b.fast0_re[k], b.fast0_im[k], b.slow0_re[k], b.slow0_im[k] = fr, fi, sr, si
            over += max(fr * fr + fi * fi - fast_level, 0.0)
            above += max(sr * sr + si * si - slow_level, 0.0)
            re = whole * (b.e1_re[k] - b.v1_re[k]) + share * b.work1_re[k] + twice1 * b.cos[k]
            im = whole * (b.e1_im[k] - b.v1_im[k]) + share * b.work1_im[k] - twice1 * b.sin[k]
            fr, fi = low_passed(b.fast1_re[k], re, fast), low_passed(b.fast1_im[k], im, fast)
            sr, si = low_passed(b.slow1_re[k], fr, slow), low_passed(b.slow1_im[k], fi, slow)
            b.fast1_re[k], b.fast1_im[k], b.slow1_re[k], b.slow1_im[k] = fr, fi, sr, si
            over += max(fr * fr + fi * fi - fast_level, 0.0)
            above += max(sr * sr + si * si - slow_level, 0.0)
    return over, above


@kernel
def updated(error, held, part, r, rise, fading, share, gains):
    """Error e, integral part v and dV/dt after a step, of one component (re or im) of an envelope."""
    g, integral, back, period = gains
    error = (1.0 - period * fading) * error + g * share * held
    slope = -integral * error - fading * part
    # back-calculation is no part of dV/dt: the law would answer the limiter by itself
    return error, part + period * (slope - back * (part + r)), slope + rise


@kernel
def update_envelopes(controller, g, integral, back):
    """Update error envelopes, integral parts and slopes of the commands of all bands."""
    c = record(controller, CONTROLLER_T, 0)
    shape0, shape1, gains = c.p.shape[0], c.p.shape[1], (g, integral, back, c.p.block / c.p.rate)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            share, r, slope = b.feedback[k], b.r_re[k], b.slope_re[k]
            fading = FORGET * (b.active[k] - share)
            b.e0_re[k], b.v0_re[k], b.slope0_re[k] = updated(
                b.e0_re[k], b.work0_re[k], b.v0_re[k], shape0 * r, shape0 * slope, fading, share, gains
            )
            b.e1_re[k], b.v1_re[k], b.slope1_re[k] = updated(
                b.e1_re[k], b.work1_re[k], b.v1_re[k], shape1 * r, shape1 * slope, fading, share, gains
            )
            r, slope = b.r_im[k], b.slope_im[k]
            b.e0_im[k], b.v0_im[k], b.slope0_im[k] = updated(
                b.e0_im[k], b.work0_im[k], b.v0_im[k], shape0 * r, shape0 * slope, fading, share, gains
            )
            b.e1_im[k], b.v1_im[k], b.slope1_im[k] = updated(
                b.e1_im[k], b.work1_im[k], b.v1_im[k], shape1 * r, shape1 * slope, fading, share, gains
            )


@kernel
def synthesise_block(controller):
    """Forces of every sample into the rows Y of `samples`, linear from the last block's envelopes to these.

    Returns the largest drive over its limit, squared; of the samples, and of their envelope where the limit is near.
    """
    c = record(controller, CONTROLLER_T, 0)
    samples, block = samples_of(controller), c.p.block
    peak = c.p.peak_decay * c.p.peak_decay * c.peak
    for quarter in range(2):
        if quarter > 0 and peak <= NEAR_LIMIT:
            break
        for t in range(c.tiles):
            b = record(c.tiles_at, TILE_T, t)
            for k in range(W):
                cos = b.sin[k] if quarter else b.cos[k]
                sin = -b.cos[k] if quarter else b.sin[k]
                re, im = b.last_force0_re[k], b.last_force0_im[k]
                up, on = b.force0_re[k] - re, b.force0_im[k] - im
                b.work0_re[k], b.work0_im[k] = re * cos - im * sin, re * sin + im * cos
                b.rise0_re[k], b.rise0_im[k] = up * cos - on * sin, up * sin + on * cos
                re, im = b.last_force1_re[k], b.last_force1_im[k]
                up, on = b.force1_re[k] - re, b.force1_im[k] - im
                b.work1_re[k], b.work1_im[k] = re * cos - im * sin, re * sin + im * cos
                b.rise1_re[k], b.rise1_im[k] = up * cos - on * sin, up * sin + on * cos
            gather(controller, t)
        sum_bands(controller)
        if not quarter:
            for m in range(block):
                samples[Y, m], samples[Y + 1, m] = samples[SUM, m], samples[SUM + 1, m]
        peak = max(peak, largest_drive(controller, samples, Y, SUM, quarter > 0))
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            b.last_force0_re[k], b.last_force0_im[k] = b.force0_re[k], b.force0_im[k]
            b.last_force1_re[k], b.last_force1_im[k] = b.force1_re[k], b.force1_im[k]
            b.rise0_re[k] = b.rise0_im[k] = b.rise1_re[k] = b.rise1_im[k] = 0.0
    return peak


@kernel
def reset_loop(controller):
    """Reset the loop's state: no confidence in the sensors is left."""
    c = record(controller, CONTROLLER_T, 0)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            b.e0_re[k] = b.e0_im[k] = b.v0_re[k] = b.v0_im[k] = b.slope0_re[k] = b.slope0_im[k] = 0.0
            b.e1_re[k] = b.e1_im[k] = b.v1_re[k] = b.v1_im[k] = b.slope1_re[k] = b.slope1_im[k] = 0.0
            b.fast0_re[k] = b.fast0_im[k] = b.slow0_re[k] = b.slow0_im[k] = 0.0
            b.fast1_re[k] = b.fast1_im[k] = b.slow1_re[k] = b.slow1_im[k] = 0.0
    for i in range(2):
        c.dc[i] = c.dc_drift[i] = 0.0
        for j in range(16):
            c.past[i, j] = 0.0


@kernel
def begin(controller, signals, first):
    """Sensors and carriers of a block, and the gains of the observer and of the DC estimate."""
    c = record(controller, CONTROLLER_T, 0)
    p, block = c.p, c.p.block
    c.implausible = sense_block(controller, signals, first)
    if p.lock > 0.0 and (block > 1 or c.sample % REFRESH == 0):
        follow_resonance(controller)
    advance_carriers(controller)
    c.quick = 1.0 if p.needs_contact > 0.0 and (c.finger_seen <= 0.0 or c.fresh > 0.0) else 0.0
    c.idle = 1.0 if c.quick > 0.0 or (p.needs_contact > 0.0 and c.speed < p.least_speed) else 0.0
    c.gain = crowding(controller) * (p.observer + c.fast_open * (p.observer_high - p.observer)) * (1.0 - c.idle)


@kernel
def find_contact(controller, turn):
    """Contact by the DC estimate, which opens the loop for a while, and the gain of the inner damper."""
    c = record(controller, CONTROLLER_T, 0)
    p = c.p
    if detect_contact(controller, turn):
        c.fast_timer, c.fast_open = p.fast_time, 1.0
        reset_finger(controller)
    c.damping_gain = 0.0 if c.scale < 1.0 else p.damper + c.fast_open * (p.damper_high - p.damper)
    return c.contact > 0.0 and p.adaptation >= 0.0


@kernel
def close_block(controller, touching, turn):
    """Envelopes from the innovations, adaptation, law, and the gain schedule.

    A detector over its level opens the loop for a while; then it closes slowly.
    """
    c = record(controller, CONTROLLER_T, 0)
    p, block = c.p, c.p.block
    integral = p.integral + c.slow_open * (p.integral_medium - p.integral)
    integral = (integral + c.fast_open * (p.integral_high - integral)) * (1.0 - c.idle)
    fast, slow = detect(controller) if p.detects > 0.0 else (0.0, 0.0)
    update_envelopes(controller, c.gain, integral, p.back_calculation * (1.0 - c.scale))
    if update_confidence(controller, c.implausible):
        reset_loop(controller)
    if touching and turn:
        if block == 1:
            note_commands(controller)
        adapt_finger(controller, c.gain, c.damping_gain)
    update_law(controller, touching, turn)
    if touching and block > 1:
        note_commands(controller)
    if fast > 0.0:
        c.fast_timer = p.fast_time
    if slow > 0.0:
        c.slow_timer = p.slow_time
    c.fast_open = 1.0 if c.fast_timer > 0.0 else max(c.fast_open - p.release, 0.0)
    c.slow_open = 1.0 if c.slow_timer > 0.0 else max(c.slow_open - p.release, 0.0)
    c.fast_timer -= 1.0
    c.slow_timer -= 1.0


@step
def error_step(state, signals, start, count):
    """Advance the default controller by `count` samples, sample by sample; see `hapticrender.jit`."""
    c, io, samples = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0), samples_of(state)
    stop = start + count
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    for n in range(start, stop):
        begin(state, signals, n)
        if c.p.analysed > 0.0:
            analyse_sample(state)
        update_targets(state, signals, n)
        turn = c.sample % TURN_SAMPLES == 0
        touching = find_contact(state, turn)
        innovate_sample(state)
        close_block(state, touching, turn)
        along0, along1, samples[SUM, 0], samples[SUM + 1, 0] = apply_law(state)
        samples[Y, 0], samples[Y + 1, 0] = along0 + samples[STEP, 0], along1 + samples[STEP + 1, 0]
        peak = max(c.p.peak_decay * c.p.peak_decay * c.peak, largest_drive(state, samples, Y, SUM, True))
        limit_drive(state, samples, Y, peak, drive, flags, n)
        if c.p.lock > 0.0 and c.unlocked > 0.0:
            flags[n] |= UNLOCKED
    return 0


@step
def block_step(state, signals, start, count):
    """Advance the default controller by `count` samples, in blocks of M > 1; see `hapticrender.jit`."""
    c, io, samples = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0), samples_of(state)
    block, stop = c.p.block, start + count
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    for first in range(start, stop, block):
        begin(state, signals, first)
        if c.stale > 0 or c.moving > 0 or c.gain != c.response_gain:
            turn_tables(state)
            invert(state, c.gain)
        if c.p.analysed > 0.0:
            analyse_block(state)
        update_targets(state, signals, first)
        touching = find_contact(state, True)
        innovate_block(state)
        close_block(state, touching, True)
        apply_law(state)
        peak = synthesise_block(state)
        limit_drive(state, samples, Y, peak, drive, flags, first)
        if c.p.lock > 0.0 and c.unlocked > 0.0:
            for m in range(block):
                flags[first + m] |= UNLOCKED
    return 0


@kernel
def observed_envelope(state):
    """Observed envelope (re, im) of band 0 in coordinate 0 of the controller at an address."""
    c = record(state, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, 0)
    return b.r_re[0] + b.e0_re[0], b.r_im[0] + b.e0_im[0]


@kernel
def finger_damping(state):
    """Estimated damping of the finger of the controller at an address."""
    return record(state, CONTROLLER_T, 0).finger_damping
