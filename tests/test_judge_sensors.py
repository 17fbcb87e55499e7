"""Verdicts on what sensors show: the uncertainty of their gain, and their noise."""

import math
from dataclasses import replace

import numpy as np
import pytest
from synthetic import make_bands, make_signals, summary_of

import hapticrender as hr
from hapticrender.loop import recorder_of
from hapticrender.protocols import Flag

UM = 1e-6


@pytest.mark.parametrize(
    ("source", "calibration", "gain", "tolerance", "value", "found"),
    [
        ("sensors", 0.01, 1.03, 0.05, 0.04, "passed"),
        ("sensors", 0.03, 1.03, 0.05, 0.06, "failed"),
        ("true", 0.5, 0.97, 0.02, 0.03, "failed"),
        ("true", 0.5, 0.99, 0.02, 0.01, "passed"),
    ],
)
def test_figures_from_sensors_contain_the_uncertainty_of_their_gain(source, calibration, gain, tolerance, value, found):
    """And it says nothing of a true motion."""
    bands = make_bands(100.0, 10 * UM)
    header = {"calibration": calibration, "motion_source": source}
    summary = summary_of(bands, make_signals(bands, gain * bands.envelope), header, tolerance=tolerance)
    assert summary["worst"]["value"] == pytest.approx(value, rel=1e-6)
    assert (summary["verdict"], summary["reason"]) == (found, "")


def test_the_noise_of_sensors_in_mm_is_recorded_as_that_of_the_motion():
    """Heave is the mean of two sensors at the ends, whose gains are 1."""
    rendering = hr.prepare(hr.Scene(texture=hr.Grating(frequency=80.0, amplitude=1e-5), duration=1.0), compiled=False)
    model = rendering.model
    milli = replace(model, coordinate_from_sensed=1e-3 * model.coordinate_from_sensed, sensed_noise=2e-3)
    header = recorder_of(replace(rendering, model=milli)).header
    assert header.sensed_noise == pytest.approx((2 * UM / math.sqrt(2), 2 * UM, 2 * UM))


@pytest.mark.parametrize(("noise", "found"), [([UM, 0.0, 0.0], "failed"), ([UM], "not judged")])
def test_noise_at_one_place_hides_no_error_at_another(rng, noise, found):
    """An error of 3 %, the tolerance 2 %, and at the centre noise of 6.2 % as well; a quiet end fails all the same."""
    bands = make_bands(100.0, 10 * UM)
    extra = np.zeros((20_000, 3))
    extra[:, 0] = UM * rng.standard_normal(20_000)
    header = {"sensed_noise": noise, "motion_source": "sensors"}
    summary = summary_of(bands, make_signals(bands, 0.97 * bands.envelope, extra=extra), header, tolerance=0.02)
    assert summary["verdict"] == found
    assert summary["waveform"]["places"]["centre"]["waveform_error"] > 0.06
    assert (summary["worst"]["place"] != "centre") == (found == "failed")


@pytest.mark.parametrize(
    ("gain", "flag", "found"), [(1.0, 0, "not judged"), (0.8, 0, "failed"), (1.0, Flag.OVERRUN, "failed")]
)
def test_what_the_noise_of_the_sensors_hides_is_not_judged(rng, gain, flag, found):
    """White noise of 1 um has 0.44 um from 20 to 500 Hz, 6.2 % of a tone of 10 um, beyond 2 %; lost samples fail."""
    bands = make_bands(100.0, 10 * UM)
    signals = make_signals(bands, gain * bands.envelope, extra=UM * rng.standard_normal((20_000, 3)))
    signals["flags"][::100] = flag
    summary = summary_of(bands, signals, {"sensed_noise": UM, "motion_source": "sensors"}, tolerance=0.02)
    assert summary["waveform"]["sensor_noise"] == pytest.approx(math.sqrt(480 / 2500) / math.sqrt(50), rel=1e-3)
    assert summary["waveform"]["places"]["centre"]["third_octaves"]["250 Hz"] < 0.04
    assert summary["verdict"] == found


@pytest.mark.parametrize(
    ("calibration", "value", "found"), [(0.09, 0.152, "not judged"), (0.11, 0.172, "failed"), (0.5, 0.562, "failed")]
)
def test_noise_excuses_no_uncertainty_that_is_over_the_bound_alone(rng, calibration, value, found):
    """White noise of 1 um reads 6.2 % of a tone of 10 um; the tolerance is 10 %, that of the windows 20 %."""
    bands = make_bands(100.0, 10 * UM)
    signals = make_signals(bands, bands.envelope, extra=UM * rng.standard_normal((20_000, 3)))
    header = {"sensed_noise": UM, "motion_source": "sensors", "calibration": calibration}
    summary = summary_of(bands, signals, header, tolerance=0.1)
    assert summary["verdict"] == found
    assert ("not distinct from the noise" in summary["reason"]) == (found == "not judged")
    assert summary["worst"]["value"] == pytest.approx(value, abs=0.01)
