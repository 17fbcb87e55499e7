"""Sensors of friction devices that fail during a run through `render`: what is stopped, how soon, and what is not."""

import numpy as np
import pytest
from electroadhesive import Screen
from scipy.signal import step
from strangers_resonator import Resonator
from test_ultrasonic_rendering import watched

import hapticrender as hr
from hapticrender.control.supervisor_kernel import JUMP_NEIGHBOURS
from hapticrender.jit import entry, record
from hapticrender.plants.electroadhesion import DRY, MOIST, NORMAL
from hapticrender.plants.ultrasonic import UltrasonicParameters
from hapticrender.renderers import conversions

START = 0.21  # s: when the sensor fails; at a zero of the vibration (0.2 s) a dead one is named frozen, as soon
ZERO = 2e-3  # s from the stop to zero drive
FINGER = hr.Finger.sliding(speed=0.08, normal_load=0.4, span=0.18)
DEVICES = {
    "ultrasonic": lambda finger, tell: Resonator(load=lambda time: 0.4, tell=tell, block=16),  # shares no code
    "electroadhesion": lambda finger, tell: Screen(blind=False, block=10, finger=finger, tell=tell),
}
FAULTS = {  # what is sensed instead of `sensed`, of which `last` was the last sample
    "healthy": lambda sensed, last, rng: sensed,
    "frozen": lambda sensed, last, rng: np.broadcast_to(last, sensed.shape),
    "dead": lambda sensed, last, rng: 0.0 * sensed,
    "no numbers": lambda sensed, last, rng: np.nan * sensed,
    "inverted": lambda sensed, last, rng: -sensed,
    "gain of 3": lambda sensed, last, rng: 3.0 * sensed,
    "gain of 1/3": lambda sensed, last, rng: sensed / 3.0,
    "noise": lambda sensed, last, rng: 1e-9 * rng.standard_normal(sensed.shape),
}


def spoiled(kind, fault):
    """A device whose sensor fails at `START`."""
    rng, last = np.random.default_rng(1), [0.0]

    def tell(sample, sensed):
        if sample < START * device.rate:
            last[0] = sensed.sensed[-1].copy()
            return sensed._replace(motion=None)
        return sensed._replace(sensed=FAULTS[fault](sensed.sensed, last[0], rng), motion=None)

    device = DEVICES[kind](FINGER, tell=tell)
    return device


def run(kind, fault):
    """Run twice as long as until it fails: the device, its recording, and what stopped it, or None."""
    device = spoiled(kind, fault)
    texture = hr.Grating(frequency=100.0, velocity=10e-3)
    scene = hr.Scene(texture=texture, finger=FINGER, device=kind, duration=2 * START)
    try:
        return device, hr.render(scene, driver=device), None
    except hr.DeviceFault as found:
        return device, found.recording, found


def largest(blocks, rate):
    """Largest magnitude before `START`, from 0.1 s on, and after it."""
    values, at = abs(np.concatenate(blocks)[:, 0]), round(START * rate)
    return values[round(0.1 * rate) : at].max(), values[at:].max()


STOPPED = [  # and within which time (s)
    ("ultrasonic", "frozen", 0.1e-3, "one value repeats"),
    ("ultrasonic", "no numbers", 8e-3, "samples are no numbers"),
    *(("ultrasonic", fault, 0.1e-3, "jumped") for fault in ("dead", "inverted", "gain of 3", "gain of 1/3", "noise")),
    ("electroadhesion", "frozen", 8e-3, "one value repeats"),
    ("electroadhesion", "dead", 0.3e-3, "jumped from one sample to the next"),
    ("electroadhesion", "noise", 0.3e-3, "jumped from one sample to the next"),
    ("electroadhesion", "gain of 3", 0.3e-3, "jumped from one sample to the next"),
    ("electroadhesion", "gain of 1/3", 0.3e-3, "jumped from one sample to the next"),
    ("electroadhesion", "no numbers", 8e-3, "samples are no numbers"),
]


