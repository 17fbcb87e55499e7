"""Both sides of every failure limit: of polar and complex methods, of H and H2, of numerics; and who holds there."""

import dataclasses

import numpy as np
import pytest
import scipy.signal
from held import amplitude_error, envelopes, fixed, hold, play
from waves import phasor

import hapticrender as hr
from examples.grigorii2021.shaping import butterworth, loop_margins, second_order_controller
from hapticrender.control.controller import setpoint_rows
from hapticrender.control.methods import METHODS, Polar
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY, LIGHT_SECOND

RATE, TURN = 5000.0, 2 * np.pi
IDEAL_SENSORS = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0, "sensor_range": 0.1}
IDEAL = PlateParameters(**IDEAL_SENSORS)


def late(samples):
    return dataclasses.replace(IDEAL, delay=samples)


def off(method, frequency, seconds, target=1e-5, places=slice(0, 1), **scene):
    """Largest relative error of the amplitude at `places` (centre, ends) over the last second."""
    motion = hold(method, fixed((frequency, target)), seconds, **{"plate": IDEAL, **scene})[1][:, places]
    return abs(amplitude_error(motion, frequency, abs(target))).max()


def ours(frequency, seconds, method="h2", **scene):
    """Worst relative error over centre and ends."""
    return off(method, frequency, seconds, places=slice(None), **scene)


def sent(method, frequency, targets, seconds):
    """Motion of the centre while the target steps from one to the next."""
    plate, bands = Plate(IDEAL, hr.Finger.absent()), [fixed((frequency, target)) for target in targets]
    controller, motion = method.design(IDEAL.device_model(RATE, 1), bands[0]), []
    for each, duration in zip(bands, seconds, strict=True):
        controller.setpoints[:] = setpoint_rows(each)
        motion.append(plate.closed_loop(controller, np.zeros(round(duration * RATE)))[3].motion[:, :1])
    return np.concatenate(motion)


def test_polar_without_a_clamp_runs_to_the_limit_below_2_6_percent():
    """The step's undershoot o takes the command to -A: r = o/(2 + o), 2.65 % for the o = 5.4 % of the loop here."""
    for clamp, ratio, holds in ((False, 0.027, True), (False, 0.025, False), (True, 0.01, True)):
        motion = sent(Polar(common=True, clamp=clamp), 47.0, (1e-4, 1e-4 * ratio), (2.0, 4.0))
        error = abs(amplitude_error(motion, 47.0, 1e-4 * ratio)[0])
        assert error < 1e-3 if holds else error > 100


def test_a_target_on_the_branch_cut_runs_the_phase_away():
    """The cut is at 90 degrees: the error of two cut angles is 0 or 360 deg; arg(X conj R) has no seam there."""
    noisy, on_the_cut = PlateParameters(), 1e-5 * np.exp(0.5j * np.pi)
    for subtract, holds in ((False, True), (True, False)):
        motion = hold(Polar(subtract=subtract), fixed((47.0, on_the_cut)), 6.0, noisy)[1][-5000:, 0]
        found = phasor(motion, 47.0) / on_the_cut
        assert (abs(found - 1) < 0.05) == holds
    for method in ("h", "h2"):
        assert ours(47.0, 4.0, method, target=on_the_cut) < 0.01


@pytest.mark.parametrize(("faster", "bias"), [(1, -0.00097), (2, -0.0145), (3, -0.0573), (6, -0.168)])
def test_too_fast_a_filter_biases_the_amplitude(faster, bias):
    """20 Hz with both bandwidths so many times 5 and 10 Hz; to the last printed digit.  An observer has no image."""
    motion = hold(Polar(common=True, bandwidths=(5.0 * faster, 10.0 * faster)), fixed((20.0, 1e-4)), 6.0, IDEAL)[1]
    assert amplitude_error(motion, 20.0, 1e-4)[0] == pytest.approx(bias, abs=5e-4)
    if faster == 1:
        assert max(ours(20.0, 6.0, method, target=1e-4) for method in ("h", "h2")) < 1e-6


