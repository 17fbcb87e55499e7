"""Compiled tick of the band bank: residual-coupled observer, dynamic-stiffness law, inner damping, finger, two speeds.

One step serves the methods that work in the device's coordinates (FACTS
section 3): the observer watches the error (H2) or the signal (H), the law
inverts D + D' d/dt, the inner loop damps the deviation at sample rate.

Symbols: R wanted, V commanded and E error envelope of a coordinate, v = V - R
the integral part, D dynamic stiffness (N/m), z the finger's, h = [1, g] with
g = p/a its place, eps the deviation y - sum Re V e^{j phi} at sample rate.
Everything a band owns is a column, the band index innermost; rows are named.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender._jit import kernel
from hapticrender.control.kernels import (
    DOUBT_TIME,
    FAR,
    FASTEST,
    FREQUENCY,
    PHASE,
    TURN,
    WANTED_IM,
    WANTED_RE,
    WAVENUMBER,
    fade,
    size,
)
from hapticrender.protocols import Array

# rows of BankState.band: carrier, target (R and its slope), and what the finger adds to it beyond its three numbers
TURNS, RAMP, WEIGHT, COS, SIN, OMEGA, SWEEP, R_RE, R_IM, DR_RE, DR_IM, RAW_RE, RAW_IM, REST_RE, REST_IM = range(15)
# the target as the observer sees it: R itself (error observer), or R behind the observer's pole
SEEN_RE, SEEN_IM = range(15, 17)
BAND_ROWS = 17
# rows of BankState.loop, LOOP_ROWS a coordinate: error; integral part, its slope; low-passed like the error; error and
# low-passed integral part at the last adaptation; fast and slow detector of the deviation
E_RE, E_IM, V_RE, V_IM, DV_RE, DV_IM, L_RE, L_IM, LAST_RE, LAST_IM, FAST_RE, FAST_IM, SLOW_RE, SLOW_IM = range(14)
LOOP_ROWS = 14
# entries of BankState.track: the finger's motion (position as given, smoothed, velocity, acceleration, seen before)
HELD, SMOOTH, VELOCITY, ACCELERATION, SEEN = range(5)
TRACK_ROWS = 5
# entries of BankState.touch: the finger's load (N), place g, contact, its three numbers; timers and openings of the two
# detectors; limiter; trust in the sensors
LOAD, PLACE, CONTACT, MASS, DAMPING, STIFFNESS, FAST_TIME, SLOW_TIME, FAST_OPEN, SLOW_OPEN, PEAK, SCALE, TRUST = range(
    13
)
TOUCH_ROWS = 13
ADAPTATION = 4  # samples between two adaptations of the finger
TRACKER_POLE = TURN * 60.0  # rad/s: triple pole of the finger's tracker; no lag under constant acceleration
CROWDED_MASS, CROWDED_STIFFNESS = 4e-3, 300.0  # kg, N/m: how far the finger's numbers may be expected to lie from zero
LEAST_MOTION, LEAST_LOAD = 5e-8, 0.03  # m, N: below these the finger is not adapted


class BankNumbers(NamedTuple):
    """What all bands share."""

    rate: float
    analysed: bool
    error_observer: bool
    lead: float  # s: delay and half the hold
    reference: float  # g of the bank that analyses and filters the target, per sample
    observer: float  # g of the observer in quiet, per sample; 0 without feedback
    observer_awake: float
    crowd_speed: float  # m/s: below it finger-locked carriers crowd, and the observer slows down with the finger
    dc: float  # 1.6 w h of the DC band (type 2)
    dc_drift: float  # (w h)^2
    integral: float  # 1/s in quiet
    integral_stirred: float
    integral_awake: float
    adapt: float  # 1/s in quiet; negative: never
    adapt_awake: float
    rest: float  # 1/s: adaptation of each band's remaining stiffness, in quiet
    rest_awake: float
    inner: float  # share of the inner loop that is always on
    inner_awake: float
    fast_pole: float  # per sample
    slow_pole: float
    fast_level: float  # m, squared
    slow_level: float
    fast_time: float  # samples
    slow_time: float
    release: float  # per sample
    ramp: float  # per sample
    lowest: float  # Hz
    highest: float
    contact_on: float  # N
    contact_off: float
    drive_limit: float
    drive_step: float  # 0: not shaped
    peak_decay: float  # per sample
    back: float  # 1/s: back-calculation at the limit
    sensed_limit: float


class BankTables(NamedTuple):
    """Parameters of the bank."""

    numbers: BankNumbers
    tone: Array  # (5, bands)
    listen: Array  # (coordinates, sensors)
    speak: Array  # (channels, coordinates): drive per force
    mass: Array  # (coordinates, coordinates)
    damping: Array
    stiffness: Array
    shape: Array  # (coordinates,) pattern of the target
    taps: Array  # (coordinates, taps) of the inner loop, N/m
    grip: Array  # (coordinates,) damping that the inner loop adds, N s/m


class BankState(NamedTuple):
    """State of the bank; changed in place."""

    band: Array  # (BAND_ROWS, bands)
    loop: Array  # (coordinates * LOOP_ROWS, bands)
    track: Array  # (TRACK_ROWS,)
    touch: Array  # (TOUCH_ROWS,)
    level: Array  # (2, coordinates) DC band and its drift
    past: Array  # (coordinates, taps) last deviations, newest first
    residual: Array  # (3, coordinates) scratch: residual of the observer, force, force a quarter turn ahead
    shaper: Array  # (2, channels) last two errors of the command's rounding
    sample: Array  # (1,) integer: samples so far


@kernel
def track_finger(track, rate, position):
    """Velocity and acceleration of the finger by a tracker with a triple pole; a new touch starts it at rest."""
    if not abs(position) <= FAR or (track[SEEN] > 0.0 and abs(position - track[HELD]) * rate > FASTEST):
        track[SEEN] = track[VELOCITY] = track[ACCELERATION] = 0.0  # lifted, or put down elsewhere
        return
    if track[SEEN] == 0.0:
        track[SMOOTH] = position
    track[SEEN] = 1.0
    track[HELD] = position
    pole = TRACKER_POLE / rate
    track[SMOOTH] += track[VELOCITY] / rate
    innovation = position - track[SMOOTH]
    track[SMOOTH] += 3.0 * pole * innovation
    track[VELOCITY] += track[ACCELERATION] / rate + 3.0 * pole * TRACKER_POLE * innovation
    track[ACCELERATION] += pole * TRACKER_POLE * TRACKER_POLE * innovation


@kernel
def carrier_pass(numbers, tone, band, track):
    """Phase, frequency, sweep and weight of every carrier."""
    for k in range(tone.shape[1]):
        wavenumber = tone[WAVENUMBER, k]
        band[OMEGA, k] = TURN * (tone[FREQUENCY, k] + wavenumber * track[VELOCITY])
        band[SWEEP, k] = TURN * wavenumber * track[ACCELERATION]
        turns = band[TURNS, k] + wavenumber * track[HELD] + tone[PHASE, k]
        psi = TURN * (turns - math.floor(turns))
        band[COS, k], band[SIN, k] = math.cos(psi), math.sin(psi)
        felt = wavenumber == 0.0 or track[SEEN] > 0.0
        ramp = min(band[RAMP, k] + numbers.ramp, 1.0) if felt else max(band[RAMP, k] - numbers.ramp, 0.0)
        band[RAMP, k] = ramp
        weight = ramp * ramp * (3.0 - 2.0 * ramp)
        if wavenumber > 0.0:
            weight *= fade(abs(band[OMEGA, k]) / TURN, numbers.lowest, numbers.highest)
        band[WEIGHT, k] = weight
        turns = band[TURNS, k] + tone[FREQUENCY, k] / numbers.rate
        band[TURNS, k] = turns - math.floor(turns)


@kernel
def target_pass(numbers, tone, band, g, wanted, target):
    """Wanted envelope R and its slope: constant, or the wanted waveform through the bank and one more pole."""
    bands = band.shape[1]
    residual = wanted
    if numbers.analysed:
        for k in range(bands):
            residual -= band[RAW_RE, k] * band[COS, k] - band[RAW_IM, k] * band[SIN, k]
    for k in range(bands):
        weight = band[WEIGHT, k]
        if numbers.analysed:
            band[RAW_RE, k] += g * residual * band[COS, k]
            band[RAW_IM, k] -= g * residual * band[SIN, k]
            follow = 0.5 * g
            re = band[R_RE, k] + follow * (weight * band[RAW_RE, k] - band[R_RE, k])
            im = band[R_IM, k] + follow * (weight * band[RAW_IM, k] - band[R_IM, k])
        else:
            re, im = weight * tone[WANTED_RE, k], weight * tone[WANTED_IM, k]
        target[k] = complex(re, im)
        pole = 1.0 if numbers.error_observer else 0.5 * numbers.reference
        band[SEEN_RE, k] += pole * (re - band[SEEN_RE, k])
        band[SEEN_IM, k] += pole * (im - band[SEEN_IM, k])
        band[DR_RE, k], band[DR_IM, k] = (re - band[R_RE, k]) * numbers.rate, (im - band[R_IM, k]) * numbers.rate
        band[R_RE, k], band[R_IM, k] = re, im


@kernel
def feel(numbers, stiffness, level, touch):
    """Load and place of the finger from the sag (the DC band); true where contact has just begun or ended."""
    load = moment = 0.0
    for c in range(level.shape[1]):
        load -= stiffness[0, c] * level[0, c]
        if level.shape[1] > 1:
            moment -= stiffness[1, c] * level[0, c]
    touch[LOAD] = load
    was = touch[CONTACT]
    touch[CONTACT] = 1.0 if load > (numbers.contact_off if was > 0.0 else numbers.contact_on) else 0.0
    if touch[CONTACT] > 0.0:
        touch[PLACE] = min(max(moment / max(load, LEAST_LOAD), -2.0), 2.0)
    return touch[CONTACT] != was


@kernel
def wake(numbers, touch, fast, slow):
    """Timers of the two detectors and how far each has opened the loop."""
    if fast:
        touch[FAST_TIME] = numbers.fast_time
    if slow:
        touch[SLOW_TIME] = numbers.slow_time
    for timer, opening in ((FAST_TIME, FAST_OPEN), (SLOW_TIME, SLOW_OPEN)):
        open_ = touch[timer] > 0.0
        touch[opening] = 1.0 if open_ else max(touch[opening] - numbers.release, 0.0)
        touch[timer] -= 1.0


@kernel
def believe(numbers, touch, loop, level, past, flags):
    """Trust in the sensors: falls to 0 within 20 ms where a sample cannot be believed; then the loop starts anew."""
    step = 1.0 / (DOUBT_TIME * numbers.rate)
    touch[TRUST] = max(touch[TRUST] - step, 0.0) if flags & 2 else min(touch[TRUST] + step, 1.0)
    if touch[TRUST] == 0.0:
        loop[:] = 0.0
        level[:] = 0.0
        past[:] = 0.0


@kernel
def residual_pass(shape, band, loop, level, residual, past, y, scale, c):
    """Residual of the observer and deviation from the command, as the limiter has scaled it, in coordinate c."""
    base = c * LOOP_ROWS
    observed = commanded = y
    for k in range(band.shape[1]):
        cos, sin = band[COS, k], band[SIN, k]
        x_re = shape[c] * band[SEEN_RE, k] + loop[base + E_RE, k]
        x_im = shape[c] * band[SEEN_IM, k] + loop[base + E_IM, k]
        observed -= x_re * cos - x_im * sin
        v_re = shape[c] * band[R_RE, k] + loop[base + V_RE, k]
        v_im = shape[c] * band[R_IM, k] + loop[base + V_IM, k]
        commanded -= scale * (v_re * cos - v_im * sin)
    residual[0, c] = observed - level[0, c]
    for i in range(past.shape[1] - 1, 0, -1):
        past[c, i] = past[c, i - 1]
    past[c, 0] = commanded
    return commanded - level[0, c]


@kernel
def observer_pass(numbers, shape, band, loop, c, error, deviation, g, integral, spill):
    """Error envelopes, integral parts and detectors of coordinate c; returns 1 for fast, 2 for slow, 3 for both."""
    base = c * LOOP_ROWS
    period = 1.0 / numbers.rate
    trips = 0
    for k in range(band.shape[1]):
        cos, sin, weight = band[COS, k], band[SIN, k], band[WEIGHT, k] / max(band[RAMP, k], 1e-9)
        weight = min(weight, 1.0)
        keep = 1.0 - 50.0 * period * (1.0 - weight)  # a carrier near 0 Hz is forgotten, not followed
        e_re = keep * loop[base + E_RE, k] + weight * g * error * cos
        e_im = keep * loop[base + E_IM, k] - weight * g * error * sin
        if not numbers.error_observer:  # X goes on by itself; E is its distance to a target that has moved
            moved = 0.5 * numbers.reference / (1.0 - 0.5 * numbers.reference)
            e_re -= shape[c] * moved * (band[R_RE, k] - band[SEEN_RE, k])
            e_im -= shape[c] * moved * (band[R_IM, k] - band[SEEN_IM, k])
        loop[base + E_RE, k], loop[base + E_IM, k] = e_re, e_im
        v_re, v_im = loop[base + V_RE, k], loop[base + V_IM, k]
        back = numbers.back * spill
        dv_re = -integral * e_re - back * (v_re + shape[c] * band[R_RE, k]) - (1.0 - weight) * 50.0 * v_re
        dv_im = -integral * e_im - back * (v_im + shape[c] * band[R_IM, k]) - (1.0 - weight) * 50.0 * v_im
        loop[base + DV_RE, k], loop[base + DV_IM, k] = dv_re, dv_im
        v_re += period * dv_re
        v_im += period * dv_im
        loop[base + V_RE, k], loop[base + V_IM, k] = v_re, v_im
        loop[base + L_RE, k] += 0.5 * g * (v_re - loop[base + L_RE, k])
        loop[base + L_IM, k] += 0.5 * g * (v_im - loop[base + L_IM, k])
        p_re, p_im = 2.0 * deviation * cos, -2.0 * deviation * sin
        loop[base + FAST_RE, k] += numbers.fast_pole * (p_re - loop[base + FAST_RE, k])
        loop[base + FAST_IM, k] += numbers.fast_pole * (p_im - loop[base + FAST_IM, k])
        loop[base + SLOW_RE, k] += numbers.slow_pole * (p_re - loop[base + SLOW_RE, k])
        loop[base + SLOW_IM, k] += numbers.slow_pole * (p_im - loop[base + SLOW_IM, k])
        if loop[base + FAST_RE, k] ** 2 + loop[base + FAST_IM, k] ** 2 > numbers.fast_level:
            trips |= 1
        if loop[base + SLOW_RE, k] ** 2 + loop[base + SLOW_IM, k] ** 2 > numbers.slow_level:
            trips |= 2
    return trips


@kernel
def held(band, loop, shape, c, k):
    """V and dV/dt of coordinate c and band k, complex."""
    base = c * LOOP_ROWS
    value = complex(shape[c] * band[R_RE, k] + loop[base + V_RE, k], shape[c] * band[R_IM, k] + loop[base + V_IM, k])
    slope = complex(
        shape[c] * band[DR_RE, k] + loop[base + DV_RE, k], shape[c] * band[DR_IM, k] + loop[base + DV_IM, k]
    )
    return value, slope


@kernel
def finger_stiffness(touch, band, k):
    """Dynamic stiffness z (N/m) of the finger at band k: its three numbers and what is left over."""
    omega = band[OMEGA, k]
    return complex(
        touch[STIFFNESS] - omega * omega * touch[MASS] + band[REST_RE, k], omega * touch[DAMPING] + band[REST_IM, k]
    )


@kernel
def law_pass(numbers, mass, damping, stiffness, shape, band, loop, touch, force, quadrature):
    """F = D V + D' dV/dt + j dw/dt M V, finger included, turned ahead by delay and hold; adds to `force`."""
    coordinates = shape.shape[0]
    for c in range(coordinates):
        quadrature[c] = 0.0
    with_finger = touch[CONTACT] > 0.0 and numbers.adapt >= 0.0
    for k in range(band.shape[1]):
        omega, sweep = band[OMEGA, k], band[SWEEP, k]
        angle = numbers.lead * (omega + 0.5 * sweep * numbers.lead)
        x = 0.5 * omega / numbers.rate
        grow = x / math.sin(x) if abs(x) > 1e-9 else 1.0
        ahead = grow * complex(math.cos(angle), math.sin(angle)) * complex(band[COS, k], band[SIN, k])
        at = dat = 0j  # of the finger
        if with_finger:
            for c in range(coordinates):
                value, slope = held(band, loop, shape, c, k)
                place = 1.0 if c == 0 else touch[PLACE]
                at += place * value
                dat += place * slope
            pull = finger_stiffness(touch, band, k) * at
            pull += complex(touch[DAMPING], 2.0 * omega * touch[MASS]) * dat + complex(0.0, sweep * touch[MASS]) * at
        for c in range(coordinates):
            total = 0j
            for i in range(coordinates):
                value, slope = held(band, loop, shape, i, k)
                total += complex(stiffness[c, i] - omega * omega * mass[c, i], omega * damping[c, i]) * value
                total += (
                    complex(damping[c, i], 2.0 * omega * mass[c, i]) * slope + complex(0.0, sweep * mass[c, i]) * value
                )
            if with_finger:
                total += (1.0 if c == 0 else touch[PLACE]) * pull
            total *= ahead
            force[c] += total.real
            quadrature[c] += total.imag