@pytest.mark.parametrize(("kind", "fault", "within", "cause"), STOPPED)
def test_a_sensor_that_fails_is_stopped(kind, fault, within, cause):
    """Zero drive within 10 ms of the fault, a screen's bias included; the sample at the end of the fade is the last.

    The amplitude grows by N u/(2 m w) at most, u the largest drive.
    """
    device, recording, found = run(kind, fault)
    assert found is not None
    assert cause in str(found)
    assert START <= found.time <= START + within
    assert recording.flags[-1] & hr.Flag.STOPPED
    drive = np.concatenate(device.played)[:, 0]
    assert not drive[round((found.time + ZERO) * device.rate) + device.delay :].any()
    before, after = largest(device.moved, device.rate)
    quiet, loud = largest(device.played, device.rate)
    if kind == "electroadhesion" or "jumped" in cause:
        assert loud <= quiet
        assert after <= before
    else:
        p = UltrasonicParameters()
        slope = p.force_constant * loud / (4 * np.pi * p.frequency * p.modal_mass)
        assert loud <= p.drive_limit
        assert after < before + slope * (found.time - START + ZERO / 10)


@pytest.mark.parametrize("kind", DEVICES)
def test_a_healthy_device_is_not_stopped(kind):
    device, recording, found = run(kind, "healthy")
    assert found is None
    assert not (recording.flags & hr.Flag.STOPPED).any()
    for blocks in (device.played, device.moved) if kind != "electroadhesion" else ():
        before, after = largest(blocks, device.rate)
        assert after == pytest.approx(before, rel=0.01)


def test_a_tribometer_that_is_inverted_is_not_stopped():
    """Friction is a magnitude: the sign of what is sensed is that of the finger's direction."""
    device, recording, found = run("electroadhesion", "inverted")
    assert found is None
    assert recording.summary()["verdict"] == "passed"
    before, after = largest(device.played, device.rate)
    assert after == pytest.approx(before, rel=0.01)


@pytest.mark.parametrize(("leak", "block"), [(DRY, 1), (NORMAL, 10), (MOIST, 10)])
def test_no_finger_makes_a_tribometer_jump(leak, block):
    """Touches, lifts, turns, and loads that come and go by a factor of 20 within no time."""
    loads = (0.0, 0.1, 0.10001, 0.2, 0.20001, 0.25, 0.251, 0.35, 0.35001), (0.2, 0.2, 4.0, 4.0, 0.2, 0.2, 4.0, 4.0, 0.2)
    touches = ((0.0, 0.3), (0.325, 0.4), (0.425, 0.5))
    finger = hr.Finger.sliding(speed=0.2, normal_load=loads, span=0.03, touches=touches)
    device = Screen(blind=False, block=block, finger=finger, gap_resistance=leak)
    texture = hr.Grating(frequency=400.0, velocity=40e-3)
    recording = hr.render(
        hr.Scene(texture=texture, finger=finger, device="electroadhesion", duration=0.5), driver=device
    )
    assert not (recording.flags & hr.Flag.STOPPED).any()


@entry
def jumped(state, blocks):
    """Whether vibrations jump in blocks (m, (n, blocks, samples)), of which each row is a vibration of its own."""
    found = np.zeros(blocks.shape[:2], np.bool_)
    resonant = record(state, conversions.RESONANT_T, 0)
    for n in range(blocks.shape[0]):
        resonant.before = resonant.last = np.nan
        for k in range(blocks.shape[1]):
            found[n, k] = conversions.jumps(resonant, blocks[n, k], 0, blocks.shape[2], False)
    return found


