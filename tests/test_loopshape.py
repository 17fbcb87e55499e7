"""Loop shaping: the controllers, their margins to the last printed digit, and what a design refuses."""

import subprocess
import sys

import naive
import numpy as np
import pytest

from hapticrender.control.loopshape import (
    FORMS,
    TransferFunction,
    analyse,
    butterworth,
    design,
    exact_controller,
    integrator,
    reduced_controller,
)
from hapticrender.control.margins import LeastMargins
from hapticrender.errors import DesignError

RATE = 5000.0
T, L = butterworth(5.0), butterworth(10.0)
CONTROLLERS = {
    "exact": exact_controller(5.0, 10.0),
    "reduced": reduced_controller(5.0, 10.0),
    "integrator": integrator(17.0),
}
EACH = pytest.mark.parametrize("form", FORMS)
HEAVE = (0.032, 1.7, 45.3e3)  # kg, N s/m, N/m: the plate as one mass
RESONANCE, HALF_WIDTH = 189.36, 4.228  # Hz: sqrt(k/m)/2 pi, and f0/2Q = b/(4 pi m)


def closed_loop(controller, low_pass):
    """Numerator and denominator of T = C/(1 + L C), from nothing but polynomial arithmetic."""
    above = np.polymul(controller.numerator, low_pass.denominator)
    below = np.polyadd(
        np.polymul(controller.denominator, low_pass.denominator), np.polymul(controller.numerator, low_pass.numerator)
    )
    return above, below


PRINTED = {  # docs/theory.md, table of the controllers
    "exact": ("61.6", "3.50", "1.553", "73.6", "4.3", "0.190", "5.00", "0.097"),
    "reduced": ("61.5", "3.75", "1.545", "73.6", "5.0", "0.194", "4.87", "0.122"),
    "integrator": ("67.6", "5.23", "1.42", "69.6", "0", "0.102", "5.22", "0.423"),
}


@EACH
def test_margins_are_the_printed_ones(form):
    found = design(form=form)
    values = (
        np.degrees(found.margins.phase),
        found.margins.gain,
        found.margins.peak_sensitivity,
        1e3 * found.margins.delay,
        100 * found.overshoot,
        found.settling_time,
        found.bandwidth,
        100 * found.ripple,
    )
    digits = [len(text.partition(".")[2]) for text in PRINTED[form]]
    assert tuple(f"{value:.{n}f}" for value, n in zip(values, digits, strict=True)) == PRINTED[form]
    assert found.margins.stable


def test_margins_read_well():
    assert str(design()) == (
        "modulus margin 0.64 at 5 Hz, gain margin 3.5, phase margin 62 deg, delay margin 73.62 ms, "
        "overshoot 4.3 %, settling 0.190 s, bandwidth 5.00 Hz, ripple 0.097 %"
    )


def test_exact_controller_has_the_printed_polynomials():
    controller = exact_controller(5.0, 10.0)
    for found, printed, half in zip(
        (*controller.numerator, *controller.denominator),
        (986.96, 8.76990e4, 3.896364e6, 1, 133.286, 8882.64, 263096.98, 0),
        (5e-3, 0.5, 0.5, 0, 5e-4, 5e-3, 5e-3, 0),
        strict=True,
    ):
        assert abs(found - printed) <= half


@pytest.mark.parametrize(("loop", "low_pass"), [(5.0, 10.0), (3.0, 4.0), (20.0, 100.0), (10.0, 5.0)])
def test_exact_controller_makes_the_loop_exactly_t(loop, low_pass):
    controller = exact_controller(loop, low_pass)
    assert controller.order == 4
    frequency = np.geomspace(0.01, 1000, 50)
    c, l_response = controller.frequency_response(frequency), butterworth(low_pass).frequency_response(frequency)
    np.testing.assert_allclose(c / (1 + l_response * c), butterworth(loop).frequency_response(frequency), rtol=1e-9)


