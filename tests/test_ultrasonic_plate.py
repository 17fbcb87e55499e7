"""The ultrasonic mode, exact and moved down, what detuning costs; and the surface against its parts, by samples."""

import numpy as np
import pytest
from proportional import Proportional
from scipy.linalg import expm

import hapticrender as hr
from hapticrender.plants.friction_laws import friction_ratio, reference_amplitude
from hapticrender.plants.sliding_contact import sliding_record, sliding_step
from hapticrender.plants.ultrasonic import UltrasonicParameters, UltrasonicPlate
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, UltrasonicSurface, full_slew
from hapticrender.protocols import Flag

IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "drive_bits": 0}
FREE, HELD = hr.Finger.absent(), hr.Finger.still(normal_load=0.5)
ROUNDING = 2.0**-52
SETTLED = 1e-9  # what is left of a transient where a test calls it settled


def twin(parameters, drive, load):
    """Displacement (m) by scipy's exponential, one for each sample, from the numbers that a data sheet would give."""
    p, period = parameters, 1 / parameters.rate
    scale = p.frequency / p.carrier
    mass, free = p.modal_mass * scale, 2 * np.pi * p.frequency * p.modal_mass / p.quality * scale
    state, motion = np.zeros(2), np.zeros(len(drive))
    for n, force in enumerate(p.force_constant * np.clip(drive, -p.drive_limit, p.drive_limit)):
        grip = (load[n] / 0.5) ** (1 / 3)
        warm = np.floor(n * period * 1000 + 1e-9) / 1000
        rise = p.temperature_rise * min(warm / p.temperature_time, 1.0)
        hertz = p.carrier + p.finger_shift * grip + p.frequency * p.temperature_coefficient * rise
        stiffness, damping = mass * (2 * np.pi * hertz) ** 2, free + p.finger_damping * grip * scale
        system = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, force / mass], [0, 0, 0]])
        motion[n] = state[0]
        state = (expm(period * system) @ np.append(state, 1.0))[:2]
    return motion


@pytest.mark.parametrize(("rate", "level"), [(80e3, "carrier"), (48e3, "envelope")])
def test_the_mode_is_integrated_exactly_however_few_samples_a_cycle_has(rng, rate, level):
    """Heat and a finger that comes, presses harder and leaves, against scipy: some 4 roundings of each of n steps."""
    load = ((0.0, 0.004, 0.006), (0.2, 0.2, 1.4))
    finger = hr.Finger.still(normal_load=load, touches=((0.0025, 0.0080),))
    parameters = UltrasonicParameters(temperature_rise=10.0, temperature_time=0.005, rate=rate, level=level, **IDEAL)
    n = round(0.01 * rate)
    drive = rng.uniform(-12.0, 12.0, n)
    pressed = finger.load(np.arange(n) / rate)
    assert len(set(pressed)) > 10
    expected = twin(parameters, drive, pressed)
    motion = UltrasonicPlate(parameters, finger).run(drive[:, None]).motion[:, 0]
    np.testing.assert_allclose(motion, expected, rtol=0, atol=n * 4 * ROUNDING * abs(expected).max())


@pytest.mark.parametrize(("load", "pole", "settling", "quality"), [(0.0, 75.0, 2.1e-3, 200), (0.5, 250.0, 0.64e-3, 60)])
def test_poles(load, pole, settling, quality):
    """75 Hz free (2.1 ms, Q 200) and 250 Hz (0.64 ms, Q 60) with a finger, to the digits printed in docs/theory.md."""
    parameters = UltrasonicParameters()
    measured = float(parameters.pole(load))
    assert abs(measured - pole) < 0.5
    assert abs(1 / (2 * np.pi * measured) - settling) < 0.5 * (1e-4 if load == 0 else 1e-5)
    assert abs(parameters.frequency / (2 * measured) - quality) < 0.5


@pytest.mark.parametrize(
    ("load", "offset", "percent", "degrees", "digits"),
    [(0.0, 10.0, -0.9, 7.6, 1), (0.0, 30.0, -7, 22, 0), (0.0, 150.0, -55, 63, 0), (0.5, 60.0, -3, 13, 0)],
)
def test_what_detuning_costs(load, offset, percent, degrees, digits):
    """1/(1 + j 2 Q df/f) at Q 200 and Q 60, to the last printed digit."""
    parameters = UltrasonicParameters()
    tuned = float(parameters.resonance(load))
    ratio = parameters.dynamic_stiffness(tuned, load) / parameters.dynamic_stiffness(tuned + offset, load)
    assert abs(100 * (abs(ratio) - 1) - percent) <= 0.5 * 10.0**-digits
    assert abs(abs(np.angle(ratio, deg=True)) - degrees) <= 0.5 * 10.0**-digits


