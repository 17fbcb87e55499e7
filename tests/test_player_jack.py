"""Live play on a sound card: JACK's dummy back end, PortAudio on it, and the plate with a finger as a second client."""

import jack_ring
import numpy as np
import pytest
from jack_ring import METRES, NOISE, RATE

import hapticrender as hr

pytestmark = pytest.mark.skipif(bool(jack_ring.missing()), reason=jack_ring.missing())


def test_textures_change_under_the_callback(tmp_path):
    """Every period waits for all, so that nothing is lost: two tones, the second at half the gain; then zero drive."""
    program = jack_ring.build(tmp_path)
    system = jack_ring.plate()
    with (
        jack_ring.server(tmp_path),
        jack_ring.device(program, tmp_path, system, length=round(60 * RATE), noise=NOISE / METRES) as device,
    ):
        with hr.Player("vt-plate", jack_ring.driver(), profile={"rate": RATE}) as player:
            player.finger(0.01, 0.0, 0.8)
            player.play(hr.Grating(frequency=100.0, amplitude=5e-6))
            device.say("run 3000")
            first = player.state()
            player.play(hr.Grating(frequency=180.0, amplitude=5e-6))
            player.gain = 0.5
            device.say("run 3000")
            second = player.state()
            device.say(f"save {tmp_path / 'before'}")
        motion = device.recorded(tmp_path / "record")[0].mean(axis=1).astype(float) * METRES
    [tone], [other] = first.bands, second.bands
    assert (tone.target, other.target) == pytest.approx((5e-6, 2.5e-6), rel=1e-3)
    # by the sensors: 1 um of noise at two ends, over 12 000 samples, is 0.01 um; the law's 1 % and 2 % are what it must
    assert tone.error < 0.02
    assert other.error < 0.02
    assert np.isfinite(first.load)
    # the truth: the last second of 180 Hz before the end
    end = len(np.fromfile(tmp_path / "before", np.float32)) // 4
    phase = 2 * np.pi * 180.0 * np.arange(round(RATE)) / RATE
    last = motion[end - len(phase) : end]
    amplitude = abs(2 * np.mean(last * np.exp(-1j * phase)))
    assert amplitude == pytest.approx(2.5e-6, rel=0.02)
