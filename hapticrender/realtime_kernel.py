"""Kernels of the real-time entry: hand-over, the finger between two calls, textures, watchdog, controller, log.

`realtime_entry.RealtimeEntry` makes the records and says what they are for.
"""

import numba
import numpy as np
from numba import carray, types

from hapticrender.control.carriers import track_finger
from hapticrender.control.records import CONTROLLER_T
from hapticrender.control.state_transfer import settle_damper, transfer
from hapticrender.jit import (
    CALLBACK,
    CONVERSION_T,
    F8,
    I8,
    SIGNALS_T,
    CFunction,
    call,
    entry,
    kernel,
    pointer,
    record,
    step,
    swap,
)
from hapticrender.protocols import Flag
from hapticrender.sampled_texture import FRESH, TEXTURE_T, evaluate, runs_out, smoothstep, value_at

HORIZON = 0.05  # s: without a new position the finger stays where it was bound for by then,
HOLD = 0.25  # s: and after so long a function of position fades out
JUMP = 2e-3  # m: a larger correction of the position is a leap
CONTINUE, ABORT = 0, 2  # results of PortAudio's callback
OVERRUN, STOPPED = int(Flag.OVERRUN), int(Flag.STOPPED)
LOST = 0b1111  # PortAudio's status: input or output under- or overflow
F4 = types.float32

SLOT = np.dtype(
    [
        *((name, np.float64) for name in ("position", "velocity", "load", "gain", "watchdog")),
        *((name, np.int64) for name in ("playing", "texture", "finger_changes", "calls")),
    ]
)
"""What the application has set: the finger, the gain, the watchdog's time (samples; 0: none), whether anything plays,
the texture's record; how often it has set the finger, and called."""
SLOT_T, SLOT_SIZE = numba.from_dtype(SLOT), SLOT.itemsize
CONTROL = np.dtype(
    [(name, np.int64) for name in "step state signals reads_waveform ahead shared limit_at damper".split()]
)
"""Addresses that run a controller on the entry's signals; whether it takes a waveform (else a factor), and how far
ahead; the table of the state that it shares with others (see `control.state_transfer`); the drive's limits;
the state of the waveform law, see `settle_damper` there."""
CONTROL_T = numba.from_dtype(CONTROL)

_ADDRESSES = (
    "control slots_at sensed_at drive_at position_at places_at waveform_at flags_at bump_at gains_at log_at copies_at "
    "tracker sensed_scale_at drive_scale_at act sense converter conversion"
)
_COUNTS = (
    "block sensors channels middle slot age samples flags refused lost ahead idle stopped timed_out taken hold unit"
)
_TEXTURE = "current previous switch changes finger_changes calls log_rows log_width sensed_position"
_STATE = "gain touch place pace offset offset_input lead lead_input open level"
_SETTINGS = "rate fade fade_out fade_in touch_step gain_smoothing offset_kept closing_step"
ENTRY = np.dtype(
    [
        *((name, np.int64) for name in f"{_ADDRESSES} {_COUNTS} {_TEXTURE}".split()),
        *((name, np.float64) for name in f"{_STATE} {_SETTINGS}".split()),
    ]
)
ENTRY_T = numba.from_dtype(ENTRY)
MIDDLE_AT, SAMPLES_AT = (ENTRY.fields[name][1] if ENTRY.fields else 0 for name in ("middle", "samples"))
COPIES = 8  # of entry and slot, one a block
ENTRY_WORDS, WORDS = ENTRY.itemsize // 8, (ENTRY.itemsize + SLOT.itemsize) // 8


@kernel
def duration(entry):
    """Samples of the last change of texture."""
    e = record(entry, ENTRY_T, 0)
    return e.fade_out + e.fade_in if e.changes > 0 else e.fade


@kernel
def waits(entry):
    """Whether the controller of the present texture has yet to take over."""
    e = record(entry, ENTRY_T, 0)
    return e.current != 0 and record(e.current, TEXTURE_T, 0).control != e.control