def respond(parameters, frequency, finger=FREE):
    """Complex response (m/V) of the settled plate to a carrier: q of a cosine, and of a sine as its imaginary part."""
    load = 0.5 if finger is HELD else 0.0
    time = np.log(1 / SETTLED) / (2 * np.pi * float(parameters.pole(load)))
    n = np.arange(int((time + parameters.temperature_time) * parameters.rate) + 2)
    carrier = np.exp(2j * np.pi * frequency * n / parameters.rate)
    parts = [
        UltrasonicPlate(parameters, finger).run(part[:, None]).motion[-1, 0] for part in (carrier.real, carrier.imag)
    ]
    return (parts[0] + 1j * parts[1]) / carrier[-1]


def held(parameters, frequency, load=0.0, rise=0.0):
    """Response with the hold at a carrier, and what the images of the hold add to it at the sampling instants."""
    image = frequency + parameters.rate * np.arange(-300, 301)
    hold = np.sinc(image / parameters.rate) * np.exp(-1j * np.pi * image / parameters.rate)
    response = parameters.force_constant * hold / parameters.dynamic_stiffness(image, load, rise)
    return response[300], response.sum() - response[300]


@pytest.mark.parametrize(
    ("level", "finger", "load", "offset"),
    [("carrier", FREE, 0.0, 100.0), ("carrier", HELD, 0.5, -400.0), ("envelope", HELD, 0.5, 0.0)],
)
def test_measured_response_is_the_predicted_one(level, finger, load, offset):
    """Images past the 300th hold less than 2 f^2 F/(300^2 rate^3) < 4e-9 of it, with F the offset or the pole."""
    parameters = UltrasonicParameters(temperature_time=1e-3, **IDEAL)
    if level == "envelope":
        parameters = parameters.sampled(48e3, "envelope")
    frequency = parameters.carrier + offset
    expected = sum(held(parameters, frequency, load))
    assert abs(respond(parameters, frequency, finger) / expected - 1) < 2 * SETTLED + 4e-9


@pytest.mark.parametrize(("load", "offset"), [(0.0, 75.0), (0.5, -100.0), (0.5, 400.0)])
def test_the_envelope_error_is_that_of_the_responses(load, offset):
    """Which `test_measured_response_is_the_predicted_one` holds at either level."""
    carrier = UltrasonicParameters(**IDEAL)
    both = carrier, carrier.sampled(48e3, "envelope")
    gain = [each.force_constant / each.dynamic_stiffness(each.carrier + offset, load) for each in both]
    assert gain[0] / gain[1] - 1 == pytest.approx(complex(carrier.envelope_error(offset, load)), rel=1e-12)


def test_the_sensor_rounds_clips_and_has_its_noise():
    parameters = UltrasonicParameters(sensor_range=4e-6, sensor_bits=8, sensor_noise=0.0)
    drive = 10.0 * np.cos(2 * np.pi * 30e3 * np.arange(1500) / 192e3)[:, None]
    read = UltrasonicPlate(parameters, FREE).run(drive)
    over = abs(read.motion[:, 0]) > 2e-6
    np.testing.assert_array_equal(read.flags, np.where(over, Flag.SENSOR_CLIPPED, 0))
    assert 50 < over.sum() < 1450
    assert abs(read.sensed).max() <= 2e-6
    step = 4e-6 / 256
    np.testing.assert_allclose(read.sensed / step, np.round(read.sensed / step), rtol=0, atol=128 * ROUNDING)
    assert abs(read.sensed - read.motion)[~over].max() <= step / 2 * (1 + 1e-9)
    noise = UltrasonicPlate(UltrasonicParameters(sensor_bits=0), FREE, seed=1).run(np.zeros((20_000, 1))).sensed
    assert abs(noise.std() / 2e-9 - 1) < 4 / np.sqrt(2 * 20_000)  # four standard deviations of an estimate of rms


