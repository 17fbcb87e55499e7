"""Loop shaping: the controllers, their margins to the last printed digit, and the loop slowed down for its delay."""

import numpy as np
import pytest

from examples.grigorii2021.shaping import analyse, exact_controller
from hapticrender.bands import Bands
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.loopshape import (
    TransferFunction,
    butterworth,
    envelope_loop,
    loop_margins,
    reduced_controller,
)
from hapticrender.control.margins import LEAST
from hapticrender.errors import DesignError
from hapticrender.plants.plate import PlateParameters

RATE = 5000.0
L = butterworth(10.0)
CONTROLLERS = {
    "exact": exact_controller(5.0, 10.0),
    "reduced": reduced_controller(5.0, 10.0),
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
    np.testing.assert_allclose(moments(reduced_controller(loop, low_pass)), moments(exact), rtol=1e-9)


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


def test_tustin_gives_the_printed_digits_and_is_exact_at_the_prewarped_frequency():
    """The second-order controller at 5 kHz."""
    b, a = reduced_controller(5.0, 10.0).tustin(RATE)
    np.testing.assert_allclose(b, 1.3043570e-5 * np.array([1, 2, 1]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(a, [1, -1.9823849911, 0.9823849911], rtol=0, atol=5e-11)
    b, a = StarSTDFT(bandwidth=10.0, rate=RATE).coefficients
    z = np.exp(2j * np.pi * 10.0 / RATE)
    assert np.polyval(b, z) / np.polyval(a, z) == pytest.approx(L.frequency_response(10.0), rel=1e-8)


@pytest.mark.parametrize("width", [5.0, 5e-5])
def test_tustin_keeps_every_coefficient_of_a_loop_however_slow(width):
    """The numerator of a slow loop at the rate of a sound card is 1e-19 (1 + z^-1)^2."""
    slow = reduced_controller(width, 2 * width)
    b, _ = slow.tustin(96e3)
    np.testing.assert_allclose(b / b[0], [1, 2, 1], rtol=1e-12)
    assert b[0] == pytest.approx(slow(2 * 96e3), rel=1e-12)


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
        b, a = reduced_controller(each, 2 * each).tustin(RATE)
        assert found["loop"] == pytest.approx([*b, *a[1:]])
    for each, kept in ((width, True), (width / 0.9, False)):
        margins = loop_margins(reduced_controller(each, 2 * each) * butterworth(2 * each), delay)
        assert (LEAST["envelope"].complaint(margins) == "") is kept
    with pytest.raises(DesignError, match=r"unstable even with a loop of 0.2\d\d Hz: lower the delay of 5 s"):
        loop_of(25_000)