@kernel
def receive(entry):
    """Take up what the application has handed over; returns the address of the slot."""
    e = record(entry, ENTRY_T, 0)
    if e.middle & FRESH:
        e.slot = swap(entry + MIDDLE_AT, e.slot) & (FRESH - 1)
    slot = record(e.slots_at, SLOT_T, e.slot)
    if slot.finger_changes != e.finger_changes:
        e.finger_changes, e.age = slot.finger_changes, 0
        jump = e.place + e.pace - slot.position  # from where it would have gone on
        # only what is new of it enters both poles: calls that follow each other closely do not hold it up
        e.offset_input = e.offset_input + jump - e.offset if abs(jump) < JUMP else 0.0
        e.offset = jump if abs(jump) < JUMP else 0.0
    if slot.texture != e.current and e.samples >= e.switch + duration(entry) and not waits(entry):  # one by one
        texture = record(slot.texture, TEXTURE_T, 0)
        e.previous, e.current = e.current, slot.texture
        e.switch = e.samples + record(e.control, CONTROL_T, 0).ahead
        e.changes, texture.begun = 1 if texture.control != e.control else 0, e.switch
    return e.slots_at + e.slot * SLOT_SIZE


@kernel
def shares(entry, sample):
    """Share of the texture before and of the present one: one fades over the other, or after it with its controller."""
    e = record(entry, ENTRY_T, 0)
    since = sample - e.switch
    if e.changes > 0:
        return 1.0 - smoothstep(since / e.fade_out), smoothstep((since - e.fade_out) / e.fade_in)
    return 1.0 - smoothstep(since / e.fade), smoothstep(since / e.fade)


@kernel
def texture_at(entry, sample, position, gain, touch):
    """Texture at a sample, while one fades into the next one."""
    e = record(entry, ENTRY_T, 0)
    (before, present), total = shares(entry, sample), 0.0
    if e.current != 0 and not waits(entry):
        total += present * gain * value_at(e.current, sample, position, touch)
    if e.previous != 0 and before > 0.0:
        total += before * gain * value_at(e.previous, sample, position, touch)
    return total


@kernel
def write_waveform(entry):
    """Waveform of the block, as far ahead as the controller needs it (of bands: the gain); the texture into the log.

    Gain and touch have waited in a ring, so that the log has what was handed to the controller.
    """
    e = record(entry, ENTRY_T, 0)
    c, size = record(e.control, CONTROL_T, 0), e.ahead + e.block
    waveform, gains = carray(pointer(e.waveform_at, F8), e.block), carray(pointer(e.gains_at, F8), (size, 2))
    places = carray(pointer(e.places_at, F8), (2, e.block))
    log = carray(pointer(e.log_at, F8), (e.log_rows, e.log_width))
    for m in range(e.block):
        now = e.samples + m
        before, present = shares(entry, now)
        newest, gone = (now + e.ahead) % size, (now + e.ahead - c.ahead) % size
        if c.reads_waveform > 0:
            place = places[1 if c.ahead > 0 else 0, m]
            waveform[m] = texture_at(entry, now + c.ahead, place, gains[newest, 0], gains[newest, 1])
        else:
            waveform[m] = gains[newest, 0] * (before + present)
        logged = texture_at(entry, now, places[0, m], gains[gone, 0], gains[gone, 1])
        log[now % e.log_rows, e.channels + e.sensors + 2] = logged


@kernel
def step_controller(entry):
    """Advance the controller that runs by a block."""
    e = record(entry, ENTRY_T, 0)
    c = record(e.control, CONTROL_T, 0)
    call(c.step, (c.state, c.signals, 0, e.block))


@kernel
def take_over(entry):
    """Let the controller of the texture that begins take over: it goes on from the state of the one before.

    That one computes this block too, so that the difference of the two drives is known.  What the next one is handed
    may be another quantity, and further ahead.
    """
    e = record(entry, ENTRY_T, 0)
    texture, drive = record(e.current, TEXTURE_T, 0), carray(pointer(e.drive_at, F8), e.block * e.channels)
    bump, flags = carray(pointer(e.bump_at, F8), e.channels), carray(pointer(e.flags_at, I8), e.block)
    last, control = record(e.control, CONTROL_T, 0), record(texture.control, CONTROL_T, 0)
    transfer(last.shared, control.shared)
    if control.damper != 0 and last.damper == 0:
        settle_damper(control.damper, e.sensed_at)
    step_controller(entry)
    for m in range(e.block):
        flags[m] &= ~STOPPED  # of this block the next one decides
    for i in range(e.channels):
        bump[i] = drive[i]
    e.control, texture.begun = texture.control, e.samples + control.ahead
    e.switch = texture.begun - e.fade_out
    write_waveform(entry)
    step_controller(entry)
    for i in range(e.channels):
        bump[i] -= drive[i]


