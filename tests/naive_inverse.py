"""Slow, obvious twin of the waveform law, sample by sample, from docs/theory.md, "The waveform law", in its symbols.

It imports nothing under test: `p` has the controller's numbers, `law` those of the waveform law.  The reference comes
`ahead` samples early, as a number a sample.  Left out: rounding, bands, what friction devices add (a contact's lag and
sticking), sensors that are late or show a derivative, lost samples, the supervisor's damper, and what follows a drive
that is no number.
"""

import numpy as np
from scipy.linalg import expm

FINGER, HEAVE, COUPLING, LOAD, INITIAL, COUNT = 0, 5, 9, 12, 14, 18


class NaiveInverse:
    """Takes one sample a call; everything it remembers is an attribute."""

    def __init__(self, p, law):
        self.p, self.law, self.T, n = p, law, 1 / p["rate"], p["coordinates"]
        self.M, self.C, self.K = law["mass"], law["damping"], law["stiffness"]
        self.from_sensor = p["coordinate_from_sensor"][:, : p["sensors"]]
        self.to_drive = p["drive_from_force"][: p["channels"]]
        self.to_force = law["force_from_drive"][:, : p["channels"]]
        self.alpha, self.taps, self.n = p["pattern"], p["taps"][:, : p["n_taps"]], n
        self.theta, self.P = law["prior"].copy(), law["prior_covariance"].copy()
        self.psi = np.zeros((4, COUNT + 1))  # states of the regressors, and of dev_u
        self.references, self.forces = [], []  # r, early; basis and deviation force of each sample
        self.poles, self.basis, self.past = (
            np.zeros(2),
            np.zeros(6),
            np.zeros((2, p["tap_stride"] * self.taps.shape[1])),
        )
        self.fade = self.slow = self.power = self.timer = self.open = self.moment = self.lever = self.peak = 0.0
        self.contact, self.since, self.hold_left, self.scale, self.smooth = 0, 1e9, 0, 1.0, 1.0
        self.samples = self.away = 0
        self.noise, self.last = 0.0, np.zeros(3)
        self.size = np.zeros(2)
        self.heave = np.zeros(2)  # mean squares of what heave's parameters explain, and of noise in it
        self.earlier = 2 * ((self.theta[HEAVE:LOAD].copy(), self.P[HEAVE:LOAD, HEAVE:LOAD].copy()),)

    def step(self, sensed, position, waveform):
        """Drive (channels,) of one sample."""
        law, p, n = self.law, self.p, self.samples
        y = self.from_sensor @ sensed
        settled = self.follow(int(np.isfinite(position)), position)
        plays = self.contact or not law["spatial"]
        self.fade = np.clip(self.fade + (law["fade_step"] if plays else -law["fade_step"]), 0, 1)
        self.references.append(waveform * (3 * self.fade**2 - 2 * self.fade**3) * self.smooth)
        now = self.reference(n - law["delay"] - 6)
        dev = y - self.alpha * now
        if self.gate(dev[0]) and self.since > law["initial_end"]:
            self.suspect_change()
        self.past = np.column_stack([dev, self.past[:, :-1]])
        if settled:
            for i in range(self.n):
                self.learn(i, dev[i])
        if n % 20 == 0:
            self.revert()
        if n % 25 == 0:
            self.discretise()
        beta, d1, d2 = self.find_basis(n)
        nominal = self.K @ self.alpha * beta[0] + self.C @ self.alpha * d1 + self.M @ self.alpha * d2
        force = nominal + self.directions() @ self.played() + self.levelling_force()
        damper = -(self.taps * self.past[:, :: p["tap_stride"]]).sum(axis=1)
        force = force + self.open * p["damper_high"] * np.clip(damper, -p["damper_limit"], p["damper_limit"])
        drive = self.play(force)
        self.forces.append((beta, self.to_force @ drive - nominal))
        self.advance(n)
        self.samples += 1
        return drive

    def reference(self, n):
        """Of the texture at sample n."""
        at = n  # entry n of the list is the reference of sample n + ahead
        return self.references[at] if at >= 0 else 0.0

    def follow(self, touching, position):
        law = self.law
        if touching:
            self.lever = np.clip(law["lever_per_metre"] * position, -2.0, 2.0)
        self.since += 1
        suspected = self.away < 0
        self.away = 0 if touching else self.away + 1
        if suspected and touching:
            self.since, self.timer = 0, law["damper_time"]
            self.restore_device()
        touching = touching or int(self.contact and self.away < (0 if suspected else law["loss_time"]))
        if touching != self.contact:
            self.contact, self.since, self.timer = touching, 0, law["damper_time"]
            self.reset(FINGER, HEAVE)
            self.reset(LOAD, COUNT)
            self.discretise()
        elif self.since in (law["learning_delay"], law["relearning_delay"]):
            self.P[:] = law["prior_covariance"]
            self.restore_device()
            self.restart_regressors()
        elif self.since == law["initial_end"]:
            self.reset(INITIAL, COUNT)
        elif self.since > law["initial_end"] and self.samples % law["report_delay"] == 0:
            self.earlier = self.earlier[1], (self.theta[HEAVE:LOAD].copy(), self.P[HEAVE:LOAD, HEAVE:LOAD].copy())
        return self.since >= law["learning_delay"]

    def restore_device(self):
        self.reset(HEAVE, LOAD)
        self.theta[HEAVE:LOAD], self.P[HEAVE:LOAD, HEAVE:LOAD] = self.earlier[0]
        self.earlier = self.earlier[0], self.earlier[0]

    def restart_regressors(self):
        self.psi[:] = 0.0
        self.psi[:, INITIAL:COUNT] = np.eye(4)
        self.theta[INITIAL:] = 0.0
        self.P[INITIAL:, INITIAL:] = np.diag(self.law["initial_variance"])

    def suspect_change(self):
        law, prior = self.law, self.law["prior_covariance"]
        self.P[LOAD:], self.P[:, LOAD:] = prior[LOAD:], prior[:, LOAD:]
        if self.contact:
            self.since = law["relearning_delay"]
            self.P[:HEAVE, :HEAVE] += np.outer(self.theta[:HEAVE], self.theta[:HEAVE])
        else:
            self.contact, self.lever, self.away, self.since = 1, 0.0, -law["report_delay"], law["learning_delay"]
            self.P[COUPLING:LOAD, COUPLING:LOAD] += 15e3**2 * np.eye(3)
            self.P[LOAD + 1, LOAD + 1] = prior[LOAD, LOAD]
        self.restart_regressors()

    def reset(self, first, last):
        inside = slice(first, last)
        self.theta[inside] = self.law["prior"][inside]
        self.P[inside, :] = self.P[:, inside] = 0.0
        self.P[inside, inside] = self.law["prior_covariance"][inside, inside]
        self.psi[:, inside] = 0.0

    def gate(self, deviation):
        law = self.law
        self.slow += law["high_pass_smoothing"] * (deviation - self.slow)
        self.power += law["mean_square_smoothing"] * ((deviation - self.slow) ** 2 - self.power)
        self.last = np.array([deviation, *self.last[:2]])
        self.noise += law["mean_square_smoothing"] * 4 / 300 * ((self.last @ [1, -2, 1]) ** 2 / 6 - self.noise)
        large = self.power > np.clip(4 * self.noise, law["gate_threshold"], 25 * law["gate_threshold"])
        if large:
            self.timer = max(self.timer, 1)
        opens = large and self.open == 0.0
        self.open = 1.0 if self.timer > 0 else max(self.open - self.p["release"], 0.0)
        self.timer -= 1
        return opens

    def learn(self, i, dev):
        psi, dev_u = self.psi[i, :COUNT], self.psi[i, COUNT]
        e = dev - dev_u + psi @ self.theta
        square = dev_u**2 + self.law["deviations"] * dev**2 + self.law["innovations"] * e**2
        self.size[i] += self.law["mean_square_smoothing"] * (square - self.size[i])
        noise = self.law["noise"][i] + self.law["model_error"] * self.size[i]
        own = slice(HEAVE, COUPLING)
        now = np.array([(psi[own] @ self.theta[own]) ** 2, self.law["noise_share"] * psi[own] @ self.P[own] @ psi])
        self.heave += self.law["power_smoothing"] * (now - self.heave)
        gain = self.P @ psi / (psi @ self.P @ psi + noise)
        self.theta = self.theta - gain * e
        self.P = self.P - np.outer(gain, psi @ self.P)

    def revert(self):
        law = self.law
        factor = np.outer(law["reversion_factor"], law["reversion_factor"])
        self.theta = law["prior"] + law["reversion_factor"] * (self.theta - law["prior"])
        self.P = factor * self.P + (1 - factor) * law["prior_covariance"]

    def discretise(self):
        law, th, w_n = self.law, self.theta, self.law["omega_n"]
        s, pole = 2j * np.pi * 180.0, law["pole"]
        low = s**2 + 2 * law["pole_damping"] * pole * s + pole**2
        z = th[0] + th[1] * s / w_n + th[2] * (s / w_n) ** 2 + th[3] * pole**2 / low + th[4] * pole * s / low
        mass = np.clip(z.real / (s**2).real, -min(2e-3, 0.2 * self.M[0, 0]), 10e-3)
        damping = np.clip(z.imag / s.imag, 0.0, 12.0)
        arm = np.outer([1.0, self.lever], [1.0, self.lever]) * self.contact

        def learned(matrix, order, both):
            own = matrix.diagonal()
            heave, coupling = th[[HEAVE + order, COUPLING + order]] / w_n**order
            coupling = np.clip(coupling, -0.2 * own[1], 0.2 * own[1])
            change = np.diag(np.clip([heave, heave if both else 0.0], -0.7 * own, 4.0 * own))
            return matrix + change + coupling * np.eye(2)[::-1]

        M = learned(self.M, 2, False) + mass * arm
        C, K = learned(self.C, 1, True) + damping * arm, learned(self.K, 0, True)
        flow = np.zeros((6, 6))
        flow[:2, 2:4] = np.eye(2)
        flow[2:4] = np.linalg.solve(M, np.hstack([-K, -C, np.eye(2)]))
        step = expm(flow * self.T)
        self.Phi, self.Gamma = step[:4, :4], step[:4, 4:]

    def find_basis(self, n):
        law, w_n = self.law, self.law["omega_n"]
        window = np.array([self.references[k] if k >= 0 else 0.0 for k in range(n - 11, n + 1)])
        d = law["filters"] @ window
        last, x = self.basis[0], self.poles
        self.poles = law["pole_step"] @ [x[0], x[1], last, d[0]]
        delay = (self.M[0, 0] * d[3] + self.C[0, 0] * d[2] + self.K[0, 0] * d[1]) * self.T
        pole = law["pole"]
        self.basis = np.array([d[0], d[1] / w_n, d[2] / w_n**2, pole**2 * self.poles[0], pole * self.poles[1], delay])
        return self.basis, d[1], d[2]

    def directions(self, basis=None):
        """Force of each parameter per unit, shape (2, COUNT); load and initial motion are not played."""
        basis = self.basis if basis is None else basis
        found = np.zeros((2, COUNT))
        along = self.contact * (self.alpha[0] + self.lever * self.alpha[1])
        found[:, FINGER:HEAVE] = along * np.outer([1.0, self.lever], basis[:5])
        found[0, HEAVE : HEAVE + 4] = self.alpha[0] * basis[[0, 1, 2, 5]]
        found[1, COUPLING : COUPLING + 3] = basis[:3]
        return found

    def played(self):
        """Parameters, heave's by the share of what they explain that is not the sensor's noise."""
        theta = self.theta.copy()
        theta[HEAVE:COUPLING] *= 1.0 - np.clip(self.heave[1] / max(self.heave[0], 1e-300), 0.0, 1.0)
        return theta

    def levelling_force(self):
        target = self.contact * np.clip(self.lever * self.theta[LOAD] + self.theta[LOAD + 1], -1.0, 1.0)
        self.moment += self.law["levelling_smoothing"] * (target - self.moment)
        return np.array([0.0, self.moment])

    def play(self, force):
        p, law = self.p, self.law
        exact = self.to_drive @ force
        needed = abs(exact).max() / p["drive_limit"] / self.smooth
        self.hold_left -= 1
        if needed >= 0.98 * self.peak:
            self.peak, self.hold_left = min(max(self.peak, needed), 20.0), law["hold"]
        elif self.hold_left < 0:
            self.peak *= law["decay"]
        self.scale += law["scale_smoothing"] * (1 / max(self.peak, 1.0) - self.scale)
        self.smooth += law["scale_smoothing"] * (self.scale - self.smooth)
        return np.clip(exact, -p["drive_limit"], p["drive_limit"])

    def advance(self, n):
        at = n - self.law["delay"]
        basis, deviation = self.forces[at] if at >= 0 else (np.zeros(6), np.zeros(2))
        inputs = np.zeros((2, COUNT + 1))
        inputs[:, :COUNT] = self.directions(basis)
        inputs[:, LOAD] = 1.0, self.contact * self.lever
        inputs[1, LOAD + 1] = 1.0
        inputs[:, COUNT] = deviation
        self.psi = self.Phi @ self.psi + self.Gamma @ inputs
