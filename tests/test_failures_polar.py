"""FACTS 2, rows of the polar method: each fails as stated, and what cures it holds on the same plate."""

import numpy as np
import pytest
from naive_methods import (
    amplitude_error,
    chirp,
    envelopes,
    fixed,
    hold,
    play,
    polar,
    retarget,
    tones,
)

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.loopshape import butterworth, margins, reduced_controller
from hapticrender.control.methods import METHODS
from hapticrender.plants.vibrotactile import Plate, PlateParameters

RATE = 5000.0
IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0)
MODEL = IDEAL.band_model(RATE, 1)
LAW_GAIN = 14.8096  # 1/s, ki of the paper's law
PULL_IN = 0.356  # mm: largest 400 Hz amplitude at 3 A, a square wave through the plate


def test_row_01_polar_without_a_clamp_runs_to_the_limit():
    """Below 2.6 % of the present amplitude; found between 2.6 and 2.7 %.

    The step's undershoot o takes the command to -A_ref, from where it never comes back: r - (1 - r) o = -r, so
    r = o/(2 + o): 2.44 % for the design's o = 5.0 %, 2.65 % for the o = 5.4 % of the loop on the plate.
    """
    for ratio, clamp, survives in ((0.027, False, True), (0.025, False, False), (0.01, True, True)):
        wanted = np.full((30_000, 1), 1e-4)
        wanted[10_000:] *= ratio
        drive, motion = play(polar(MODEL, tones(RATE, 30_000, 47.0, wanted), clamp=clamp), plate=IDEAL)
        error = abs(amplitude_error(motion, 47.0, ratio * 1e-4)[0])
        assert error < 1e-3 if survives else error > 100
        assert (abs(drive[-5000:]).max() == IDEAL.current_limit) is not survives
    for method in ("paper", "h", "h2"):
        motion = retarget(method, 47.0, [(2.0, 1e-4), (4.0, 1e-6)], IDEAL)
        assert abs(amplitude_error(motion, 47.0, 1e-6)[0]) < 1e-3


def test_row_02_a_reference_on_the_branch_cut_runs_the_phase_away():
    """The error of two cut angles is 0 or 360 deg, 180 on average: ki 180 deg/s = 2666 deg/s, 8000 deg in 3 s.

    FACTS: 8400.  Noise decides how soon it starts and the drawn phase comes on top: 5 %.
    """
    on_the_cut = 1e-5 * np.exp(1j * np.pi * (1 - 1e-7))
    for wanted, relative, runs in ((on_the_cut, False, True), (on_the_cut, True, False), (1e-5j, False, False)):
        controller = polar(MODEL, tones(RATE, 20_000, 47.0, wanted), relative=relative)
        _, motion = play(controller)
        turned = abs(np.degrees(controller.state.law[1, 0, 0].real))
        if runs:
            assert turned == pytest.approx(LAW_GAIN * 180 * 4.0, rel=0.05)
            assert amplitude_error(motion, 47.0, 1e-5)[0] < -0.5
        else:
            assert turned < 200
            assert abs(amplitude_error(motion, 47.0, 1e-5)[0]) < 0.01
    for method in ("paper", "h", "h2"):
        _, motion = hold(method, fixed((47.0, on_the_cut)), 4.0)
        assert abs(amplitude_error(motion, 47.0, 1e-5)[0]) < 0.01


@pytest.mark.parametrize(
    ("faster", "bias"), [(1, -0.00097), (2, -0.0145), (3, -0.0573), (6, -0.168), (12, -0.296)], ids=lambda value: None
)
def test_row_03_too_fast_a_filter_biases_the_amplitude(faster, bias):
    """20 Hz, both bandwidths so many times 5 and 10 Hz: rL rT = 0.125 faster^2, and the rule allows 0.28.

    FACTS: -1.5, -5.7, -17 %, then broken: -30 % at x12.  Tolerance: the last printed digit; what is broken wanders with
    the rounding, by a percent.
    """
    tone = tones(RATE, 30_000, 20.0, 1e-4)
    _, motion = play(polar(MODEL, tone, loop_bandwidth=5.0 * faster, filter_bandwidth=10.0 * faster), plate=IDEAL)
    assert amplitude_error(motion, 20.0, 1e-4)[0] == pytest.approx(bias, abs=5e-4 if faster < 12 else 0.01)


