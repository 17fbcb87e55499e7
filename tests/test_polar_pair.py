"""The paper's controller in pairs of samples inside the plate's loop equals itself sample by sample."""

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.accuracy.plate import tones
from hapticrender.bands import Bands
from hapticrender.control.methods import METHODS
from hapticrender.control.polar.pair import in_pairs
from hapticrender.plants.closed import CLOSED, closed_plate_run
from hapticrender.plants.vibrotactile import Plate, PlateParameters

FLAWLESS = PlateParameters(current_bits=0, sensor_bits=0)  # rounding stays rounding
FINGER = hr.Finger.sliding(speed=0.08, normal_load=0.8, mechanics="heavy", touches=((0.02, 0.1), (0.14, 2.0)))
SAMPLES = 1200


def fixed(count):
    return tones(np.linspace(40.0, 400.0, count), 2e-6)


def grating():
    nothing = np.zeros(2)
    return Bands(
        frequency=nothing, wavenumber=np.array([1000.0, 2000.0]), phase=nothing, envelope=np.array([4e-6, 1e-6j])
    )


def disturbed(noise):
    """Noise with samples that no sensor can show, at odd and even counts, alone and in a row."""
    noise = noise.copy()
    noise[[301, 500], 0] = 1e4
    noise[700:703, 1] = np.nan
    return noise


def run(loop, method, bands, pieces, spoil=lambda noise: noise, parameters=FLAWLESS):
    """What is heard, done and told in `pieces` of so many samples, by one of the loops."""
    controller, plate = METHODS[method].design(parameters.band_model(5000.0, 1), bands), Plate(parameters, FINGER)
    finger, noise, flags = plate._next(SAMPLES)
    columns = [np.full((SAMPLES, k), np.nan) for k in (2, 3, 2)]
    target, noise = np.full((SAMPLES, len(bands.frequency)), np.nan + 0j), spoil(noise)
    start = 0
    while start < SAMPLES:
        part = slice(start, start + next(pieces))
        sensed, motion, drive = (each[part] for each in columns)
        given = finger[part], noise[part], np.zeros(len(sensed)), sensed, motion, drive, target[part], flags[part]
        loop(plate._tables, plate._state, controller.tables, controller.state, plate._last, *given)
        start = part.stop
    return *columns, target, flags


@pytest.mark.parametrize("method", ["paper", "paper-common"])
@pytest.mark.parametrize("bands", [fixed(3), fixed(11), grating()], ids=["a tile", "tiles", "finger-locked"])
@pytest.mark.parametrize("spoil", [lambda noise: noise, disturbed], ids=["believed", "doubted"])
def test_pairs_equal_single_samples(method, bands, spoil):
    """In any pieces, odd ones among them; only sums round elsewhere, 2e-16 in each of 1200 samples."""
    expected = run(closed_plate_run, method, bands, iter([SAMPLES]), spoil)
    assert abs(expected[2]).max() > 1e-3
    assert expected[4].any() == (spoil is disturbed)
    loop = CLOSED[type(METHODS[method].design(FLAWLESS.band_model(5000.0, 1), bands).tables)]
    assert loop is not closed_plate_run
    fresh = METHODS[method].design(FLAWLESS.band_model(5000.0, 1), bands)
    assert in_pairs(fresh.tables, fresh.state) == (method == "paper")
    for pieces in ([SAMPLES], [1, 2, 63, 1, 1, 64, 65, 300, 303, 400]):
        found = run(loop, method, bands, iter(pieces), spoil)
        for one, other in zip(found[:4], expected[:4], strict=True):
            assert np.isfinite(one[expected[4] == 0]).all()
            np.testing.assert_allclose(one, other, rtol=0, atol=3e-13 * np.nanmax(abs(other)))
        np.testing.assert_array_equal(found[4], expected[4])