def test_reduced_controller_has_the_printed_numbers():
    numerator, denominator = reduced_controller(5.0, 10.0).numerator, reduced_controller(5.0, 10.0).denominator
    assert denominator[1] == pytest.approx(88.858, abs=5e-4)
    assert numerator[0] / denominator[1] == pytest.approx(14.8096, abs=5e-5)


@pytest.mark.parametrize(("loop", "low_pass"), [(5.0, 10.0), (3.0, 4.0), (20.0, 100.0)])
def test_reduced_controller_matches_three_moments(loop, low_pass):
    def moments(controller):
        """Taylor coefficients of s C at s = 0, by long division from below."""
        above = [*controller.numerator[::-1], 0.0, 0.0, 0.0]
        below = [*controller.denominator[-2::-1], 0.0, 0.0, 0.0]
        series = []
        for order in range(3):
            known = sum(series[i] * below[order - i] for i in range(order))
            series.append((above[order] - known) / below[0])
        return series

    exact, reduced = moments(exact_controller(loop, low_pass)), moments(reduced_controller(loop, low_pass))
    np.testing.assert_allclose(reduced, exact, rtol=1e-9)


def test_17_is_the_largest_whole_gain_of_an_integrator_that_does_not_overshoot():
    assert analyse(integrator(17.0), L).overshoot < 1e-4
    assert analyse(integrator(18.0), L).overshoot > 3e-3


@EACH
def test_step_figures_agree_with_partial_fractions(form):
    time = np.arange(20_000) / 20_000
    response = naive.step_response(*closed_loop(CONTROLLERS[form], L), time)
    found = analyse(CONTROLLERS[form], L)
    assert found.overshoot == pytest.approx(response.max() - 1, abs=1e-4)  # the harmonics end at 4 kHz: 5e-5
    assert found.settling_time == pytest.approx(time[np.flatnonzero(abs(response - 1) > 0.02)[-1]], abs=1e-4)


@EACH
def test_gain_margin_is_the_edge_of_stability(form):
    controller = CONTROLLERS[form]
    edge = analyse(controller, L).margins.gain
    for factor, stable in ((0.999, True), (1.001, False)):
        louder = TransferFunction(tuple(factor * edge * np.array(controller.numerator)), controller.denominator)
        assert (np.roots(closed_loop(louder, L)[1]).real.max() < 0) == stable
        assert analyse(louder, L).margins.stable is stable


@EACH
def test_delay_margin_is_the_edge_of_stability(form):
    controller = CONTROLLERS[form]
    edge = analyse(controller, L).margins.delay
    assert analyse(controller, L, delay=0.999 * edge).margins.stable
    beyond = analyse(controller, L, delay=1.001 * edge)
    assert not beyond.margins.stable
    assert beyond.overshoot == beyond.settling_time == np.inf


@pytest.mark.parametrize(("share", "grows"), [(0.9, False), (1.1, True)])
def test_delay_margin_holds_in_simulation(share, grows):
    controller = reduced_controller(5.0, 10.0)
    delay = round(share * analyse(controller, L).margins.delay * RATE)
    output = naive.envelope_loop(controller.tustin(RATE), L.tustin(RATE, prewarp=10.0), np.ones(15_000), delay)
    early, late = np.ptp(output[5000:10_000]), np.ptp(output[10_000:])
    assert (late > early) == grows


@EACH
@pytest.mark.parametrize("frequency", [0.5, 5.0])
def test_discretised_loop_has_the_predicted_response(form, frequency):
    """A slow reference through the loop at 5 kHz, one sample of delay in it, against T(f) with that delay."""
    controller = CONTROLLERS[form]
    time = np.arange(3 * int(RATE)) / RATE
    turn = np.exp(2j * np.pi * frequency * time)
    output = naive.envelope_loop(controller.tustin(RATE), L.tustin(RATE, prewarp=10.0), turn.real, delay=1)
    settled = time >= 1.0  # whole periods of every frequency remain
    measured = 2 * np.mean(output[settled] * turn[settled].conjugate())
    forward = controller.frequency_response(frequency) * np.exp(-2j * np.pi * frequency / RATE)
    predicted = forward / (1 + forward * L.frequency_response(frequency))
    assert measured == pytest.approx(predicted, rel=3e-4)  # Tustin warps by (pi f/rate)^2/3: 3e-5 at 15 Hz


