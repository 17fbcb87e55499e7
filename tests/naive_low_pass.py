"""The methods with low passes as their equations read: numpy, a sample at a time, importing nothing under test.

Finger, carriers and references are those of the default controller's twin.  Unlike the compiled step, polar loops
follow a carrier that runs backwards as its mirror image: phi and R change their sign, and the low pass's states are
conjugated at the reversal.
"""

import numpy as np
from naive_error import FADE_OUT, LEAK, TURN, NaiveError


def section(coefficients, states, x, y=None):
    """Second-order section, transposed direct form II, whose output may have been cut to y; changes the states."""
    b0, b1, b2, a1, a2 = coefficients
    y = b0 * x + states[0] if y is None else y
    states[0], states[1] = b1 * x - a1 * y + states[1], b2 * x - a2 * y
    return y


class NaiveLowPass(NaiveError):
    """A controller of numbers `p` and set-points; `table` has rows of gain, then of lag (polar laws)."""

    def __init__(self, p, setpoints, table=None):
        super().__init__(p, setpoints)
        n, k, self.table = len(self.from_sensor), self.K, table
        self.low, self.integral = [np.zeros((2, n, k), complex) for _ in range(2)]
        self.amplitude, self.angle = np.zeros((2, n, k)), np.zeros((2, n, k))
        self.window, self.V = np.zeros((int(p["window"]), n, k), complex), np.zeros((n, k), complex)
        self.fade = (self.wavenumber == 0.0) * 1.0 if p["polar"] else np.zeros(k)
        self.sign, self.r_phasor, self.table_speed = np.ones(k), np.ones(k, complex), 0.0

    def step(self, sensed, position, waveform):
        """Return the drive, shape (channels,), and the targets, shape (bands,)."""
        p, before = self.p, self.x
        plausible = (abs(sensed) < p["sensor_limit"]).all()  # NaN is not
        y = self.from_sensor @ (sensed if plausible else np.zeros_like(sensed))
        if self.locked:
            seen = self.seen
            self.track(position)
            speed = (self.x - before) / self.T if seen else 0.0
            self.table_speed += (1 - np.exp(-TURN * 40.0 * self.T)) * (speed - self.table_speed)
        carrier = self.carriers()
        self.references(carrier, waveform, min(abs(self.velocity) / p["crowd_speed"], 1.0) if p["crowd_speed"] else 1.0)
        change = self.T / FADE_OUT
        self.confidence = np.clip(self.confidence + (change if plausible else -change), 0.0, 1.0)
        if self.confidence == 0.0:
            for state in (self.low, self.integral, self.amplitude, self.angle, self.V):
                state[:] = 0.0
        force = (self.polar if p["polar"] else self.complex)(y, carrier)
        self.samples += 1
        return np.clip(self.to_drive @ (self.confidence * force), -p["drive_limit"], p["drive_limit"]), self.target

    def estimate(self, y, carrier):
        x = 2 * y[:, None] * carrier.conj()
        if not len(self.window):
            return section(self.p["low_pass"], self.low, x)
        self.window[self.samples % len(self.window)] = np.where(self.sign < 0, x.conj(), x)  # kept unmirrored
        mean = self.window.mean(axis=0)
        return np.where(self.sign < 0, mean.conj(), mean)

    def polar(self, y, carrier):
        omega, r = self.w, self.R
        sign = np.where(omega == 0.0, self.sign, np.sign(omega))
        self.low[:, :, sign != self.sign] = self.low[:, :, sign != self.sign].conj()
        self.sign = sign
        r_magnitude = abs(r)
        r_nonzero = r_magnitude > 1e-12
        self.r_phasor = np.where(r_nonzero, r / np.where(r_nonzero, r_magnitude, 1.0), self.r_phasor)
        carrier, r_phasor = (np.where(sign < 0, z.conj(), z) for z in (carrier, self.r_phasor))
        n, at = len(y), abs(self.frequency + self.wavenumber * self.table_speed) / self.p["table_step"]
        gain, lag = (
            np.array([np.interp(at, np.arange(row.size), row) for row in rows]) for rows in np.split(self.table, 2)
        )
        if not self.p["feedback"]:
            amplitude, theta = np.broadcast_to(r_magnitude, (n, r_magnitude.size)), self.p["lead"] * abs(omega) - lag
        else:
            x = self.estimate(y, carrier)
            off = self.cut(x) - self.cut(r_phasor) if self.p["subtracted"] else self.cut(x * r_phasor.conj())
            theta = -section(self.p["loop"], self.angle, off * r_nonzero)
            free = self.p["loop"][0] * (r_magnitude - abs(x)) + self.amplitude[0]
            amplitude = np.maximum(free, 0.0) if self.p["clamped"] else free
            section(self.p["loop"], self.amplitude, r_magnitude - abs(x), amplitude)
        return (amplitude / gain * (r_phasor * carrier * np.exp(1j * theta)).real).sum(axis=1)

    @staticmethod
    def cut(x):
        """Angle above -270 up to 90 degrees."""
        angle = np.where(x == 0.0, 0.0, np.angle(x))  # whatever the sign of zero
        return np.where(angle > np.pi / 2, angle - TURN, angle)

    def complex(self, y, carrier):
        p, n, omega, r, weight = self.p, len(y), self.w, self.R, self.weight
        mass, damping, stiffness = (p[name][:n, :n, None] for name in ("mass", "damping", "stiffness"))
        wanted = p["pattern"][:n, None] * r
        if p["deviation"]:
            y = y - p["pattern"][:n] * (r * carrier).real.sum()
        v = np.zeros_like(self.V)
        if p["feedback"]:
            x = self.estimate(y, carrier)
            v = section(p["loop"], self.integral, weight * (-x if p["deviation"] else wanted - x))
            self.integral *= 1 - LEAK * (1 - weight) / p["rate"]
        v = v + p["forward"] * wanted
        slope, self.V, sweep = (v - self.V) / self.T, v, self.sweep
        force = np.einsum("ijk,jk->ik", stiffness - omega**2 * mass + 1j * omega * damping, v)
        if p["dynamic"]:
            force += np.einsum("ijk,jk->ik", damping + 2j * omega * mass, slope)
            force += np.einsum("ijk,jk->ik", 1j * sweep * mass, v)
        lead, half = p["lead"], omega / p["rate"] / 2
        ahead = np.exp(1j * (omega * lead + sweep * lead**2 / 2)) / np.sinc(half / np.pi)
        return (force * ahead * carrier).real.sum(axis=1)
