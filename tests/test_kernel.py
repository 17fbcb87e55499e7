"""The default controller's kernel: equal to its naive twin, to its pieces, and in blocks to its single samples."""

from dataclasses import replace

import numpy as np
import pytest
from naive_error import NaiveError
from synthetic import make_bands

import hapticrender as hr
from hapticrender.control.controller import setpoint_rows
from hapticrender.control.controller_design import ONE_SPEED, design_controller, rules_for
from hapticrender.control.device_model import FingerRange
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Flag
from hapticrender.touch.mechanics import HEAVY

RATE = 5000.0
IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0)


def tones(frequency, amplitude=10e-6, wavenumber=0.0, **options):
    return make_bands(frequency, amplitude, wavenumber, np.arange(len(frequency)), **options)


def waveform_of(bands):
    return replace(bands, envelope=None)


def plate_controller(bands, *, parameters=IDEAL, delay=1, block=1, rules=None, feedback=True, **settings):
    model = replace(parameters, delay=delay).device_model(parameters.rate, delay)
    rules = rules or rules_for(bands)
    controller = design_controller("h2", replace(model, block=block), bands, rules, feedback=feedback)
    for name, value in settings.items():
        controller.state["p"][name] = value
    return controller


def friction_controller(bands):
    """Of a device that is there only under a sliding finger, with a sensor that is late and a contact that lags."""
    finger = FingerRange(needs_contact=True, contact=None, least_speed=5e-3)
    changes = {
        "finger": finger,
        "sensor_delay": 1e-4,
        "contact_length": 2e-5,
        "contact_damping": 0.05,
        "typical_speed": 0.1,
        "drive_limit": 9.0,
    }
    model = replace(replace(IDEAL, coils=1).device_model(RATE, 1), **changes)
    return design_controller("h2", model, bands, ONE_SPEED)


def played_by_twin(controller, sensed, position, wanted):
    p = {name: controller.settings[name] for name in controller.settings.dtype.names}
    twin = NaiveError(p, setpoint_rows(controller.bands)[:, : controller.n_bands])
    rows = [twin.step(*row) for row in zip(sensed, position, wanted, strict=True)]
    return twin, *(np.array(column) for column in zip(*rows, strict=True))


def agree(controller, sensed, position, wanted):
    """Kernel and twin on the same samples; returns the twin and the kernel's flags.

    Carriers turn 64 times between two looks at their phase, three integrators of the finger's tracker multiply the
    rounding of a position by (rate/377)^3 in acceleration, and D cancels up to (189/400)^2 Q near a resonance: 1e-9 of
    the largest drive holds all of it, an error in a term of the law does not pass.
    """
    drive, target, flags = controller.run(sensed, position, wanted)
    twin, *expected = played_by_twin(controller, sensed, position, wanted)
    for found, each in ((drive, expected[0]), (target, expected[1])):
        np.testing.assert_allclose(found, each, rtol=0, atol=1e-9 * abs(each).max())
    np.testing.assert_array_equal(flags, expected[2])
    state = controller.state[0]
    numbers = [state[f"finger_{name}"] for name in ("mass", "damping", "stiffness")]
    np.testing.assert_allclose(numbers, [twin.m, twin.b, twin.k], rtol=1e-8, atol=1e-12)
    return twin, flags


