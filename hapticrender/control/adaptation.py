"""Compiled adaptation of the default controller: contact, and the finger's mass, damping and stiffness.

What the observer shows answers a drive that was commanded a delay ago, and shows the motion behind its pole.  The
heave row of the force balance holds as well for envelopes that are all delayed and filtered alike, <.>.  With z the
finger's dynamic stiffness, h = [1, g] its lever arm, y = h V, a = X - V what the command did not do, and
D_a = D + j w b_a with the damping b_a of the inner loop,

    z_found h X = <z_sent y> - D_a a - (D' + z' h) da/dt - j dw/dt (M + m_f h) a

so that the estimate in use when the command was given is kept apart from the present one: neither delay nor observer
closes a loop through the adaptation.  The motion X is <R> + E.  A step of adaptation is a block, or `TURN_SAMPLES`.
"""

from __future__ import annotations

from hapticrender.control.laws import contact_damping
from hapticrender.control.records import COMMAND_T, CONTROLLER_T, TILE_T, W
from hapticrender.jit import kernel, record

TURN_SAMPLES = 8  # samples of a step of adaptation, sample by sample
COMPLETE = 0.9  # of a carrier's own history, from which on its band counts
LEAST_LOAD = 0.03  # N: a smaller load tells no place


@kernel
def detect_contact(controller, turn):
    """Load and lever arm of the finger from the DC estimate; True where contact has just begun or ended."""
    c = record(controller, CONTROLLER_T, 0)
    k = c.p.stiffness
    load = -(k[0, 0] * c.dc[0] + k[0, 1] * c.dc[1])
    moment = -(k[1, 0] * c.dc[0] + k[1, 1] * c.dc[1])
    on = 1.0 if load > (c.p.contact_off if c.contact > 0.0 else c.p.contact_on) else 0.0
    changed = on != c.contact
    c.load, c.contact = load, on
    if on > 0.0 and (turn or changed):
        c.lever = min(max(moment / max(load, LEAST_LOAD), -2.0), 2.0)
    return changed


@kernel
def adaptation_step(controller):
    """Number of the step of adaptation."""
    c = record(controller, CONTROLLER_T, 0)
    return c.sample // (1 if c.p.block > 1 else TURN_SAMPLES)


@kernel
def reset_finger(controller):
    """Reset the finger estimate and the command history: contact has begun or ended."""
    c = record(controller, CONTROLLER_T, 0)
    c.finger_mass = c.finger_damping = c.finger_stiffness = 0.0
    shape0, shape1 = c.p.shape[0], c.p.shape[1]
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            re, im = b.r_re[k], b.r_im[k]
            b.remainder_re[k] = b.remainder_im[k] = b.finger_force_re[k] = b.finger_force_im[k] = b.command_force_re[
                k
            ] = b.command_force_im[k] = 0.0
            b.filtered_r_re[k], b.filtered_r_im[k], b.filtered_omega[k], b.complete[k] = re, im, b.omega[k], 1.0
            b.last0_re[k], b.last0_im[k] = b.e0_re[k] - b.v0_re[k], b.e0_im[k] - b.v0_im[k]
            b.last1_re[k], b.last1_im[k] = b.e1_re[k] - b.v1_re[k], b.e1_im[k] - b.v1_im[k]
            b.command0_re[k], b.command0_im[k] = b.v0_re[k] + shape0 * re, b.v0_im[k] + shape0 * im
            b.command1_re[k], b.command1_im[k] = b.v1_re[k] + shape1 * re, b.v1_im[k] + shape1 * im
            b.filtered0_re[k], b.filtered0_im[k] = b.command0_re[k], b.command0_im[k]
            b.filtered1_re[k], b.filtered1_im[k] = b.command1_re[k], b.command1_im[k]
        for h in range(c.history):
            store_commands(controller, t, h)


@kernel
def store_commands(controller, t, h):
    """Copy the commands of a tile into the history."""
    c = record(controller, CONTROLLER_T, 0)
    b, s = record(c.tiles_at, TILE_T, t), record(c.commands_at, COMMAND_T, h * c.tiles + t)
    for k in range(W):
        s.command0_re[k], s.command0_im[k], s.command1_re[k], s.command1_im[k] = (
            b.command0_re[k],
            b.command0_im[k],
            b.command1_re[k],
            b.command1_im[k],
        )
        s.command_force_re[k], s.command_force_im[k] = b.command_force_re[k], b.command_force_im[k]


