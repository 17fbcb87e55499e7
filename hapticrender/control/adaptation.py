"""Compiled adaptation of the default controller: contact, and the finger's mass, damping and stiffness.

What the observer shows answers a drive that was commanded a delay ago, and shows the motion behind its pole.  The
heave row of the force balance holds as well for envelopes that are all delayed and filtered alike, <.>.  With z the
finger's dynamic stiffness, h = [1, g] its lever arm, y = h V, a = X - V what the command did not do, and
D_a = D + j w b_a with the damping b_a of the inner loop,

    z_found h X = <z_sent y> - D_a a - (D' + z' h) da/dt - j dw/dt (M + m_f h) a

so that the estimate in use when the command was given is kept apart from the present one: neither delay nor observer
closes a loop through the adaptation.  The motion X is <R> + E.  A step of adaptation is a block, or
8 samples.
"""

from __future__ import annotations

from hapticrender.control.laws import contact_damping
from hapticrender.control.records import COMMAND_T, CONTROLLER_T, TILE_T
from hapticrender.jit import kernel, record
from hapticrender.vectors import conj, get, imag, maximum, pair, put, real, square, total, where, zeros

ADAPTATION_SAMPLES = 8  # samples of a step of adaptation, sample by sample
COMPLETE = 0.9  # of a carrier's own history, from which on its band counts
LEAST_LOAD = 0.03  # N: a smaller load tells no place


@kernel
def detect_contact(controller, adapt_now):
    """Load and lever arm of the finger from the DC estimate; True where contact has just begun or ended."""
    c = record(controller, CONTROLLER_T, 0)
    k = c.p.stiffness
    load = -(k[0, 0] * c.dc[0] + k[0, 1] * c.dc[1])
    moment = -(k[1, 0] * c.dc[0] + k[1, 1] * c.dc[1])
    on = 1.0 if load > (c.p.contact_off if c.contact > 0.0 else c.p.contact_on) else 0.0
    changed = on != c.contact
    c.load, c.contact = load, on
    if on > 0.0 and (adapt_now or changed):
        c.lever = min(max(moment / max(load, LEAST_LOAD), -2.0), 2.0)
    return changed


@kernel
def adaptation_step(controller):
    """Number of the step of adaptation."""
    c = record(controller, CONTROLLER_T, 0)
    return c.sample // (1 if c.p.block > 1 else ADAPTATION_SAMPLES)


@kernel
def reset_finger(controller):
    """Reset the finger estimate and the command history: contact has begun or ended."""
    c = record(controller, CONTROLLER_T, 0)
    c.finger_mass = c.finger_damping = c.finger_stiffness = 0.0
    shape0, shape1 = c.p.shape[0], c.p.shape[1]
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        reference, v0, v1 = get(b, "r"), get(b, "v0"), get(b, "v1")
        command0, command1 = v0 + shape0 * reference, v1 + shape1 * reference
        put(b, "remainder", 0.0)
        put(b, "finger_force", 0.0)
        put(b, "filtered_r", reference)
        put(b, "filtered_omega", get(b, "omega"))
        put(b, "complete", 1.0)
        put(b, "last0", get(b, "e0") - v0)
        put(b, "last1", get(b, "e1") - v1)
        put(b, "filtered0", command0)
        put(b, "filtered1", command1)
        for h in range(c.history):
            s = record(c.commands_at, COMMAND_T, h * c.tiles + t)
            put(s, "command0", command0)
            put(s, "command1", command1)
            put(s, "force", 0.0)


@kernel
def note_commands(controller):
    """Note what is commanded in this step, and the finger's part of the force."""
    c = record(controller, CONTROLLER_T, 0)
    mass, damping, spring, lever = c.finger_mass, c.finger_damping, c.finger_stiffness, c.law_lever
    shape0, shape1, first = c.p.shape[0], c.p.shape[1], adaptation_step(controller) % c.history * c.tiles
    for t in range(c.tiles):
        b, s = record(c.tiles_at, TILE_T, t), record(c.commands_at, COMMAND_T, first + t)
        w, reference = get(b, "omega"), get(b, "r")
        command0, command1 = get(b, "v0") + shape0 * reference, get(b, "v1") + shape1 * reference
        impedance = pair(spring - w * w * mass, w * damping) + get(b, "remainder")
        put(s, "command0", command0)
        put(s, "command1", command1)
        put(s, "force", impedance * (command0 + lever * command1))


