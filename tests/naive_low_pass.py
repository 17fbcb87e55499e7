"""The methods with low passes as their equations read: numpy, a sample at a time, importing nothing under test.

Unlike the compiled step, polar loops follow a carrier that runs backwards as its mirror image: phi and R change their
sign, and the low pass's states are conjugated at the reversal.
"""

import numpy as np

TURN = 2 * np.pi


def smoothstep(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def section(coefficients, states, x, y=None):
    """Second-order section, transposed direct form II, whose output may have been cut to y; changes the states."""
    b0, b1, b2, a1, a2 = coefficients
    y = b0 * x + states[0] if y is None else y
    states[0], states[1] = b1 * x - a1 * y + states[1], b2 * x - a2 * y
    return y


class NaiveLowPass:
    """A controller of `settings` (by name) for bands; `table` has rows of gain, then of lag (polar laws)."""

    def __init__(self, settings, bands, table=None):
        self.p, self.bands, self.table = settings, bands, table
        n, k = int(settings["coordinates"]), len(bands.frequency)
        self.listen = settings["coordinate_from_sensor"][:n, : settings["sensors"]]
        self.speak = settings["drive_from_force"][: settings["channels"], :n]
        self.low, self.law = [np.zeros((2, n, k), complex) for _ in range(2)]
        self.amplitude, self.angle = np.zeros((2, n, k)), np.zeros((2, n, k))
        self.window, self.v = np.zeros((int(settings["window"]), n, k), complex), np.zeros((n, k), complex)
        self.fade = (bands.wavenumber == 0.0).astype(float) if settings["polar"] else np.zeros(k)
        self.raw, self.target = np.zeros(k, complex), np.zeros(k, complex)
        self.sign, self.heading = np.ones(k), np.ones(k, complex)
        self.sample, self.confidence, self.seen, self.slow = 0, 1.0, False, 0.0
        self.held = self.smooth = self.velocity = self.acceleration = 0.0

    def track(self, position):
        """Observer of the finger with a triple pole at 60 Hz; a leap or NaN is no finger."""
        period, pole = 1 / self.p["rate"], TURN * 60.0
        before = self.held if self.seen else None
        self.advance(position, period, pole)
        speed = 0.0 if before is None else (self.held - before) / period
        self.slow += (1 - np.exp(-TURN * 40.0 * period)) * (speed - self.slow)

    def advance(self, position, period, pole):
        leapt = self.seen and abs(position - self.held) > 10.0 * period
        if leapt or not abs(position) <= 1e3:
            self.velocity, self.acceleration, self.seen = 0.0, 0.0, False
            return
        predicted = (self.smooth if self.seen else position) + period * self.velocity
        innovation = position - predicted
        self.smooth = predicted + 3 * pole * period * innovation
        self.velocity += period * self.acceleration + 3 * pole**2 * period * innovation
        self.acceleration += pole**3 * period * innovation
        self.held, self.seen = position, True

    def weights(self, omega):
        step, ridge = self.p["fade_in"], self.bands.wavenumber > 0.0
        self.fade = np.clip(self.fade + np.where(self.seen | ~ridge, step, -step), 0.0, 1.0)
        hertz = abs(omega) / TURN
        above = smoothstep(2 * hertz / self.p["lowest"] - 1)
        below = smoothstep((1.25 - hertz / self.p["highest"]) / 0.25)
        return smoothstep(self.fade) * np.where(ridge, above * below, 1.0)

    def references(self, wanted, carrier, omega, weight):
        target = self.bands.envelope
        if self.p["analysed"]:
            gain = self.p["waveform_gain"]
            if self.p["crowd_speed"]:
                gain = gain * min(abs(self.velocity) / self.p["crowd_speed"], 1.0)
            self.raw = self.raw + gain * (wanted - (self.raw * carrier).real.sum()) * carrier.conj()
            self.target = self.target + gain / 2 * (weight * self.raw - self.target)
            return self.target
        target = weight * target * (wanted if self.p["modulated"] else 1.0)
        return 1j * omega * target if self.p["differentiated"] else target

    def step(self, sensed, position, wanted):
        """Return the drive, shape (channels,), and the targets, shape (bands,)."""
        p, bands = self.p, self.bands
        plausible = abs(sensed) < p["sensor_limit"]  # NaN is not
        y = self.listen @ (sensed if plausible.all() else np.zeros_like(sensed))
        if (bands.wavenumber > 0.0).any():
            self.track(position)
        turns = bands.frequency * self.sample / p["rate"] + bands.wavenumber * self.held
        carrier = np.exp(1j * (TURN * np.mod(turns, 1.0) + bands.phase))
        omega = TURN * (bands.frequency + bands.wavenumber * self.velocity)
        weight = self.weights(omega)
        r = self.references(wanted, carrier, omega, weight)
        step = 1 / (0.02 * p["rate"])
        self.confidence = np.clip(self.confidence + (step if plausible.all() else -step), 0.0, 1.0)
        if self.confidence == 0.0:
            for state in (self.low, self.law, self.amplitude, self.angle, self.v):
                state[:] = 0.0
        law = self.polar if p["polar"] else self.complex
        force = law(y, carrier, omega, r, weight)
        self.sample += 1
        return np.clip(self.speak @ (self.confidence * force), -p["drive_limit"], p["drive_limit"]), r

    def estimate(self, y, carrier):
        x = 2 * y[:, None] * carrier.conj()
        if not len(self.window):
            return section(self.p["low_pass"], self.low, x)
        self.window[self.sample % len(self.window)] = np.where(self.sign < 0, x.conj(), x)  # kept unmirrored
        mean = self.window.mean(axis=0)
        return np.where(self.sign < 0, mean.conj(), mean)

    def polar(self, y, carrier, omega, r, weight):
        sign = np.where(omega == 0.0, self.sign, np.sign(omega))
        self.low[:, :, sign != self.sign] = self.low[:, :, sign != self.sign].conj()
        self.sign = sign
        amount = abs(r)
        sounds = amount > 1e-12
        self.heading = np.where(sounds, r / np.where(sounds, amount, 1.0), self.heading)
        carrier, heading = (np.where(sign < 0, z.conj(), z) for z in (carrier, self.heading))
        n, at = len(y), abs(self.bands.frequency + self.bands.wavenumber * self.slow) / self.p["table_step"]
        gain, lag = (
            np.array([np.interp(at, np.arange(row.size), row) for row in rows]) for rows in np.split(self.table, 2)
        )
        if not self.p["feedback"]:
            amplitude, theta = np.broadcast_to(amount, (n, amount.size)), self.p["lead"] * abs(omega) - lag
        else:
            x = self.estimate(y, carrier)
            off = self.cut(x) - self.cut(heading) if self.p["subtracted"] else self.cut(x * heading.conj())
            theta = -section(self.p["loop"], self.angle, off * sounds)
            free = self.p["loop"][0] * (amount - abs(x)) + self.amplitude[0]
            amplitude = np.maximum(free, 0.0) if self.p["clamped"] else free
            section(self.p["loop"], self.amplitude, amount - abs(x), amplitude)
        return (amplitude / gain * (heading * carrier * np.exp(1j * theta)).real).sum(axis=1)

    @staticmethod
    def cut(x):
        """Angle above -270 up to 90 degrees."""
        angle = np.where(x == 0.0, 0.0, np.angle(x))  # whatever the sign of zero
        return np.where(angle > np.pi / 2, angle - TURN, angle)

    def complex(self, y, carrier, omega, r, weight):
        p, n = self.p, len(y)
        mass, damping, stiffness = (p[name][:n, :n, None] for name in ("mass", "damping", "stiffness"))
        wanted = p["shape"][:n, None] * r
        if p["deviation"]:
            y = y - p["shape"][:n] * (r * carrier).real.sum()
        v = np.zeros_like(self.v)
        if p["feedback"]:
            x = self.estimate(y, carrier)
            v = section(p["loop"], self.law, weight * (-x if p["deviation"] else wanted - x))
            self.law *= 1 - 50.0 * (1 - weight) / p["rate"]
        v = v + p["forward"] * wanted
        slope, self.v = (v - self.v) * p["rate"], v
        sweep = TURN * self.bands.wavenumber * self.acceleration
        force = np.einsum("ijk,jk->ik", stiffness - omega**2 * mass + 1j * omega * damping, v)
        if p["dynamic"]:
            force += np.einsum("ijk,jk->ik", damping + 2j * omega * mass, slope)
            force += np.einsum("ijk,jk->ik", 1j * sweep * mass, v)
        lead, half = p["lead"], omega / p["rate"] / 2
        ahead = np.exp(1j * (omega * lead + sweep * lead**2 / 2)) / np.sinc(half / np.pi)
        return (force * ahead * carrier).real.sum(axis=1)
