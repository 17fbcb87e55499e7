"""Supervision: a compiled step around a controller's that stops the drive where the device does not follow it.

Every sample it compares the coordinates q (heave, rocking) with the force F of the drive that acts, the mean of the
samples before and after the moment of sensing, at a cost that does not grow with the bands.  The residual force r is
what the device model lacks: a finger, its load, noise, or a fault (docs/theory.md, "Supervision").  Energies E are
one-pole means of squares.

=== ============ ================================================================================ ====================
no  cause        condition                                                                        for
=== ============ ================================================================================ ====================
1   invalid      share of samples that are not finite or not inside the range > 0.3               20 ms (mean)
                 or every second or third at least is no number                                   7.1 ms
2   frozen       a sensor repeats a value for 10 samples and 2 ms, and 5 times as long as ever
                 before (or 10 ms), while the drive moves; or the device's last block of samples,
                 for as many samples, and 2 ms, while the drive does not repeat itself            at once
3   inconsistent E_r > finger + load + model + delay + noise, and E_r < 6 E_F; not within 60 ms   15 to 60 ms
                 after a contact begins or ends, unless in danger
4   active       -mean(r v) > 0.6 sqrt(E_F E_v), E_r < 6 E_F, in danger only                      5 ms
                 or > 0.65 sqrt(E_F E_v) in heave, E_r < 6 E_F, means over 0.2 s ("slowly")       0.3 s
                 or the inner damper asks for more than 2.5 times its limit, rms over 3 ms        15 ms
5   drive        mean of u^2 > (1.5 B + A/2.4)^2/2: more than any finger takes                    30 ms (mean) + 60 ms
6   ringing      inner damper's force beyond 500 Hz and 1.5 times the carriers > 4 times its noise   12 ms
7   overmotion   motion of an end > 3 R + 5.4 sag                                                 5 samples
8   beyond       a sensor shows more than the device's limit of displacement                      3 in 10 ms
9   sensor gain  a sensor shows -1.6 to -0.4, -0.25 to 0.25, or more than 2 times the motion that
                 device and drive give; see `gain_faults`                                         3 ms
10  actuator     its gain: an actuator gives -1.6 to -0.4 times its force; see `gain_faults`      5 ms and more
    gain
11  swapped      two sensors show each other's motion, or two actuators give each other's force;  3 ms; actuators
                 see `gain_faults`                                                                5 ms and more
12  jump         a tribometer shows a friction that changes by half within one sample and by less
                 than a quarter of that in the samples before and after                           at once
=== ============ ================================================================================ ====================

R (m) and B (drive unit) are what the scene needs at most with the worst finger, A the drive of a hard press, `sag` the
static displacement under 5 N.  *Danger* is a motion > 4 R + 1.36 sag or a drive above 0.9 of its limit.  The drive
fades out in 2 ms, on overmotion in 0.2 ms, and stays at zero.  A ringing damper is turned down to 0.4, then to 0; the
drive stops where it rings all the same for 150 ms.

Tests 3 to 5, 7 and 9 to 11 need a `Demand`, 9 to 11 at most two sensors and actuators; 6 a controller with an inner
damper; 8 a limit; 12 a sensor behind its contact.  Without them a controller has tests 1 and 2.  Causes have these
numbers.  `limit_rms_drive` holds the device's limit of rms drive, where it has one.  `control.supervisor` designs it.
"""

import math

import numba
import numpy as np
from numba import carray

from hapticrender.control.gain_faults import MOST, check_gains, start_gains
from hapticrender.control.records import CONTROLLER_T, MOST_CHANNELS, MOST_SENSORS
from hapticrender.jit import F8, I8, SIGNALS_T, call, kernel, pointer, record, step
from hapticrender.protocols import Flag

