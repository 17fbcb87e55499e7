"""The default controller in blocks: the observer of single samples, for every device and kind of target."""

from dataclasses import replace

import numpy as np
import pytest
from test_kernel import IDEAL, RATE, plate_controller, tones, waveform_of

import hapticrender as hr
from hapticrender.control.controller_design import ONE_SPEED, design_controller
from hapticrender.plants.plate import Plate
from hapticrender.renderers.electroadhesion import ElectroadhesionRenderer
from hapticrender.touch.mechanics import HEAVY

NOTHING = {"integral": 0.0, "integral_medium": 0.0, "integral_high": 0.0, "adaptation": -1.0, "contact_on": 1e9}


def observer(p, y, carriers):
    """Error envelopes and DC estimate of the observer of docs/theory.md after all samples, R = 0."""
    g, envelope = p["observer"], np.zeros((2, carriers.shape[1]), complex)
    dc, drift = np.zeros(2), np.zeros(2)
    for n in range(len(y)):
        e = y[n] - dc - (envelope * carriers[n]).real.sum(axis=1)
        envelope = envelope + g * np.outer(e, carriers[n].conj())
        dc, drift = dc + drift + p["dc"] * e, drift + p["dc_drift"] * e
    return envelope, dc


@pytest.mark.parametrize("block", [3, 64])
@pytest.mark.parametrize("moves", [False, True])
def test_the_observer_in_blocks_is_that_of_single_samples(block, moves, rng):
    """The triangular solve is exact: only roundings differ, some K of them a sample, each forgotten at the pole."""
    bands = tones(np.arange(20.0, 401.0, 20.0), 1e-30)
    if moves:
        bands = tones(np.zeros(4), 1e-30, wavenumber=[1000.0, 2000.0, 3000.0, 4000.0])
    controller = plate_controller(bands, delay=64, block=block, detects=0.0, crowd_speed=0.0, **NOTHING)
    before, n = 2000 // block * block, 40 * block  # samples in which the finger's tracker settles and targets fade in
    sensed, time = np.vstack([np.zeros((before, 2)), 1e-5 * rng.standard_normal((n, 2))]), np.arange(before + n) / RATE
    position = 0.1 * time if moves else 0.0 * time
    controller.run(sensed, position, 0.0 * time)
    y = sensed[before:] @ controller.settings["coordinate_from_sensor"][:, :2].T
    carriers = np.exp(1j * bands.carrier_phase(time, position)[before:])
    expected, dc = observer(controller.settings, y, carriers)
    found = [controller.field(f"e{i}_re") + 1j * controller.field(f"e{i}_im") for i in (0, 1)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * abs(expected).max())
    np.testing.assert_allclose(controller.state[0]["dc"], dc, rtol=0, atol=1e-12 * abs(dc).max())


@pytest.mark.parametrize("block", [2, 25])
def test_a_recorded_waveform_is_analysed_in_blocks_as_sample_by_sample(block, rng):
    """The envelopes found in the waveform are those of the observer; the target follows them once a block."""
    bands, n = waveform_of(tones([47.0, 130.0, 261.0])), 40 * block
    controller = plate_controller(bands, delay=64, block=block)
    wanted = 1e-5 * rng.standard_normal(n)
    controller.run(np.zeros((n, 2)), np.zeros(n), wanted)
    carriers = np.exp(1j * bands.carrier_phase(np.arange(n) / RATE, np.zeros(n)))
    raw = np.zeros(3, complex)
    for k in range(n):
        raw = (
            raw
            + controller.settings["waveform_gain"] * (wanted[k] - (raw * carriers[k]).real.sum()) * carriers[k].conj()
        )
    found = controller.field("raw_re") + 1j * controller.field("raw_im")
    np.testing.assert_allclose(found, raw, rtol=0, atol=1e-12 * abs(raw).max())