@pytest.mark.parametrize(("frequency", "holds"), [(140, True), (141, False), (150, False), (155, True)])
def test_a_static_inverse_is_unstable_near_the_modes_of_the_free_plate(frequency, holds):
    """At 141-145 and 150-154 Hz: the rocking envelope turns as it decays, which D alone does not hold; D' does.

    Quantised, so that something starts it; growth is slow, 1.3 1/s at 143 Hz.
    """
    quiet = PlateParameters(sensor_noise=0.0)
    error = ours(frequency, 20.0, "static", plate=quiet)
    assert error < 1e-2 if holds else error > 0.1
    if not holds:
        assert ours(frequency, 8.0, "stiffness", plate=quiet) < 2.8e-3
        assert ours(frequency, 5.0, "h") < 1e-3
        assert ours(frequency, 3.0) < 1e-4


@pytest.mark.parametrize(
    ("mechanics", "unstable"),
    [(LIGHT_SECOND, {"static": (175.0, 187.0), "stiffness": (175.0,)}), (HEAVY, {"static": (175.0,), "stiffness": ()})],
)
def test_a_static_inverse_is_unstable_near_the_modes_under_a_finger(mechanics, unstable):
    """A finger at 15 mm; with D' a heavy one is held.  H2 adapts."""
    finger = hr.Finger.still(15e-3, normal_load=0.0, mechanics=mechanics)
    for method, bad in unstable.items():
        for frequency in (167.0, 175.0, 187.0):
            error = off(method, frequency, 8.0, finger=finger)
            assert error > 0.3 if frequency in bad else error < 0.01, (frequency, method, error)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_phase_error_of_the_plant_up_to_the_phase_margin_is_held(sign):
    """61.5 deg away from resonance; 38 deg for the static inverse at the mode."""
    margins = loop_margins(second_order_controller(5.0, 10.0) * butterworth(10.0))
    assert np.degrees(margins.phase) == pytest.approx(61.5, abs=0.05)
    for method, frequency, degrees, holds in (
        ("static", 111.0, 55, True),
        ("static", 111.0, 66, False),
        ("static", 189.0, 28, True),
        ("static", 189.0, 50, False),
        ("stiffness", 189.0, 55, True),
        ("stiffness", 189.0, 66, False),
    ):
        error = off(method, frequency, 8.0, ahead=sign * degrees / 360.0 / frequency)
        assert error < 0.01 if holds else error > 0.3, (method, frequency, degrees, error)


def test_unknown_and_known_delay():
    """400 Hz: 2 unknown samples (58 deg) are held, 3 (86 deg) not; a loop of 5 Hz has a delay margin of 73.6 ms."""
    for extra, holds in ((2, True), (3, False)):
        error = off("static", 400.0, 6.0, plate=late(1 + extra), known=IDEAL)
        assert error < 2e-3 if holds else error > 2e-2
        assert off("static", 400.0, 6.0, plate=late(1 + extra)) < 1e-3
        assert max(ours(400.0, 6.0, method, plate=late(1 + extra)) for method in ("h", "h2")) < 1e-4
    for milliseconds, holds in ((60, True), (80, False)):
        error = off(
            dataclasses.replace(METHODS["stiffness"], bandwidths=(5.0, 10.0)), 111.0, 8.0, plate=late(5 * milliseconds)
        )
        assert error < 0.01 if holds else error > 0.1


def test_polar_and_a_delay_it_does_not_know():
    """The phase of the carrier over the delay must be found by the phase loop; 36 ms at 47 Hz lie at its branch cut."""
    for milliseconds, holds in ((30, True), (36, False), (60, True)):
        error = off("paper-common", 47.0, 10.0, plate=late(5 * milliseconds), known=IDEAL)
        assert error < 1e-3 if holds else error > 0.1


