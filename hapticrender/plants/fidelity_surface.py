"""How an ultrasonic surface's amplitude follows what is wanted of it, in closed form at either level.

In the frame of the carrier w, at the offset W, the amplitude loop is linear for small modulation.  With
z = e^(j (w+W) h) at the carrier's period h, the mode G held over it, the loop's delay d, its feedback K and its law's
feed-forward::

    Y/R = G z^-d (FF - K_r + K + K_z)/(1 + G z^-d (K + K_z)),    FF = rho (D + D' (1 - e^(-j W h))/h)

K is that of `control.bank.loop`.  K_z and K_r are what learning adds (`control.bank.learning`): the learnt part zeta of
D goes after what the command did not do, a, with the pace gamma, and its force zeta R undoes R's division::

    zeta' = gamma (<zeta> - zeta - (D a + D' a')/R),    a = e - <v> + r

<.> is late and smooth, e the error envelope, v the integral part and r what the target moved while it was late.

The mode at level "envelope" differs in D by `UltrasonicParameters.envelope_error`; but the loop's sample is longer
there, and lateness and learning tell more of the two levels apart than that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import fft, fftfreq, ifft, next_fast_len

from hapticrender.control.bank.learning import ADAPTATION
from hapticrender.control.bank.loop import BankLoop, KnownFinger, Structure
from hapticrender.control.bank.state import BankTables
from hapticrender.control.kernels import FREQUENCY
from hapticrender.control.stability import STATES, bank_loop
from hapticrender.plants.surface import SurfaceParameters
from hapticrender.protocols import Array

GRID = 400  # offsets of either sign at which the loop is computed; between them it is interpolated
LEAST_OFFSET = 1e-3  # Hz: a slower change of the amplitude is followed perfectly
RIPPLE = 3e-5  # of the amplitude, at twice the carrier of level "envelope" as samples show it: as seen, not derived
NYQUIST = 0.49  # of the rate: to there, lest an offset should take the carrier to nothing


@dataclass(frozen=True, kw_only=True)
class AmplitudeLoop:
    """The amplitude loop under a finger of one load, settled.

    Parameters
    ----------
    parameters : SurfaceParameters
        The surface and its level.
    tables : BankTables
        Of the loop, as designed.
    load : float, N
        Of the finger; 0: none.
    rise : float, K
        Of the temperature.
    state : {"quiet", "stirred", "awake"}
        Which of the loop's detectors stand open.
    """

    parameters: SurfaceParameters
    tables: BankTables
    load: float
    rise: float
    state: str

    @cached_property
    def omega(self) -> float:
        """Angular frequency (rad/s) of the carrier: the resonance, where it is followed."""
        mode = self.parameters.carrier_mode
        frequency = mode.resonance(self.load, self.rise) if self.parameters.lock else mode.carrier
        return 2 * np.pi * float(frequency)

    @cached_property
    def damping(self) -> float:
        """Of the mode (N s/m)."""
        return float(self.parameters.carrier_mode.damping(self.load))

    @cached_property
    def stiffness(self) -> complex:
        """D (N/m) of the mode at the carrier, which the loop has learnt."""
        mode = self.parameters.carrier_mode
        resonance = 2 * np.pi * float(mode.resonance(self.load, self.rise))
        return mode.mass * (resonance - self.omega) * (resonance + self.omega) + 1j * self.omega * self.damping

    @cached_property
    def loop(self) -> BankLoop:
        """The bank on the mode."""
        mode, known = self.parameters.carrier_mode, self.tables
        resonance = 2 * np.pi * float(mode.resonance(self.load, self.rise))
        free = known.stiffness[0, 0] - self.omega**2 * known.mass[0, 0] + 1j * self.omega * known.damping[0, 0]
        learnt = self.stiffness - free
        tone = known.tone.copy()
        tone[FREQUENCY] = self.omega / (2 * np.pi)
        numbers = ([[mode.mass]], [[self.damping]], [[mode.mass * resonance**2]])
        return bank_loop(
            known._replace(tone=tone),
            self.state,
            plant=Structure.free(*(np.array(number) for number in numbers)),
            finger=KnownFinger(0.0, learnt.imag / self.omega, learnt.real, 0.0),
        )

    def response(self, offset: Array) -> Array:
        """Envelope of the mode per wanted amplitude (complex) at `offset` (Hz, not 0) from the carrier.

        In one sample: what is sensed at that at which the amplitude is asked for.
        """
        turn, h = 2 * np.pi * np.asarray(offset, float), self.loop.period
        mode, fed_back = self._round(turn)
        slope = self.damping + 2j * self.omega * self.parameters.carrier_mode.mass
        forward = self._ahead * (self.stiffness + slope * (1 - np.exp(-1j * turn * h)) / h) - self._learning(turn)[1]
        return mode * (forward + fed_back) / (1 + mode * fed_back)

    def _round(self, turn: Array) -> tuple[Array, Array]:
        """Mode, delay included (m/N), and feedback (N/m) at `turn` (rad/s) from the carrier."""
        z = np.exp(1j * (self.omega + turn) * self.loop.period)
        gain, rest = (each[0] for each in self.loop.controller(z))
        mode = self.loop.plant.response(z)[:, 0, 0] * z**-self.loop.delay
        return mode, gain[:, 0, 0] + self._learning(turn)[0] / rest

    @property
    def _ahead(self) -> complex:
        """Return rho, which turns the force ahead by delay and hold."""
        h = self.loop.period
        return complex(np.exp(1j * self.omega * self.tables.numbers.lead) / np.sinc(self.omega * h / (2 * np.pi)))

    def _learning(self, turn: Array) -> tuple[Array, Array]:
        """Force (N/m) that learning adds, per residual, and that it takes away, per target."""
        known, h = self.tables, self.loop.period
        g, integral, inner = (float(each[0]) for each in (self.loop.observer, self.loop.integral, self.loop.inner))
        lively = max(STATES[self.state])
        pace = known.numbers.adapt + lively * (known.numbers.adapt_awake - known.numbers.adapt)
        still = 1 / (1 - np.exp(-1j * turn * h))  # of an integral in the carrier's frame
        error, step = 0.5 * g * still, ADAPTATION * h
        last, keep = np.exp(-1j * turn * step), (1 - 0.5 * g) ** ADAPTATION
        shown, change = (1 - keep) / (1 - keep * last), (1 - last) / step
        middle = (2 / g - 1) / ADAPTATION - keep / (1 - keep)
        back = int(known.numbers.age + 0.5)
        sent = shown * last**back * (1 - (known.numbers.age + middle - back) * (1 - last))
        away, moved = error * (1 + integral * h * still * sent), shown * (1 - middle * step / (h * still)) - sent
        held = _mean_turn(ADAPTATION, turn * h) * np.exp(-0.5j * (ADAPTATION - 1) * turn * h)
        law = self.stiffness + 1j * self.omega * inner * known.grip[0]
        slope = self.damping + 2j * self.omega * known.mass[0, 0]
        learnt = self._ahead * pace * (law + slope * change) * held / (change + pace * last * (1 - sent))
        return learnt * away, learnt * moved

    def needed(self, wanted: Array) -> Array:
        """Drive (V, shape (n,)) for a wanted amplitude (m, (n,)): |D a + D' a'| over the modal force of a volt."""
        mode = self.parameters.carrier_mode
        slope = self.damping + 2j * self.omega * mode.mass
        force = self.stiffness * wanted + slope * np.gradient(wanted) * self.parameters.rate
        return abs(force) / mode.force_constant

    def follow(self, wanted: Array) -> tuple[Array, Array, Array]:
        """Amplitude in the mean over every sample of the surface, and the loop's deviation.

        Parameters
        ----------
        wanted : ndarray, shape (n,), m
            At the end of each sample; what comes before is taken for a repetition of it.

        Returns
        -------
        amplitude, slow, fast : ndarray, shape (n,), m
            The last two are what the detectors that open "stirred" and "awake" hear of the deviation.
        """
        size = next_fast_len(len(wanted) + 1)
        padded = np.concatenate([wanted, np.linspace(wanted[-1], wanted[0], size - len(wanted) + 2)[1:-1]])
        rate, many, numbers = self.parameters.rate, self.parameters.substeps, self.tables.numbers
        offset, spectrum = fftfreq(size, 1 / rate), fft(padded)
        one_side = np.geomspace(LEAST_OFFSET, NYQUIST * rate, GRID)
        known = np.concatenate([-one_side[::-1], one_side])
        whole, turn = self.response(known), 2 * np.pi * known * self.loop.period
        asked = _mean_turn(many, turn) ** 2  # the straight line between samples
        late = _mean_turn(many, turn) * np.exp(0.5j * (3 - many) * turn)  # to the mean over what is then there

        def played(response: Array, steady: float) -> Array:
            return ifft(_between(offset, known, response, steady) * spectrum)[: len(wanted)]

        amplitude = played(asked * late * whole, 1.0)
        amplitude += self._image(known, played, float(wanted.mean()))
        away = asked * (whole - 1.0)
        fast, slow = (pole / (1 - (1 - pole) * np.exp(-1j * turn)) for pole in (numbers.fast_pole, numbers.slow_pole))
        slow = slow * fast  # it listens to the fast one
        return abs(amplitude), abs(played(away * slow, 0.0)), abs(played(away * fast, 0.0))

    def _image(self, offset: Array, played: Callable[[Array, float], Array], steady: float) -> Array:
        """What the corners of the straight line between samples leave of it near minus the carrier, and a ripple.

        The line's images lie a multiple of the surface's rate away.  One that comes to -2 w is, as all is real, at the
        resonance, and the law has raised it there, taking it for a change as fast as that.  Its phase is chance: here
        it is opposite at the two levels, which tells most of them apart.
        """
        rate, twice, moved = self.parameters.rate, self.omega / np.pi, self.parameters.level == "envelope"
        away = -rate * round(twice / rate)
        alias = -away - twice
        found = _mean_turn(self.parameters.substeps, 2 * np.pi * (offset + away) * self.loop.period) ** 2
        image = played(found * self.response(offset + away), 0.0).conj()
        image = image + RIPPLE * steady if moved else -image
        return image * np.exp(2j * np.pi * alias * np.arange(len(image)) / rate)


def _between(offset: Array, known: Array, values: Array, steady: float) -> Array:
    """Values at `offset` (Hz), `steady` at 0."""
    real, imaginary = (np.interp(offset, known, part) for part in (values.real, values.imag))
    return np.where(abs(offset) < LEAST_OFFSET, steady, real + 1j * imaginary)


def _mean_turn(many: int, turn: Array) -> Array:
    """Mean of e^(j turn k) over `many` k around 0."""
    return np.sinc(many * turn / (2 * np.pi)) / np.sinc(turn / (2 * np.pi))
