"""Slow, obvious twin of the default controller, sample by sample, from the equations of docs/theory.md.

It imports nothing under test: `p` is a mapping of the design's numbers (gains, times, bounds, matrices), `setpoints`
has the rows frequency (Hz), wavenumber (1/m), phase (turns), target (re, im), sensor response (re, im).  Envelopes are
complex arrays of shape (coordinates, bands).
"""

import numpy as np

SATURATED, NONFINITE, SENSOR_CLIPPED = 1, 2, 4
TURN, TRACKER = 2 * np.pi, 2 * np.pi * 60.0  # rad/s: triple pole of the finger's tracker
FAR, FASTEST, FRESH, FADE_OUT, LEAK = 1e3, 10.0, 0.03, 0.02, 50.0  # m, m/s, s, s, 1/s
STEP = 8  # samples of a step of adaptation


def smooth(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = np.clip(x, 0.0, 1.0)
    return 3 * x**2 - 2 * x**3


def between(low, high, share):
    return low + share * (high - low)


class NaiveError:
    """Takes one sample a call; everything it remembers is an attribute."""

    def __init__(self, p, setpoints):
        self.p, n = p, p["coordinates"]
        self.frequency, self.wavenumber, self.phase = setpoints[:3]
        self.set, self.shown = setpoints[3] + 1j * setpoints[4], setpoints[5] + 1j * setpoints[6]
        self.K, self.T = len(self.frequency), 1 / p["rate"]
        self.M, self.C, self.S = (p[name][:n, :n] for name in ("mass", "damping", "stiffness"))
        self.shape, self.taps = p["pattern"][:n, None], p["taps"][:n, : p["n_taps"]]
        self.from_sensor = p["coordinate_from_sensor"][:n, : p["sensors"]]
        self.to_drive = p["drive_from_force"][: p["channels"], :n]
        self.locked = bool((self.wavenumber > 0).any() or p["needs_contact"])
        zero = np.zeros((n, self.K), complex)
        self.E, self.v, self.fast, self.slow, self.acted, self.apart = (zero.copy() for _ in range(6))
        self.turns, self.fade, self.complete = np.zeros(self.K), np.zeros(self.K), np.zeros(self.K)
        self.raw, self.target, self.R, self.rest, self.force_then, self.R_then = (zero[0].copy() for _ in range(6))
        self.w_then = np.zeros(self.K)
        self.l, self.r, self.past = np.zeros(n), np.zeros(n), np.zeros((n, self.taps.shape[1]))
        self.x = self.smooth_x = self.velocity = self.acceleration = self.speed = self.smooth_speed = self.fresh = 0.0
        self.seen = self.contact = False
        self.lever = self.m = self.b = self.k = self.peak = 0.0
        self.timer, self.open = [0.0, 0.0], [0.0, 0.0]  # of the fast and the slow detector
        self.scale = self.confidence = 1.0
        self.samples, self.commands, self.known_lever = 0, {}, np.array([1.0, 0.0])[:n]

    def step(self, sensed, position, waveform):
        """Drive (channels,), target (bands,) and flags of one sample."""
        p, T = self.p, self.T
        good = np.abs(sensed) < p["sensor_limit"]
        y = self.from_sensor @ np.where(good, sensed, 0.0)
        sane = abs(waveform) <= FAR or not (p["reads_waveform"] or p["modulated"])
        flags = NONFINITE if not good.all() or abs(position) > FAR or not sane else 0
        flags |= SENSOR_CLIPPED if (np.isfinite(sensed) & ~good).any() else 0
        if self.locked:
            self.track(position)
        carrier = self.carriers()
        self.samples += 1
        quick = p["needs_contact"] and (not self.seen or self.fresh > 0)
        idle = quick or (p["needs_contact"] and self.speed < p["least_speed"])
        crowded_gain = min(abs(self.velocity) / p["crowd_speed"], 1.0) if p["crowd_speed"] > 0 else 1.0
        g = 0.0 if idle else crowded_gain * between(p["observer"], p["observer_high"], self.open[0])
        self.references(carrier, waveform if sane else 0.0, crowded_gain)
        turn = self.samples % STEP == 0
        self.detect_contact(turn)
        inner = between(p["damper"], p["damper_high"], self.open[0]) if self.scale == 1 else 0.0
        ki = between(p["integral"], p["integral_medium"], self.open[1])
        ki = 0.0 if idle else between(ki, p["integral_high"], self.open[0])

        predicted = self.l + ((self.shape * self.R + self.E) * carrier).real.sum(axis=1)
        y = y if good.all() else predicted
        deviation = y - self.scale * ((self.shape * self.R + self.v) * carrier).real.sum(axis=1)
        self.past = np.column_stack([deviation, self.past[:, :-1]])
        damping = -inner * (self.taps * self.past).sum(axis=1)
        e = y - predicted  # residual
        self.l = self.l + self.r + (p["dc_fast"] if quick else p["dc"]) * e
        self.r = self.r + (p["dc_drift_fast"] if quick else p["dc_drift"]) * e

        shown = e[:, None] * carrier.conj()
        trips = self.detect(self.E - self.v + 2 * shown)
        fading = LEAK * (1 - self.share)
        self.E = (1 - T * fading) * self.E + g * self.share * shown
        dv = -ki * self.E - fading * self.v
        back = p["back_calculation"] * (1 - self.scale)
        self.v = self.v + T * (dv - back * (self.v + self.shape * self.R))
        dV = dv + self.shape * self.dR
        change = T / FADE_OUT
        self.confidence = min(self.confidence + change, 1.0) if good.all() else max(self.confidence - change, 0.0)
        if self.confidence == 0:
            for state in (self.E, self.v, dV, self.fast, self.slow, self.l, self.r, self.past):
                state[:] = 0
        adapts = self.contact and p["adaptation"] >= 0
        if adapts and turn:
            self.adapt(g, inner)
        F = self.law(dV, adapts)
        for i, name in enumerate(("fast", "slow")):
            if trips[i]:
                self.timer[i] = p[f"{name}_time"]
            self.open[i] = 1.0 if self.timer[i] > 0 else max(self.open[i] - p["release"], 0.0)
            self.timer[i] -= 1
        drive = self.limited((F * carrier).sum(axis=1) + damping)
        return drive, self.target, flags | (SATURATED if self.scale < 1 else 0)

    def track(self, position):
        """Finger's position, velocity and acceleration: three equal poles; and its speed behind one."""
        T, a = self.T, TRACKER
        jumped = self.seen and abs(position - self.x) > FASTEST * T
        if jumped or not abs(position) <= FAR:
            self.seen, self.acceleration = False, 0.0
            self.speed, self.fresh = 0.0 if jumped else (1 - a * T) * self.speed, max(self.fresh - 1, 0)
            self.smooth_speed = 0.0 if jumped else self.smooth_speed + a * T * (self.speed - self.smooth_speed)
            return
        moved = abs(position - self.x) / T if self.seen else 0.0
        self.velocity = self.velocity if self.seen else 0.0
        predicted = (self.smooth_x if self.seen else position) + T * self.velocity
        error = position - predicted
        self.smooth_x = predicted + 3 * a * T * error
        self.velocity += T * self.acceleration + 3 * a**2 * T * error
        self.acceleration += a**3 * T * error
        self.speed += a * T * (moved - self.speed)
        self.smooth_speed += a * T * (self.speed - self.smooth_speed)
        self.fresh = max(self.fresh - 1, 0) if self.seen else FRESH / T
        self.x, self.seen = position, True

    def carriers(self):
        """Frequency, sweep, fade, weight and share of every band; returns e^(j phi)."""
        p = self.p
        self.w = TURN * (self.frequency + self.wavenumber * self.velocity)
        self.sweep = TURN * self.wavenumber * self.acceleration
        carrier = np.exp(1j * TURN * ((self.turns + self.wavenumber * self.x + self.phase) % 1.0))
        self.turns = (self.turns + self.frequency * self.T) % 1.0
        slides = self.seen and (not p["needs_contact"] or self.speed >= p["least_speed"])
        rises = slides | ((self.wavenumber == 0) & (not p["needs_contact"]))
        self.fade = np.clip(self.fade + np.where(rises, 1, -1) * p["fade_in"], 0.0, 1.0)
        f, edge, follows = abs(self.w) / TURN, p["highest_edge"], self.wavenumber > 0
        grown = smooth(self.fade)
        if p["lowest"] > 0:
            grown = grown * np.where(follows, smooth(2 * f / p["lowest"] - 1), 1.0)
        self.weight = grown * np.where(follows, smooth((edge - f / p["highest"]) / (edge - 1)), 1.0)
        heard = np.where(follows, smooth(4 * (edge - f / p["highest"])), 1.0)
        self.share = np.minimum(grown * heard / np.maximum(self.fade, 1e-9), 1.0)
        if p["corrected"] and self.locked:
            lag = p["contact_length"] / max(2 * self.speed - self.smooth_speed, 0.1 * p["typical_speed"])
            self.shown = np.exp(-1j * p["sensor_delay"] * self.w) * (1 + 1j * lag * self.w)
        return carrier

    def references(self, carrier, waveform, crowded_gain):
        """Target, reference R and its slope."""
        p, before = self.p, self.R
        turn = 1j * self.w if p["differentiated"] else 1.0
        if p["reads_waveform"]:
            e = waveform - (self.raw * carrier).real.sum()
            self.raw = self.raw + crowded_gain * p["waveform_gain"] * e * carrier.conj()
            follow = min(crowded_gain * p["waveform_gain"] / 2, 1.0)
            self.target = self.target + follow * (self.weight * turn * self.raw - self.target)
        else:
            self.target = turn * self.weight * self.set * (waveform if p["modulated"] else 1.0)
        self.R = self.shown * self.target
        self.dR = (self.R - before) / self.T

    def detect_contact(self, turn):
        """Load and lever arm from the sag, W [1, g] = -K l; a change opens the loop and resets the finger."""
        p, carried = self.p, -self.S @ self.l
        before = self.contact
        self.contact = bool(carried[0] > (p["contact_off"] if before else p["contact_on"]))
        if self.contact and (turn or not before):
            self.lever = np.clip(carried[1] / max(carried[0], 0.03), -2.0, 2.0) if len(carried) > 1 else 0.0
        if self.contact != before:
            self.timer[0], self.open[0] = p["fast_time"], 1.0
            self.m = self.b = self.k = 0.0
            self.rest, self.force_then, self.R_then = 0 * self.rest, 0 * self.R, self.R
            self.w_then, self.complete = self.w, np.ones(self.K)
            self.acted = self.shape * self.R + self.v
            self.apart, self.commands, self.first = self.E - self.v, {}, self.acted

    def detect(self, deviation):
        """Whether the deviation behind the fast and the slow pole exceeds its level in any band."""
        p = self.p
        if not p["detects"]:
            return False, False
        self.fast = self.fast + p["fast_smoothing"] * (deviation - self.fast)
        self.slow = self.slow + p["slow_smoothing"] * (deviation - self.slow)
        return (abs(self.fast) ** 2 > p["fast_threshold"]).any(), (abs(self.slow) ** 2 > p["slow_threshold"]).any()

    def finger(self):
        """Finger estimate z(j w) of every band, and its slope."""
        return self.k - self.w**2 * self.m + 1j * self.w * self.b + self.rest, self.b + 2j * self.w * self.m

    def lag_damping(self):
        p = self.p
        return p["contact_damping"] * (1 / max(self.speed, 0.1 * p["typical_speed"]) - 1 / p["typical_speed"])

    def law(self, dV, adapts):
        """F = rho (D V + D' dV/dt + j dw/dt M V), finger included, band by band."""
        p, V, w, sweep = self.p, self.shape * self.R + self.v, self.w, self.sweep
        h = self.known_lever = np.array([1.0, self.lever])[: len(V)]
        (z, slope), both = self.finger(), np.outer(h, h)[:, :, None]  # shape (coordinates, coordinates, bands)
        M, S = self.M[:, :, None], self.S[:, :, None]
        C = self.C[:, :, None] + self.lag_damping() * both
        D, D1 = S - w**2 * M + 1j * w * C + 1j * sweep * M, C + 2j * w * M
        if adapts:
            D, D1 = D + (z + 1j * sweep * self.m) * both, D1 + slope * both
        rho = np.exp(1j * p["lead"] * (w + p["lead"] * sweep / 2)) / np.sinc(w * self.T / TURN)
        return rho * (D * V + D1 * dV).sum(axis=1)

    def adapt(self, g, inner):
        """Finger's mass, damping and stiffness from z h X = <z h V> - D_a a - (D' + z' h) da/dt - j dw/dt M a."""
        p, step = self.p, STEP * self.T
        V = self.shape * self.R + self.v
        self.commands[self.samples // STEP] = np.vstack([V, self.finger()[0] * (self.known_lever @ V)])
        pole = max(g / 2, 1e-4)  # of the observer, a sample; its mean age within a step of samples (steps):
        kept = (1 - pole) ** np.arange(STEP)
        middle, settled = kept @ np.arange(STEP) / kept.sum() / STEP, 1 - (1 - pole) ** STEP
        back = int(p["age"] + 0.5)
        start = np.vstack([self.first, 0 * self.R])  # before contact: as at contact
        new, old = (self.commands.get(self.samples // STEP - back - i, start) for i in (0, 1))
        then = between(new, old, p["age"] + middle - back)
        self.acted = between(self.acted, then[:-1], settled)
        self.force_then = between(self.force_then, then[-1], settled)
        self.R_then = between(self.R_then, self.R - middle * step * self.dR, settled)
        whole, w = (self.fade >= 1) & (self.share >= 1), self.w - middle * step * self.sweep
        self.w_then = np.where(whole, between(self.w_then, w, settled), w)
        self.complete = np.where(whole, between(self.complete, 1.0, settled), 0.0)

        h, X, lively = np.array([1.0, self.lever])[: len(V)], self.shape * self.R_then + self.E, max(self.open)
        a, before = X - self.acted, self.apart
        self.apart, motion, sums, total = a, h @ X, np.zeros(3), 0.0
        rest = step * between(p["rest"], p["rest_high"], lively)
        for k, w in enumerate(self.w_then):
            if abs(motion[k]) < p["least_motion"] or self.complete[k] < 0.9:
                continue
            C0 = self.C[0] + h * self.lag_damping()
            D = self.S[0] - w**2 * self.M[0] + 1j * w * C0 + 1j * self.sweep[k] * (self.M[0] + h * self.m)
            D[0] += 1j * w * inner * p["added_damping"][0]
            slope = C0 + h * self.b + 2j * w * (self.M[0] + h * self.m)
            z = (self.force_then[k] - D @ a[:, k] - slope @ (a[:, k] - before[:, k]) / step) / motion[k]
            miss = z - (self.k - w**2 * self.m + 1j * w * self.b)
            free = abs(self.S[0, 0] - w**2 * self.M[0, 0] + 1j * w * self.C[0, 0])
            weight, k2, m2 = abs(motion[k] / free) ** 2, p["typical_stiffness"] ** 2, p["typical_mass"] ** 2 * w**2
            sums += weight * np.array([k2 * miss.real, -m2 * miss.real, 0]) / (k2 + m2 * w**2)
            sums[2] += weight * miss.imag / w
            total += weight
            self.rest[k] += rest * (miss - self.rest[k])
        if total > 0:
            found = np.array([self.k, self.m, self.b])
            found += step * between(p["adaptation"], p["adaptation_high"], lively) * sums / total
            names = ("stiffness", "mass", "damping")
            bounds = np.transpose([p[f"{name}_range"] for name in names])
            self.k, self.m, self.b = np.clip(found, *bounds)

    def limited(self, force):
        """Scale the envelope of the analytic drive into the limit."""
        p, drive = self.p, self.confidence * (self.to_drive @ force)
        self.peak = max(abs(drive).max() / p["drive_limit"], p["peak_decay"] * self.peak)
        self.scale = min(1.0, 1 / self.peak) if self.peak > 0 else 1.0
        return np.clip(self.scale * drive.real, -p["drive_limit"], p["drive_limit"])