def test_saturation_winds_the_polar_loop_up():
    """2 s of 1 mm at 400 Hz, then 10 um: the wind-up unwinds at ki (0.356 mm - A), 3.72 s, and the loop settles in 0.4.

    0.356 mm is the largest amplitude at 3 A, a square wave through the plate.
    """
    motion = sent(METHODS["paper-common"], 400.0, (1e-5, 1e-3, 1e-5), (0.5, 2.0, 6.5))[:, 0]
    total = np.cumsum(np.append(0.0, 2 * motion * np.exp(-2j * np.pi * 400 * np.arange(len(motion)) / RATE)))
    running = abs(total[50:] - total[:-50]) / 50
    recovered = np.flatnonzero(abs(running / 1e-5 - 1) > 0.05)[-1] / RATE + 0.01 - 2.5
    assert recovered == pytest.approx(2.0 * (1.0 - 0.356) / (0.356 - 0.01) + 0.4, abs=0.05)


@pytest.mark.parametrize(
    ("method", "spacing", "least", "most"),
    [
        ("paper-common", 20.0, 0.015, 0.07),
        ("paper-common", 10.0, 0.3, 1.0),
        (dataclasses.replace(METHODS["stiffness"], bandwidths=(5.0, 10.0)), 8.0, 0.0, 1e-3),
        (dataclasses.replace(METHODS["stiffness"], bandwidths=(5.0, 10.0)), 7.0, 0.3, np.inf),
        ("h2", 10.0, 0.0, 1e-6),
    ],
    ids=str,
)
def test_close_bands(method, spacing, least, most):
    """Four bands in phase beat into the polar amplitude; low passes of 5 Hz are unstable below 8 Hz; h2 has no beat."""
    frequency = 60.0 + spacing * np.arange(4)
    motion = hold(method, fixed(*((f, 1e-5) for f in frequency)), 12.0, IDEAL)[1]
    assert least <= max(abs(amplitude_error(motion, f, 1e-5)[0]) for f in frequency) < most


def test_an_unfiltered_reference_makes_feedback_fight_feedforward():
    """A target doubled in 50 ms overshoots by 13-17 % where it is compared unfiltered with an envelope that lags."""
    x = np.clip((np.arange(15_000) / RATE - 1.5) / 0.05, 0.0, 1.0)
    bands = dataclasses.replace(fixed((111.0, 1e-5)), modulated=True)
    for filtered, least, most in ((True, -0.02, 0.02), (False, 0.13, 0.17)):
        method = dataclasses.replace(METHODS["stiffness"], feed_forward=True, filtered=filtered)
        motion = hold(method, bands, 3.0, IDEAL, waveform=1 + x * x * (3 - 2 * x))[1][:, 0]
        width = 2 * round(RATE / 111.0)
        product = 2 * motion * np.exp(-2j * np.pi * 111.0 * np.arange(15_000) / RATE)
        running = abs(np.convolve(product, np.ones(width) / width, mode="valid"))[7500:]
        assert least < running.max() / 2e-5 - 1 < most


def comb():
    """20 bands from 20 to 400 Hz, 10 um each, random phases."""
    phase = np.random.default_rng(1).uniform(0, TURN, 20)
    return fixed(*((20.0 * (k + 1), 1e-5 * np.exp(1j * phase[k])) for k in range(20)))


def comb_error(controller, seconds, plate, finger=None):
    """Error of the centre within 10-420 Hz over the last 3 s, in dB of what is wanted."""
    motion = play(controller, seconds, plate, finger)[1][:, 0]
    bands = comb()
    time = np.arange(len(motion)) / RATE
    wanted = (bands.envelope * np.exp(1j * TURN * np.outer(time, bands.frequency))).real.sum(axis=1)
    keep = scipy.signal.butter(4, [10, 420], "band", fs=RATE, output="sos")
    error = scipy.signal.sosfiltfilt(keep, motion - wanted)
    late = slice(-15_000, -500)
    return 20 * np.log10(error[late].std() / wanted[late].std())


@pytest.mark.parametrize("method", ["h", "h2"])
def test_the_design_rules_keep_a_comb_of_20_hz_spacing(method):
    """The observer stays below spacing/5, where a comb diverges."""
    assert comb_error(METHODS[method].design(IDEAL.device_model(RATE, 1), comb()), 6.0, IDEAL) < -100