@kernel
def note_commands(controller):
    """Note what is commanded in this step, and the finger's part of the force."""
    c = record(controller, CONTROLLER_T, 0)
    mass, damping, stiffness, lever = c.finger_mass, c.finger_damping, c.finger_stiffness, c.known_lever
    shape0, shape1, step = c.p.shape[0], c.p.shape[1], adaptation_step(controller) % c.history
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            w, re, im = b.omega[k], b.v0_re[k] + shape0 * b.r_re[k], b.v0_im[k] + shape0 * b.r_im[k]
            b.command0_re[k], b.command0_im[k] = re, im
            b.command1_re[k], b.command1_im[k] = b.v1_re[k] + shape1 * b.r_re[k], b.v1_im[k] + shape1 * b.r_im[k]
            re, im = re + lever * b.command1_re[k], im + lever * b.command1_im[k]
            z_re, z_im = stiffness - w * w * mass + b.remainder_re[k], w * damping + b.remainder_im[k]
            b.command_force_re[k], b.command_force_im[k] = z_re * re - z_im * im, z_re * im + z_im * re
        store_commands(controller, t, step)


@kernel
def recall_commands(controller, t, newer, older, share):
    """Recall the commands of a tile between two steps of the history, `share` of the older one."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    new, old = record(c.commands_at, COMMAND_T, newer + t), record(c.commands_at, COMMAND_T, older + t)
    for k in range(W):
        b.command0_re[k] = new.command0_re[k] + share * (old.command0_re[k] - new.command0_re[k])
        b.command0_im[k] = new.command0_im[k] + share * (old.command0_im[k] - new.command0_im[k])
        b.command1_re[k] = new.command1_re[k] + share * (old.command1_re[k] - new.command1_re[k])
        b.command1_im[k] = new.command1_im[k] + share * (old.command1_im[k] - new.command1_im[k])
        b.command_force_re[k] = new.command_force_re[k] + share * (old.command_force_re[k] - new.command_force_re[k])
        b.command_force_im[k] = new.command_force_im[k] + share * (old.command_force_im[k] - new.command_force_im[k])


@kernel
def filter_commands(controller, t, pole, middle):
    """Filter commands, the finger's force, reference and frequency of a tile alike, as the observer filters motion."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    behind = middle * max(c.p.block, TURN_SAMPLES) / c.p.rate
    for k in range(W):
        b.filtered0_re[k] += pole * (b.command0_re[k] - b.filtered0_re[k])
        b.filtered0_im[k] += pole * (b.command0_im[k] - b.filtered0_im[k])
        b.filtered1_re[k] += pole * (b.command1_re[k] - b.filtered1_re[k])
        b.filtered1_im[k] += pole * (b.command1_im[k] - b.filtered1_im[k])
        b.finger_force_re[k] += pole * (b.command_force_re[k] - b.finger_force_re[k])
        b.finger_force_im[k] += pole * (b.command_force_im[k] - b.finger_force_im[k])
        b.filtered_r_re[k] += pole * (b.r_re[k] - behind * b.slope_re[k] - b.filtered_r_re[k])
        b.filtered_r_im[k] += pole * (b.r_im[k] - behind * b.slope_im[k] - b.filtered_r_im[k])
        w = b.omega[k] - behind * b.sweep[k]
        whole = b.fade[k] >= 1.0 and b.feedback[k] >= 1.0
        b.filtered_omega[k] = b.filtered_omega[k] + pole * (w - b.filtered_omega[k]) if whole else w
        b.complete[k] = b.complete[k] + pole * (1.0 - b.complete[k]) if whole else 0.0


@kernel
def taken_force(stiffness, damping, drag, skin, mass, w, sweep, motion, slope):
    """Force that a motion beyond the commanded one takes in the heave row: D_a a + (D' + z' h) da/dt + j dw/dt m a."""
    (ar, ai), (sr, si) = motion, slope
    re, im, turn = stiffness - w * w * mass, w * damping + sweep * skin, 2.0 * w * skin
    return re * ar - im * ai + drag * sr - turn * si, re * ai + im * ar + drag * si + turn * sr