def in_closed_loop(plant, controller, seconds):
    """Motion of the middle and flags, from the plant's own loop."""
    n = round(seconds * plant.rate) // controller.block * controller.block
    _, _, flags, sensed = plant.closed_loop(controller, np.zeros(n))
    return sensed.motion[:, 0], flags


def late_error(motion, bands, rate):
    """Rms error of the band's envelope over the target in windows of 0.1 s, from 1.5 s on."""
    size, n = round(0.1 * rate), np.arange(len(motion))
    turned = 2 * motion * np.exp(-1j * bands.carrier_phase(n / rate, 0.0 * n)[:, 0])
    windows = turned[: len(turned) // size * size].reshape(-1, size).mean(axis=1)[15:]
    return np.sqrt((abs(windows / bands.envelope[0] - 1) ** 2).mean())


@pytest.mark.parametrize(("rate", "block"), [(5000.0, 10), (5000.0, 25), (48_000.0, 64)])
def test_a_plate_in_blocks_follows_as_well_as_in_samples(rate, block):
    """Free: to 1e-8.  Under a sliding finger: what the finger's impedance adds while the loop's delay passes.

    The finger turns the plate's stiffness by dD in a time tau = stroke/speed; feedback that is later by t leaves an
    error of the order of t/tau of that more, here t = block/rate and tau = 0.5 s: 0.4 to 1 %.
    """
    bands, errors = tones([170.0]), {}
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.6, mechanics=HEAVY, span=0.04)
    for name, size in (("samples", 1), ("blocks", block)):
        parameters = replace(IDEAL, rate=rate, delay=size)
        controller = plate_controller(bands, parameters=parameters, delay=size, block=size)
        free, flags = in_closed_loop(Plate(parameters, hr.Finger.absent(), block=size), controller, 2.5)
        assert not flags.any()
        controller = plate_controller(bands, parameters=parameters, delay=size, block=size)
        slid, _ = in_closed_loop(Plate(parameters, finger, block=size), controller, 3.0)
        errors[name] = late_error(free, bands, rate), late_error(slid, bands, rate)
    assert max(errors["samples"][0], errors["blocks"][0]) < 1e-8
    assert errors["blocks"][1] < errors["samples"][1] + block / rate / 0.5


def friction_session(block):
    """Simulated electroadhesion screen that takes blocks, and a controller for a friction of 0.1 N at 72 Hz."""
    finger = hr.Finger.sliding(speed=0.05, normal_load=1.0)
    texture = hr.Grating(frequency=72.0, amplitude=0.64 * 0.1 / (2 * np.pi * 72.0))
    scene = hr.Scene(texture=texture, finger=finger, device="electroadhesion", duration=2.0, keep_unfelt=True)
    opened = ElectroadhesionRenderer().open(scene)
    model = replace(opened.model, delay=block, block=block)
    return opened.plant, design_controller("h2", model, opened.bands, ONE_SPEED)


@pytest.mark.parametrize("block", [10, 64])
def test_a_friction_device_in_blocks_follows_its_target(block):
    """Friction of the screen, handed over in blocks, over 72 whole periods: within 1 %, the accuracy suite's bound."""
    plant, controller = friction_session(block)
    drive, motion, n = np.zeros((block, 1)), [], 2 * int(plant.rate) // block
    for _ in range(n):
        sensed = plant.run(drive)
        motion.append(sensed.motion[:, 0])
        drive, target, _ = controller.run(sensed.sensed, sensed.position, np.zeros(block))
    assert controller.block == block
    late = np.concatenate(motion)[: 2 * int(plant.rate) // block * block][-int(plant.rate) :]
    found = abs(2 * np.mean((late - late.mean()) * np.exp(-2j * np.pi * 72.0 * np.arange(late.size) / plant.rate)))
    assert found == pytest.approx(abs(target[-1, 0]), rel=0.01)
    assert abs(target[-1, 0]) == pytest.approx(0.1, rel=0.01)