def pressed(rng, bands, position, load=0.5, noise=1e-7):
    """Sensors of a plate that moves nearly as it should; a finger presses off its middle in the middle half."""
    n = len(position)
    phase = bands.carrier_phase(np.arange(n) / RATE, np.where(abs(position) < 1.0, position, np.nan))
    sensed = noise * rng.standard_normal((n, 2)) + 9e-6 * np.cos(phase - 0.1).sum(axis=1)[:, None]
    sag = -load / PlateParameters().stiffness_matrix[0, 0]
    sensed[n // 4 : 3 * n // 4] += sag * np.array([1.0, 1.4])
    return sensed


MANY = [20.0 + 45.0 * k for k in range(8)]
BANKS = {
    "1": tones([170.0]),
    "8": tones(MANY),
    "11": tones([*MANY, 380.0, 440.0, 480.0]),
    "crowded": tones([100.0, 120.0, 140.0]),
    "locked": tones([0.0, 0.0, 70.0], wavenumber=[500.0, 1000.0, 0.0]),
    "analysed": waveform_of(tones([47.0, 150.0])),
    "modulated and differentiated": tones([47.0, 150.0], 1e-8, modulated=True, differentiated=True),
}


@pytest.mark.parametrize(("name", "coils"), [*((name, 1 if name == "8" else 2) for name in BANKS)])
def test_the_kernel_is_its_twin(name, coils, rng):
    """Noise, a finger that comes, goes and turns back, samples that are no numbers, a drive at its limit."""
    bands, n = BANKS[name], 1800
    time = np.arange(n) / RATE
    position = 0.01 * np.cos(2 * np.pi * 2.0 * time)
    position[: 40 * (coils - 1)], position[1700] = np.nan, 1e9
    sensed = pressed(rng, bands, position)
    sensed[1400, 0], sensed[1450:1600] = np.nan, np.inf
    wanted = 1 + 0.3 * np.cos(30.0 * time) if bands.modulated else 1e-5 * np.cos(2 * np.pi * 47.0 * time)
    controller = plate_controller(bands, parameters=replace(IDEAL, coils=coils, current_limit=0.3))
    twin, flags = agree(controller, sensed, position, wanted)
    assert {flag for flag in (Flag.SATURATED, Flag.NONFINITE) if (flags & flag).any()} == {1, 2}
    assert twin.samples == n


def test_the_finger_is_adapted_as_in_the_twin(rng):
    """On a plate under a heavy finger, in closed loop, the same samples given to both."""
    bands, n = tones([70.0, 170.0, 261.0]), 2500
    controller = plate_controller(bands)
    plate = Plate(IDEAL, hr.Finger.still(5e-3, 0.8, mechanics=HEAVY), seed=2)
    _, _, _, sensed = plate.closed_loop(controller, np.zeros(n))
    again = plate_controller(bands)
    twin, _ = agree(again, sensed.sensed, sensed.position, np.zeros(n))
    assert twin.m == pytest.approx(controller.state[0]["finger_mass"], rel=1e-8)
    assert twin.contact
    assert twin.b > 0.1


@pytest.mark.parametrize("differentiated", [False, True])
def test_a_friction_device_is_its_twin(differentiated, rng):
    """Targets only in sliding contact, load always there, sensor delay and contact lag corrected."""
    bands = tones([0.0, 0.0], wavenumber=[1000.0, 2000.0], differentiated=differentiated)
    time = np.arange(2400) / RATE
    position = 0.02 * np.cos(2 * np.pi * 1.0 * time)
    position[:300] = position[1800:1950] = np.nan
    sensed = pressed(rng, bands, position) * (500.0 if differentiated else 1.0)
    controller = friction_controller(bands)
    agree(controller, sensed, position, np.zeros(2400))
    names = ("needs_contact", "corrected", "contact_damping", "least_speed", "sensor_delay", "contact_length")
    assert all(controller.settings[name] > 0 for name in names)


def test_the_gain_schedule_is_the_printed_one():
    """docs/theory.md: integral and adaptation (1/s), poles of the observer (Hz), times of the detectors (s)."""
    p = plate_controller(tones([170.0])).settings
    rates = [p[name] for name in ("integral", "integral_medium", "integral_high", "adaptation", "adaptation_high")]
    assert rates == pytest.approx([2.0, 15.0, 25.0, 1.0, 100.0])
    assert [p[name] * RATE / (4 * np.pi) for name in ("observer", "observer_high")] == pytest.approx([10.0, 20.0])
    assert [p[name] / RATE for name in ("fast_time", "slow_time")] == pytest.approx([0.15, 0.4])
    assert 1.0 / (p["release"] * RATE) == pytest.approx(0.05)
    crowded = plate_controller(tones([100.0, 139.0])).settings
    assert [(each["detects"], each["damper"]) for each in (p, crowded)] == [(1.0, 0.0), (0.0, 0.2)]


@pytest.mark.parametrize(("delay", "block"), [(1, 1), (64, 64)])
def test_phases_after_ten_hours(delay, block):
    """Set to what 10 h of counting leaves, the phase goes on right; counting itself rounds once a refresh.

    Each refresh (64 samples) adds a number below 1 turn to one below 1/2, off by 2^-53 turns at most each: 10 h of
    48 kHz are 2.7e7 refreshes, 2 pi 2.7e7 2^-52 = 3.8e-8 rad if all add up.  Shown over 1.5e4 of them.
    """
    rate, frequency, blocks = 48_000.0, [47.0, 111.3, 399.7], 15_000
    parameters = replace(IDEAL, rate=rate)
    controller = plate_controller(tones(frequency, 1e-9), parameters=parameters, delay=delay, block=block)
    n = 64 * blocks
    controller.run(np.zeros((n, 2)), np.zeros(n), np.zeros(n))
    exact = np.array([np.longdouble(f) * n / rate for f in frequency])
    apart = np.asarray((controller.field("turns") - exact + 0.5) % 1.0 - 0.5, float)
    a_refresh = abs(apart).max() / blocks
    assert a_refresh < 2.0**-52
    assert 2 * np.pi * a_refresh * 36_000 * rate / 64 < 1e-5
