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
3. A target of 0.1 um whose amplitude is learned from N = 400 s of two sensors with noise sigma = 1 um alone: the
   Cramer-Rao bound ``sigma sqrt(2/N)/sqrt(2)``.
4. Ridges on a screen whose gain is learned from N samples of a tribometer with noise sigma: ``sigma sqrt(2/N)/A``, A
   their friction's amplitude, with what open loop leaves, which is told the gain.  Of estimates without bias: one that
   leaves the gain where the profile states it can be nearer.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import scipy.linalg

from hapticrender.accuracy.plate import BENT, FREQUENCIES, RATE, rms
from hapticrender.accuracy.signals import sliding
from hapticrender.control.load_damper import choose_load_damping
from hapticrender.mathx import state_space, zoh
from hapticrender.plants.plate import EXPECTED_BENDING
from hapticrender.protocols import Array
from hapticrender.recordings.envelopes import amplitude_error, fit
from hapticrender.touch.mechanics import HEAVY, NONE, FingerMechanics
from hapticrender.touch.perception import VELOCITY_PER_FORCE

OPEN_LOOP = {1e-3: 0.0029, 0.5e-3: 0.0058}  # m: error, measured by tests/test_friction_waveform.py
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


def sag(place: float, finger: FingerMechanics = HEAVY, load: float = 0.8) -> Array:
    """Displacement (m, shape (2501,)) at a finger's place (m) from a load (N) on, on the rigid plate with its damper.

    ``M q'' + C q' + K q = F - load under``, q heave, rocking and the phalanx; `under` is the finger's row.
    """
    under = np.r_[BENT.displacement(place)[:2], 0.0]
    skin = under - np.eye(3)[2] * (finger.order == 4)
    phalanx = finger.phalanx_mass or 1.0, finger.phalanx_damping, finger.phalanx_stiffness or 1.0
    plate = BENT.mass_matrix, BENT.damping_matrix, BENT.stiffness_matrix
    m, c, k = (scipy.linalg.block_diag(*each) for each in zip(plate, phalanx, strict=True))
    m += finger.mass * np.outer(under, under)
    c += finger.damping * np.outer(skin, skin)
    k += finger.stiffness * np.outer(skin, skin)
    model = replace(BENT.device_model(RATE, 1), bending=EXPECTED_BENDING)
    damping = choose_load_damping(model)
    a, b = zoh(*state_space(m, c, k, np.column_stack([np.eye(3)[:, :2], -under])), 1.0 / RATE)
    state, past = np.zeros(6), np.zeros((2, damping.stride * damping.taps.shape[1]))
    force, moved = np.zeros((model.delay + 1, 2)), [0.0]
    for _ in range(2500):
        past = np.column_stack([state[:2], past[:, :-1]])
        force = np.vstack([force[1:], -(damping.taps * past[:, :: damping.stride]).sum(axis=1)])
        state = a @ state + b @ np.r_[force[0], load]
        moved.append(under @ state[:3])
    return np.array(moved)


def sag_figure(place: float) -> float:
    """Ringing of a heavy finger's sag in the comb's first nine windows of 0.1 s, over its lines of 10 um."""
    index = 250 * np.arange(9)[:, None] + np.arange(500)
    phase = 2 * np.pi / RATE * np.multiply.outer(index, LINES)
    return float(rms(fit(phase, sag(place)[index][..., None])[0] / 10e-6, (0, 1, 2)))


def main() -> None:
    """Print what each leaves."""
    for (name, finger), share in product((("free", NONE), ("heavy finger", HEAVY)), (1.0, 0.0)):
        *pairs, sweep = bent_figures(finger, share)
        tone, white, comb = (f"{at:.2%} / {end:.2%}" for at, end in pairs)
        print(f"bent glass, exact {'ends' if share else 'heave'}, {name}, under the finger / at the ends:")
        print(f"    tones {tone}, white noise {white}, comb {comb}, sweeps {sweep:.2%}")
    turn = float(sliding(np.array(1.0)))  # where the suite's finger touches
    for place in (turn, 0.0):
        print(f"comb, first half second, at {1e3 * place:.2f} mm: {20 * np.log10(sag_figure(place)):.1f} dB")
    share = 1e-6 / np.sqrt(400 * RATE) / 1e-7
    beyond = 1 - math.erf(0.01 / share / math.sqrt(2)) ** 2  # normal, at either of the case's two frequencies
    print(f"0.1 um in 1 um of noise, from 400 s of two sensors: {share:.2%} rms; beyond 1 % in {beyond:.0%} of plays")
    for wavelength, open_loop in OPEN_LOOP.items():  # 5 um under 0.08 m/s; 0.75 s of 10 kHz with 1 mN of noise
        friction = 5e-6 * 2 * np.pi * 0.08 / wavelength / VELOCITY_PER_FORCE
        gain = 1e-3 * np.sqrt(2 / 7500) / friction
        print(f"ridges of {1e3 * wavelength:g} mm: gain {gain:.2%} rms, error {math.hypot(gain, open_loop):.2%}")


if __name__ == "__main__":
    main()