INVALID, FROZEN, INCONSISTENT, ACTIVE, DRIVE, RINGING, OVERMOTION, BEYOND = range(1, 9)
SENSOR_GAIN, ACTUATOR_GAIN, SWAPPED, JUMP = range(9, 13)
EVERY = (1 << MOST) - 1  # sensors whose gains are compared, as bits
STOPPED, SATURATED = int(Flag.STOPPED), int(Flag.SATURATED)
ROOT2 = math.sqrt(2.0)
INVALID_SHARE = 0.3
MOST_KEPT = 2  # samples that are numbers, between two that are not
REPEAT_FACTOR = 5  # times the longest repetition before: converters may hold their values
BY_DRIVE = 6.0  # E_r over E_F: in a fault the residual is the drive, in a load step it is not
POWER = 0.6
SLOW_POWER, SLOW_FORCE = 0.65, 3.0  # healthy: below 0.03, with a finger negative, while it taps up to 0.8 for a moment
RINGING_STEP = 0.4
JUMP_SHARE, JUMP_NEIGHBOURS = 0.5, 0.25  # of the friction before; of the jump: a mass shows 0.41 of it or more
JUMP_INVALID = 0.9  # of what one invalid sample, whose value is held, adds to their share: a tenth of its time ago

_SETTINGS = """
sensor_limit invalid_smoothing frozen_drive low high corner top_gain omega energy_smoothing power_smoothing
drive_smoothing ring_corner ring_top_gain ring_smoothing lever danger_motion danger_drive most_motion most_drive
large_drive most_damping sensed_bound drive_limit heat_smoothing heat_gain slow_smoothing
fade_out fade_now least_friction friction_smoothing
""".split()
_TIMES = (
    "invalid frozen inconsistent active drive ring ring_wait ring_stop suspension beyond slow limit loss".split()
)  # samples
SETTINGS = np.dtype(
    [
        *((name, np.float64) for name in _SETTINGS),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        ("coordinate_from_sensor", np.float64, (2, MOST_SENSORS)),
        ("force_from_drive", np.float64, (2, MOST_CHANNELS)),
        ("bound", np.float64, (2, 8)),  # of E_r, of each coordinate, per energy of q, v, a, dF in both
        ("noise", np.float64, (2,)),  # of E_r (N2)
        ("ringing", np.float64, (2,)),  # N2, of the damper's force; 0: no test
        *((f"{name}_time", np.int64) for name in _TIMES),
        *((name, np.int64) for name in ("step", "state", "controller", "modelled", "sensors", "channels", "block")),
        *((name, np.int64) for name in ("delay", "needs_contact", "forces_at", "limited", "gains")),
        *((name, np.int64) for name in ("frame", "frame_at")),
    ]
)
"""Settings of a supervisor, as `design_supervisor` derives them: factors and fades per sample, times in samples."""
COUNTS = ("inconsistent", "active", "drive", "motion", "ring", "ring_wait", "slow", "limit", "contact")
SUPERVISOR = np.dtype(
    [
        ("p", SETTINGS),
        *(
            (name, np.float64)
            for name in ("fade", "fade_step", "invalid", "damper_scale", "motion", "peak", "position")
        ),
        *((name, np.float64, (4,)) for name in ("input", "low", "high", "band", "level", "value", "rate", "change")),
        *((name, np.float64, (4,)) for name in ("ring_band", "ring_level")),
        *((name, np.float64, (2,)) for name in ("force", "power", "ring_energy", "limit_energy")),
        ("friction", np.float64, (4,)),  # of test 12: mean until three samples ago, and those three, oldest first
        ("slow", np.float64, (4,)),  # means of the slow test 4: -r v, and the squares of v, F and r
        ("signals", np.float64, (12,)),  # q, v, a, dF, F, r in both coordinates, and their energies
        ("energy", np.float64, (12,)),
        *((name, np.float64, (MOST_CHANNELS,)) for name in ("drive_energy", "heat")),
        *((name, np.float64, (MOST_SENSORS,)) for name in ("last", "least", "most", "least_change", "most_change")),
        *((name, np.int64, (MOST_SENSORS,)) for name in ("repeats", "longest", "frame_repeats")),
        *((f"{name}_count", np.int64) for name in COUNTS),
        *((name, np.int64) for name in ("kept", "broken")),  # samples; see `is_broken`
        *(
            (name, np.int64)
            for name in ("suspended", "sample", "now", "sensors", "cause", "stopped", "beyond_count", "away")
        ),
        ("compared", np.int64),  # whether motion and drive were compared in the last sample
    ]
)
SUPERVISOR_T = numba.from_dtype(SUPERVISOR)