def test_a_vibration_that_jumps_is_found_at_any_phase_and_a_healthy_one_never_jumps(rng):
    """In the block; 0.9 um in 2 nm of noise, which decays as under the finger that damps most, or does not, for 5 s.

    A dead sensor that falls to 0 from near it is found as one that repeats a value.
    """
    driver = hr.prepare(
        hr.Scene(texture=hr.Grating(frequency=100.0, velocity=10e-3), finger=FINGER, device="ultrasonic", duration=0.6),
        driver=watched(FINGER, tell=lambda sample, sensed: sensed),
    ).driver
    mode = driver.parameters.mode
    worst = mode.damping() + 3.0 * (mode.damping(15.0) - mode.damping())
    jumps = lambda blocks: jumped(driver.state.ctypes.data, blocks)  # noqa: E731
    assert not jumps(2e-9 * rng.standard_normal((1, 1, 100))).any()  # at rest, before all else
    turns = 2 * np.pi * (mode.frequency - 60.0) / driver.driver.rate * np.arange(32)  # off by two half widths
    phase = np.arange(0, 2 * np.pi, 0.1)[:, None]
    for gain in (3.0, 1 / 3, -1.0):
        steady = 0.9e-6 * np.cos(turns + phase) + 2e-9 * rng.standard_normal((len(phase), 32))
        assert (jumps((steady * np.repeat([1.0, gain], 16)).reshape(-1, 2, 16)) == [False, True]).all()
    for damping in (0.0, float(worst)):
        decay = np.exp(-damping / (2 * mode.modal_mass * driver.driver.rate) * np.arange(32))
        values = 0.9e-6 * decay * np.cos(turns + rng.uniform(0, 6.3, (30_000, 1)))
        assert not jumps((values + 2e-9 * rng.standard_normal(values.shape))[:, None]).any()


def test_a_sensor_that_is_noisier_than_stated_is_no_jump():
    """40 nm where 2 nm are stated."""
    device = Resonator(load=lambda time: 0.4, noise=40e-9, block=48)
    texture = hr.Grating(frequency=100.0, velocity=10e-3)
    recording = hr.render(hr.Scene(texture=texture, finger=FINGER, device="ultrasonic", duration=0.3), driver=device)
    assert not (recording.flags & hr.Flag.STOPPED).any()


@pytest.mark.parametrize("damping", [0.44, 0.65, 1.0])
def test_a_mass_shows_no_step_alone(damping):
    """Its largest step between samples has a large one beside it, at any phase; test 12 needs less."""
    omega, ratios = 2 * np.pi * 1300.0, []
    time = np.arange(4000) * 2 * damping / omega / 200  # parts of the longest sample for which test 12 is designed
    shown = step(([omega**2], [1.0, 2 * damping * omega, omega**2]), T=time)[1]
    for phase in range(200):
        steps = abs(np.diff(np.r_[0.0, 0.0, shown[phase::200]]))
        largest_at = steps.argmax()
        ratios.append(steps[[largest_at - 1, largest_at + 1]].max() / steps[largest_at])
    assert min(ratios) > JUMP_NEIGHBOURS


@pytest.mark.parametrize("hold", [2, 10])
def test_a_converter_that_holds_its_values_is_no_jump(hold):
    """Under a load that comes within no time, and in a fast grating."""
    play_steps(lambda sample, sensed: sensed._replace(sensed=sensed.sensed[np.arange(10) // hold * hold], motion=None))


@pytest.mark.parametrize(("lost", "after"), [(1, 0), (1, 1), (1, 4), (2, -1), (2, 0), (2, 3)])
def test_samples_that_are_lost_beside_a_step_of_load_are_no_jump(lost, after):
    """Their values are held meanwhile."""

    def tell(sample, sensed):
        late = sample + np.arange(10) - 3000 - after
        gone = (late >= 0) & (late < lost)
        return sensed._replace(sensed=np.where(gone[:, None], np.nan, sensed.sensed), motion=None)

    play_steps(tell)


def play_steps(tell):
    """Play a screen whose sensor shows `tell` under loads that come and go within no time; a stop is an error."""
    loads = (0.0, 0.3, 0.30001, 0.35, 0.35001), (0.2, 0.2, 4.0, 4.0, 0.2)
    finger = hr.Finger.sliding(speed=0.08, normal_load=loads, span=0.05)
    device = Screen(blind=False, block=10, finger=finger, tell=tell)
    assert device.rate == 10e3
    texture = hr.Grating(frequency=400.0, velocity=40e-3)
    hr.render(hr.Scene(texture=texture, finger=finger, device="electroadhesion", duration=0.4), driver=device)
