"""Targets that a waveform multiplies, that grow with the finger's speed, and carriers that follow a resonance."""

import numpy as np
import pytest

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel, FingerRange
from hapticrender.control.methods import method_named
from hapticrender.errors import DesignError
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Flag

RATE = 5000.0
MODEL = PlateParameters().band_model(RATE, 1)
BLOCKS = PlateParameters().band_model(48e3, 128)


def targets(bands, wanted, position, method="h2", model=MODEL):
    """Target envelopes of a controller that senses nothing, with the ramp at the beginning cut off."""
    controller = method_named(method).design(model, bands)
    sensed = np.zeros((len(wanted), 2))
    return controller.run(sensed, position, wanted)[1]


@pytest.mark.parametrize("method", ["h", "h2", "stiffness", "resonant"])
def test_a_modulated_target_is_its_envelope_times_the_waveform(method):
    n = 2000
    wanted = 1.0 + 0.5 * np.sin(2 * np.pi * 7.0 * np.arange(n) / RATE)
    bands = Bands(frequency=[100.0], wavenumber=[0.0], phase=[0.0], envelope=[1e-6 + 2e-6j], modulated=True)
    target = targets(bands, wanted, np.full(n, np.nan), method)
    late = slice(500, None)  # a target fades in over 50 ms
    np.testing.assert_allclose(target[late, 0], (1e-6 + 2e-6j) * wanted[late], rtol=1e-12)


def test_in_blocks_the_factor_is_that_of_the_blocks_end():
    from dataclasses import replace

    n, block = 9600, 64
    wanted = 1.0 + 0.5 * np.sin(2 * np.pi * 7.0 * np.arange(n) / 48e3)
    bands = Bands(frequency=[100.0], wavenumber=[0.0], phase=[0.0], envelope=[1e-6 + 0j], modulated=True)
    target = targets(bands, wanted, np.full(n, np.nan), "h2", replace(BLOCKS, block=block))
    ends = wanted.reshape(-1, block)[:, -1]
    np.testing.assert_allclose(target[::block, 0][60:], 1e-6 * ends[60:], rtol=1e-12)


@pytest.mark.parametrize("method", ["h2", "stiffness"])
@pytest.mark.parametrize("speed", [0.08, -0.04])
def test_a_differentiated_target_turns_with_the_signed_frequency(method, speed):
    """d/dt Re A e^(j 2 pi x/l) has the envelope j 2 pi (v/l) A, v < 0 included; a fixed one has j 2 pi f A."""
    n = 3000
    position = speed * (np.arange(n) / RATE - 0.3)
    locked = Bands(frequency=[0.0], wavenumber=[1e3], phase=[0.0], envelope=[1e-6 + 0j], differentiated=True)
    target = targets(locked, np.zeros(n), position, method)
    # the finger's tracker (triple pole of 60 Hz) has found its speed after some 30 ms, the ramp ends after 50
    np.testing.assert_allclose(target[-1, 0], 2j * np.pi * speed * 1e3 * 1e-6, rtol=1e-9)
    fixed = Bands(frequency=[80.0], wavenumber=[0.0], phase=[0.0], envelope=[1e-6 + 0j], differentiated=True)
    target = targets(fixed, np.zeros(n), position, method)
    np.testing.assert_allclose(target[-1, 0], 2j * np.pi * 80.0 * 1e-6, rtol=1e-9)


def test_a_waveform_is_analysed_then_differentiated():
    n = 8000
    wanted = 1e-6 * np.cos(2 * np.pi * 80.0 * np.arange(n) / RATE)
    bands = Bands(frequency=[80.0], wavenumber=[0.0], phase=[0.0], differentiated=True)
    target = targets(bands, wanted, np.full(n, np.nan))
    np.testing.assert_allclose(target[-1, 0], 2j * np.pi * 80.0 * 1e-6, rtol=1e-3)  # the bank's pole, 1.6 s later


@pytest.mark.parametrize("kind", ["modulated", "differentiated"])
def test_polar_methods_refuse_such_targets(kind):
    bands = Bands(frequency=[80.0], wavenumber=[0.0], phase=[0.0], envelope=[1e-6 + 0j], **{kind: True})
    with pytest.raises(DesignError, match="polar"):
        method_named("paper").design(MODEL, bands)


CARRIER, MASS, QUALITY = 30e3, 5e-3, 200.0
FAST = 192e3


def resonator(lock):
    """Ultrasonic mode as a band model (FACTS 6)."""
    omega = 2 * np.pi * CARRIER
    stiffness = MASS * omega**2
    one = np.eye(1)
    return BandModel(
        rate=FAST,
        delay=1,
        mass=MASS * one,
        damping=MASS * omega / QUALITY * one,
        stiffness=stiffness * one,
        force_from_drive=one,
        coordinate_from_sensed=one,
        side_from_coordinate=one,
        place_from_coordinate=one,
        places=("amplitude",),
        drive_limit=40.0,
        sensed_limit=2e-5,
        rigid=True,
        pace=25.0,
        lock=lock,
        finger=FingerRange(
            mass=(0.0, 0.0),
            damping=(-1.0, 200.0),
            stiffness=(-0.03 * stiffness, 0.03 * stiffness),
            typical_mass=1e-12,
            typical_stiffness=1e5,
            contact=None,
        ),
    )


def played(shift, lock, seconds=0.15):
    """Drive, flags and found shift of the carrier on a mode that is `shift` (Hz) away from the model."""
    from scipy.linalg import expm

    omega = 2 * np.pi * (CARRIER + shift)
    system = np.zeros((3, 3))
    system[0, 1], system[1] = 1.0, [-(omega**2), -omega / QUALITY, 1 / MASS]
    grown = expm(system / FAST)
    bands = Bands(frequency=[CARRIER], wavenumber=[0.0], phase=[0.0], envelope=[1e-6 + 0j])
    controller = method_named("h2").design(resonator(lock), bands)
    state, drive, played, flags = np.zeros(2), 0.0, [], []
    away, nothing = np.full(1, np.nan), np.zeros(1)
    for _ in range(int(seconds * FAST)):
        sensed = state[:1, None].copy()
        state = grown[:2, :2] @ state + grown[:2, 2] * drive
        out, _, flag = controller.run(sensed, away, nothing)
        drive = out[0, 0]
        played.append(drive)
        flags.append(flag[0])
    return np.array(played), np.array(flags), float(controller.state.shift[0])


def test_the_carrier_finds_the_resonance_and_spares_the_drive():
    """30 Hz off at Q 200 costs 7 % (FACTS 6: 10 K): sqrt(1 + (30/75)^2) without the lock, nothing with it."""
    late = int(0.03 * FAST)
    held, _, still = played(-30.0, 0.0)
    locked, flags, found = played(-30.0, 20.0)
    least = MASS * (2 * np.pi * (CARRIER - 30.0)) ** 2 / QUALITY * 1e-6 / np.sinc(CARRIER / FAST)  # behind the hold
    assert still == 0.0
    assert found == pytest.approx(-30.0, abs=0.5)
    assert abs(locked[-late:]).max() == pytest.approx(least, rel=5e-3)
    assert abs(held[-late:]).max() == pytest.approx(least * np.hypot(1.0, 30.0 / 75.0), rel=1e-2)
    assert not (flags[-late:] & Flag.UNLOCKED).any()
    assert (flags[:10] & Flag.UNLOCKED).all()  # before anything moves nothing is locked
