"""The ultrasonic surface against its parts: mode, amplitude loop, friction law and contact, sample by sample."""

import numpy as np
import pytest
from proportional import Proportional

import hapticrender as hr
from hapticrender.plants.friction_laws import friction_ratio, reference_amplitude
from hapticrender.plants.sliding_contact import sliding_record, sliding_step
from hapticrender.plants.ultrasonic import UltrasonicParameters, UltrasonicPlate
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, UltrasonicSurface, full_slew
from hapticrender.protocols import Flag

QUIET = UltrasonicParameters(sensor_noise=0.0, sensor_bits=0, drive_bits=0)
SLIDE = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
NOMINAL = (0.5, 0.05)
BUMPS = 0.06 * np.sin(np.arange(300) / 9.0)


def parameters(**changes):
    return SurfaceParameters(level="envelope", sensor="tribometer", force_noise=0.0, mode=QUIET, **changes)


def loop(p):
    """A proportional amplitude loop on the mode's carrier, in the direction of the mode's velocity at resonance."""
    return Proportional(2e5, pulse=p.carrier_mode.carrier / p.carrier_mode.rate)


def twin(p, drive, whole, load, speed):
    """True friction, measured friction, amplitude and flags by the parts' own public steps."""
    mode, law, contact = p.carrier_mode, p.friction_law.numbers, sliding_record(p)
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
        steady = whole * friction_ratio(law, amplitude, load, speed)
        rows.append((*sliding_step(contact[0], steady, speed, 0.0), amplitude, flags | (inside != ratio)))
    return np.array(rows)


@pytest.mark.parametrize("law", ["fit", "load-sharing", "intermittent"])
def test_a_surface_is_its_parts(law):
    """Sample by sample, to the rounding of 1200 steps; what is beyond the law's reach is flagged."""
    p = parameters(law=law)
    surface = UltrasonicSurface(p, loop(p), SLIDE, nominal=NOMINAL)
    drive = np.r_[BUMPS, 0.5]  # N: more than all of the friction
    played = surface.run(drive[:, None])
    friction, sensed, amplitude, flags = twin(p, drive, p.friction_coefficient * 0.4, 0.4, 0.08).T
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
