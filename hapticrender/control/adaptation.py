"""Compiled adaptation of the law by bands: the finger's mass, damping and stiffness (docs/theory.md, "Adaptation").

The finger's force is what remains of the heave row of the force balance.  Its envelopes are all delayed and filtered as
the observer delays and filters motion, and the estimate in use when a command was given is kept apart from the present
one: neither delay nor observer closes a loop through the adaptation.  A step of adaptation is a block, or 8 samples.
"""

from hapticrender.control.laws import contact_damping
from hapticrender.control.records import COORDINATE_T, PAIR_T, TILE_T, coordinates_of
from hapticrender.jit import kernel, record
from hapticrender.vectors import conj, get, imag, maximum, pair, put, real, square, total, where, zeros

ADAPTATION_SAMPLES = 8  # samples of a step of adaptation, sample by sample
FORCE = 2  # of the commands of a tile: those of both coordinates, and the finger's force
COMPLETE = 0.9  # of a carrier's own history, from which on its band counts


@kernel
def adaptation_step(c):
    """Number of the step of adaptation."""
    return c.sample // (1 if c.p.block > 1 else ADAPTATION_SAMPLES)


@kernel
def reset_finger(c):
    """Reset the finger estimate and the command history: contact has begun or ended."""
    c.finger_mass = c.finger_damping = c.finger_stiffness = 0.0
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        put(b, "remainder", 0.0)
        put(b, "finger_force", 0.0)
        put(b, "filtered_r", get(b, "expected") if c.p.block == 1 else get(b, "r"))
        put(b, "filtered_omega", get(b, "omega"))
        put(b, "complete", 1.0)
        for i in range(c.p.coordinates):
            x = record(coordinates_of(c, t), COORDINATE_T, i)
            command = get(x, "v") + c.p.pattern[i] * get(b, "r")
            put(x, "last", get(x, "e") - get(x, "v"))
            put(x, "filtered", command)
            for h in range(c.history):
                put(record(c.commands_at, PAIR_T, 3 * (h * c.tiles + t) + i), "z", command)
        for h in range(c.history):
            put(record(c.commands_at, PAIR_T, 3 * (h * c.tiles + t) + FORCE), "z", 0.0)


@kernel
def note_commands(c):
    """Note what is commanded in this step, and the finger's part of the force."""
    mass, damping, spring = c.finger_mass, c.finger_damping, c.finger_stiffness
    first = adaptation_step(c) % c.history * c.tiles
    for t in range(c.tiles):
        b, motion = record(c.tiles_at, TILE_T, t), pair(zeros(), zeros())
        for i in range(c.p.coordinates):
            command = get(record(coordinates_of(c, t), COORDINATE_T, i), "v") + c.p.pattern[i] * get(b, "r")
            put(record(c.commands_at, PAIR_T, 3 * (first + t) + i), "z", command)
            motion = motion + (c.law_lever if i > 0 else 1.0) * command
        w = get(b, "omega")
        impedance = pair(spring - w * w * mass, w * damping) + get(b, "remainder")
        put(record(c.commands_at, PAIR_T, 3 * (first + t) + FORCE), "z", impedance * motion)


@kernel
def interpolated(a, b, share):
    """Value between a and b, `share` of b."""
    return a + share * (b - a)


@kernel
def pool(c, b, residual, motion, rest):
    """Parts of a tile in stiffness, mass and damping, and weights |h X|^2/|D|^2; a band keeps what is left."""
    p, w = c.p, get(b, "filtered_omega")
    w2, size2 = w * w, square(motion)
    spring2, mass2 = p.typical_stiffness * p.typical_stiffness, p.typical_mass * p.typical_mass
    counts = where(where(size2 >= p.least_motion * p.least_motion, get(b, "complete"), 0.0) >= COMPLETE, 1.0, 0.0)
    found = counts / maximum(size2, 1e-300) * (residual * conj(motion))
    left = found - counts * pair(c.finger_stiffness - w2 * c.finger_mass, w * c.finger_damping)
    along = p.stiffness[0, 0] - w2 * p.mass[0, 0]
    weight = counts * size2 / (along * along + p.damping[0, 0] * p.damping[0, 0] * w2 + 1e-300)
    scale = real(left) * weight / (spring2 + mass2 * w2 * w2)
    remainder = get(b, "remainder")
    put(b, "remainder", remainder + rest * (left - counts * remainder))
    # w < 0 where the finger moves backwards
    return spring2 * scale, mass2 * w2 * scale, weight * imag(left) * w / maximum(w2, 1e-18), weight


