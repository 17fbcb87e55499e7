"""Loop shaping: the controllers, their margins to the last printed digit, and the loop slowed down for its delay."""

import re
from math import radians

import numpy as np
import pytest
from scipy.signal import bilinear

from examples.grigorii2021.shaping import (
    TransferFunction,
    analyse,
    butterworth,
    exact_controller,
    loop_margins,
    second_order_controller,
)
from hapticrender.bands import Bands
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.loopshape import MOST_DELAY, _widest, envelope_loop, loop_section
from hapticrender.control.margins import LeastMargins
from hapticrender.control.methods import MOST_INTEGRAL
from hapticrender.errors import DesignError
from hapticrender.plants.plate import PlateParameters

RATE = 5000.0
L = butterworth(10.0)
LEAST = LeastMargins(modulus=1 / 1.8, gain=2.5, phase=radians(45.0), delay=0.0)  # docs/theory.md, "Margins"
CONTROLLERS = {
    "exact": exact_controller(5.0, 10.0),
    "reduced": second_order_controller(5.0, 10.0),
    "integrator": TransferFunction((17.0,), (1.0, 0.0)),
}
EACH = pytest.mark.parametrize("form", CONTROLLERS)
PRINTED = {  # docs/theory.md, table of the controllers
    "exact": ("61.6", "3.50", "1.553", "73.6", "4.3", "0.190", "5.00", "0.097"),
    "reduced": ("61.5", "3.75", "1.545", "73.6", "5.0", "0.194", "4.87", "0.122"),
    "integrator": ("67.6", "5.23", "1.42", "69.6", "0", "0.102", "5.22", "0.423"),
}


@EACH
def test_figures_are_the_printed_ones(form):
    found = analyse(CONTROLLERS[form], L)
    values = (
        np.degrees(found.margins.phase),
        found.margins.gain,
        1 / found.margins.modulus,
        1e3 * found.margins.delay,
        100 * found.overshoot,
        found.settling_time,
        found.bandwidth,
        100 * found.ripple,
    )
    digits = [len(text.partition(".")[2]) for text in PRINTED[form]]
    assert tuple(f"{value:.{n}f}" for value, n in zip(values, digits, strict=True)) == PRINTED[form]


@pytest.mark.parametrize(("loop", "low_pass"), [(5.0, 10.0), (3.0, 4.0), (20.0, 100.0)])
def test_the_exact_controller_makes_the_loop_t_and_the_reduced_one_matches_three_moments(loop, low_pass):
    def moments(controller):
        """Taylor coefficients of s C at s = 0, by long division from below."""
        above = [*controller.numerator[::-1], 0.0, 0.0, 0.0]
        below = [*controller.denominator[-2::-1], 0.0, 0.0, 0.0]
        series = []
        for order in range(3):
            known = sum(series[i] * below[order - i] for i in range(order))
            series.append((above[order] - known) / below[0])
        return series

    exact, frequency = exact_controller(loop, low_pass), np.geomspace(0.01, 1000, 50)
    c, l_response = exact.frequency_response(frequency), butterworth(low_pass).frequency_response(frequency)
    np.testing.assert_allclose(c / (1 + l_response * c), butterworth(loop).frequency_response(frequency), rtol=1e-9)
    np.testing.assert_allclose(moments(second_order_controller(loop, low_pass)), moments(exact), rtol=1e-9)


@EACH
def test_gain_and_delay_margins_are_the_edges_of_stability(form):
    """The gain by the poles of the closed loop; the delay by Nyquist's count."""
    margins = loop_margins(CONTROLLERS[form] * L)
    for factor, stable in ((0.999, True), (1.001, False)):
        plain = CONTROLLERS[form]
        louder = TransferFunction(tuple(factor * margins.gain * np.array(plain.numerator)), plain.denominator)
        poles = np.roots(
            np.polyadd(np.polymul(louder.denominator, L.denominator), np.polymul(louder.numerator, L.numerator))
        )
        assert (poles.real.max() < 0) == stable
        assert loop_margins(louder * L).stable is stable
        assert loop_margins(CONTROLLERS[form] * L, factor * margins.delay).stable is stable


def as_filter(section):
    """Second-order section (b0, b1, b2, a1, a2) as (b, a)."""
    return np.array(section[:3]), np.array([1.0, *section[3:]])