@kernel
def repeats_frame(supervisor, i, value, drive):
    """Whether sensor `i` shows the device's last block (`frame` samples) again, while the sum of the drive differs.

    A texture of that period repeats itself too, and is none; one value that repeats is for test 2 to find.
    """
    s = record(supervisor, SUPERVISOR_T, 0)
    p, count, least, most = s.p, s.frame_repeats, s.least_change, s.most_change
    frame = carray(pointer(p.frame_at, F8), (p.frame, MOST_SENSORS, 2))
    row = s.sample % p.frame
    change = drive - frame[row, i, 1]
    if value == frame[row, i, 0] and change == change and s.repeats[i] < p.frame:
        count[i] += 1
        least[i], most[i] = min(least[i], change), max(most[i], change)
    else:
        count[i], least[i], most[i] = 0, 0.0, 0.0
    frame[row, i, 0], frame[row, i, 1] = value, drive
    return count[i] >= max(p.frame, p.frozen_time) and most[i] - least[i] > p.frozen_drive


@kernel
def is_broken(supervisor, lost):
    """Whether samples have been no numbers for too long, with at most `MOST_KEPT` between them that are.

    `kept` of the state counts samples since the last one that was `lost`, `broken` those since the first of such.
    """
    s = record(supervisor, SUPERVISOR_T, 0)
    if not lost:
        s.kept += 1
        return False
    s.broken = (s.broken + s.kept if s.kept <= MOST_KEPT else 0) + 1
    s.kept = 0
    return s.broken >= s.p.invalid_time


@kernel
def check_sensors(supervisor, sensed, n, drive, acts):
    """Convert a sample's sensors to coordinates, an invalid one held; tests 1 and 2 against the sum of the drive.

    Returns the cause, and the sensors that are invalid, as bits.  A drive that does not act (on a surface without a
    sliding finger) moves no sensor.
    """
    s = record(supervisor, SUPERVISOR_T, 0)
    p, cause, invalid, frozen, beyond, lost = s.p, 0, 0, 0, 0, False
    last, repeats, longest, least, most, shows = s.last, s.repeats, s.longest, s.least, s.most, p.coordinate_from_sensor
    q0 = q1 = 0.0
    for i in range(p.sensors):
        value = sensed[n * p.sensors + i]
        if not abs(value) < p.sensor_limit:
            invalid |= 1 << i
            lost |= not math.isfinite(value)
        elif value == last[i] and acts:
            repeats[i] += 1
            least[i], most[i] = min(least[i], drive), max(most[i], drive)
            usual = REPEAT_FACTOR * (min(longest[i], p.frozen_time) if longest[i] > 0 else p.frozen_time)
            if repeats[i] >= max(p.frozen_time, usual) and most[i] - least[i] > p.frozen_drive:
                frozen |= 1 << i
        else:
            longest[i] = max(longest[i], repeats[i])
            last[i], repeats[i], least[i], most[i] = value, 1, drive, drive
        if p.frame > 1 and repeats_frame(supervisor, i, value, drive if acts else np.nan):
            frozen |= 1 << i
        if p.sensor_limit > abs(value) > p.sensed_bound:
            beyond |= 1 << i
        q0 += shows[0, i] * last[i]
        q1 += shows[1, i] * last[i]
    s.input[0], s.input[1] = q0, q1
    s.invalid += p.invalid_smoothing * ((1.0 if invalid > 0 else 0.0) - s.invalid)
    if is_broken(supervisor, lost) or (invalid > 0 and s.invalid > INVALID_SHARE):
        cause = INVALID
    elif frozen > 0:
        cause = FROZEN
    s.beyond_count = max(s.beyond_count + (p.beyond_time if beyond > 0 else -1), 0)
    if beyond > 0 and s.beyond_count > 2 * p.beyond_time:
        cause = BEYOND
    if cause > 0 and s.cause == 0:
        s.sensors = invalid if cause == INVALID else frozen if cause == FROZEN else beyond
    return cause, invalid


@kernel
def check_jump(supervisor, slides):
    """Test 12: whether a friction has jumped between two samples, as behind a tribometer's mass no contact can."""
    s = record(supervisor, SUPERVISOR_T, 0)
    f, now, p = s.friction, s.last[0], s.p
    mean, before, first, second = f[0], f[1], f[2], f[3]
    jump = abs(second - first)
    alone = max(abs(first - before), abs(now - second)) < JUMP_NEIGHBOURS * jump
    steady = mean > p.least_friction and abs(first - mean) < JUMP_SHARE * mean
    fresh = before != first and s.invalid < JUMP_INVALID * p.invalid_smoothing  # else a converter may hold its values
    f[0] = mean + p.friction_smoothing * (before - mean) if slides else 0.0
    f[1], f[2], f[3] = first, second, now
    return steady and fresh and alone and jump > JUMP_SHARE * mean


