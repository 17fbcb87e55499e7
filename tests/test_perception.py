"""Perception: the threshold's table and its inverses, and the bands that may be left out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic import make_bands

from hapticrender.bands import Bands
from hapticrender.touch import perception
from hapticrender.touch.perception import detection_threshold, drop_unfelt

# Bolanowski 1988, Verrillo 1963 and 1992, um peak; 3 Hz from the longer table of the same sources.
TABLE = {
    **{1: 28, 3: 25, 5: 18, 10: 11, 20: 6.3, 31.5: 4.7, 40: 4.0, 50: 2.5, 63: 1.7, 80: 1.06, 100: 0.63, 125: 0.40},
    **{160: 0.22, 200: 0.14, 250: 0.11, 300: 0.11, 400: 0.18, 500: 0.35, 700: 1.1, 1000: 5},
}
ROUNDING = 1e-12  # some 4000 units in the last place: logarithm, interpolation and power cost a few dozen

FREQUENCIES = st.floats(1.0, 1000.0)
AMPLITUDES = st.floats(1e-12, 1e-2)


@pytest.mark.parametrize("frequency", TABLE)
def test_the_classic_threshold_is_the_published_one(frequency):
    found = detection_threshold(float(frequency), "classic")
    assert found == pytest.approx(1e-6 * TABLE[frequency], rel=ROUNDING)


@pytest.mark.parametrize(("frequency", "below"), [(1, 6), (20, 6), (40, 10), (63, 10), (80, 25), (500, 25), (1000, 25)])
def test_the_safe_threshold_lies_below_the_classic_one_by_what_active_touch_gains(frequency, below):
    """docs/theory.md: -6 dB below 40 Hz, -10 dB from 40, -25 dB from 80; a border belongs to the lower side."""
    expected = 1e-6 * TABLE[frequency] * 10 ** (-below / 20)
    assert detection_threshold(frequency) == pytest.approx(expected, rel=ROUNDING)


def test_beyond_the_table_nothing_is_known_and_little_is_safe():
    below, above = np.array([0.0, 0.5, 0.999999]), np.array([1000.001, 5e3, 1e6])
    assert np.isnan(detection_threshold(np.concatenate([below, above]), "classic")).all()
    assert detection_threshold(below).tolist() == [0.0, 0.0, 0.0]
    assert (detection_threshold(above) <= detection_threshold(1000.0)).all()
    assert detection_threshold(5e3) == detection_threshold(1000.0)


@given(AMPLITUDES, FREQUENCIES)
def test_level_and_displacement_are_inverses(amplitude, frequency):
    """A level of up to 200 dB is known to 200 times 1e-16 dB; a dB is 12 % of the displacement."""
    level = perception.sensation_level(amplitude, frequency)
    assert perception.displacement(level, frequency) == pytest.approx(amplitude, rel=ROUNDING)
    assert perception.sensation_level(10 * amplitude, frequency) == pytest.approx(level + 20, abs=1e-10)


def test_levels_of_what_cannot_be_felt_and_of_what_nobody_measured():
    assert perception.sensation_level(0.0, 100.0) == -np.inf
    assert perception.sensation_level(1j * 1.06e-6, 80.0) == pytest.approx(0.0, abs=1e-10)
    assert np.isnan(perception.sensation_level(1e-6, np.array([0.5, 2000.0]))).all()


def test_roughness_counts_thresholds_of_the_pacinian_channel():
    at = detection_threshold(np.array([40.0, 250.0]), "classic")
    assert perception.roughness(at, np.array([40.0, 250.0])) == pytest.approx(2.0, rel=ROUNDING)
    assert perception.roughness(3j * at[1], 250.0) == pytest.approx(9.0, rel=ROUNDING)
    # An octave below 40 Hz the channel is 12 dB less sensitive in amplitude: a sixteenth of the power.
    assert perception.roughness(at[0], 20.0) == pytest.approx(1 / 16, rel=ROUNDING)
    assert perception.roughness(1.0, 0.0) == perception.roughness(1.0, 1000.001) == 0.0


LOUD = 1e-3  # m: felt wherever the threshold is known
DEVICE = {"top_speed": 0.1, "lowest": 10.0, "highest": 400.0}


def bands_of(*entries):
    """Bands of (frequency, wavenumber, amplitude), with phases by which they can be distinguished."""
    frequency, wavenumber, amplitude = np.array(entries, float).reshape(-1, 3).T
    return make_bands(frequency, amplitude * np.exp(0.3j), wavenumber, np.arange(frequency.size))


def left(*entries, **device):
    """Indices of the bands that stay beside a loud one, which is kept in any case."""
    bands = drop_unfelt(bands_of(*entries, (100.0, 0.0, LOUD)), **DEVICE | device)
    assert len(bands) + len(bands.unfelt) == len(entries) + 1
    return bands.phase[:-1].tolist()


@pytest.mark.parametrize("frequency", [1.0, 39.999, 40.0, 80.0, 250.0, 1000.0, 5e4])
def test_a_fixed_carrier_goes_just_below_the_safe_curve_and_stays_on_it(frequency):
    least = detection_threshold(frequency)
    assert left((frequency, 0.0, least * (1 - 1e-9))) == []
    assert left((frequency, 0.0, least * (1 + 1e-9))) == [0]


# Fixed part (Hz) and wavenumber (1/m) of a carrier, and where (Hz) it is felt best under a finger of up to 0.1 m/s in
# 10 to 400 Hz: at the top of its range, short of a border, on it, inside, and at the bottom (300 to 400 of 300 to 480).
LOCKED = [
    *((0.0, 2000.0, 200.0), (0.0, 390.0, 39.0), (0.0, 400.0, 40.0), (0.0, 5000.0, 250.0), (0.0, 1e6, 250.0)),
    *((60.0, 500.0, 110.0), (390.0, 900.0, 300.0)),
]


@pytest.mark.parametrize(("frequency", "wavenumber", "keenest"), LOCKED)
def test_a_locked_carrier_goes_only_if_it_is_unfelt_wherever_the_finger_takes_it(frequency, wavenumber, keenest):
    least = detection_threshold(keenest)
    assert left((frequency, wavenumber, least * (1 - 1e-9))) == []
    assert left((frequency, wavenumber, least * (1 + 1e-9))) == [0]


@given(st.floats(0, 600), st.floats(1.0, 1e4), st.floats(0.001, 1.0), st.floats(1.0, 100.0), st.floats(100.0, 2000.0))
def test_no_frequency_on_the_way_is_more_sensitive(frequency, wavenumber, top_speed, lowest, highest):
    """Against a fine grid of finger speeds, both ways, with 1e-9 for the grid's own rounding."""
    way = np.abs(frequency + np.linspace(-top_speed, top_speed, 4001) * wavenumber)
    way = way[(way >= lowest) & (way <= highest)]
    device = {"top_speed": top_speed, "lowest": lowest, "highest": highest}
    if way.size:
        felt = detection_threshold(way).min() * (1 + 1e-9)
        assert left((frequency, wavenumber, felt), **device) == [0]