def test_row_03_an_observer_has_no_image():
    """The residual holds no 2 f0: nothing is left but rounding, noise being off."""
    for method in ("h", "h2"):
        _, motion = hold(method, fixed((20.0, 1e-4)), 6.0, IDEAL)
        assert abs(amplitude_error(motion, 20.0, 1e-4)).max() < 1e-6


def test_row_04_two_sides_apart():
    """170 Hz: centre +129 %, far end +419 %, one side at zero; heave and rocking together hold within 0.01 %."""
    quiet = PlateParameters(sensor_noise=0.0)
    drive, motion = hold("paper", fixed((170.0, 1e-5)), 6.0, quiet)
    error = amplitude_error(motion, 170.0, 1e-5)
    assert (error[0], error[1:].max()) == (pytest.approx(1.29, abs=0.01), pytest.approx(4.19, abs=0.01))
    assert abs(drive[-5000:]).max(axis=0).min() == 0.0
    for method in ("h", "h2"):
        _, motion = hold(method, fixed((170.0, 1e-5)), 6.0, IDEAL)
        assert abs(amplitude_error(motion, 170.0, 1e-5)).max() < 1e-4


@pytest.mark.parametrize(
    ("frequency", "milliseconds", "holds"),
    [(47.0, 30, True), (47.0, 36, False), (47.0, 60, True), (111.0, 42, False), (111.0, 54, True), (111.0, 72, False)],
)
def test_row_07_polar_and_a_long_known_delay(frequency, milliseconds, holds):
    """FACTS: polar fails past 30-42 ms.  That is its branch cut, not its margin.

    A polar loop cannot be told the delay; the phase of the carrier over it has to be found by the phase loop, which
    runs away where that lies at the -270 deg cut: 609 = 360 + 249 deg over 36 ms at 47 Hz with overshoot, 238 over 42
    ms at 111 Hz.  Elsewhere it holds up to its delay margin, 73.6 ms.
    """
    late = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0, delay=5 * milliseconds)
    _, motion = hold("paper-common", fixed((frequency, 1e-5)), 10.0, late, known=IDEAL)
    error = abs(amplitude_error(motion, frequency, 1e-5)[0])
    assert error < 1e-3 if holds else error > 0.1


def test_row_07_resonance_shortens_the_delay_that_polar_bears():
    """The amplitude's own pole f0/2Q takes the margin from 73.6 to 50.7 ms: 42 ms hold, 54 do not."""
    law, low_pass = reduced_controller(5.0, 10.0), butterworth(10.0)
    mode, damping = (float(value[1]) for value in IDEAL.modes())
    assert margins(law, low_pass).delay_margin == pytest.approx(0.0736, abs=5e-5)
    assert margins(law, low_pass, amplitude_pole=mode * damping).delay_margin == pytest.approx(0.0507, abs=5e-5)
    errors = []
    for milliseconds in (42, 54):
        late = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0, delay=5 * milliseconds)
        _, motion = hold("paper-common", fixed((189.0, 1e-5)), 10.0, late, known=IDEAL)
        errors.append(abs(amplitude_error(motion, 189.0, 1e-5)[0]))
    assert errors[0] < 0.01
    assert errors[1] > 0.1


def recovered(motion, wanted, after):
    """Seconds after `after` (s) until the running amplitude at 400 Hz stays within 5 %."""
    n = np.arange(len(motion))
    total = np.cumsum(np.append(0.0, 2 * motion[:, 0] * np.exp(-2j * np.pi * 400 * n / RATE)))
    running = abs(total[50:] - total[:-50]) / 50
    return np.flatnonzero(abs(running / wanted - 1) > 0.05)[-1] / RATE + 0.01 - after