def test_h_and_h2_on_a_comb_under_a_sliding_heavy_finger():
    """H -45 dB without noise, H2 -48 to -51 dB with it."""
    finger = hr.Finger.sliding(speed=0.1, normal_load=0.8, mechanics=HEAVY, touches=((0.5, 100.0),))
    quiet, noisy = (plate.device_model(RATE, 1) for plate in (IDEAL, PlateParameters()))
    assert -47 < comb_error(METHODS["h"].design(quiet, comb()), 6.0, IDEAL, finger) < -42
    assert comb_error(METHODS["h2"].design(noisy, comb()), 9.0, PlateParameters(), finger) < -48


def touch(method, frequency, wanted, mechanics, position):
    """Largest relative error of the centre after a touch in 1 ms at 1 s, and after lift-off in one sample at 2 s."""
    load = 0.3 if mechanics is LIGHT_SECOND else 0.8
    curve = ((0.0, 1.0, 1.001), (1e-4, 1e-4, load))
    finger = hr.Finger(hr.Still(position), normal_load=curve, touches=((1.0, 2.0),), mechanics=mechanics)
    motion = hold(method, fixed((frequency, wanted)), 3.0, finger=finger)[1][:, :1]
    phase = TURN * frequency * np.arange(len(motion)) / RATE
    time, found = envelopes(motion, phase, RATE, max(0.02, 2 / frequency))
    error = abs(abs(found[:, 0]) / wanted - 1)
    return error[(time > 0.985) & (time < 1.9)].max(), error[(time > 1.985) & (time < 2.9)].max()


@pytest.mark.parametrize(("frequency", "position"), [(185.0, 0.0), (189.0, 27.5e-3)])
def test_an_instant_touch_shakes_h_but_not_h2(frequency, position):
    """With H heavy 50-69 %, light 24-46 %; H2 <= 13 %."""
    for mechanics in (HEAVY, LIGHT_SECOND):
        assert 0.2 < max(touch("h", frequency, 5e-5, mechanics, position)) < 0.90
        assert max(touch("h2", frequency, 5e-5, mechanics, position)) < 0.13


@pytest.mark.parametrize(
    ("wanted", "least", "most"), [(5e-5, 0.0, 0.13), (2e-5, 0.1, 0.2), (1e-5, 0.2, 0.4), (3e-6, 0.6, 1.0)]
)
@pytest.mark.parametrize("frequency", [143.0, 189.0])
def test_h2_lets_a_sudden_release_ring_below_10_um(frequency, wanted, least, most):
    """24-92 % below 10 um, 0.8 N: 25-35 % at 10 um, 79-82 % at 3 um (H 117-243 %): 18 um of sag ring out."""
    _, release = touch("h2", frequency, wanted, HEAVY, 0.0)
    assert least <= release < most
    if wanted == 3e-6:
        assert touch("h", frequency, wanted, HEAVY, 0.0)[1] > 1.1


def wrong(stiffness=1.0, mass=1.0, **other):
    """The plate that the controller believes in."""
    right = PlateParameters()
    return PlateParameters(
        stiffness_1=stiffness * right.stiffness_1,
        stiffness_2=stiffness * right.stiffness_2,
        mass=mass * right.mass,
        inertia=mass * right.inertia,
        **other,
    )


def settled(motion, frequency):
    """Seconds until centre and ends stay within 5 % of 50 um."""
    phase = TURN * frequency * np.arange(len(motion)) / RATE
    time, found = envelopes(motion, phase, RATE, 0.02)
    return time[abs(abs(found) / 5e-5 - 1).max(axis=1) > 0.05].max()


