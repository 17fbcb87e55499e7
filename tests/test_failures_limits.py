"""Limits of H and H2, from both sides."""

import numpy as np
import pytest
import scipy.signal
from held import amplitude_error, envelopes, fixed, hold, play

import hapticrender as hr
from hapticrender.control.methods import METHODS
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import HEAVY, LIGHT_SECOND

RATE = 5000.0
IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0, sensor_range=0.1)
TURN = 2 * np.pi


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
    """40-70 % with H at 185-189 Hz, the finger learnt at 60 /s; H2 <= 13 %.

    Found in 1 ms and off in one sample, learnt at 100 /s: heavy 50-69 %, light 24-46 %.
    """
    for mechanics in (HEAVY, LIGHT_SECOND):
        assert 0.2 < max(touch("h", frequency, 5e-5, mechanics, position)) < 0.90
        assert max(touch("h2", frequency, 5e-5, mechanics, position)) < 0.13


@pytest.mark.parametrize(
    ("wanted", "least", "most"), [(5e-5, 0.0, 0.13), (2e-5, 0.1, 0.2), (1e-5, 0.2, 0.4), (3e-6, 0.6, 1.0)]
)
@pytest.mark.parametrize("frequency", [143.0, 189.0])
def test_h2_lets_a_sudden_release_ring_below_10_um(frequency, wanted, least, most):
    """24-92 % below ~10 um, 0.8 N: 24-33 % at 10 um, 76-90 at 3 um.  The 18 um of the sag ring out themselves.

    Found: 25-35 % at 10 um, 79-82 % at 3 um; H 117-243 % there.
    """
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


IDEAL_SENSORS = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0, "sensor_range": 0.1}


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