@kernel
def adapt_pass(numbers, mass, damping, stiffness, shape, grip, band, loop, touch, inner, gain, rest):
    """The finger's three numbers, pooled over bands, and what is left of each band's stiffness, from the heave row."""
    coordinates = shape.shape[0]
    step = ADAPTATION / numbers.rate
    sum_k = sum_m = sum_b = total = 0.0
    stiff2, mass2 = CROWDED_STIFFNESS * CROWDED_STIFFNESS, CROWDED_MASS * CROWDED_MASS
    for k in range(band.shape[1]):
        omega = band[OMEGA, k]
        felt = commanded = away = 0j
        for c in range(coordinates):
            base = c * LOOP_ROWS
            place = 1.0 if c == 0 else touch[PLACE]
            error = complex(loop[base + E_RE, k], loop[base + E_IM, k])
            own = complex(loop[base + L_RE, k], loop[base + L_IM, k])
            wanted = complex(shape[c] * band[SEEN_RE, k], shape[c] * band[SEEN_IM, k])
            felt += place * (wanted + error)
            commanded += place * (wanted + own)
            apart = error - own
            before = complex(loop[base + LAST_RE, k], loop[base + LAST_IM, k])
            loop[base + LAST_RE, k], loop[base + LAST_IM, k] = apart.real, apart.imag
            away += complex(stiffness[0, c] - omega * omega * mass[0, c], omega * damping[0, c]) * apart
            away += complex(damping[0, c], 2.0 * omega * mass[0, c]) * (apart - before) / step
            if c == 0:
                away += complex(0.0, inner * omega * grip[0]) * apart
        size2 = felt.real * felt.real + felt.imag * felt.imag
        if size2 < LEAST_MOTION * LEAST_MOTION or band[WEIGHT, k] < 1.0:  # too small, or a carrier near 0 Hz
            continue
        found = (finger_stiffness(touch, band, k) * commanded - away) * felt.conjugate() / size2
        own_re = stiffness[0, 0] - omega * omega * mass[0, 0]
        weight = size2 / (own_re * own_re + (omega * damping[0, 0]) ** 2)
        miss = found.real - touch[STIFFNESS] + omega * omega * touch[MASS]
        drag = found.imag - omega * touch[DAMPING]
        scale = weight / (stiff2 + omega**4 * mass2)
        sum_k += scale * stiff2 * miss
        sum_m += scale * omega * omega * mass2 * miss
        sum_b += weight * drag / omega
        total += weight
        band[REST_RE, k] += step * rest * (miss - band[REST_RE, k])
        band[REST_IM, k] += step * rest * (drag - band[REST_IM, k])
    if total > 0.0:
        step *= gain / total
        touch[STIFFNESS] = min(max(touch[STIFFNESS] + step * sum_k, -500.0), 15e3)
        touch[MASS] = min(max(touch[MASS] - step * sum_m, -2e-3), 12e-3)
        touch[DAMPING] = min(max(touch[DAMPING] + step * sum_b, 0.0), 12.0)