@kernel
def filter_signals(supervisor):
    """Filter coordinates and forces by H; the state-variable low-pass gives H x, H s x and H s^2 x at once."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, g = s.p, s.p.corner
    for i in range(4):
        step = p.low * (s.input[i] - s.low[i])
        x = s.low[i] + step
        s.low[i] = x + step
        step = p.high * (x - s.high[i])
        mean = s.high[i] + step
        s.high[i] = mean + step
        top = p.top_gain * (x - mean - s.level[i] - (g + ROOT2) * s.band[i])
        band = s.band[i] + g * top
        level = s.level[i] + g * band
        s.band[i], s.level[i] = band + g * top, level + g * band
        s.value[i], s.rate[i], s.change[i] = level, p.omega * band, p.omega * p.omega * top


@kernel
def check_growth(supervisor, residual):
    """Test 4, slowly: whether heave has been driven on by what the model lacks for long, as no finger does."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, force, rate = s.p, s.value[2], s.rate[0]
    s.slow[0] += p.slow_smoothing * (-residual * rate - s.slow[0])
    s.slow[1] += p.slow_smoothing * (rate * rate - s.slow[1])
    s.slow[2] += p.slow_smoothing * (force * force - s.slow[2])
    s.slow[3] += p.slow_smoothing * (residual * residual - s.slow[3])
    grows = s.slow[0] > 0.0 and s.slow[0] * s.slow[0] > SLOW_POWER * SLOW_POWER * s.slow[1] * s.slow[2]
    grows &= s.slow[3] < BY_DRIVE * s.slow[2] and s.slow[2] > SLOW_FORCE * p.noise[0]
    s.slow_count = s.slow_count + 1 if grows else 0
    return s.slow_count >= p.slow_time


@kernel
def check_motion(supervisor):
    """Tests 3, 4 and 7: whether the motion follows from the drive; returns the cause, or 0."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, x, e, value, rate, change = s.p, s.signals, s.energy, s.value, s.rate, s.change
    last0, last1 = value[2], value[3]
    filter_signals(supervisor)
    s.motion = abs(value[0]) + p.lever * abs(value[1])
    danger = s.peak > p.danger_drive or s.motion > p.danger_motion
    wrong, active, grows = False, False, False
    mass, damping, stiffness, bounds = p.mass, p.damping, p.stiffness, p.bound
    for i in range(2):
        q, v, a, force = value[i], rate[i], change[i], value[2 + i]
        r = force
        for j in range(2):
            r -= mass[i, j] * change[j] + damping[i, j] * rate[j] + stiffness[i, j] * value[j]
        if i == 0:
            grows = check_growth(supervisor, r)
        step = force - (last0 if i == 0 else last1)
        x[i], x[2 + i], x[4 + i], x[6 + i], x[8 + i], x[10 + i] = q, v, a, step, force, r
        s.power[i] += p.power_smoothing * (-r * v - s.power[i])
    for k in range(12):
        e[k] += p.energy_smoothing * (x[k] * x[k] - e[k])
    for i in range(2):
        bound, residual, drive, power = p.noise[i], e[10 + i], e[8 + i], s.power[i]
        for j in range(8):
            bound += bounds[i, j] * e[j]
        by_drive = residual < BY_DRIVE * drive
        wrong |= by_drive and residual > bound
        active |= by_drive and power > 0.0 and power * power > POWER * POWER * drive * e[2 + i]
    wrong &= danger or s.contact_count == 0  # a contact that begins or ends is no fault
    s.inconsistent_count = s.inconsistent_count + (4 if danger else 1) if wrong else max(s.inconsistent_count - 2, 0)
    s.active_count = s.active_count + 1 if active and danger else 0
    s.motion_count = s.motion_count + 1 if s.motion > p.most_motion else 0
    if s.motion_count >= 5:
        return OVERMOTION
    if s.active_count >= p.active_time or grows:
        return ACTIVE
    return INCONSISTENT if s.inconsistent_count >= p.inconsistent_time else 0


@kernel
def compare_gains(supervisor, invalid):
    """Tests 9 to 11; returns the cause, and the sensors or actuators, as bits."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, q = s.p, s.input
    if s.compared == 0:  # a steady load is no motion
        k = p.stiffness
        start_gains(p.gains, q[0], q[1], k[0, 0] * q[0] + k[0, 1] * q[1], k[1, 0] * q[0] + k[1, 1] * q[1])
    sensors, actuators, swapped = check_gains(p.gains, s.last, p.sensors, invalid, s.force[0], s.force[1])
    if sensors == 0 and actuators == 0 and not swapped:
        return 0, 0
    for i in range(p.sensors):
        if 2 * s.repeats[i] > p.frozen_time:  # that is for test 2 to find
            sensors &= ~(1 << i)
            swapped = False
    if swapped:
        return SWAPPED, EVERY
    if sensors > 0:
        return SENSOR_GAIN, sensors
    return (ACTUATOR_GAIN, actuators) if actuators > 0 else (0, 0)


