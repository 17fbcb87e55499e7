"""The finger as the band bank knows it: its motion, its touch, and what stands for its mechanics."""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import any_of, high, low, select, size
from hapticrender.compiled.lanes_memory import lanes, read, write
from hapticrender.control.bank import rows as row
from hapticrender.control.kernels import FAR, FASTEST, TURN

TRACKER_POLE = TURN * 60.0  # rad/s: triple pole of the finger's tracker; no lag under constant acceleration
FRESH_TIME = 0.03  # s: for so long after a touch a friction is told from its step
SLOWEST = 0.1  # of the typical speed: a slower contact hardly modulates at all
LEAST_LOAD = 0.03  # N: a place is not told by less


@kernel
def track_finger(track, rate, position):
    """Velocity and acceleration of the finger by a tracker with a triple pole; a new touch starts it at rest."""
    period = 1.0 / rate
    pole = TRACKER_POLE * period
    seen, held = read(track, row.SEEN), read(track, row.HELD)
    leapt = (seen > 0.0) & (size(position - held) * rate > FASTEST)
    here = select(leapt, 0.0, select(size(position) <= FAR, 1.0, 0.0))
    present = here > 0.0  # else lifted, or put down elsewhere
    position = select(present, position, held)
    smooth, velocity, acceleration = read(track, row.SMOOTH), read(track, row.VELOCITY), read(track, row.ACCELERATION)
    predicted = select(seen > 0.0, smooth, position) + period * velocity
    innovation = position - predicted
    write(select(present, predicted + 3.0 * pole * innovation, smooth), track, row.SMOOTH)
    faster = velocity + period * acceleration + 3.0 * pole * TRACKER_POLE * innovation
    write(select(present, faster, 0.0), track, row.VELOCITY)
    steeper = acceleration + pole * TRACKER_POLE * TRACKER_POLE * innovation
    write(select(present, steeper, 0.0), track, row.ACCELERATION)
    write(position, track, row.HELD)
    write(here, track, row.SEEN)
    moved = select(present & (seen > 0.0), size(position - held) * rate, 0.0)
    speed = read(track, row.SPEED)
    write(select(leapt, 0.0, speed + pole * (moved - speed)), track, row.SPEED)
    came = present & ((seen <= 0.0) | leapt)
    write(select(came, FRESH_TIME * rate, high(read(track, row.FRESH) - 1.0, 0.0)), track, row.FRESH)


@kernel
def feel(numbers, coordinates, stiffness, level, touch, turn):
    """Load and place of the finger from the sag (the DC band); true where contact has just begun or ended.

    The place is looked at in its turn, and where contact has changed.
    """
    load = moment = 0.0 * read(level, 0, 0)
    for c in range(coordinates):
        load -= read(stiffness, 0, c) * read(level, 0, c)
        if coordinates > 1:
            moment -= read(stiffness, 1, c) * read(level, 0, c)
    was, place = read(touch, row.CONTACT), read(touch, row.PLACE)
    on = select(load > select(was > 0.0, numbers.contact_off, numbers.contact_on), 1.0, 0.0)
    write(load, touch, row.LOAD)
    write(on, touch, row.CONTACT)
    changed = size(on - was) > 0.5
    if turn or any_of(changed):
        due = on > (0.0 if turn else was)
        write(select(due, low(high(moment / high(load, LEAST_LOAD), -2.0), 2.0), place), touch, row.PLACE)
    return changed


@kernel
def finger_stiffness(touch, band, t):
    """Dynamic stiffness z (N/m) of the finger at a tile's bands: its three numbers and what is left over."""
    omega = lanes(band, t, row.OMEGA)
    re = read(touch, row.STIFFNESS) - omega * omega * read(touch, row.MASS) + lanes(band, t, row.REST_RE)
    return re, omega * read(touch, row.DAMPING) + lanes(band, t, row.REST_IM)
