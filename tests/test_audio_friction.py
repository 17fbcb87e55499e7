"""Screens and hybrids on a sound card: PortAudio on a JACK server, and the device with a finger as a second client."""

import time
from concurrent.futures import ThreadPoolExecutor

import jack_ring
import numpy as np
import pytest
from jack_ring import CLIENT, METRES, NOISE, RATE, ROUND_TRIP, SETTLED, run_paced
from waves import phasor

import hapticrender as hr
from hapticrender.drivers.audio import AudioDriver
from hapticrender.touch.perception import VELOCITY_PER_FORCE

pytestmark = pytest.mark.skipif(bool(jack_ring.missing()), reason=jack_ring.missing())


def test_a_screen_is_played_by_the_compiled_callback(connected, tmp_path):
    """Behind its square root, at the pace of a clock; within 3 %, the demand on friction, by its tribometer.

    1 mN of noise over half a second of 48 kHz is 0.01 mN of some 16.  There is no attraction after the end.
    """
    speed, load = 0.08, 0.4
    system, offset = jack_ring.screen(speed, load)
    device = connected(system, length=round(60 * RATE), noise=1e-3 / jack_ring.FRICTION)
    device.say(f"square {offset}")
    scales = {"drive_per_full_scale": jack_ring.PEAK, "sensed_per_full_scale": jack_ring.FRICTION}
    card = AudioDriver(CLIENT, (1,), (1,), delay=ROUND_TRIP, **scales)
    tone = hr.Grating(frequency=100.0, velocity=10e-3)
    with hr.Player("electroadhesion", card) as player, ThreadPoolExecutor(1) as pool:
        player.finger(-0.08, speed, load)
        player.play(tone)
        player.record(tmp_path / "screen.au")
        running = pool.submit(run_paced, device)
        while not running.done():
            player.finger(-0.08 + speed * player.time, speed, load)
            player.sleep(0.01)
        recording = player.end_recording()
    wanted, found = (phasor(each[SETTLED], 100.0, RATE) for each in (recording.reference, recording.motion[:, 0]))
    assert abs(found - wanted) < 0.03 * abs(wanted)
    time.sleep(0.05)
    friction = device.recorded(tmp_path / "record")[0][:, 0] * jack_ring.FRICTION
    assert friction[-1] == pytest.approx(0.8 * load, rel=1e-3)  # of the load alone
    assert friction.max() > friction[-1] + 2 * abs(wanted)  # the bias is headroom for twice the texture


def test_a_hybrid_is_played_by_the_compiled_callback_and_changes_its_texture(connected, tmp_path):
    """100 Hz, of which plate and screen make half each, 90 Hz as a whole waveform, by the plate, then 80 Hz.

    Skin velocity within 1 % and 1 degree.
    By its sensors, of which 1 um at both ends is 4 um/s over half a second, and 4 mN 23; and as it truly is.
    """
    speed, load, scales, part = 0.08, 0.4, {}, SETTLED.stop - SETTLED.start
    system, offset = jack_ring.hybrid(speed, load)
    device = connected(system, length=round(60 * RATE), noise=NOISE / METRES)
    device.say(f"square {offset}")
    scales["drive_per_full_scale"] = (jack_ring.AMPERES, jack_ring.AMPERES, jack_ring.PEAK)
    scales["sensed_per_full_scale"] = (METRES, METRES, jack_ring.FRICTION)
    card = AudioDriver(CLIENT, (1, 2, 3), (1, 2, 3), delay=ROUND_TRIP, **scales)
    with hr.Player("hybrid", card) as player, ThreadPoolExecutor(1) as pool:
        player.finger(-0.08, speed, load)
        for frequency in (100.0, 90.0, 80.0):
            texture = hr.Grating(frequency=frequency, velocity=10e-3)
            whole = hr.Recorded(
                samples=texture.waveform(np.arange(RATE) / RATE, np.zeros(round(RATE))), rate=RATE, gain=1.0
            )
            player.play(whole if frequency == 90.0 else texture)
            player.record(tmp_path / f"{frequency}.au")
            begin, running = player.time, pool.submit(run_paced, device)
            while not running.done():
                player.finger(-0.08 + speed * (player.time - begin), speed, load)
                player.sleep(0.01)
            recording = player.end_recording()
            signals = recording.reference, recording.motion[:, 0]
            wanted, found = (phasor(each[SETTLED], frequency, RATE) for each in signals)
            assert abs(wanted) == pytest.approx(10e-3, rel=1e-3)
            assert abs(abs(found / wanted) - 1) < 0.01
            assert abs(np.angle(found / wanted, deg=True)) < 1.0
            end = running.result() - round(0.1 * RATE)
            true = device.recorded(tmp_path / "record")[0][end - part : end].astype(float)
            moved, friction = (phasor(each, frequency, RATE) for each in (true[:, :2].mean(axis=1), true[:, 2]))
            skin = 2j * np.pi * frequency * METRES * moved + VELOCITY_PER_FORCE * jack_ring.FRICTION * friction
            assert abs(skin) == pytest.approx(10e-3, rel=0.01)