@pytest.mark.parametrize("wanted", [1e-5, 1e-4])
def test_row_08_saturation_winds_the_polar_loop_up(wanted):
    """2 s of 1 mm at 400 Hz, then less.  The wind-up, ki 2 s (1 mm - 0.356 mm), unwinds at ki (0.356 mm - A).

    That is 3.72 s to 10 um and 5.03 s to 100 um, plus the loop's own settling of 0.2 s: FACTS' 4 s is the recovery to
    10 um.  Ours scales the whole envelope and calculates back: <= 0.25 s.
    """
    targets = np.full((45_000, 1), wanted)
    targets[2500:12_500] = 1e-3
    _, motion = play(polar(MODEL, tones(RATE, 45_000, 400.0, targets)), plate=IDEAL)
    expected = 2.0 * (1.0 - PULL_IN) / (PULL_IN - wanted * 1e3)
    assert recovered(motion, wanted, 2.5) == pytest.approx(expected + 0.2, abs=0.05)
    motion = retarget("h2", 400.0, [(0.5, wanted), (2.0, 1e-3), (2.0, wanted)])
    assert recovered(motion, wanted, 2.5) <= 0.25


def test_row_09_close_bands_beat_into_the_polar_amplitude():
    """FACTS: worst band off 1.7-2.6 % at 20 Hz spacing, 98 % at 10 Hz; it grows with bands and their phases.

    Four in phase: 1.6 and 31 %; eight at random phases 5.5-6.0 and 35-57 %.  The observer's one residual has no beat.
    """
    for spacing, least, most in ((20.0, 0.015, 0.07), (10.0, 0.3, 1.0)):
        frequency = 60.0 + spacing * np.arange(4)
        _, motion = play(polar(MODEL, tones(RATE, 50_000, frequency, np.full(4, 1e-5))), plate=IDEAL)
        worst = max(abs(amplitude_error(motion, each, 1e-5)[0]) for each in frequency)
        assert least < worst < most
        _, motion = hold("h2", fixed(*((each, 1e-5) for each in frequency)), 4.0, IDEAL)
        assert max(abs(amplitude_error(motion, each, 1e-5)[0]) for each in frequency) < 1e-6


def chirped(method, speed, mechanics):
    """Relative errors (complex, by windows of 20 ms) of 50 um from 30 to 390 Hz, locked to a finger near 10 mm."""
    wavelength = 1e-5
    carriers = chirp(RATE, 30.0, 390.0, speed, 5e-5)
    position = 10e-3 + wavelength * np.unwrap(carriers.phase[:, 0]) / (2 * np.pi)
    load = 0.0 if mechanics == "none" else 0.8
    finger = hr.Finger.sampled(position, rate=RATE, normal_load=load, mechanics=mechanics)
    bands = Bands(
        frequency=np.zeros(1),
        wavenumber=np.full(1, 1 / wavelength),
        phase=np.full(1, -2 * np.pi * (position[0] / wavelength % 1)),
        envelope=np.full(1, 5e-5 + 0j),
    )
    controller = METHODS[method].design(MODEL, bands)
    motion = Plate(IDEAL, finger).closed_loop(controller, np.zeros(len(position)))[3].motion
    time, found = envelopes(motion, carriers.phase[:, 0], RATE, 0.02)
    return found[time > 1.01, 0] / 5e-5 - 1


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("speed", "mechanics", "naive", "h", "h2"),
    [
        (200, "none", 0.05, 0.0015, 0.0002),
        (200, "heavy", 0.16, 0.004, 0.0006),
        (400, "heavy", 0.18, 0.010, 0.0015),
        (800, "heavy", 0.20, 0.025, 0.005),
        (1600, "heavy", 0.20, 0.061, 0.015),
    ],
)
def test_row_10_chirps(speed, mechanics, naive, h, h2):
    """Amplitude, rms: polar 5.5 % at 200 Hz/s free and 16-21 % heavy; FACTS 10, 18 %, and 100 % at 1600 Hz/s.

    The 100 % is the error of the complex envelope: its phase is lost.  H 0.10 % free and 0.25, 0.78, 2.1, 4.8 % heavy
    (FACTS 0.4, 1.0, 1.9, 6.1), H2 0.006 and 0.02, 0.07, 0.26, 0.9 % (FACTS 0.5, 0.5, 0.7, 1.1 with noise).
    """
    polar_error = chirped("paper-common", speed, mechanics)
    assert rms(abs(1 + polar_error) - 1) > naive
    for method, bound in (("h", h), ("h2", h2)):
        assert rms(abs(1 + chirped(method, speed, mechanics)) - 1) < bound
    if speed == 1600:
        assert rms(abs(polar_error)) > 1.0