def test_tustin_gives_the_printed_digits():
    """The second-order controller at 5 kHz."""
    b, a = reduced_controller(5.0, 10.0).tustin(RATE)
    np.testing.assert_allclose(b, 1.3043570e-5 * np.array([1, 2, 1]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(a, [1, -1.9823849911, 0.9823849911], rtol=0, atol=5e-11)


def test_prewarped_tustin_is_exact_at_one_frequency():
    for frequency in (10.0, 400.0):
        b, a = L.tustin(RATE, prewarp=frequency)
        z = np.exp(2j * np.pi * frequency / RATE)
        assert np.polyval(b, z) / np.polyval(a, z) == pytest.approx(L.frequency_response(frequency), rel=1e-8)


def test_ripple_follows_the_rule_of_four_octaves():
    """(rL rT/4)^2 while both low passes lie far below 2 f0; 0.5 % at rL rT = 0.283."""
    for lowest, error in ((20.0, 3e-3), (80.0, 2e-5)):
        found = analyse(exact_controller(5.0, 10.0), L, lowest_frequency=lowest)
        assert found.ripple == pytest.approx((10 * 5 / lowest**2 / 4) ** 2, rel=error)
    assert (0.283 / 4) ** 2 == pytest.approx(0.005, abs=1e-5)


@EACH
def test_ripple_is_what_a_carrier_of_20_hz_brings_into_the_drive(form):
    drive, _ = naive.carrier_loop(
        CONTROLLERS[form].tustin(RATE), L.tustin(RATE, prewarp=10.0), HEAVE, 20.0, RATE, samples=7500
    )
    held = drive[2500:]
    line = 2 * abs(np.mean(held * np.exp(-2j * np.pi * 40.0 * np.arange(held.size) / RATE))) / held.mean()
    # the modulus bends by |L(40 Hz)|^2/2 = 0.2 %, and the plate's gain differs by its resonance only
    assert line == pytest.approx(analyse(CONTROLLERS[form], L).ripple, rel=4e-3)


def test_amplitude_pole_left_out_at_resonance_overshoots_by_34_percent():
    predicted = analyse(CONTROLLERS["reduced"], L, amplitude_pole=HALF_WIDTH)
    assert f"{100 * predicted.overshoot:.0f}" == "34"
    assert overshoot_on_the_carrier(CONTROLLERS["reduced"], RESONANCE) == pytest.approx(predicted.overshoot, abs=2e-3)


def test_amplitude_pole_put_into_the_design_restores_the_step():
    shaped = design(form="reduced", lowest_frequency=RESONANCE, amplitude_pole=HALF_WIDTH)
    plain = design(form="reduced")
    assert shaped.margins.phase == pytest.approx(plain.margins.phase, rel=1e-6)
    assert overshoot_on_the_carrier(shaped.controller, RESONANCE) == pytest.approx(plain.overshoot, abs=2e-3)


def overshoot_on_the_carrier(controller, frequency):
    """Largest excess of the true amplitude of the one-mass plate over a step of the reference at `frequency`."""
    laws = controller.tustin(RATE), L.tustin(RATE, prewarp=10.0)
    _, amplitude = naive.carrier_loop(*laws, HEAVE, frequency, RATE, samples=3000)
    return amplitude.max() - 1


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (
            {"delay": 0.021},
            r"modulus margin 0.45 at .* Hz is below 0.56: lower loop_bandwidth=5.0 Hz.* or lower delay=0.021",
        ),
        ({"delay": 0.021, "least": LeastMargins(modulus=0.4, delay=0.0, phase=0.8)}, "phase margin 44.* is below 45.8"),
        ({"delay": 0.021, "least": LeastMargins(modulus=0.4, delay=0.0, gain=2.5)}, "gain margin 2.0. is below 2.50"),
        ({"form": "reduced", "filter_bandwidth": 5.0}, "raise filter_bandwidth=5.0 Hz above loop_bandwidth=5.0 Hz"),
        ({"delay": 0.08}, "the loop is unstable: lower loop_bandwidth=5.0 Hz"),
        ({"amplitude_pole": 4.2}, "ripple 0.93% is above 0.50%: lower filter_bandwidth or"),
        ({"loop_bandwidth": 5.1}, "loop_bandwidth 5.1 Hz is above lowest_frequency/4 = 5 Hz.*lower loop_bandwidth"),
        ({"filter_bandwidth": 10.1}, "filter_bandwidth 10.1 Hz is above lowest_frequency/2 = 10 Hz"),
        ({"lowest_frequency": 19.9}, "loop_bandwidth 5 Hz is above lowest_frequency/4 = 4.975 Hz"),
    ],
)
def test_design_refuses_and_says_what_to_change(options, complaint):
    with pytest.raises(DesignError, match=complaint):
        design(**options)