@pytest.mark.parametrize(("stiffness", "frequency"), [(1.05, 143.0), (1.05, 189.0), (0.95, 189.0)])
def test_a_wrong_stiffness_slows_h_and_not_h2(stiffness, frequency):
    """k off by 5 %: H settles in 0.1-0.2 s at 143 Hz and in 0.8-0.9 s at 189 Hz; H2 in 0.05."""
    known = wrong(stiffness, **IDEAL_SENSORS)
    late = settled(hold("h", fixed((frequency, 5e-5)), 4.0, IDEAL, known)[1], frequency)
    assert late < 0.3 if frequency == 143.0 else 0.5 < late < 1.2
    assert settled(hold("h2", fixed((frequency, 5e-5)), 4.0, IDEAL, known)[1], frequency) < 0.08


@pytest.mark.parametrize(
    ("frequency", "stiffness", "mass"), [(143.0, 1.05, 0.95), (189.0, 0.95, 1.05), (189.0, 1.1, 1.0)]
)
def test_h_diverges_on_a_plate_off_by_10_percent_and_h2_does_not(frequency, stiffness, mass):
    """k and m 5 % apart, or k 10 %, shift the mode by 5 %: H diverges; the inner loop adds j w b_a to D."""
    known = wrong(stiffness, mass, **IDEAL_SENSORS)
    motion = hold("h", fixed((frequency, 5e-5)), 6.0, IDEAL, known)[1]
    assert abs(amplitude_error(motion, frequency, 5e-5)).max() > 1.0
    motion = hold("h2", fixed((frequency, 5e-5)), 3.0, IDEAL, known)[1]
    assert settled(motion, frequency) < 0.2
    assert abs(amplitude_error(motion, frequency, 5e-5)).max() < 1e-3


def test_h2_holds_quietly_at_189_hz_only_on_the_plate_of_the_design():
    """Wobble in phase (within 20 Hz) of 1 um: 0.012-0.017 um; with k off by 1 % the detector opens: 0.043 um."""
    for known, least, most in ((wrong(), 0.0, 0.020e-6), (wrong(1.01), 0.03e-6, 0.06e-6)):
        motion = hold("h2", fixed((189.0, 1e-6)), 12.0, PlateParameters(), known, seed=1)[1][:, 0]
        turned = 2 * motion * np.exp(-1j * TURN * 189.0 * np.arange(len(motion)) / RATE)
        near = scipy.signal.sosfiltfilt(scipy.signal.butter(2, 20, fs=RATE, output="sos"), turned.real)
        assert least < near[10_000:-2500].std() < most


def spur(method, bits_known):
    """Largest line (m) of the centre at 180-220 Hz while 1 um at 20 Hz is held by a 12-bit drive, 5 s."""
    plate = PlateParameters()
    known = plate if bits_known else PlateParameters(current_bits=0)
    motion = hold(method, fixed((20.0, 1e-6)), 10.0, plate, known)[1][-25_000:, 0]
    line = 2 * abs(np.fft.rfft(motion - motion.mean())) / len(motion)
    frequency = np.fft.rfftfreq(len(motion), 1 / RATE)
    return line[(frequency >= 180) & (frequency <= 220)].max()


@pytest.mark.parametrize("method", ["h", "h2"])
def test_rounding_of_the_command(method):
    """Harmonics of 12-bit stairs meet the mode at 189 Hz: paper 0.40 um, H 0.33, H2 0.24; shaped 0.003.

    Rounding is unshaped where the controller is not told of the step.
    """
    assert 0.20e-6 < spur(method, False) < 0.45e-6
    assert spur(method, True) < 0.011e-6
    if method == "h2":
        assert 0.20e-6 < spur("paper", True) < 0.45e-6


def test_controlling_both_coordinates_holds_the_ends():
    """Common mode leaves the ends to the plate, 30 % and more near the rocking mode; heave and rocking hold them."""
    finger = hr.Finger.still(15e-3, normal_load=0.8, mechanics=HEAVY)
    errors = {}
    for method in ("paper-common", "h2"):
        motion = hold(method, fixed((147.0, 5e-5)), 6.0, IDEAL, finger=finger)[1][-5000:]
        found = phasor(motion, 147.0)
        errors[method] = abs(found / found[0] - 1).max()
    assert errors["paper-common"] > 0.3
    assert errors["h2"] < 1e-4