def test_the_drive_is_limited_rounded_and_safe_against_nonsense():
    parameters = UltrasonicParameters(drive_bits=4, sensor_noise=0.0)

    def first(volts):
        drive = np.array([[volts], [0.0]])
        return UltrasonicPlate(parameters, FREE).run(drive).motion[1, 0]

    assert first(25.0) == first(10.0) > first(8.75) > 0.0
    assert first(1.3) == first(1.25) == -first(-1.25) != 0.0  # 20 V in 16 steps
    assert [first(each) for each in (np.nan, np.inf, -np.inf)] == [0.0, 0.0, 0.0]


QUIET = UltrasonicParameters(**IDEAL)
SLIDE = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
NOMINAL = (0.5, 0.05)
BUMPS = 0.06 * np.sin(np.arange(300) / 9.0)


def parameters(**changes):
    return SurfaceParameters(level="envelope", sensor="tribometer", force_noise=0.0, mode=QUIET, **changes)


def loop(p):
    """A proportional amplitude loop on the mode's carrier, in the direction of the mode's velocity at resonance."""
    return Proportional(2e5, pulse=p.carrier_mode.carrier / p.carrier_mode.rate)


def by_parts(p, simulated, drive, load, speed):
    """True friction, measured friction, amplitude and flags by the parts' own public steps; `p` is assumed."""
    mode, law, contact = simulated.carrier_mode, p.friction_law.numbers, sliding_record(simulated)
    whole, true_whole = p.friction_coefficient * load, simulated.friction_coefficient * load
    plate, controller = UltrasonicPlate(mode, SLIDE), loop(p)
    decay, slew = 0.5 * float(mode.damping()) / mode.mass / mode.rate, full_slew(mode)
    before, reached, volts, rows = 0.0, -1.0, np.zeros((1, 1)), []
    for force in drive:
        ratio = p.bias + force / whole
        inside = min(max(ratio, p.least_ratio), 1.0)
        wanted, flags, squares = reference_amplitude(law, inside, load, speed), 0, []
        start = reached
        for k in range(p.substeps):
            line = before + (wanted - before) * (k + 1) / p.substeps
            rise = max(slew - decay * reached, 0.05 * slew)
            change = min(max(line - reached, -slew - decay * reached), rise)
            reached = reached + change if start >= 0.0 else line
            flags |= Flag.SATURATED if reached != line else 0
            played = plate.run(volts)
            volts = controller.run(played.sensed, np.array([reached]))
            q, rate = plate.state["z"][0]
            squares.append(q**2 + (rate * mode.rate / (2 * np.pi * float(mode.resonance(load)))) ** 2)
        before, amplitude = wanted, np.sqrt(np.mean(squares))
        steady = true_whole * friction_ratio(simulated.friction_law.numbers, amplitude, load, speed)
        rows.append((*sliding_step(contact[0], steady, speed, 0.0), amplitude, flags | (inside != ratio)))
    return np.array(rows)


@pytest.mark.parametrize("law", ["fit", "load-sharing", "intermittent"])
@pytest.mark.parametrize(
    "other", [{}, {"law": "intermittent", "friction_coefficient": 0.5}, {"law": "fit", "bias": 0.9}]
)
def test_a_surface_is_its_parts(law, other):
    """Sample by sample, to the rounding of 1200 steps; what is beyond the law's reach is flagged.

    Where the surface is another than its controller assumes, the reference is by what is assumed.
    """
    p = parameters(law=law)
    simulated = parameters(**{"law": law, **other})
    surface = UltrasonicSurface(simulated, loop(p), SLIDE, nominal=NOMINAL, assumed=p if other else None)
    drive = np.r_[BUMPS, 0.5]  # N: more than all of the friction
    played = surface.run(drive[:, None])
    friction, sensed, amplitude, flags = by_parts(p, simulated, drive, 0.4, 0.08).T
    columns = (played.motion[:, 0], played.sensed[:, 0], surface.amplitude)
    for found, expected in zip(columns, (friction, sensed, amplitude), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * abs(expected).max())
    np.testing.assert_array_equal(played.flags, flags)
    assert int(flags[-1]) & Flag.SATURATED
    assert np.ptp(amplitude[100:]) > 0.2 * amplitude.mean()  # it is modulated


def test_a_lifted_finger_leaves_no_friction_and_the_amplitude_of_the_nominal_one():
    p = parameters()
    surface = UltrasonicSurface(p, loop(p), hr.Finger.absent(), nominal=NOMINAL)
    played = surface.run(np.zeros((300, 1)))
    assert not played.motion.any()
    assert surface.state["reference"][0] == pytest.approx(float(p.friction_law.amplitude(p.bias, *NOMINAL)), rel=1e-12)