@pytest.mark.parametrize(
    ("options", "cure"),
    [
        ({"delay": 0.03}, {"loop_bandwidth": 1.5}),
        ({"delay": 0.03, "form": "integrator", "lowest_frequency": 80.0}, {"filter_bandwidth": 40.0}),
        ({"amplitude_pole": 4.2}, {"lowest_frequency": 40.0}),
    ],
)
def test_the_advice_heals(options, cure):
    with pytest.raises(DesignError, match=f"(lower|or) (the )?{next(iter(cure))}|raise {next(iter(cure))}"):
        design(**options)
    assert design(**(options | cure)).margins.stable


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"form": "fourth"}, "form='fourth' must be one of exact, reduced, integrator"),
        ({"loop_bandwidth": 0.0}, "loop_bandwidth=0.0 must be positive"),
        ({"filter_bandwidth": float("nan")}, "filter_bandwidth=nan must be positive"),
        ({"lowest_frequency": -20.0}, "lowest_frequency=-20.0 must be positive"),
        ({"delay": -0.01}, "delay=-0.01 s must be finite and >= 0"),
        ({"amplitude_pole": 0.0}, "amplitude_pole=0.0 must be positive"),
    ],
)
def test_nonsense_is_a_value_error(options, complaint):
    with pytest.raises(ValueError, match=complaint):
        design(**options)


def test_a_loop_that_never_reaches_1_has_no_margins():
    with pytest.raises(ValueError, match=r"never crosses 1 \(largest 0.5\)"):
        analyse(TransferFunction((0.5,), (1.0,)), L)


def test_transfer_functions_are_monic_values():
    assert TransferFunction((2.0,), (2.0, 4.0)) == TransferFunction((0.0, 1.0), (1.0, 2.0))
    assert (T * L)(1.0 + 2.0j) == pytest.approx(T(1.0 + 2.0j) * L(1.0 + 2.0j), rel=1e-13)
    assert abs(L.frequency_response(10.0)) == pytest.approx(np.sqrt(0.5), rel=1e-13)


@pytest.mark.parametrize(
    ("numerator", "denominator", "complaint"),
    [
        ((1.0, 0.0), (1.0,), "numerator of order 1 must not exceed denominator order 0"),
        ((1.0,), (0.0, 0.0), "denominator=.* not all zero"),
        ((float("nan"),), (1.0,), "numerator=.* finite"),
    ],
)
def test_transfer_functions_refuse_what_is_not_proper(numerator, denominator, complaint):
    with pytest.raises(ValueError, match=complaint):
        TransferFunction(numerator, denominator)


def test_tustin_refuses_a_frequency_it_cannot_reach():
    with pytest.raises(ValueError, match="prewarp=500.0 Hz must lie between 0 and half the rate, 500.0 Hz"):
        L.tustin(1000.0, prewarp=500.0)
    with pytest.raises(ValueError, match="rate=0.0 must be positive"):
        L.tustin(0.0)


def test_importing_leaves_scipy_signal_alone():
    code = "import sys, hapticrender.control.loopshape; print('scipy.signal' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert found.stdout.strip() == "False"
