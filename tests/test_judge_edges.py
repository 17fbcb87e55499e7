"""Verdicts at the edges of the band that is judged, 20 to 500 Hz: of textures, and of what a motion has beside it."""

import math

import numpy as np
import pytest
from synthetic import judged, make_play, times

UM = 1e-6


@pytest.mark.parametrize(
    ("frequency", "seconds"), [*((each, 4.0) for each in (15.0, 17.0, 18.0, 501.0, 502.0, 503.0)), (5.0, 0.4)]
)
def test_a_tone_beside_the_band_is_not_judged_whatever_the_motion(rng, frequency, seconds):
    """No figure divides by what is left of it in the band: 1 nm of noise beside it read 1e9 %."""
    tone = 10 * UM * np.cos(2 * np.pi * frequency * times(seconds))
    for motion in (tone, 0.0 * tone, tone + 1e-9 * rng.standard_normal(len(tone))):
        summary = make_play(tone, motion).summary()
        assert (summary["verdict"], summary["worst"]["value"]) == ("not judged", None)
        assert summary["reason"] == "the texture has nothing from 20 to 500 Hz"


@pytest.mark.parametrize("frequency", [20.0, 21.0, 499.0])
@pytest.mark.parametrize(("gain", "found"), [(0.91, "passed"), (0.89, "failed")])
def test_a_tone_at_an_edge_of_the_band_is_judged(frequency, gain, found):
    tone = 10 * UM * np.cos(2 * np.pi * frequency * times(4.0))
    figures, verdict = judged(tone, gain * tone)
    assert verdict == found
    assert figures["waveform_error"] == pytest.approx(1.0 - gain, rel=1e-6)


@pytest.mark.parametrize("outside", [5.0, 900.0])
@pytest.mark.parametrize(("gain", "found"), [(0.92, "passed in band"), (0.88, "failed")])
def test_a_thousandth_of_the_energy_in_the_band_is_judged_by_itself(outside, gain, found):
    far, near = (30 * UM * np.cos(2 * np.pi * hertz * times(4.0)) for hertz in (outside, 90.0))
    near *= math.sqrt(1e-3)
    summary = make_play(far + near, far + gain * near).summary()
    assert summary["verdict"] == found
    assert summary["waveform"]["share_outside"] == pytest.approx(0.999, abs=1e-5)
    assert summary["waveform"]["places"]["centre"]["waveform_error"] == pytest.approx(1.0 - gain, rel=0.01)


@pytest.mark.parametrize("phase", [0.0, 0.8, 1.6])
@pytest.mark.parametrize(
    ("amplitude", "frequency", "error", "worst"),
    [(100, 8, 0.04, 0.1), (30, 15, 0.06, 0.16), (10, 17, 0.04, 0.11), (10, 18, 0.1, 0.19), (30, 1200, 0.03, 0.03)]
    + [(30, 2000, 0.01, 0.01), (30, 2400, 0.01, 0.01)],
)
def test_motion_beside_the_band_fails_no_tone(amplitude, frequency, error, worst, phase):
    """Of what lies beside an edge the filter leaves a part, and the ends of a run one more; theory, section 7."""
    tone = 10 * UM * np.cos(2 * np.pi * 90 * times(4.0) + 0.3)
    beside = amplitude * UM * np.cos(2 * np.pi * frequency * times(4.0) + phase)
    figures, verdict = judged(tone, tone + beside)
    assert verdict == "passed"
    assert figures["waveform_error"] < error
    assert figures["window_error"] < worst


@pytest.mark.parametrize("frequency", [22.0, 25.0, 330.0, 480.0])
def test_motion_within_the_band_counts_whole(frequency):
    """What the high pass leaves of 22 Hz is 91 %, and the low pass of 480 Hz 73 %; the spectra leave all."""
    tone, beside = (10 * UM * np.cos(2 * np.pi * each * times(4.0)) for each in (90.0, frequency))
    figures, verdict = judged(tone, tone + 0.12 * beside)
    assert verdict == "failed"
    assert figures["waveform_error"] == pytest.approx(0.12, rel=0.01)