@kernel
def run_controller(entry):
    """Advance the controller by a block; after a change, what its drive differs from the last one's fades out.

    Their sum stays within the limit of the drive.
    """
    e = record(entry, ENTRY_T, 0)
    if waits(entry) and e.switch + e.fade_out <= e.samples:
        take_over(entry)
    else:
        step_controller(entry)
    if e.changes > 0 and not waits(entry) and e.samples < e.switch + duration(entry):
        drive, bump = carray(pointer(e.drive_at, F8), (e.block, e.channels)), carray(pointer(e.bump_at, F8), e.channels)
        limit = carray(pointer(record(e.control, CONTROL_T, 0).limit_at, F8), e.channels)
        flags = carray(pointer(e.flags_at, I8), e.block)
        for m in range(e.block):
            left = 1.0 - shares(entry, e.samples + m)[1] if flags[m] & STOPPED == 0 else 0.0
            for i in range(e.channels):
                drive[m, i] = min(max(drive[m, i] + left * bump[i], -limit[i]), limit[i])


@kernel
def follow_finger(entry, slot, m):
    """Where the finger is in sample m of the block, and where it will be at the end of the look-ahead (m)."""
    e, s = record(entry, ENTRY_T, 0), record(slot, SLOT_T, 0)
    position, ahead = carray(pointer(e.position_at, F8), e.block), e.ahead / e.rate
    if e.sensed_position != 0:
        position[m] = carray(pointer(e.sensed_position, F8), 1)[e.taken + m]
        c = record(e.tracker, CONTROLLER_T, 0)
        track_finger(c, position[m])
        there = position[m] + ahead * (c.velocity + 0.5 * ahead * c.acceleration)
    else:
        age = (e.age + m) / e.rate
        position[m] = s.position + min(age, HORIZON) * s.velocity + e.offset
        there = position[m] + e.lead
        kept, lead = e.offset_kept, ahead * s.velocity if age < HORIZON else 0.0
        e.lead_input = lead + kept * (e.lead_input - lead)  # two poles: neither place nor speed steps
        e.lead = e.lead_input + kept * (e.lead - e.lead_input)
        e.offset_input *= kept
        e.offset = e.offset_input + kept * (e.offset - e.offset_input)
    touches = position[m] == position[m]
    if touches:
        e.pace = position[m] - e.place if abs(position[m] - e.place) < JUMP else 0.0
        e.place = position[m]
    fresh = e.sensed_position != 0 or e.age + m < HOLD * e.rate
    e.touch = min(max(e.touch + (e.touch_step if touches and fresh else -e.touch_step), 0.0), 1.0)
    return e.place, there if touches else e.place


@kernel
def play_texture(entry, slot):
    """Follow finger, gain and textures over a block, and hand the controller its waveform."""
    e, s = record(entry, ENTRY_T, 0), record(slot, SLOT_T, 0)
    size = e.ahead + e.block
    gains, places = carray(pointer(e.gains_at, F8), (size, 2)), carray(pointer(e.places_at, F8), (2, e.block))
    for m in range(e.block):
        places[0, m], places[1, m] = follow_finger(entry, slot, m)
        e.gain += e.gain_smoothing * (s.gain - e.gain)
        then = (e.samples + m + e.ahead) % size
        gains[then, 0], gains[then, 1] = e.gain, smoothstep(e.touch)
    if e.current != 0:
        evaluate(e.current, e.samples, e.ahead)
    if e.previous != 0 and shares(entry, e.samples)[0] > 0.0:
        evaluate(e.previous, e.samples, e.ahead)
    write_waveform(entry)
    if e.current != 0 and runs_out(e.current, e.samples + record(e.control, CONTROL_T, 0).ahead, e.block):
        e.lost |= OVERRUN
    e.age += e.block
    e.taken += e.block


