"""Control methods as one would first write them, each with the mistake that a failure test is about.

Two compiled loops on the library's plate: polar (amplitude and phase of heave,
Grigorii et al. 2021) and complex (2 x 2 envelopes of heave and rocking).  They
know their carriers exactly, sample by sample, which is kind to them.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.compiled.jit import kernel
from hapticrender.control.kernels import WANTED_IM, WANTED_RE, biquad_step
from hapticrender.control.loopshape import butterworth, integrator, reduced_controller
from hapticrender.control.methods import METHODS
from hapticrender.plants.closed import CLOSED
from hapticrender.plants.kernels import plate_advance, plate_drive, plate_sense
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.protocols import Array

TURN = 2 * math.pi


class Carriers(NamedTuple):
    """What is wanted, known in advance, each (samples, bands)."""

    phase: Array  # rad
    omega: Array  # rad/s
    sweep: Array  # rad/s2
    wanted: Array  # m, complex


class Choices(NamedTuple):
    """Switches and numbers of both loops; each default is the choice that does not fail."""

    rate: float
    lead: float  # s: delay and half the hold
    low_pass: tuple[float, float, float, float, float]
    law: tuple[float, float, float, float, float]
    clamp: bool = True  # polar: the commanded amplitude stays >= 0
    relative: bool = True  # polar: phase error from X conj(R), not from the difference of two cut angles
    slope: bool = True  # complex: D' d/dt and the chirp term beside D
    forward: float = 1.0  # complex: share of the reference fed forward
    filtered: bool = True  # complex: what X is compared with passes the low pass that X passed
    matrix_rate: float = 0.0  # complex: 1/s, NLMS of an unstructured 2 x 2 stiffness
    twist: float = 0.0  # rad: error of the plant's phase
    limit: float = math.inf  # A


class PolarTables(NamedTuple):
    carriers: Carriers
    choices: Choices
    gain: Array  # (bands,) m/A of heave by both coils


class ComplexTables(NamedTuple):
    carriers: Carriers
    choices: Choices
    listen: Array
    speak: Array
    mass: Array
    damping: Array
    stiffness: Array


class NaiveState(NamedTuple):
    low: Array  # (2, 2, bands) low-pass states of X
    law: Array  # (2, 2, bands)
    reference: Array  # (2, bands)
    force: Array  # (2, 2, bands) low-passed force
    before: Array  # (2, 2, bands) last V and X
    extra: Array  # (2, 2, bands) learnt stiffness
    sample: Array  # (1,) integer


class NaiveController:
    """Behind the `Controller` protocol, for `Plate.closed_loop`."""

    def __init__(self, name, tables):
        bands = tables.carriers.phase.shape[1]
        self.method, self.n_bands, self.tables = name, bands, tables
        pair = [np.zeros((2, 2, bands), complex) for _ in range(5)]
        self.state = NaiveState(pair[0], pair[1], np.zeros((2, bands), complex), *pair[2:], np.zeros(1, np.int64))


def section(transfer, rate):
    b, a = transfer.tustin(rate)
    b = np.append(b, np.zeros(3 - len(b)))
    a = np.append(a, np.zeros(3 - len(a)))
    return tuple(float(x) for x in (*b, *a[1:]))


def choices(model, loop_bandwidth=5.0, filter_bandwidth=10.0, gain=None, **other):
    """The paper's second-order law, or an integrator of `gain` (1/s)."""
    law = integrator(gain) if gain else reduced_controller(loop_bandwidth, filter_bandwidth)
    return Choices(
        rate=model.rate,
        lead=(model.delay + 0.5) / model.rate,
        low_pass=section(butterworth(filter_bandwidth), model.rate),
        law=section(law, model.rate),
        **{"limit": model.drive_limit, **other},
    )


def tones(rate, samples, frequency, wanted):
    """Fixed carriers; `wanted` (m) is one envelope a band or (samples, bands)."""
    frequency = np.atleast_1d(np.asarray(frequency, float))
    turns = np.multiply.outer(np.arange(samples) / rate, frequency)
    shape = (samples, len(frequency))
    return Carriers(
        phase=TURN * (turns - np.floor(turns)),
        omega=np.broadcast_to(TURN * frequency, shape).copy(),
        sweep=np.zeros(shape),
        wanted=np.broadcast_to(np.asarray(wanted, complex), shape).copy(),
    )


