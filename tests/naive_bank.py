"""A slow, obvious twin of the band bank's whole step: complex arrays of (coordinates, bands), one line an equation.

Written from FACTS section 3 and reports/damping.md; of the library it is given
only the numbers in its tables and the pole of the finger's tracker.  Equation marks below: O observer, L law,
F finger, D damping, S saturation, as in those pages.
"""

import numpy as np

SATURATED, NONFINITE = 1, 2
LEAST_LOAD = 0.03  # N
FAR, FASTEST, TRUST_TIME = 1e3, 10.0, 0.02  # m, m/s, s
FINGER_M, FINGER_K = 4e-3, 300.0  # kg, N/m
STEP = 8  # samples of learning


def smooth(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3 - 2 * x)


def move(start, end, share):
    return start + share * (end - start)


class NaiveBank:
    """Takes one sample a call; everything it remembers is an attribute."""

    def __init__(self, tables, tracker_pole):
        self.tracker_pole = tracker_pole  # rad/s
        self.p, self.t = tables.numbers, tables
        frequency, wavenumber, phase, real, imaginary = tables.tone
        self.frequency, self.wavenumber, self.phase = frequency, wavenumber, phase
        self.constant = real + 1j * imaginary
        K, C = len(frequency), len(tables.listen)
        self.turns, self.ramp, self.weight = np.zeros(K), np.zeros(K), np.zeros(K)
        self.raw, self.R, self.dR, self.rest, self.seen_R, self.saw_R = (np.zeros(K, complex) for _ in range(6))
        self.E, self.v, self.dv, self.acted, self.apart, self.fast, self.slow = (
            np.zeros((C, K), complex) for _ in range(7)
        )
        self.sent, self.forgotten = [], np.zeros(K)
        self.shown_force, self.shown_R, self.shown_omega = (np.zeros(K, complex) for _ in range(3))
        self.held = self.place_of_finger = self.velocity = self.acceleration = 0.0
        self.seen = False
        self.dc, self.drift = np.zeros(C), np.zeros(C)
        self.eps = np.zeros(tables.taps.shape[::-1])  # newest first
        self.contact, self.g = False, 0.0
        self.m = self.b = self.k = 0.0
        self.timers, self.open = [0.0, 0.0], [0.0, 0.0]  # fast, slow
        self.peak, self.scale, self.trust = 0.0, 1.0, 1.0
        self.round_1, self.round_2 = np.zeros(len(tables.speak)), np.zeros(len(tables.speak))
        self.samples, self.knew_contact, self.known_lever = 0, False, None

    def step(self, sensed, position, wanted):
        """Drive, target and flags of one sample."""
        p, t = self.p, self.t
        T = 1 / p.rate
        flags = 0
        far = abs(position) > FAR
        if not abs(wanted) <= FAR:
            wanted, far = 0.0, True
        self.follow(position)
        carrier = self.carriers()
        calm = min(abs(self.velocity) / p.crowd_speed, 1.0) if p.crowd_speed > 0 else 1.0
        target = self.reference(carrier, wanted, calm * p.reference)
        self.feel()
        self.know()
        fast, slow = self.open
        ki = move(move(p.integral, p.integral_stirred, slow), p.integral_awake, fast)
        inner = move(p.inner, p.inner_awake, fast) if self.scale == 1 else 0.0
        gain = calm * move(p.observer, p.observer_awake, fast)

        believed = np.abs(sensed) <= p.sensed_limit
        if not believed.all():
            flags |= NONFINITE
        y = t.listen @ np.where(believed, sensed, 0.0)

        R = np.outer(t.shape, self.R)
        dR = np.outer(t.shape, self.dR)
        seen = np.outer(t.shape, self.seen_R)
        e = y - self.dc - ((seen + self.E) * carrier).real.sum(axis=1)  # O, on the error
        eps = y - self.scale * ((R + self.v) * carrier).real.sum(axis=1)  # D
        deviation = eps - self.dc
        self.eps = np.vstack([eps, self.eps[:-1]])
        F = -inner * (t.taps.T * self.eps).sum(axis=0)
        self.dc = self.dc + p.dc * e + self.drift  # type 2
        self.drift = self.drift + p.dc_drift * e

        w = np.minimum(self.weight / np.maximum(self.ramp, 1e-9), 1.0)
        fading = 50.0 * (1 - w)
        self.E = (1 - fading * T) * self.E + w * gain * e[:, None] * carrier.conj()
        if not p.error_observer:
            self.E = self.E - np.outer(t.shape, self.seen_R - self.saw_R)
        spill = p.back * (1 - self.scale)
        self.dv = -ki * self.E - fading * self.v  # S: the law is not told of what the limiter takes back
        self.v = self.v + T * (self.dv - spill * (self.v + R))
        heard = 2 * deviation[:, None] * carrier.conj()
        self.fast = self.fast + p.fast_pole * (heard - self.fast)
        self.samples += 1
        turn = self.samples % STEP == 0
        if turn:  # the slow detector listens to the fast one
            self.slow = move(self.slow, self.fast, 1 - (1 - p.slow_pole) ** STEP)
        self.believe(believed.all())
        self.wake((abs(self.fast) ** 2 > p.fast_level).any(), turn and (abs(self.slow) ** 2 > p.slow_level).any())
        turning = (self.force(R, dR) * self.ahead() * carrier).sum(axis=1)
        drive, cut = self.speak(F + turning)
        if turn and self.contact and p.adapt >= 0:
            lively = max(fast, slow)
            self.show(R, gain / 2)
            self.adapt(inner, move(p.adapt, p.adapt_awake, lively), move(p.rest, p.rest_awake, lively))
        return drive, target, flags | cut | (NONFINITE if far else 0)

    def follow(self, position):
        """Finger tracker: three equal poles."""
        leapt = self.seen and abs(position - self.held) * self.p.rate > FASTEST
        if leapt or not abs(position) <= FAR:
            self.seen, self.velocity, self.acceleration = False, 0.0, 0.0
            return
        if not self.seen:
            self.place_of_finger = position
        self.seen, self.held = True, position
        T, a = 1 / self.p.rate, self.tracker_pole
        self.place_of_finger += T * self.velocity
        miss = position - self.place_of_finger
        self.place_of_finger += 3 * a * T * miss
        self.velocity += T * self.acceleration + 3 * a**2 * T * miss
        self.acceleration += a**3 * T * miss

    def carriers(self):
        """e^{j phi}, and beside it omega, its slope, ramps and weights."""
        p = self.p
        self.omega = 2 * np.pi * (self.frequency + self.wavenumber * self.velocity)
        self.sweep = 2 * np.pi * self.wavenumber * self.acceleration
        carrier = np.exp(2j * np.pi * ((self.turns + self.wavenumber * self.held + self.phase) % 1.0))
        for k in range(len(self.turns)):
            present = self.wavenumber[k] == 0 or self.seen
            self.ramp[k] = min(self.ramp[k] + p.ramp, 1.0) if present else max(self.ramp[k] - p.ramp, 0.0)
            self.weight[k] = smooth(self.ramp[k])
            if self.wavenumber[k] > 0:
                f = abs(self.omega[k]) / (2 * np.pi)
                self.weight[k] *= smooth(2 * f / p.lowest - 1) * smooth(5 - 4 * f / p.highest)
        self.turns = (self.turns + self.frequency / p.rate) % 1.0
        return carrier

    def reference(self, carrier, wanted, gain):
        """R and dR/dt; returns the target."""
        p = self.p
        if p.analysed:
            e = wanted - (self.raw * carrier).real.sum()
            self.raw = self.raw + gain * e * carrier.conj()
            target = self.R + gain / 2 * (self.weight * self.raw - self.R)
        else:
            target = self.weight * self.constant
        self.dR = (target - self.R) * p.rate
        self.R = target
        self.saw_R = self.seen_R
        self.seen_R = target if p.error_observer else self.seen_R + p.reference / 2 * (target - self.seen_R)
        return target

    def feel(self):
        """Load, place and contact from the sag: W [1, g] = -K dc; what was learnt of a finger goes with it."""
        carried = -self.t.stiffness @ self.dc
        load, moment = carried[0], carried[1] if len(carried) > 1 else 0.0
        before = self.contact
        self.contact = load > (self.p.contact_off if before else self.p.contact_on)
        if self.contact and (self.samples % STEP == 0 or not before):
            self.g = min(max(moment / max(load, LEAST_LOAD), -2.0), 2.0)
        if self.contact != before:
            self.timers[0] = self.p.fast_time
            self.m = self.b = self.k = 0.0
            self.rest = np.zeros_like(self.rest)
            V = np.outer(self.t.shape, self.R) + self.v
            self.apart, self.acted, self.sent = self.E - self.v, V, [(V, 0 * self.R)]
            self.shown_force, self.shown_R, self.shown_omega = 0 * self.R, self.R, self.omega
            self.forgotten = np.ones_like(self.omega)  # what was before the carriers were all there

    def believe(self, heard):
        """S: fade out while a sensor cannot be believed; once silent, forget what it said."""
        change = 1 / (TRUST_TIME * self.p.rate)
        self.trust = min(self.trust + change, 1.0) if heard else max(self.trust - change, 0.0)
        if self.trust == 0:
            for state in (self.E, self.v, self.dv, self.acted, self.apart, self.fast, self.slow, self.dc, self.drift):
                state[:] = 0
            self.eps[:] = 0

    def wake(self, *trips):
        """Timers of the two detectors (fast, slow), and how far each has opened the loop."""
        for i, (trip, time) in enumerate(zip(trips, (self.p.fast_time, self.p.slow_time), strict=True)):
            if trip:
                self.timers[i] = time
            self.open[i] = 1.0 if self.timers[i] > 0 else max(self.open[i] - self.p.release, 0.0)
            self.timers[i] -= 1

    def lever(self):
        """h = [1, g]: where the finger stands in the device's coordinates."""
        return np.array([1.0, self.g])[: len(self.dc)]

    def stiffness_of(self, k, w):
        """D, D' and j dw/dt M of the bare device at band k, whose carrier turns by w."""
        t = self.t
        D = t.stiffness - w**2 * t.mass + 1j * w * t.damping
        return D, t.damping + 2j * w * t.mass, 1j * self.sweep[k] * t.mass

    def finger_at(self, k):
        """Finger's z at band k: three numbers and what each band has left over."""
        w = self.omega[k]
        return self.k - w**2 * self.m + 1j * w * self.b + self.rest[k]

    def know(self):
        """The law looks at the finger's place in turn with the adaptation, and at a touch."""
        due = self.samples % STEP == 0 or self.contact != self.knew_contact
        self.knew_contact = self.contact
        if due:
            self.known_lever = self.lever()

    def force(self, R, dR):
        """L: F = D V + D' dV/dt + j dw/dt M V in a matrix a band, finger included."""
        V, dV = R + self.v, dR + self.dv
        F = np.zeros_like(V)
        for k, w in enumerate(self.omega):
            D, slope, chirp = self.stiffness_of(k, w)
            if self.contact and self.p.adapt >= 0:
                structure = np.outer(self.known_lever, self.known_lever)
                D = D + self.finger_at(k) * structure
                slope = slope + (self.b + 2j * w * self.m) * structure
                chirp = chirp + 1j * self.sweep[k] * self.m * structure
            F[:, k] = (D + chirp) @ V[:, k] + slope @ dV[:, k]
        return F

    def ahead(self):
        """Phase of delay and half the hold, chirp included, and 1/sinc of the hold."""
        lead, turns = self.p.lead, self.omega / (2 * np.pi * self.p.rate)
        return np.exp(1j * lead * (self.omega + self.sweep * lead / 2)) / np.sinc(turns)

    def show(self, R, pole):
        """F: what was commanded, in the middle of a step as the observer sees it, behind its pole; so is all else."""
        p = self.p
        V = R + self.v
        finger = np.array([self.finger_at(k) for k in range(len(self.R))])
        self.sent.append((V, finger * (self.known_lever @ V)))
        shares = (1 - max(pole, 1e-4)) ** np.arange(STEP)  # of the step's samples, newest first
        middle = shares @ np.arange(STEP) / shares.sum()  # samples ago
        age = (p.lead * p.rate + middle) / STEP
        before = np.arange(len(self.sent))[::-1]  # steps ago; before the touch it was as at the touch
        steps = np.array([np.concatenate([each[0], each[1][None]]) for each in self.sent])
        low, ago = steps[0], int(age)
        newer = steps[before == ago][0] if ago < len(steps) else low
        older = steps[before == ago + 1][0] if ago + 1 < len(steps) else low
        late = move(newer, older, age - ago)
        settled = 1 - (1 - max(pole, 1e-4)) ** STEP
        self.acted = move(self.acted, late[:-1], settled)
        self.shown_force = move(self.shown_force, late[-1], settled)
        wanted = move(self.shown_R, self.R - middle / p.rate * self.dR, settled)
        self.shown_R = wanted if p.error_observer else self.seen_R
        faded = (np.minimum(self.weight / np.maximum(self.ramp, 1e-9), 1.0) < 1) | (self.ramp < 1)
        omega = self.omega - middle / p.rate * self.sweep
        self.shown_omega = np.where(faded, omega, move(self.shown_omega, omega, settled))
        self.forgotten = np.where(faded, 0.0, move(self.forgotten, 1.0, settled))

    def adapt(self, inner, mu, mu_rest):
        """F: three numbers pooled over bands, weights |y_p|^2/|D|^2, and one stiffness a band."""
        step = STEP / self.p.rate
        X = np.outer(self.t.shape, self.shown_R) + self.E
        apart, before = X - self.acted, self.apart
        self.apart = apart
        h = self.lever()
        y_p = h @ X
        sums, total = np.zeros(3), 0.0
        for k, w in enumerate(self.shown_omega):
            if abs(y_p[k]) < 5e-8 or self.forgotten[k] < 0.9:
                continue
            D, slope, chirp = self.stiffness_of(k, w)
            slope_skin = slope[0] + (self.b + 2j * w * self.m) * h
            away = (D[0] + chirp[0] + 1j * self.sweep[k] * self.m * h) @ apart[:, k]
            away += slope_skin @ (apart[:, k] - before[:, k]) / step
            away += 1j * w * inner * self.t.grip[0] * apart[0, k]
            z = (self.shown_force[k] - away) / y_p[k]
            miss = z.real - (self.k - w**2 * self.m)
            drag = z.imag - w * self.b
            weight = abs(y_p[k]) ** 2 / abs(D[0, 0]) ** 2
            den = FINGER_K**2 + w**4 * FINGER_M**2
            sums += weight * np.array([FINGER_K**2 * miss / den, w**2 * FINGER_M**2 * miss / den, drag / w])
            total += weight
            self.rest[k] += step * mu_rest * (miss + 1j * drag - self.rest[k])
        if total > 0:
            by_k, by_m, by_b = step * mu * sums / total
            self.k = min(max(self.k + by_k, -500.0), 15e3)
            self.m = min(max(self.m - by_m, -2e-3), 12e-3)
            self.b = min(max(self.b + by_b, 0.0), 12.0)

    def speak(self, F):
        """S: the whole envelope (of the analytic signal F) scaled to the limit, rounding shaped by (1 - z^-1)^2."""
        p = self.p
        drive = self.trust * (self.t.speak @ F)
        self.peak = max(abs(drive).max() / p.drive_limit, self.peak * p.peak_decay)
        self.scale = min(1.0, 1 / self.peak) if self.peak > 0 else 1.0
        drive = self.scale * drive.real
        if self.trust == 0:
            self.round_1, self.round_2 = np.zeros_like(drive), np.zeros_like(drive)
        elif p.drive_step > 0:
            shaped = drive + 2 * self.round_1 - self.round_2
            drive = p.drive_step * np.floor(shaped / p.drive_step + 0.5)
            self.round_1, self.round_2 = np.clip(shaped - drive, -p.drive_step, p.drive_step), self.round_1
        return np.clip(drive, -p.drive_limit, p.drive_limit), SATURATED if self.scale < 1 else 0
