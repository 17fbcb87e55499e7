"""What is left of figures that docs/figures.md states as missed where one thing alone is wrong.

Run: python -m benchmarks.bounds

1. Glass that bends.  One force F moves heave x_c and the mode e, so what the place under a finger and the ends differ
   by, ``(1 - phi) e``, is the same for every law to first order: no law is below it at both together.  With
   ``x_c = r - s e`` (s = 1: both ends follow the texture r exactly, as sensors there make a law that learns do;
   s = 0: heave is that of the exactly known rigid plate), D_0 and D_b the dynamic stiffness of heave and mode, c the
   mode's shape at the coils, and a finger of dynamic stiffness D_f at p, where the shape is phi::

       F = D_0 (r - s e) + D_f y,   D_b e = c F - phi D_f y,   y = r + (phi - s) e

2. The comb's first half second: 0.8 N within a sample on the damped plate; its sag rings, and nothing else is wrong.
   A law that compensated the sag would leave less.
3. Touch and lift: an exact inverse, the wrong one (of the plate before) until `late` after the contact or its end, and
   a damper on the error all the while.  Sags are not compensated: a law that did, or fed back more than a damper,
   would leave less; without a load most of it is gone.
4. A target of 0.1 um whose amplitude is learned from N = 400 s of two sensors with noise sigma = 1 um alone: the
   Cramer-Rao bound ``sigma sqrt(2/N)/sqrt(2)``.
5. Ridges on a screen whose gain is learned from N samples of a tribometer with noise sigma: ``sigma sqrt(2/N)/A``, A
   their friction's amplitude, with what open loop leaves, which is told the gain.  Of estimates without bias: one that
   leaves the gain where the profile states it can be nearer.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import scipy.linalg

from hapticrender.accuracy.plate import AMPLITUDE, BENT, FINGERS, FREQUENCIES, PLACES, RATE, Bench, rms
from hapticrender.accuracy.signals import sliding
from hapticrender.protocols import Array
from hapticrender.recordings.envelopes import amplitude_error, fit
from hapticrender.touch.mechanics import HEAVY, NONE, FingerMechanics
from hapticrender.touch.perception import VELOCITY_PER_FORCE

DAMPED = 2.4, 1.4  # Q of the default plate's damper in heave and rocking (docs/theory.md, "Inner damper")
OPEN_LOOP = {1e-3: 0.0029, 0.5e-3: 0.0058}  # m: error, measured by tests/test_friction_waveform.py
REPORT = 5e-3  # s: after which a contact is reported
RAMP, TRANSIENT = 5, 500  # samples: of a rising load; until every transient is over
LINES = np.arange(20.0, 401.0, 20.0)  # Hz
WHITE, SWEPT = np.arange(20.0, 400.5), np.arange(30.0, 390.5)  # Hz


def bent(frequency: Array, finger: FingerMechanics, position: Array, share: float = 1.0) -> tuple[Array, Array]:
    """Errors over the texture (complex, shape (positions, frequencies)) under the finger and at the ends.

    `share` is s: 1 where both ends are exact, 0 where heave is.
    """
    mode, omega = 2 * np.pi * BENT.bending_frequency, 2 * np.pi * frequency
    heave, coil = BENT.dynamic_stiffness(frequency)[:, 0, 0], BENT.bending_coil
    bend = BENT.bending_mass * (mode**2 - omega**2 + 2j * BENT.bending_damping * mode * omega)
    tissue, shape = 1j * omega * finger.impedance(frequency), BENT.displacement(position)[:, 2:]
    forced = coil * heave + (coil - shape) * tissue
    moved = forced / (bend + share * coil * heave - (coil - shape) * (shape - share) * tissue)
    return (shape - share) * moved, (1 - share) * moved


def bent_figures(finger: FingerMechanics, share: float) -> tuple[Array, Array, Array, float]:
    """Worst tone (amplitude, rms over a slide), white noise, and comb, under the finger and at the ends; sweep."""
    position = sliding(np.arange(0.0, 1.0, 1e-3))
    tones = [rms(amplitude_error(1 + each, 1.0)).max() for each in bent(np.array(FREQUENCIES), finger, position, share)]
    white, comb = (rms(np.array(bent(each, finger, position, share)), (1, 2)) for each in (WHITE, LINES))
    sweep = rms(amplitude_error(1 + bent(SWEPT, finger, np.zeros(1), share)[0], 1.0), (0, 1))
    return np.array(tones), white, comb, float(sweep)


class DampedPlate:
    """The rigid plate, damped, under a finger: ``M q'' + (C + C_d) q' + K q = f``, q heave, rocking, phalanx.

    `under` is the finger's row: its displacement is ``under @ q``; an `order` of 0 leaves the plate free.
    """

    def __init__(self, finger: FingerMechanics, position: float, quality: tuple[float, float] = DAMPED) -> None:
        self.under = np.r_[BENT.displacement(position)[:2], 0.0]
        skin = self.under - np.eye(3)[2] * (finger.order == 4)
        phalanx = finger.phalanx_mass or 1.0, finger.phalanx_damping, finger.phalanx_stiffness or 1.0
        plate = BENT.mass_matrix, BENT.damping_matrix, BENT.stiffness_matrix
        self.m, self.c, self.k = (scipy.linalg.block_diag(*each) for each in zip(plate, phalanx, strict=True))
        self.m += finger.mass * np.outer(self.under, self.under)
        self.c += finger.damping * np.outer(skin, skin)
        self.k += finger.stiffness * np.outer(skin, skin)
        critical = np.sqrt(BENT.mass_matrix.diagonal() * BENT.stiffness_matrix.diagonal())
        self.damper = np.diag(np.r_[critical / quality, 0.0])
        flow = -np.linalg.solve(self.m, np.hstack([self.k, self.c + self.damper]))
        self.step = scipy.linalg.expm(np.vstack([np.eye(3, 6, 3), flow]) / RATE)

    def exact(self, omega: float) -> tuple[Array, Array]:
        """Coordinates while the plate follows the texture 1, and the force that it takes (complex, shape (3,))."""
        stiffness = self.k - self.m * omega**2 + 1j * omega * self.c
        q = np.r_[1.0, 0.0, -stiffness[2, 0] / stiffness[2, 2]]
        return q, stiffness @ q

    def play(self, start: Array, count: int, omega: float, force: Array, texture: complex, load: float) -> Array:
        """States q, q' (count + 1, 6) from a start (6,) on, under `force` and damper per `texture`, and a load (N)."""
        stiffness = self.k - self.m * omega**2 + 1j * omega * (self.c + self.damper)
        q = texture * np.linalg.solve(stiffness, force + 1j * omega * self.damper[0])
        tone = np.exp(1j * omega * np.arange(count + 1) / RATE)[:, None] * np.r_[q, 1j * omega * q]
        rest = np.r_[np.linalg.solve(self.k, -load * self.under), np.zeros(3)]
        free = [start - tone[0].real - rest]
        for _ in range(count):
            free.append(self.step @ free[-1])
        return np.asarray(tone.real + rest + free)