def chirp(rate, start, stop, speed, wanted, lead_in=1.0):
    """One carrier that rests at `start` (Hz) for `lead_in` (s), then climbs to `stop` at `speed` (Hz/s)."""
    time = np.arange(round((lead_in + (stop - start) / speed) * rate)) / rate
    since = np.maximum(time - lead_in, 0.0)
    turns = start * time + 0.5 * speed * since**2
    return Carriers(
        phase=(TURN * (turns - np.floor(turns)))[:, None],
        omega=(TURN * (start + speed * since))[:, None],
        sweep=np.where(time < lead_in, 0.0, TURN * speed)[:, None],
        wanted=np.full((len(time), 1), wanted, complex),
    )


def polar(model, carriers, **options):
    """Amplitude and phase loops on heave, one look-up gain a band (the carrier's first frequency)."""
    response = model.response(carriers.omega[0] / TURN)[:, 0] @ np.ones(2)
    return NaiveController("naive polar", PolarTables(carriers, choices(model, **options), abs(response)))


def complex_inverse(model, carriers, **options):
    """2 x 2 complex envelopes through the free device's dynamic stiffness."""
    tables = ComplexTables(
        carriers,
        choices(model, **options),
        np.ascontiguousarray(model.coordinate_from_sensed),
        np.linalg.inv(model.force_from_drive),
        model.mass,
        model.damping,
        model.stiffness,
    )
    return NaiveController("naive complex", tables)


@kernel
def polar_step(tables, state, sensed, drive):
    """One sample: drive of both coils from the amplitude and phase of heave."""
    choices, n = tables.choices, state.sample[0]
    heave, total = 0.5 * (sensed[0] + sensed[1]), 0.0
    for k in range(tables.gain.shape[0]):
        carrier = cmath.exp(1j * tables.carriers.phase[n, k])
        wanted = tables.carriers.wanted[n, k]
        x, state.low[0, 0, k], state.low[0, 1, k] = biquad_step(
            choices.low_pass, state.low[0, 0, k], state.low[0, 1, k], 2.0 * heave * carrier.conjugate()
        )
        if choices.relative:
            turn = wanted * x.conjugate()
            miss = math.atan2(turn.imag, turn.real)
        else:
            miss = math.atan2(wanted.imag, wanted.real) - math.atan2(x.imag, x.real)
        theta, state.law[1, 0, k], state.law[1, 1, k] = biquad_step(
            choices.law, state.law[1, 0, k], state.law[1, 1, k], complex(miss, 0.0)
        )
        law, error = choices.law, abs(wanted) - abs(x)
        command = law[0] * error + state.law[0, 0, k].real
        if choices.clamp:
            command = max(command, 0.0)
        state.law[0, 0, k] = complex(law[1] * error - law[3] * command + state.law[0, 1, k].real, theta.real)
        state.law[0, 1, k] = complex(law[2] * error - law[4] * command, 0.0)
        total += command / tables.gain[k] * (carrier * cmath.exp(1j * theta.real)).real
    state.sample[0] += 1
    drive[0] = drive[1] = min(max(total, -choices.limit), choices.limit)


@kernel
def product(tables, omega, slope, sweep, value, rate_of, c):
    """Row c of D V + D' dV/dt + j dw/dt M V."""
    total = 0j
    for i in range(2):
        m, b = tables.mass[c, i], tables.damping[c, i]
        total += complex(tables.stiffness[c, i] - omega * omega * m, omega * b) * value[i]
        if slope:
            total += complex(b, 2.0 * omega * m) * rate_of[i] + complex(0.0, sweep * m) * value[i]
    return total


@kernel
def learn(choices, state, miss, x, k):
    """NLMS on the unstructured 2 x 2 stiffness of band k."""
    size = abs(x[0]) ** 2 + abs(x[1]) ** 2 + 1e-16
    for c in range(2):
        for i in range(2):
            state.extra[c, i, k] += choices.matrix_rate / choices.rate * miss[c] * x[i].conjugate() / size