@kernel
def check_drive(supervisor, drive, n):
    """Test 5, on the drive of the last sample; returns whether it failed, and the largest drive."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, large, peak = s.p, False, 0.0
    for i in range(p.channels):
        value = drive[n, i]
        peak = max(peak, abs(value))
        s.drive_energy[i] += p.drive_smoothing * (value * value - s.drive_energy[i])
        large |= s.drive_energy[i] > p.most_drive
    s.drive_count = s.drive_count + 1 if large else 0
    s.peak = peak
    return s.drive_count > p.drive_time


@kernel
def check_ringing(supervisor):
    """Test 6: turn a ringing inner damper down to 0.4, then to 0; returns whether it rings all the same."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, c, g, over = s.p, record(s.p.controller, CONTROLLER_T, 0), s.p.ring_corner, False
    if c.damping_gain == 0.0 and s.damper_scale == 1.0:  # off by its schedule
        return False
    s.suspended = p.suspension_time if s.peak > p.large_drive else max(s.suspended - 1, 0)
    for i in range(2):
        top = c.damper_force[i]
        for j in (i, 2 + i):
            top = p.ring_top_gain * (top - s.ring_level[j] - (g + ROOT2) * s.ring_band[j])
            band = s.ring_band[j] + g * top
            s.ring_band[j], s.ring_level[j] = band + g * top, s.ring_level[j] + 2.0 * g * band
        s.ring_energy[i] += p.ring_smoothing * (top * top - s.ring_energy[i])
        over |= s.ring_energy[i] > p.ringing[i] > 0.0
    s.ring_wait_count = max(s.ring_wait_count - 1, 0)
    s.ring_count = s.ring_count + 1 if over and s.suspended == 0 and s.ring_wait_count == 0 else 0
    if s.damper_scale > 0.0 and s.ring_count >= p.ring_time:
        s.damper_scale = RINGING_STEP if s.damper_scale == 1.0 else 0.0
        s.ring_count, s.ring_wait_count, c.damper_scale = 0, p.ring_wait_time, s.damper_scale
    return s.ring_count >= p.ring_stop_time