@kernel
def write_log(entry, slot):
    """Drive, sensed, position, load and flags of the block into the log, beside the texture."""
    e, s = record(entry, ENTRY_T, 0), record(slot, SLOT_T, 0)
    drive, sensed = carray(pointer(e.drive_at, F8), e.block * e.channels), carray(pointer(e.sensed_at, F8), 1)
    position, flags = carray(pointer(e.position_at, F8), e.block), carray(pointer(e.flags_at, I8), e.block)
    log = carray(pointer(e.log_at, F8), (e.log_rows, e.log_width))
    for m in range(e.block):
        row = (e.samples + m) % e.log_rows
        for i in range(e.channels):
            log[row, i] = drive[m * e.channels + i]
        for i in range(e.sensors):
            log[row, e.channels + i] = sensed[m * e.sensors + i]
        log[row, e.channels + e.sensors] = position[m]
        log[row, e.channels + e.sensors + 1] = s.load
        log[row, e.channels + e.sensors + 3] = flags[m]


@kernel
def watch(entry, slot):
    """Count the samples since the application has called; beyond the watchdog's time the drive is stopped."""
    e, s = record(entry, ENTRY_T, 0), record(slot, SLOT_T, 0)
    if s.calls != e.calls:
        e.calls, e.idle = s.calls, 0
    e.idle += e.block
    if s.watchdog > 0.0 and e.idle > s.watchdog and e.stopped < 0:
        e.stopped, e.timed_out = e.samples, 1


@kernel
def stop(entry):
    """Bring every channel down to zero within `supervisor.FADE_OUT` of a stop, to stay; returns the block's flags.

    The supervisor of one part of a device stops the drive of that part alone, and perhaps faster.
    """
    e, raised = record(entry, ENTRY_T, 0), 0
    flags, drive = carray(pointer(e.flags_at, I8), e.block), carray(pointer(e.drive_at, F8), e.block * e.channels)
    for m in range(e.block):
        if e.stopped < 0 and flags[m] & STOPPED:
            e.stopped = e.samples + m
        if e.stopped >= 0:
            e.open = max(e.open - e.closing_step, 0.0)
            flags[m] |= STOPPED
            for i in range(e.channels):
                drive[m * e.channels + i] *= e.open
        raised |= flags[m]
    return raised


@kernel
def sense(entry):
    """Convert what the device has given in a unit to what the controller senses, where something is between them."""
    e = record(entry, ENTRY_T, 0)
    s, c = record(e.slots_at, SLOT_T, e.slot), record(e.conversion, CONVERSION_T, 0)
    finger, flags = carray(pointer(c.finger, F8), (e.unit, 2)), carray(pointer(c.flags, I8), e.unit)
    c.lost = e.lost & OVERRUN
    flags[:] = 0
    for m in range(e.unit):
        finger[m, 0] = s.load
        finger[m, 1] = (s.velocity if e.age < HORIZON * e.rate else 0.0) if s.position == s.position else np.nan
    call(e.sense, (e.converter, e.conversion, 0, e.unit * e.hold))
    for m in range(e.unit):
        e.lost |= flags[m]


@kernel
def act(entry):
    """Convert the drive of a unit to what is played; that fades at rest, as zero drive is a bias."""
    e = record(entry, ENTRY_T, 0)
    if e.act != 0:
        call(e.act, (e.converter, e.conversion, 0, e.unit))
    s, c = record(e.slots_at, SLOT_T, e.slot), record(e.conversion, CONVERSION_T, 0)
    played = carray(pointer(c.played, F8), (e.unit * e.hold, e.channels))
    for m in range(e.unit * e.hold):
        rests = e.stopped >= 0 or s.playing == 0
        e.level = max(e.level - e.closing_step / e.hold, 0.0) if rests else 1.0
        for i in range(e.channels):
            played[m, i] *= e.level