@kernel
def forget_finger(touch, band, loop):
    """Touch or lift-off: what was learnt of one finger does not hold for the next."""
    touch[MASS] = touch[DAMPING] = touch[STIFFNESS] = 0.0
    for k in range(band.shape[1]):
        band[REST_RE, k] = band[REST_IM, k] = 0.0
        for base in range(0, loop.shape[0], LOOP_ROWS):
            loop[base + LAST_RE, k] = loop[base + E_RE, k] - loop[base + L_RE, k]
            loop[base + LAST_IM, k] = loop[base + E_IM, k] - loop[base + L_IM, k]


@kernel
def speak_pass(numbers, speak, force, quadrature, shaper, touch, drive):
    """Drive from force: the whole envelope scaled to the limit, the rounding's noise shaped (2nd order).

    The envelope is that of the analytic signal, force and its quadrature: steady for a steady tone, so that scaling it
    distorts nothing.
    """
    peak = 0.0
    for i in range(drive.shape[0]):
        total = across = 0.0
        for c in range(force.shape[0]):
            total += speak[i, c] * force[c]
            across += speak[i, c] * quadrature[c]
        drive[i] = touch[TRUST] * total
        peak = max(peak, touch[TRUST] * size(total, across) / numbers.drive_limit)
    touch[PEAK] = max(peak, touch[PEAK] * numbers.peak_decay)
    touch[SCALE] = 1.0 / touch[PEAK] if touch[PEAK] > 1.0 else 1.0
    limit, step = numbers.drive_limit, numbers.drive_step
    for i in range(drive.shape[0]):
        exact = touch[SCALE] * drive[i]
        drive[i] = exact
        if touch[TRUST] == 0.0:
            shaper[0, i] = shaper[1, i] = 0.0
        elif step > 0.0:
            shaped = exact + 2.0 * shaper[0, i] - shaper[1, i]
            drive[i] = step * math.floor(shaped / step + 0.5)
            shaper[1, i] = shaper[0, i]
            shaper[0, i] = min(max(shaped - drive[i], -step), step)
        drive[i] = min(max(drive[i], -limit), limit)
    return 1 if touch[SCALE] < 1.0 else 0