@kernel
def complex_step(tables, state, sensed, drive):
    """One sample: 2 x 2 envelopes of heave and rocking, feedback and feed-forward through D."""
    choices, n = tables.choices, state.sample[0]
    total0 = total1 = 0.0
    for k in range(tables.carriers.phase.shape[1]):
        carrier = cmath.exp(1j * tables.carriers.phase[n, k])
        omega, sweep = tables.carriers.omega[n, k], tables.carriers.sweep[n, k]
        wanted = tables.carriers.wanted[n, k]
        late, state.reference[0, k], state.reference[1, k] = biquad_step(
            choices.low_pass, state.reference[0, k], state.reference[1, k], wanted
        )
        against = late if choices.filtered else wanted
        y = (
            tables.listen[0, 0] * sensed[0] + tables.listen[0, 1] * sensed[1],
            tables.listen[1, 0] * sensed[0] + tables.listen[1, 1] * sensed[1],
        )
        x0, state.low[0, 0, k], state.low[0, 1, k] = biquad_step(
            choices.low_pass, state.low[0, 0, k], state.low[0, 1, k], 2.0 * y[0] * carrier.conjugate()
        )
        x1, state.low[1, 0, k], state.low[1, 1, k] = biquad_step(
            choices.low_pass, state.low[1, 0, k], state.low[1, 1, k], 2.0 * y[1] * carrier.conjugate()
        )
        v0, state.law[0, 0, k], state.law[0, 1, k] = biquad_step(
            choices.law, state.law[0, 0, k], state.law[0, 1, k], against - x0
        )
        v1, state.law[1, 0, k], state.law[1, 1, k] = biquad_step(
            choices.law, state.law[1, 0, k], state.law[1, 1, k], -x1
        )
        v, x = (v0 + choices.forward * wanted, v1), (x0, x1)
        dv = ((v[0] - state.before[0, 0, k]) * choices.rate, (v[1] - state.before[0, 1, k]) * choices.rate)
        dx = ((x[0] - state.before[1, 0, k]) * choices.rate, (x[1] - state.before[1, 1, k]) * choices.rate)
        state.before[0, 0, k], state.before[0, 1, k] = v
        state.before[1, 0, k], state.before[1, 1, k] = x
        f0 = product(tables, omega, choices.slope, sweep, v, dv, 0)
        f1 = product(tables, omega, choices.slope, sweep, v, dv, 1)
        if choices.matrix_rate > 0.0:
            f0 += state.extra[0, 0, k] * v[0] + state.extra[0, 1, k] * v[1]
            f1 += state.extra[1, 0, k] * v[0] + state.extra[1, 1, k] * v[1]
            g0, state.force[0, 0, k], state.force[0, 1, k] = biquad_step(
                choices.low_pass, state.force[0, 0, k], state.force[0, 1, k], f0
            )
            g1, state.force[1, 0, k], state.force[1, 1, k] = biquad_step(
                choices.low_pass, state.force[1, 0, k], state.force[1, 1, k], f1
            )
            g0 -= product(tables, omega, True, sweep, x, dx, 0)
            g1 -= product(tables, omega, True, sweep, x, dx, 1)
            g0 -= state.extra[0, 0, k] * x[0] + state.extra[0, 1, k] * x[1]
            g1 -= state.extra[1, 0, k] * x[0] + state.extra[1, 1, k] * x[1]
            learn(choices, state, (g0, g1), x, k)
        turn = 0.5 * omega / choices.rate
        ahead = carrier * cmath.exp(1j * (omega * choices.lead + choices.twist)) * turn / math.sin(turn)
        total0 += (f0 * ahead).real
        total1 += (f1 * ahead).real
    state.sample[0] += 1
    for i in range(2):
        drive[i] = min(max(tables.speak[i, 0] * total0 + tables.speak[i, 1] * total1, -choices.limit), choices.limit)


