"""Devices with a carrier on a sound card at 192 kHz: PortAudio, and the device as a second client of a JACK server.

In a file of its own, as a process of PortAudio should not meet two servers at once.
"""

from contextlib import ExitStack

import jack_ring
import numpy as np
import pytest
from jack_ring import CLIENT, FAST, PEAK, SHORT, VIBRATION, VOLTS, System
from scipy.signal import hilbert
from waves import phasor

import hapticrender as hr
from hapticrender.drivers.audio import AudioDriver
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.plants.ultrasonic_surface import SurfaceParameters

pytestmark = pytest.mark.skipif(bool(jack_ring.missing()), reason=jack_ring.missing())


@pytest.fixture
def fast(jack_program, tmp_path):
    """Function that connects a system to a card at `FAST`; returns it, and the card's driver for `Player`.

    From when the card is open until it closes every period of 83 us waits for all clients, and lasts 1 ms, so that the
    application sets the finger in time.
    """

    class Card(AudioDriver):
        def _open(self):
            super()._open()
            for each in ("free 1", "pace 1"):
                self.system.say(each)

        def close(self):
            if self.active:
                for each in ("pace 0", "free 0"):
                    self.system.say(each)
            super().close()

    def run(system, *channels, noise=0.0, **options):
        card = Card(CLIENT, *channels, rate=FAST, block=SHORT, **options)
        card.probe = False
        card.system = stack.enter_context(
            jack_ring.device(jack_program, tmp_path, system, length=round(120 * FAST), noise=noise)
        )
        return card.system, card

    with jack_ring.server(tmp_path, "fast", FAST, SHORT), ExitStack() as stack:
        yield run


def play_fast(device, kind, card, texture, path, **tables):
    """Play under a sliding finger, 0.3 s, then 0.25 s that are recorded; recording, and the device's last sample."""
    speed, load = 0.08, 0.4
    with hr.Player(kind, card, **tables) as player:
        player.finger(-0.08, speed, load)
        player.play(texture)
        for end in (0.3, 0.55):
            while player.time < end:
                player.finger(-0.08 + speed * player.time, speed, load)
                player.sleep(0.004)
            if end == 0.3:
                player.record(path)
        last = device.say("count").periods * SHORT
        return player.end_recording(), last


def test_an_ultrasonic_surface_is_played_by_the_compiled_callback(fast, tmp_path):
    """In closed loop over 32 samples at 192 kHz: by the friction that its amplitude leaves, and truly, within 1 %."""
    load, frequency = 0.4, 100.0
    scales = {"drive_per_full_scale": VOLTS, "sensed_per_full_scale": VIBRATION}
    device, card = fast(jack_ring.vibrating(load), (1,), (1,), noise=2e-9 / VIBRATION, delay=2 * SHORT, **scales)
    texture = hr.Grating(frequency=frequency, velocity=10e-3)
    recording, last = play_fast(device, "ultrasonic", card, texture, tmp_path / "live.au")
    here = slice(-round(0.2 * recording.rate), None)
    wanted, found = (
        phasor(each[here], frequency, recording.rate) for each in (recording.reference, recording.motion[:, 0])
    )
    true = device.recorded(tmp_path / "record")[0][last - round(0.25 * FAST) : last, 0] * VIBRATION
    amplitude = abs(hilbert(true.astype(float)))[round(0.03 * FAST) : round(0.23 * FAST)]
    surface = SurfaceParameters()
    friction = 0.8 * load * surface.friction_law.ratio(amplitude, load, 0.08)
    truth = phasor(friction, frequency, FAST) * surface.lag_response(frequency, 0.08)
    assert abs(found / wanted - 1) < 0.01
    assert abs(truth) == pytest.approx(abs(wanted), rel=0.01)
    assert recording.header.motion_source == "inferred"


def test_a_carrier_is_played_by_the_compiled_callback(fast, tmp_path):
    """20 kHz at 192, in open loop: at its crests, every 48 samples, the attraction is that of the texture."""
    load, frequency, speed = 0.4, 100.0, 0.08
    device, card = fast(
        System(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1)), (1,), (), drive_per_full_scale=PEAK
    )
    texture = hr.Grating(frequency=frequency, velocity=10e-3)
    recording, last = play_fast(
        device, "electroadhesion", card, texture, tmp_path / "live.au", rendering={"output": "carrier"}
    )
    played = device.recorded(tmp_path / "record")[0][:last, 0].astype(float)
    played = played[np.flatnonzero(played)[0] :] * PEAK * np.sinc(5 / 48)
    surface = ElectroadhesionParameters()
    attraction = surface.gain(load) * played[::48] ** 2
    here = slice(-round(0.2 * FAST / 48), None)
    friction = surface.friction_coefficient * attraction[here]
    truth = phasor(friction, frequency, FAST / 48) * surface.lag_response(frequency, speed)
    wanted = phasor(recording.reference[-round(0.2 * recording.rate) :], frequency, recording.rate)
    assert abs(truth) == pytest.approx(abs(wanted), rel=0.01)
    turn = np.arange(len(played)) * 5 % 48 / 48
    np.testing.assert_allclose(played[turn == 0.25], 0, atol=1e-9)
