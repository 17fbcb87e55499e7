"""Limits of the band bank: overload, resolution, junk, silence, time without end, and reversals through zero speed."""

import dataclasses

import numpy as np
import pytest
from held import fixed, grating
from hypothesis import given
from hypothesis import strategies as st
from synthetic import make_bands

import hapticrender as hr
from hapticrender.control.methods import METHODS
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Flag

RATE = 5000.0
IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0}
OURS = pytest.mark.parametrize("method", ["h", "h2"])


def design(method, bands, parameters=None, **changes):
    parameters = parameters or PlateParameters()
    model = parameters.device_model(parameters.rate, parameters.delay)
    return METHODS[method].design(dataclasses.replace(model, **changes), bands)


@OURS
def test_a_target_grows_over_its_ramp_and_does_not_strike_the_modes(method):
    """50 ms leave a peak of x1.02 near the modes, where a step leaves x1.5-1.75."""
    for frequency in (143.0, 170.0):
        controller = design(method, fixed((frequency, 1e-5)), PlateParameters(**IDEAL))
        _, target, _, sensed = Plate(PlateParameters(**IDEAL), hr.Finger.absent()).closed_loop(
            controller, np.zeros(5000)
        )
        ramp = round(1 / controller.settings["fade_in"])
        n = np.arange(1, ramp + 1) / ramp
        np.testing.assert_allclose(target[: n.size, 0].real, 1e-5 * n**2 * (3 - 2 * n), rtol=0, atol=1e-17)
        assert abs(sensed.motion[:, 0]).max() <= 1.03e-5


JUNK = st.one_of(
    st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 1e300, 5e-324]), st.floats(allow_nan=True, width=64)
)
SPOILT = st.lists(st.tuples(st.integers(0, 599), st.sampled_from(["sensed", "position", "wanted"]), JUNK), max_size=30)


@pytest.mark.parametrize(
    ("method", "analysed", "block"), [("h", True, 1), ("h2", True, 10), ("paper", False, 1), ("static", True, 1)]
)
@given(spoilt=SPOILT)
def test_drive_is_finite_and_inside_its_limit_whatever_comes_in(method, analysed, block, spoilt):
    """Any number at any sample of any input: the implausible ones that are read raise a flag, and no state is lost."""
    bands = make_bands([47.0, 0.0], None if analysed else 1e-5, [0.0, 500.0])
    controller = design(method, bands, block=block, delay=block)
    time = np.arange(900) / RATE
    given_ = {
        "sensed": 1e-5 * np.sin(300 * time)[:, None] * np.ones(2),
        "position": 0.1 * time,
        "wanted": 1e-5 * np.cos(2 * np.pi * 47 * time),
    }
    for n, name, value in spoilt:
        given_[name][n] = value
    drive, target, flags = controller.run(given_["sensed"], given_["position"], given_["wanted"])
    assert np.isfinite(drive).all()
    assert abs(drive).max() <= controller.settings["drive_limit"]
    assert np.isfinite(target).all()
    for name in controller.tiles.dtype.names:
        assert np.isfinite(controller.tiles[name]).all(), name
    for (n, name), value in {(n, name): value for n, name, value in spoilt}.items():
        unread = np.isnan(value) if name == "position" else name == "wanted" and not analysed  # NaN there: no finger
        absurd = not abs(value) <= 1e3 and not unread
        assert not absurd or flags[n] & Flag.NONFINITE, (n, name, value)


SPEED, SWIPES = 50e-3, 3.0  # m/s at most, swipes there and back a second


def swipe(method, wavelength, mechanics):
    """Drive, frequency and its largest sweep (Hz/s) after the first 1.5 s of 10 um under swipes, ideal electronics."""
    time, load = np.arange(17_500) / RATE, 0.0 if mechanics == "none" else 0.8
    finger = hr.Finger.swiping(frequency=SWIPES, speed=SPEED, normal_load=load, mechanics=mechanics)
    parameters = PlateParameters(**IDEAL)
    controller = design(method, grating(wavelength, 1e-5), parameters)
    drive, _, flags, _ = Plate(parameters, finger).closed_loop(controller, np.zeros(17_500))
    assert not flags.any()
    frequency = SPEED / wavelength * np.cos(2 * np.pi * SWIPES * time)
    return drive[7500:], frequency[7500:], 2 * np.pi * SWIPES * SPEED / wavelength


@pytest.mark.parametrize(
    ("method", "mechanics", "wavelength"), [("h", "none", 1e-3), ("h2", "none", 2e-3), ("h2", "heavy", 0.5e-3)]
)
def test_reversals_through_zero_speed_do_not_click(method, mechanics, wavelength):
    """3 Hz swipes of +-50 mm/s: no step in drive larger than its own slope at the band's frequency.

    With h2, what is left of 30 mA below 10 Hz stays under one step of the 12-bit command, 1.46 mA.

    A drive of size A cos(phi) moves by at most A w/rate a sample, w the highest; while the carrier fades between 20
    and 10 Hz, its third-order step of n samples adds A 1.5/n.
    """
    drive, frequency, sweep = swipe(method, wavelength, mechanics)
    size, fade = abs(drive).max(), 10.0 / sweep * RATE
    fastest, slow = 2 * np.pi * np.array([abs(frequency).max(), 20.0]) / RATE
    assert size > 0.02
    assert abs(np.diff(drive, axis=0)).max() <= size * max(fastest, slow + 1.5 / fade)
    assert abs(np.diff(drive, 2, axis=0)).max() <= size * fastest  # a lone step, with the carrier's slope taken out
    assert method == "h" or abs(drive[abs(frequency) < 9.0]).max() < PlateParameters().current_step


EXTREMES = {  # plate, carriers
    "delay of 5 samples": ({"delay": 5}, [47.0, 189.0]),
    "20 kHz": ({"rate": 20_000.0}, [47.0, 189.0]),
    "48 kHz": ({"rate": 48_000.0}, [47.0, 189.0]),
    "one band at 20 Hz": ({}, [20.0]),
    "32 bands": ({}, np.linspace(20.0, 330.0, 32)),
    "half a hertz apart": ({}, [100.0, 100.5]),
}


@pytest.mark.parametrize("extreme", EXTREMES)
def test_h2_holds_at_the_edges_of_its_range(extreme):
    """Noise-free and unquantised, free plate: every band within 0.1 % from 3 s on."""
    plate, carriers = EXTREMES[extreme]
    parameters = PlateParameters(**IDEAL, **plate)
    carriers, wanted = np.array(carriers), 1e-5 / np.sqrt(len(carriers))
    controller = design("h2", fixed(*((f, wanted) for f in carriers)), parameters)
    samples = int(5 * parameters.rate)
    drive, _, _, sensed = Plate(parameters, hr.Finger.absent()).closed_loop(controller, np.zeros(samples))
    turns = np.multiply.outer(np.arange(samples)[-round(2 * parameters.rate) :] / parameters.rate, carriers)
    basis = np.concatenate([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)
    found = np.linalg.lstsq(basis, sensed.motion[-len(basis) :, 0], rcond=None)[0]
    real, imaginary = found[: len(carriers)], -found[len(carriers) :]
    np.testing.assert_allclose(real + 1j * imaginary, wanted, rtol=0, atol=1e-3 * wanted)
    assert abs(drive).max() < parameters.current_limit