def test_bands_go_together_only_if_their_sum_is_unfelt():
    """Two at 0.49 of the threshold go, of two at 0.51 one stays; weakest first whatever their order."""
    t = detection_threshold(np.array([50.0, 90.0, 200.0]))
    assert left((50.0, 0.0, 0.49 * t[0]), (90.0, 0.0, 0.49 * t[1])) == []
    assert left((50.0, 0.0, 0.51 * t[0]), (90.0, 0.0, 0.505 * t[1])) == [0]
    assert left((50.0, 0.0, 0.3 * t[0]), (90.0, 0.0, 0.9 * t[1]), (200.0, 0.0, 0.3 * t[2])) == [1]


def test_what_stays_is_untouched_and_what_went_is_noted():
    bands = bands_of((20.0, 0.0, 1e-5), (1050.0, 0.0, 4e-9), (0.0, 1e3, 1e-5), (60.0, 500.0, 1e-9), (5.0, 0.0, 0.0))
    kept = drop_unfelt(bands, **DEVICE)
    for name in ("frequency", "wavenumber", "phase", "envelope"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(bands, name)[[0, 2]])
    assert kept.unfelt == (
        "1050 Hz: target 4 nm is below the detection threshold, 281 nm at 1050 Hz",
        "60 Hz + wavelength 2 mm: target 1 nm is below the detection threshold, 29.2 nm at 110 Hz",
        "5 Hz: target 0 pm is below the detection threshold, 9.02 µm at 5 Hz",
    )


def test_bands_of_a_recording_and_no_bands_at_all_are_kept():
    recorded = Bands(frequency=[500.0], wavenumber=[0.0], phase=[0.0])
    for bands in (recorded, bands_of()):
        assert drop_unfelt(bands, **DEVICE) is bands