@kernel
def interpolated(a, b, share):
    """Value between a and b, `share` of b."""
    return a + share * (b - a)


@kernel
def taken_force(spring, damping, drag, skin, mass, w, sweep, motion, slope):
    """Force that a motion beyond the commanded one takes in the heave row: D_a a + (D' + z' h) da/dt + j dw/dt m a."""
    return pair(spring - w * w * mass, w * damping + sweep * skin) * motion + pair(drag, 2.0 * skin * w) * slope


@kernel
def pool(controller, b, residual, motion, rest):
    """Parts of a tile in stiffness, mass and damping, and weights |h X|^2/|D|^2; a band keeps what is left."""
    c = record(controller, CONTROLLER_T, 0)
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
def adapt_finger(controller, observer, damper):
    """Take a step of adaptation: the finger's three numbers from the residual force of every band.

    Commands, the finger's force, reference and frequency are delayed and filtered alike, as the observer filters
    motion; the residual is pooled with weights |h X|^2/|D|^2, and a band keeps what is left.
    """
    c = record(controller, CONTROLLER_T, 0)
    p, lag, g = c.p, contact_damping(controller), c.lever
    samples, number = max(p.block, ADAPTATION_SAMPLES), adaptation_step(controller)
    rate, high = p.rate / samples, max(c.fast_open, c.slow_open)
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
    newer, older = (number - back) % c.history * c.tiles, (number - back - 1) % c.history * c.tiles
    mass, damping, spring = c.finger_mass, c.finger_damping, c.finger_stiffness
    k0, k1, m0, m1 = p.stiffness[0, 0], p.stiffness[0, 1], p.mass[0, 0], p.mass[0, 1]
    b0, b1 = p.damping[0, 0] + lag, p.damping[0, 1] + g * lag
    drag0, drag1, skin0, skin1 = b0 + damping, b1 + g * damping, m0 + mass, m1 + g * mass
    b0 += damper * p.added_damping[0]
    sum_k, sum_m, sum_b, weights = zeros(), zeros(), zeros(), zeros()
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        new, old = record(c.commands_at, COMMAND_T, newer + t), record(c.commands_at, COMMAND_T, older + t)
        command0 = interpolated(
            get(b, "filtered0"), interpolated(get(new, "command0"), get(old, "command0"), share), pole
        )
        command1 = interpolated(
            get(b, "filtered1"), interpolated(get(new, "command1"), get(old, "command1"), share), pole
        )
        force = interpolated(get(b, "finger_force"), interpolated(get(new, "force"), get(old, "force"), share), pole)
        reference = interpolated(get(b, "filtered_r"), get(b, "r") - behind * get(b, "slope"), pole)
        sweep = get(b, "sweep")
        w, complete = get(b, "omega") - behind * sweep, get(b, "complete")
        whole = where(get(b, "fade") >= 1.0, get(b, "feedback"), 0.0) >= 1.0
        w = where(whole, interpolated(get(b, "filtered_omega"), w, pole), w)
        complete = where(whole, complete + pole * (1.0 - complete), 0.0)
        x0, x1 = get(b, "e0") + p.shape[0] * reference, get(b, "e1") + p.shape[1] * reference
        motion, a0, a1 = x0 + g * x1, x0 - command0, x1 - command1
        slope0, slope1 = rate * (a0 - get(b, "last0")), rate * (a1 - get(b, "last1"))
        residual = force - taken_force(k0, b0, drag0, skin0, m0, w, sweep, a0, slope0)
        residual = residual - taken_force(k1, b1, drag1, skin1, m1, w, sweep, a1, slope1)
        put(b, "filtered0", command0)
        put(b, "filtered1", command1)
        put(b, "finger_force", force)
        put(b, "filtered_r", reference)
        put(b, "filtered_omega", w)
        put(b, "complete", complete)
        put(b, "last0", a0)
        put(b, "last1", a1)
        part_k, part_m, part_b, weight = pool(controller, b, residual, motion, rest)
        sum_k, sum_m, sum_b, weights = sum_k + part_k, sum_m + part_m, sum_b + part_b, weights + weight
    weight = total(weights)
    step = gain / rate / (weight if weight > 0.0 else 1.0)
    c.finger_stiffness = min(max(spring + step * total(sum_k), p.least_stiffness), p.most_stiffness)
    c.finger_mass = min(max(mass - step * total(sum_m), p.least_mass), p.most_mass)
    c.finger_damping = min(max(damping + step * total(sum_b), p.least_damping), p.most_damping)