@kernel
def commanded(c, newer, older, share):
    """Command or finger's force between those of two numbers, `share` of the older one."""
    newest, oldest = record(c.commands_at, PAIR_T, newer), record(c.commands_at, PAIR_T, older)
    return interpolated(get(newest, "z"), get(oldest, "z"), share)


@kernel
def adapt_finger(c, observer, damper):
    """Take a step of adaptation: the finger's three numbers from the residual force of every band.

    Commands, the finger's force, reference and frequency are delayed and filtered alike, as the observer filters
    motion; the residual is pooled with weights |h X|^2/|D|^2, and a band keeps what is left.
    """
    p, lag, number = c.p, contact_damping(c), adaptation_step(c)
    samples, high = max(p.block, ADAPTATION_SAMPLES), max(c.fast_open, c.slow_open)
    rate = p.rate / samples
    gain = p.adaptation + high * (p.adaptation_high - p.adaptation)
    rest = (p.rest + high * (p.rest_high - p.rest)) / rate
    follow = max(0.5 * observer, 1e-4)
    kept = 1.0
    for _ in range(samples):
        kept *= 1.0 - follow
    pole = 1.0 - kept
    middle = 0.5 if p.block > 1 else (1.0 / follow - 1.0) / samples - (1.0 / pole - 1.0)
    back, behind = int(p.age + 0.5), middle / rate
    share = p.age + middle - back
    newer, older = 3 * c.tiles * ((number - back) % c.history), 3 * c.tiles * ((number - back - 1) % c.history)
    sum_k, sum_m, sum_b, weights = zeros(), zeros(), zeros(), zeros()
    for t in range(c.tiles):
        b, motion = record(c.tiles_at, TILE_T, t), pair(zeros(), zeros())
        reference = get(b, "expected") if p.block == 1 else get(b, "r")
        reference = interpolated(get(b, "filtered_r"), reference - behind * get(b, "slope"), pole)
        sweep, complete = get(b, "sweep"), get(b, "complete")
        w = get(b, "omega") - behind * sweep
        whole = where(get(b, "fade") >= 1.0, get(b, "feedback"), 0.0) >= 1.0
        w = where(whole, interpolated(get(b, "filtered_omega"), w, pole), w)
        put(b, "complete", where(whole, complete + pole * (1.0 - complete), 0.0))
        put(b, "filtered_r", reference)
        put(b, "filtered_omega", w)
        force = commanded(c, newer + 3 * t + FORCE, older + 3 * t + FORCE, share)
        force = interpolated(get(b, "finger_force"), force, pole)
        put(b, "finger_force", force)
        for i in range(p.coordinates):  # of the heave row: D_a a + (D' + z' h) da/dt + j dw/dt m a
            x, arm = record(coordinates_of(c, t), COORDINATE_T, i), c.lever if i > 0 else 1.0
            command = commanded(c, newer + 3 * t + i, older + 3 * t + i, share)
            command = interpolated(get(x, "filtered"), command, pole)
            moved = get(x, "e") + p.pattern[i] * reference
            a = moved - command
            slope, motion = rate * (a - get(x, "last")), motion + arm * moved
            mass, damping = p.mass[0, i] + arm * c.finger_mass, p.damping[0, i] + arm * lag
            added = damping + (damper * p.added_damping[0] if i == 0 else 0.0)
            along = pair(p.stiffness[0, i] - w * w * p.mass[0, i], w * added + sweep * mass) * a
            force = force - (along + pair(damping + arm * c.finger_damping, 2.0 * mass * w) * slope)
            put(x, "filtered", command)
            put(x, "last", a)
        part_k, part_m, part_b, weight = pool(c, b, force, motion, rest)
        sum_k, sum_m, sum_b, weights = sum_k + part_k, sum_m + part_m, sum_b + part_b, weights + weight
    weight = total(weights)
    step = gain / rate / (weight if weight > 0.0 else 1.0)
    c.finger_stiffness = min(max(c.finger_stiffness + step * total(sum_k), p.stiffness_range[0]), p.stiffness_range[1])
    c.finger_mass = min(max(c.finger_mass - step * total(sum_m), p.mass_range[0]), p.mass_range[1])
    c.finger_damping = min(max(c.finger_damping + step * total(sum_b), p.damping_range[0]), p.damping_range[1])
