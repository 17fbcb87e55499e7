"""Slow, obvious twins of the library's fast functions; nothing under test is imported here."""

import cmath
import math

import numpy as np
import scipy.linalg


class Recursion:
    """``y[n] = sum b[k] x[n-k] - sum_(k>0) a[k] y[n-k]``, one sample a call."""

    def __init__(self, b, a):
        self.b, self.a = b, a
        self.x, self.y = [0.0] * len(b), [0.0] * (len(a) - 1)

    def __call__(self, x):
        self.x = [x, *self.x[:-1]]
        y = sum(b * x for b, x in zip(self.b, self.x, strict=True))
        y -= sum(a * y for a, y in zip(self.a[1:], self.y, strict=True))
        self.y = [y, *self.y[:-1]][: len(self.a) - 1]
        return y


def step_response(numerator, denominator, time):
    """Unit step response by partial fractions over the poles, which must be distinct and not 0."""
    poles = np.roots(denominator)
    slope = np.polyval(np.polyder(denominator), poles)
    residues = np.polyval(numerator, poles) / (slope * poles)
    static = numerator[-1] / denominator[-1]
    return static + (residues * np.exp(np.multiply.outer(time, poles))).sum(axis=-1).real


def envelope_loop(controller, low_pass, reference, delay=0):
    """Output of the amplitude loop with plant 1: controller and low pass as (b, a), `delay` in samples (>= 1)."""
    law, estimator = Recursion(*controller), Recursion(*low_pass)
    line = [0.0] * delay
    output = []
    for wanted in reference:
        output.append(line.pop(0))
        line.append(law(wanted - estimator(output[-1])))
    return np.array(output)


def carrier_loop(controller, low_pass, plant, frequency, rate, samples):
    """Drive amplitude and true amplitude of a polar loop that steps to 1, run on the carrier itself.

    `plant` is (mass, damping, stiffness), driven by a force held between
    samples; the look-up table is its gain at `frequency`.
    """
    mass, damping, stiffness = plant
    w = 2 * math.pi * frequency
    table = abs(stiffness - mass * w**2 + 1j * w * damping)
    transition, from_force = held(mass, damping, stiffness, 1 / rate)
    law, real, imaginary = Recursion(*controller), Recursion(*low_pass), Recursion(*low_pass)
    state = np.zeros(2)
    drive, amplitude = np.zeros(samples), np.zeros(samples)
    for n in range(samples):
        carrier = cmath.exp(1j * w * n / rate)
        amplitude[n] = abs(complex(state[0], -state[1] / w))
        demodulated = 2 * state[0] * carrier.conjugate()
        estimate = abs(complex(real(demodulated.real), imaginary(demodulated.imag)))
        drive[n] = max(law(1.0 - estimate), 0.0)
        state = transition @ state + from_force * table * drive[n] * carrier.real
    return drive, amplitude


def held(mass, damping, stiffness, period):
    """Exact transition of (position, velocity) over `period`, and what a unit force held over it adds."""
    system = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, 1 / mass], [0, 0, 0]])
    both = scipy.linalg.expm(system * period)
    return both[:2, :2], both[:2, 2]