@kernel
def polar_plate_run(plate, moving, tables, state, last, finger, noise, wanted, sensed, motion, drive, target, flags):
    for n in range(sensed.shape[0]):
        flags[n] = plate_sense(plate, moving, noise[n], sensed[n], motion[n])
        plate_drive(plate, moving, last)
        plate_advance(plate, moving, finger[n, 0], finger[n, 1], finger[n, 2])
        drive[n, 0], drive[n, 1] = last[0], last[1]
        polar_step(tables, state, sensed[n], last)


@kernel
def complex_plate_run(plate, moving, tables, state, last, finger, noise, wanted, sensed, motion, drive, target, flags):
    for n in range(sensed.shape[0]):
        flags[n] = plate_sense(plate, moving, noise[n], sensed[n], motion[n])
        plate_drive(plate, moving, last)
        plate_advance(plate, moving, finger[n, 0], finger[n, 1], finger[n, 2])
        drive[n, 0], drive[n, 1] = last[0], last[1]
        complex_step(tables, state, sensed[n], last)


# Loops of their own, as the library's one loop is cached on disk under a stamp that does not know of this file.
CLOSED[PolarTables] = polar_plate_run
CLOSED[ComplexTables] = complex_plate_run


def play(controller, seconds=None, plate=None, finger=None, seed=0):
    """Drive (A) and true motion (m: centre, end 1, end 2) of a controller on the plate, by default to its end."""
    plate = Plate(plate or PlateParameters(), finger or hr.Finger.absent(), seed)
    samples = len(controller.tables.carriers.phase) if seconds is None else round(seconds * plate.rate)
    drive, _, _, sensed = plate.closed_loop(controller, np.zeros(samples))
    return drive, sensed.motion


def fixed(*pairs):
    """Bands of fixed carriers from (frequency, envelope) pairs."""
    frequency = np.array([pair[0] for pair in pairs], float)
    zero = np.zeros(len(pairs))
    return Bands(
        frequency=frequency, wavenumber=zero, phase=zero, envelope=np.array([pair[1] for pair in pairs], complex)
    )


def hold(method, bands, seconds, plate=None, known=None, **scene):
    """Drive and motion under a method of the library; `known` is the plate that it was designed for."""
    plate = plate or PlateParameters()
    known = known or plate
    controller = METHODS[method].design(known.band_model(plate.rate, known.delay), bands)
    return play(controller, seconds, plate, **scene)


def retarget(method, frequency, wanted, plate=None):
    """Motion under a method of the library while the target is each of `wanted`, (seconds, envelope), in turn."""
    plate = plate or PlateParameters()
    controller = METHODS[method].design(plate.band_model(plate.rate, plate.delay), fixed((frequency, wanted[0][1])))
    device = Plate(plate, hr.Finger.absent())
    pieces = []
    for seconds, envelope in wanted:
        controller.tables.tone[[WANTED_RE, WANTED_IM], 0] = complex(envelope).real, complex(envelope).imag
        pieces.append(device.closed_loop(controller, np.zeros(round(seconds * plate.rate)))[3].motion)
    return np.concatenate(pieces)


def envelopes(motion, phase, rate, window, hop=None):
    """Centre times (s) and complex envelopes (windows, columns) by least squares with offset and slope.

    `window` and `hop` (a quarter window) in s; `phase` (rad) is the carrier's, sample by sample.
    """
    width = round(window * rate)
    hop = round((hop or window / 4) * rate)
    starts = np.arange(0, len(motion) - width + 1, hop)
    ramp = np.linspace(-1, 1, width)
    found = []
    for start in starts:
        piece = slice(start, start + width)
        basis = np.column_stack([np.cos(phase[piece]), -np.sin(phase[piece]), np.ones(width), ramp])
        fit = np.linalg.lstsq(basis, motion[piece], rcond=None)[0]
        found.append(fit[0] + 1j * fit[1])
    return (starts + width / 2) / rate, np.array(found)


def amplitude_error(motion, frequency, wanted, rate=5000.0, seconds=1.0):
    """Relative error of the mean amplitude of each column over the last `seconds`, which hold whole periods."""
    n = np.arange(len(motion))[-round(seconds * rate) :]
    found = 2 * np.mean(motion[n] * np.exp(-1j * TURN * frequency * n / rate)[:, None], axis=0)
    return abs(found) / wanted - 1.0