@kernel
def check_limit(supervisor):
    """Test 4, by the damper: whether its force has been far beyond its limit for longer than in any contact."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, c, over = s.p, record(s.p.controller, CONTROLLER_T, 0), False
    if c.damping_gain == 0.0:
        s.limit_energy[0] = s.limit_energy[1] = 0.0
        s.limit_count = 0
        return False
    for i in range(2):
        force = c.damping_gain * c.damper_force[i]
        s.limit_energy[i] += p.ring_smoothing * (force * force - s.limit_energy[i])
        over |= s.limit_energy[i] > p.most_damping > 0.0
    s.limit_count = s.limit_count + 1 if over else 0
    return s.limit_count >= p.limit_time


@kernel
def limit_rms_drive(supervisor, drive, flags, n):
    """Cut a sample's drive to the limit that its heat leaves, and return the next sample's limit.

    The heat h is the mean of u^2; with the rms limit L and the drive limit P, u^2 <= P^2 - (P^2/L^2 - 1) h, which is
    L^2 where h is, so that h never passes L^2.
    """
    s = record(supervisor, SUPERVISOR_T, 0)
    p, most, before = s.p, 0.0, 0.0
    for i in range(p.channels):
        before = max(before, s.heat[i])
    limit = math.sqrt(max(p.drive_limit * p.drive_limit - p.heat_gain * before, 0.0))
    for i in range(p.channels):
        value = drive[n, i]
        if abs(value) > limit:
            value = math.copysign(limit, value)
            flags[n] |= SATURATED
        drive[n, i] = value
        s.heat[i] += p.heat_smoothing * (value * value - s.heat[i])
        most = max(most, s.heat[i])
    return math.sqrt(max(p.drive_limit * p.drive_limit - p.heat_gain * most, 0.0))


@kernel
def supervise(supervisor, sensed, position, drive, flags, n):
    """Run the tests on a sample, and fade its drive out once one has failed."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p = s.p
    forces = carray(pointer(p.forces_at, F8), (p.delay + 1, 3))
    now, later = s.now, s.now - 1 if s.now > 0 else p.delay  # the drive that acts from this sample on; this sample's
    s.now = now + 1 if now < p.delay else 0
    for i in range(2):
        s.input[2 + i], s.force[i] = 0.5 * (s.force[i] + forces[now, i]), forces[now, i]
    acts = p.needs_contact == 0 or (position[n] == position[n] and position[n] != s.position)
    s.position = position[n]
    away = 0 if math.isfinite(position[n]) else min(s.away + 1, p.loss_time + 1)  # a single one missing is no lift-off
    changes = away == p.loss_time or (away == 0 and s.away >= p.loss_time)
    s.contact_count = p.drive_time if changes else max(s.contact_count - 1, 0)
    s.away = away
    cause, invalid = check_sensors(supervisor, sensed, n, forces[now, 2], acts)
    if check_drive(supervisor, drive, n) and cause == 0:
        cause = DRIVE
    if p.least_friction > 0.0 and check_jump(supervisor, position[n] == position[n]) and cause == 0:
        cause = JUMP
    if p.modelled > 0:
        if s.compared == 0:  # a steady load is no motion
            for i in range(2):
                s.low[i] = s.high[i] = s.input[i]
        found = check_motion(supervisor)
        cause = found if cause == 0 or found == OVERMOTION else cause
        if p.controller != 0 and check_ringing(supervisor) and cause == 0:
            cause = RINGING
        if p.controller != 0 and check_limit(supervisor) and cause == 0:
            cause = ACTIVE
        if p.gains != 0 and s.cause == 0:
            found, which = compare_gains(supervisor, invalid)
            if found > 0 and cause == 0:
                cause, s.sensors = found, which
        s.compared = 1
    else:
        s.compared = 0
    if cause != 0 and s.cause == 0:
        s.cause, s.stopped = cause, s.sample
    if s.cause != 0:
        s.fade_step = max(s.fade_step, p.fade_now if cause == OVERMOTION else p.fade_out)
        s.fade = max(s.fade - s.fade_step, 0.0)
        flags[n] |= STOPPED
    if p.heat_smoothing > 0.0:
        limit = limit_rms_drive(supervisor, drive, flags, n)
        if p.limited != 0:  # the controller scales its whole envelope into it
            record(p.limited, CONTROLLER_T, 0).p.drive_limit = limit
    force0 = force1 = total = 0.0
    for i in range(p.channels):
        value = s.fade * drive[n, i]
        drive[n, i] = value
        force0 += p.force_from_drive[0, i] * value
        force1 += p.force_from_drive[1, i] * value
        total += value
    forces[later, 0], forces[later, 1], forces[later, 2] = force0, force1, total
    s.sample += 1


@step
def supervised_step(state, signals, start, count):
    """Advance the supervised controller by `count` samples, block by block, and supervise every sample."""
    s, io, stop = record(state, SUPERVISOR_T, 0), record(signals, SIGNALS_T, 0), start + count
    p = s.p
    sensed, position, flags = pointer(io.sensed, F8), pointer(io.position, F8), carray(pointer(io.flags, I8), stop)
    drive = carray(pointer(io.drive, F8), (stop, p.channels))
    for first in range(start, stop, p.block):
        if s.fade > 0.0:
            call(p.step, (p.state, signals, first, p.block))
        else:
            drive[first : first + p.block] = 0.0
        for n in range(first, first + p.block):
            supervise(state, sensed, position, drive, flags, n)
    return 0