def test_tustin_gives_the_printed_digits_and_is_exact_at_the_prewarped_frequency():
    """The second-order controller at 5 kHz."""
    b, a = as_filter(loop_section(5.0, 10.0, RATE))
    np.testing.assert_allclose(b, 1.3043570e-5 * np.array([1, 2, 1]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(a, [1, -1.9823849911, 0.9823849911], rtol=0, atol=5e-11)
    continuous = second_order_controller(5.0, 10.0)
    for found, known in zip((b, a), bilinear(continuous.numerator, continuous.denominator, RATE), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-9)
    b, a = StarSTDFT(bandwidth=10.0, rate=RATE).coefficients
    z = np.exp(2j * np.pi * 10.0 / RATE)
    assert np.polyval(b, z) / np.polyval(a, z) == pytest.approx(L.frequency_response(10.0), rel=1e-8)


@pytest.mark.parametrize("width", [5.0, 5e-5])
def test_a_section_keeps_every_coefficient_however_slow(width):
    """The numerator of a slow loop at the rate of a sound card is 1e-19 (1 + z^-1)^2."""
    b, _ = as_filter(loop_section(width, 2 * width, 96e3))
    np.testing.assert_allclose(b / b[0], [1, 2, 1], rtol=1e-12)
    assert b[0] == pytest.approx(second_order_controller(width, 2 * width)(2 * 96e3), rel=1e-12)


@pytest.mark.parametrize(
    ("loop", "delay"),
    [(second_order_controller(5.0, 10.0) * L, MOST_DELAY / 5.0), (CONTROLLERS["integrator"], MOST_INTEGRAL / 17.0)],
    ids=["loop and low pass", "integrator"],
)
def test_the_longest_delay_is_where_the_least_margins_end(loop, delay):
    """In any loop of that form: only the product of bandwidth and delay counts."""
    for factor, kept in ((0.99999, True), (1.00001, False)):
        assert (LEAST.complaint(loop_margins(loop, factor * delay)) == "") is kept


def loop_of(delay, frequency=20.0):
    """Loop of one envelope for a tone, in a loop of so many samples of delay."""
    bands = Bands(frequency=[frequency], wavenumber=[0.0], phase=[0.0], envelope=[1e-6])
    return envelope_loop(PlateParameters().device_model(RATE, delay), bands)


def test_a_loop_is_a_quarter_of_the_carrier_or_as_wide_as_its_delay_allows():
    """5 Hz for a tone of 20 Hz; then by steps of a tenth, no further than need be; below a twentieth it is refused."""
    assert loop_of(1)[1] == 5.0
    settings, width = loop_of(200)
    delay = 200 / RATE
    assert width < 5.0
    for found, each in ((loop_of(1)[0], 5.0), (settings, width)):
        assert found["loop"] == loop_section(each, 2 * each, RATE)
    for each, kept in ((width, True), (width / 0.9, False)):
        margins = loop_margins(second_order_controller(each, 2 * each) * butterworth(2 * each), delay)
        assert (LEAST.complaint(margins) == "") is kept


@pytest.mark.parametrize("lowest", [20.0, 43.0, 111.0])
def test_the_delay_that_a_refusal_states_is_accepted_and_a_hundredth_more_is_not(lowest):
    """It is rounded down, to three digits, from 0.995 of the bound: at least 0.99 of it."""
    with pytest.raises(
        DesignError, match=r"leaves too small a margin: must be <= \S+ s, even with a loop of"
    ) as refused:
        _widest(lowest, 5.0)
    stated = float(re.search(r"<= (\S+) s", str(refused.value))[1])
    assert _widest(lowest, stated)[0] >= 0.05 * lowest / 4
    with pytest.raises(DesignError):
        _widest(lowest, 1.011 * stated)


@pytest.mark.parametrize(
    ("frequency", "periods"), [(12.0, 1), (20.0, 1), (39.0, 1), (47.0, 2), (105.0, 5), (110.0, 5), (250.0, 12)]
)
def test_a_running_mean_has_whole_periods_of_the_lowest_fixed_carrier(frequency, periods):
    """As many as a period of 20 Hz has, beside carriers that follow the finger, too; the loop stays that of 20 Hz."""
    model = PlateParameters().device_model(RATE, 1)
    for wavenumber in ([0.0, 0.0], [0.0, 1000.0]):
        bands = Bands(frequency=[frequency, 2 * frequency * (wavenumber[1] == 0.0)], wavenumber=wavenumber,
                      phase=[0.0, 0.0], envelope=[1e-6, 1e-6])  # fmt: skip
        settings, width = envelope_loop(model, bands, boxcar=True)
        assert settings["window"] == round(periods * RATE / frequency)
        assert width == min(frequency, 20.0) / 4
    alone = Bands(frequency=[0.0], wavenumber=[1000.0], phase=[0.0], envelope=[1e-6])
    assert envelope_loop(model, alone, boxcar=True)[0]["window"] == 250