@kernel
def bank_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags."""
    numbers, shape, taps = tables.numbers, tables.shape, tables.taps
    band, loop, touch, level = state.band, state.loop, state.touch, state.level
    past, residual, listen = state.past, state.residual, tables.listen
    mass, damping, stiffness = tables.mass, tables.damping, tables.stiffness
    flags = 0
    odd = 0
    if not abs(wanted) <= FAR:
        wanted = 0.0
        odd = 2
    if abs(position) > FAR:
        odd = 2
    track_finger(state.track, numbers.rate, position)
    carrier_pass(numbers, tables.tone, band, state.track)
    calm = 1.0
    if numbers.crowd_speed > 0.0:
        calm = min(abs(state.track[VELOCITY]) / numbers.crowd_speed, 1.0)
    target_pass(numbers, tables.tone, band, calm * numbers.reference, wanted, target)
    if feel(numbers, stiffness, level, touch):
        touch[FAST_TIME] = numbers.fast_time
        forget_finger(touch, band, loop)
    fast, slow = touch[FAST_OPEN], touch[SLOW_OPEN]
    integral = numbers.integral + slow * (numbers.integral_stirred - numbers.integral)
    integral += fast * (numbers.integral_awake - integral)
    inner = numbers.inner + fast * (numbers.inner_awake - numbers.inner)
    if touch[SCALE] < 1.0:
        inner = 0.0  # no room for it
    g = calm * (numbers.observer + fast * (numbers.observer_awake - numbers.observer))
    trips = 0
    for c in range(shape.shape[0]):
        y = 0.0
        for s in range(sensed.shape[0]):
            if abs(sensed[s]) <= numbers.sensed_limit:
                y += listen[c, s] * sensed[s]
            else:  # NaN included
                flags |= 2
        deviation = residual_pass(shape, band, loop, level, residual, past, y, touch[SCALE], c)
        residual[1, c] = 0.0
        for i in range(taps.shape[1]):
            residual[1, c] -= inner * taps[c, i] * past[c, i]
        error = residual[0, c]
        level[0, c] += numbers.dc * error + level[1, c]
        level[1, c] += numbers.dc_drift * error
        trips |= observer_pass(numbers, shape, band, loop, c, error, deviation, g, integral, 1.0 - touch[SCALE])
    believe(numbers, touch, loop, level, past, flags)
    wake(numbers, touch, trips & 1, trips & 2)
    state.sample[0] += 1
    if touch[CONTACT] > 0.0 and numbers.adapt >= 0.0 and state.sample[0] % ADAPTATION == 0:
        lively = max(fast, slow)
        gain = numbers.adapt + lively * (numbers.adapt_awake - numbers.adapt)
        rest = numbers.rest + lively * (numbers.rest_awake - numbers.rest)
        adapt_pass(numbers, mass, damping, stiffness, shape, tables.grip, band, loop, touch, inner, gain, rest)
    law_pass(numbers, mass, damping, stiffness, shape, band, loop, touch, residual[1], residual[2])
    return flags | odd | speak_pass(numbers, tables.speak, residual[1], residual[2], state.shaper, touch, drive)


@kernel
def bank_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `bank_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = bank_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])