@kernel
def add_residual(controller, t, rate, damper):
    """Motion at the finger, and the force that the finger takes, of a tile."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    p, lag, g = c.p, contact_damping(controller), c.lever
    shape0, shape1, k0, k1 = p.shape[0], p.shape[1], p.stiffness[0, 0], p.stiffness[0, 1]
    m0, m1 = p.mass[0, 0], p.mass[0, 1]
    b0, b1 = p.damping[0, 0] + lag, p.damping[0, 1] + g * lag
    drag0, drag1 = b0 + c.finger_damping, b1 + g * c.finger_damping
    skin0, skin1, b0 = m0 + c.finger_mass, m1 + g * c.finger_mass, b0 + damper * p.added_damping[0]
    for k in range(W):
        w, sweep, re, im = b.filtered_omega[k], b.sweep[k], b.filtered_r_re[k], b.filtered_r_im[k]
        x0r, x0i, x1r, x1i = (
            b.e0_re[k] + shape0 * re,
            b.e0_im[k] + shape0 * im,
            b.e1_re[k] + shape1 * re,
            b.e1_im[k] + shape1 * im,
        )
        b.contact_motion_re[k], b.contact_motion_im[k] = x0r + g * x1r, x0i + g * x1i
        ar, ai = x0r - b.filtered0_re[k], x0i - b.filtered0_im[k]
        slope = rate * (ar - b.last0_re[k]), rate * (ai - b.last0_im[k])
        b.last0_re[k], b.last0_im[k] = ar, ai
        re, im = taken_force(k0, b0, drag0, skin0, m0, w, sweep, (ar, ai), slope)
        ar, ai = x1r - b.filtered1_re[k], x1i - b.filtered1_im[k]
        slope = rate * (ar - b.last1_re[k]), rate * (ai - b.last1_im[k])
        b.last1_re[k], b.last1_im[k] = ar, ai
        more, turn = taken_force(k1, b1, drag1, skin1, m1, w, sweep, (ar, ai), slope)
        b.residual_re[k], b.residual_im[k] = b.finger_force_re[k] - re - more, b.finger_force_im[k] - im - turn


@kernel
def pool(controller, t, rest):
    """Sums of a tile towards stiffness, mass and damping, and of weights |h X|^2/|D|^2; a band keeps what is left."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    p, mass, damping, stiffness = c.p, c.finger_mass, c.finger_damping, c.finger_stiffness
    m, d, s = p.mass[0, 0], p.damping[0, 0], p.stiffness[0, 0]
    stiff2, mass2 = p.typical_stiffness * p.typical_stiffness, p.typical_mass * p.typical_mass
    least2 = p.least_motion * p.least_motion
    sum_k = sum_m = sum_b = weights = 0.0
    for k in range(W):
        w, yr, yi, fr, fi = (
            b.filtered_omega[k],
            b.contact_motion_re[k],
            b.contact_motion_im[k],
            b.residual_re[k],
            b.residual_im[k],
        )
        w2, size2 = w * w, yr * yr + yi * yi
        counts = 1.0 if size2 >= least2 and b.complete[k] >= COMPLETE else 0.0
        share = counts / max(size2, 1e-300)
        miss = share * (fr * yr + fi * yi) - counts * (stiffness - w2 * mass)
        drag = share * (fi * yr - fr * yi) - counts * w * damping
        along = s - w2 * m
        weight = counts * size2 / (along * along + w2 * d * d + 1e-300)
        scale = weight / (stiff2 + w2 * w2 * mass2)
        sum_k += scale * stiff2 * miss
        sum_m += scale * w2 * mass2 * miss
        sum_b += weight * drag * w / max(w2, 1e-18)  # w < 0 where the finger moves backwards
        weights += weight
        b.remainder_re[k] += rest * (miss - counts * b.remainder_re[k])
        b.remainder_im[k] += rest * (drag - counts * b.remainder_im[k])
    return sum_k, sum_m, sum_b, weights


@kernel
def adapt_finger(controller, observer, damper):
    """Take a step of adaptation: the finger's three numbers from the residual force of every band."""
    c = record(controller, CONTROLLER_T, 0)
    p = c.p
    samples, number = max(p.block, TURN_SAMPLES), adaptation_step(controller)
    rate = p.rate / samples
    lively = max(c.fast_open, c.slow_open)
    gain = p.adaptation + lively * (p.adaptation_high - p.adaptation)
    rest = (p.rest + lively * (p.rest_high - p.rest)) / rate
    follow = max(0.5 * observer, 1e-4)
    pole = 1.0 - (1.0 - follow) ** samples
    middle = 0.5 if p.block > 1 else (1.0 / follow - 1.0) / samples - (1.0 / pole - 1.0)
    back = int(p.age + 0.5)
    share = p.age + middle - back
    new, old = (number - back) % c.history * c.tiles, (number - back - 1) % c.history * c.tiles
    sum_k = sum_m = sum_b = weights = 0.0
    for t in range(c.tiles):
        recall_commands(controller, t, new, old, share)
        filter_commands(controller, t, pole, middle)
        add_residual(controller, t, rate, damper)
        stiffness, mass, damping, weight = pool(controller, t, rest)
        sum_k, sum_m, sum_b, weights = sum_k + stiffness, sum_m + mass, sum_b + damping, weights + weight
    step = gain / rate / (weights if weights > 0.0 else 1.0)
    c.finger_stiffness = min(max(c.finger_stiffness + step * sum_k, p.least_stiffness), p.most_stiffness)
    c.finger_mass = min(max(c.finger_mass - step * sum_m, p.least_mass), p.most_mass)
    c.finger_damping = min(max(c.finger_damping + step * sum_b, p.least_damping), p.most_damping)