def sag_figure(place: float, quality: tuple[float, float] = DAMPED) -> float:
    """Ringing of a heavy finger's sag in the comb's first nine windows of 0.1 s, over its lines of 10 um."""
    plate = DampedPlate(HEAVY, place, quality)
    moved = plate.play(np.zeros(6), 2500, 0.0, np.zeros(3), 0.0, 0.8)[:, :3] @ plate.under
    index = 250 * np.arange(9)[:, None] + np.arange(500)
    phase = 2 * np.pi / RATE * np.multiply.outer(index, LINES)
    return float(rms(fit(phase, moved[index][..., None])[0] / 10e-6, (0, 1, 2)))


def touch_errors(
    frequency: float, finger: FingerMechanics, load: float, place: float, late: float, seed: int = 1
) -> Array:
    """Peak errors of a tone's amplitude after a touch and a lift: middle, finger, both ends (shape (4,)).

    `seed` decides the tone's phase, as in the suite.
    """
    omega, worst = 2 * np.pi * frequency, np.zeros(4)
    wait, time = round(late * RATE), np.arange(-100, TRANSIENT + 1) / RATE
    tone = np.roll(
        AMPLITUDE * np.exp(1j * (omega * time + Bench(method="", seed=seed).tone(frequency).phase)), -100
    )  # from 0 on
    index = 5 * np.arange((len(time) - 100) // 5)[:, None] + np.arange(100)  # windows of 20 ms, 1 ms apart
    loaded, free = DampedPlate(finger, place), DampedPlate(NONE, place)
    columns = np.vstack([np.eye(3)[0], loaded.under, *np.pad(BENT.displacement(BENT.ends)[:, :2], ((0, 0), (0, 1)))])
    for touches in (True, False):
        before, after = (free, loaded) if touches else (loaded, free)
        rest = np.linalg.solve(before.k, (touches - 1) * load * before.under)  # the phalanx rests before a touch
        q = tone[0] * before.exact(omega)[0]
        states = [np.r_[q.real + rest, (1j * omega * q).real]]
        for n in range(TRANSIENT):
            pressed = load * min((n + 0.5) / RAMP, 1.0) if touches else 0.0
            known = before if n < wait else after
            states.append(after.play(states[-1], 1, omega, known.exact(omega)[1], tone[n], pressed)[1])
        moved = np.vstack([tone[-100:, None].real + columns @ rest, np.array(states)[:, :3] @ columns.T])
        found = fit(omega * time[index][..., None], moved[index])[0][..., 0]
        worst = np.maximum(worst, abs(amplitude_error(found, AMPLITUDE)).max(axis=0))
    return worst


def touch_figures(late: float, loaded: bool = True, seed: int = 1) -> tuple[float, float, float]:
    """Worst of "touch rigid": in the middle, under the finger, at the worse end; without the load if not `loaded`."""
    cases = product(FREQUENCIES[5:], FINGERS, PLACES)
    found = np.max([touch_errors(f, who, load * loaded, place, late, seed) for f, (who, load), place in cases], axis=0)
    return float(found[0]), float(found[1]), float(found[2:].max())


def main() -> None:
    """Print what each leaves."""
    for (name, finger), share in product((("free", NONE), ("heavy finger", HEAVY)), (1.0, 0.0)):
        *pairs, sweep = bent_figures(finger, share)
        tone, white, comb = (f"{at:.2%} / {end:.2%}" for at, end in pairs)
        print(f"bent glass, exact {'ends' if share else 'heave'}, {name}, under the finger / at the ends:")
        print(f"    tones {tone}, white noise {white}, comb {comb}, sweeps {sweep:.2%}")
    turn = float(sliding(np.array(1.0)))  # where the suite's finger touches
    for place, quality in product((turn, 0.0), (DAMPED, (1.0, 1.0))):
        first = 20 * np.log10(sag_figure(place, quality))
        print(f"comb, first half second, at {1e3 * place:.2f} mm, Q of heave and rocking {quality}: {first:.1f} dB")
    cases = (("report", REPORT), ("touch", 0.0))
    for (since, late), (loaded, seed) in product(cases, ((True, 1), (False, 1), (True, 2), (True, 3))):
        figures = " / ".join(f"{each:.1%}" for each in touch_figures(late, loaded, seed))
        what = f"exact from the {since} on, {'' if loaded else 'no '}load, phases of seed {seed}"
        print(f"touch and lift, {what}: middle / finger / end {figures}")
    share = 1e-6 / np.sqrt(400 * RATE) / 1e-7
    beyond = 1 - math.erf(0.01 / share / math.sqrt(2)) ** 2  # normal, at either of the case's two frequencies
    print(f"0.1 um in 1 um of noise, from 400 s of two sensors: {share:.2%} rms; beyond 1 % in {beyond:.0%} of plays")
    for wavelength, open_loop in OPEN_LOOP.items():  # 5 um under 0.08 m/s; 0.75 s of 10 kHz with 1 mN of noise
        friction = 5e-6 * 2 * np.pi * 0.08 / wavelength / VELOCITY_PER_FORCE
        gain = 1e-3 * np.sqrt(2 / 7500) / friction
        print(f"ridges of {1e3 * wavelength:g} mm: gain {gain:.2%} rms, error {math.hypot(gain, open_loop):.2%}")


if __name__ == "__main__":
    main()