@kernel
def keep(entry, slot):
    """Copy entry and slot between two blocks, for `foresee`."""
    e = record(entry, ENTRY_T, 0)
    copies = carray(pointer(e.copies_at, I8), (COPIES, WORDS))
    row = (e.samples // e.block) % COPIES
    copies[row, :ENTRY_WORDS] = carray(pointer(entry, I8), ENTRY_WORDS)
    copies[row, ENTRY_WORDS:] = carray(pointer(slot, I8), WORDS - ENTRY_WORDS)


@entry
def foresee(entry, slot, path):
    """Where a copy of the entry lets the finger be from its next sample on (m, shape (2, n)); 2: NaN while lifted."""
    e = record(entry, ENTRY_T, 0)
    places = carray(pointer(path, F8), (2, e.block))
    for m in range(e.block):
        places[0, m] = follow_finger(entry, slot, m)[0]


@kernel
def advance(entry):
    """Advance the controller by the block that is in its `sensed`; returns all flags of the block."""
    e = record(entry, ENTRY_T, 0)
    flags, drive = carray(pointer(e.flags_at, I8), e.block), carray(pointer(e.drive_at, F8), e.block * e.channels)
    slot = receive(entry)
    watch(entry, slot)
    play_texture(entry, slot)
    flags[:] = e.lost
    e.lost = 0
    if record(slot, SLOT_T, 0).playing > 0 and not (e.timed_out > 0 and e.open == 0.0):
        run_controller(entry)
    else:
        drive[:] = 0.0
    raised = stop(entry)
    write_log(entry, slot)
    e.flags |= raised
    swap(entry + SAMPLES_AT, e.samples + e.block)  # the log's rows are there for whoever reads the count
    keep(entry, slot)
    return raised


@kernel
def carry(entry, sensed, drive, frames, dtype, scaled):
    """Advance by units of samples of `dtype` at two addresses, full scales where `scaled`, else in SI units.

    A unit is a block of the controller or, where something is between it and the device, a call.  Returns the flags, or
    -1 and zeros where it refuses.
    """
    e, count, raised = record(entry, ENTRY_T, 0), int(frames), 0
    c, samples = record(e.conversion, CONVERSION_T, 0), e.unit * e.hold
    out = carray(pointer(drive, dtype), count * e.channels if drive != 0 else 0)
    if count % samples or (sensed == 0 and e.sensors > 0) or drive == 0:
        e.refused += 1
        out[:] = 0.0
        return -1
    inputs, outputs = samples * e.sensors, samples * e.channels
    source, raw = carray(pointer(sensed, dtype), count * e.sensors), carray(pointer(c.raw, F8), inputs)
    played = carray(pointer(c.played, F8), outputs)
    own, result = carray(pointer(e.sensed_at, F8), e.block * e.sensors), carray(pointer(e.drive_at, F8), 1)
    all_sensed, all_drive = carray(pointer(c.sensed, F8), e.unit * e.sensors), carray(pointer(c.drive, F8), 1)
    units, scales = carray(pointer(e.sensed_scale_at, F8), e.sensors), carray(pointer(e.drive_scale_at, F8), 1)
    for unit in range(count // samples):
        for i in range(inputs):
            raw[i] = source[unit * inputs + i] * (units[i % e.sensors] if scaled else 1.0)
        if e.sense != 0:
            sense(entry)
        for first in range(0, e.unit, e.block):
            for i in range(e.block * e.sensors):
                own[i] = all_sensed[first * e.sensors + i]
            raised |= advance(entry)
            for i in range(e.block * e.channels):
                all_drive[first * e.channels + i] = result[i]
        if e.converter != 0:
            act(entry)
        for i in range(outputs):
            out[unit * outputs + i] = played[i] * (scales[i % e.channels] if scaled else 1.0)
    return raised


def _plain(sensed, drive, frames, entry):
    """Advance by blocks of double samples in SI units; returns the flags, or -1 where it refuses."""
    return carry(entry, sensed, drive, frames, F8, False)


def _audio(sensed, drive, frames, time, status, entry):
    """Advance by blocks of interleaved float samples at full scale: PortAudio's callback."""
    e = record(entry, ENTRY_T, 0)
    if status & LOST:
        e.lost = OVERRUN
    return ABORT if carry(entry, sensed, drive, frames, F4, True) < 0 else CONTINUE


@step
def advance_simulated(entry, signals, first, n):
    """Advance in the closed loop of a simulated device, whose own finger is used where `sensed_position` is not 0."""
    e, s = record(entry, ENTRY_T, 0), record(signals, SIGNALS_T, 0)
    flags = carray(pointer(s.flags, I8), first + n)
    for m in range(first, first + n):
        e.lost |= flags[m]
    e.sensed_position, e.taken = s.position if e.sensed_position != 0 else 0, first
    sensed, drive = s.sensed + 8 * first * e.sensors, s.drive + 8 * first * e.channels
    return carry(entry, sensed, drive, n, F8, False)


PLAIN = CFunction(_plain, types.int32(I8, I8, types.uint64, I8))
AUDIO = CFunction(_audio, CALLBACK)
