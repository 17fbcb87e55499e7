"""Gratings: waveform, bands and refusals."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hapticrender.touch.grating import Grating

TIME = np.linspace(0.0, 0.1, 501)

GRATINGS = {
    "sine in time": Grating(amplitude=10e-6, frequency=111.0, phase=0.7),
    "sine in space": Grating(amplitude=10e-6, wavelength=1e-3, phase=-2.0),
    "square in time": Grating(amplitude=1e-6, frequency=31.0, shape="square", phase=0.3),
    "triangle in space": Grating(amplitude=1e-6, wavelength=2e-3, shape="triangle", harmonics=3, phase=1.0),
    "inharmonic": Grating(amplitude=5e-6, frequency=20.0, partials=((1, 1.0, 0.0), (2.7, -0.5, 1.2))),
}


def test_a_spatial_grating_is_read_at_the_position_only():
    ridges = Grating(amplitude=10e-6, wavelength=1e-3)
    position = np.concatenate([np.linspace(-0.02, 0.03, 700), np.linspace(0.03, -0.02, 300)])
    expected = 10e-6 * np.cos(2 * np.pi * position / 1e-3)
    for time in (np.arange(1000) / 5000, np.full(1000, 7.0)):
        np.testing.assert_allclose(ridges.waveform(time, position), expected, atol=1e-6 * 1e-9)


def test_a_spatial_grating_is_still_while_lifted_and_a_tone_is_not():
    position = np.array([0.0, np.nan, 0.0005, np.nan])
    time = np.zeros(4)
    assert Grating(amplitude=1e-6, wavelength=1e-3).waveform(time, position).tolist() == [1e-6, 0.0, -1e-6, 0.0]
    assert Grating(amplitude=1e-6, frequency=50.0).waveform(time, position).tolist() == [1e-6] * 4


@pytest.mark.parametrize("name", GRATINGS)
def test_bands_carry_the_waveform(name):
    grating = GRATINGS[name]
    position = 0.02 * np.sin(2 * np.pi * 3 * TIME)
    bands = grating.bands(rate=5000.0)
    summed = (bands.envelope * np.exp(1j * bands.carrier_phase(TIME, position))).real.sum(axis=1)
    np.testing.assert_allclose(grating.waveform(TIME, position), summed, atol=1e-9 * grating.amplitude)


@pytest.mark.parametrize(("shape", "order"), [("square", 1), ("triangle", 3)])
def test_partials_converge_to_the_shape_at_the_order_of_their_series(shape, order):
    """Coefficients fall as 1/n (square) or 1/n^2 (triangle): the power left out falls as N^-1 or N^-3."""
    turns = (np.arange(1 << 14) + 0.5) / (1 << 14)
    ideal = {"square": np.sign(np.cos(2 * np.pi * turns)), "triangle": np.abs(4 * turns - 2) - 1}[shape]
    left_out = []
    for harmonics in (8, 16):
        grating = Grating(amplitude=1e-3, frequency=1.0, shape=shape, harmonics=harmonics)
        left_out.append(np.mean((grating.waveform(turns, turns) / 1e-3 - ideal) ** 2))
    assert np.log2(left_out[0] / left_out[1]) == pytest.approx(order, abs=0.02)


def test_velocity_and_level_become_the_amplitude():
    """Closed form: 0.06 m/s is 0.48 mm at 20 Hz and 0.024 mm at 400 Hz; threshold 0.63 um at 100 Hz."""
    assert Grating(velocity=0.06, frequency=20.0).amplitude == pytest.approx(0.48e-3, abs=0.005e-3)
    assert Grating(velocity=0.06, frequency=400.0).amplitude == pytest.approx(0.024e-3, abs=0.0005e-3)
    assert Grating(velocity=0.06, wavelength=1e-3, speed=0.4).amplitude == pytest.approx(0.024e-3, abs=0.0005e-3)
    assert Grating(level=20.0, frequency=100.0).amplitude == pytest.approx(6.3e-6, rel=1e-12)
    assert Grating(level=-20.0, wavelength=1e-3, speed=0.1).amplitude == pytest.approx(0.063e-6, rel=1e-12)


@pytest.mark.parametrize(
    "stated", [{"velocity": 0.01, "frequency": 70.0}, {"level": 0, "wavelength": 1e-3, "speed": np.float32(0.1)}]
)
def test_gratings_are_equal_however_they_were_stated(stated):
    grating = Grating(**stated, shape="square")
    again = replace(grating, velocity=None, level=None, speed=None)
    plain = Grating(grating.amplitude, stated.get("frequency"), stated.get("wavelength"), "square")
    for other in (again, plain, pickle.loads(pickle.dumps(grating)), replace(grating, phase=0.0)):
        assert other == grating
        assert hash(other) == hash(grating)
    assert repr(plain) == repr(grating)
    assert {type(value) for value in (grating.amplitude, grating.frequency or grating.wavelength)} == {float}
