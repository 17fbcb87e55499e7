"""The plate's parameters over a recording: a coil that warms and a suspension that creeps are followed."""

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.analysis.analyse import analyse_finger
from hapticrender.plants.plate import PlateParameters, structure
from hapticrender.touch.mechanics import LIGHT_SECOND, NONE

RATE, DURATION, LOAD, PLACE = 5000.0, 9.0, 0.4, 8e-3
TOUCH = (2.5, 6.0)
FREQUENCIES = np.array([31.0, 72.0, 111.0, 170.0, 261.0])


def open_loop(time, frequencies, motion=20e-6):
    """Currents (A, (n, 2)) that move the paper's plate by about `motion` over f/20 Hz at each frequency."""
    s = 2j * np.pi * frequencies
    stiffness = np.abs(32e-3 * s**2 + 1.7 * s + 45.3e3)
    phase = 2 * np.pi * np.arange(len(frequencies)) ** 2 / len(frequencies)
    current = np.cos(2 * np.pi * np.outer(time, frequencies) + phase) @ (
        motion * np.sqrt(20.0 / frequencies) * stiffness / 14.8
    )
    return np.stack([current, current], axis=1)


def drifting(drift, creep, touch, rng):
    """Recording of a plate whose parameters change in proportion to time (share of them at the end), and its truth.

    `creep` (m) is how far the plate's rest moves to the end.
    """
    n, step = round(DURATION * RATE), 250
    time = np.arange(n) / RATE
    start = PlateParameters()
    drive = open_loop(time, FREQUENCIES)
    drive = start.current_step * np.round(drive / start.current_step)
    motion, state = np.zeros((n, 2)), np.zeros(4)
    for first in range(0, n, step):
        share = (first + step / 2) / n
        names = ("stiffness_1", "stiffness_2", "damping_1", "damping_2")
        plate = PlateParameters.with_overrides({k: getattr(start, k) * (1 + drift.get(k, 0.0) * share) for k in names})
        down = touch is not None and touch[0] <= time[first] < touch[1]
        phi, gamma = structure(plate, LIGHT_SECOND if down else NONE, PLACE).zero_order_hold(RATE)
        pushed = np.column_stack([drive[first : first + step], np.full(step, LOAD * down)]) @ gamma.T
        for k in range(step):
            motion[first + k] = state[:2]
            state = phi @ state + pushed[k]
    ends = motion @ start.displacement(start.ends)[:, :2].T + (creep * time / DURATION)[:, None]
    sensed = ends + 1e-6 * rng.standard_normal((n, 2))
    sensed = start.sensor_step * np.round(sensed / start.sensor_step)
    bands = [hr.Grating(frequency=f, amplitude=10e-6) for f in FREQUENCIES]
    scene = hr.Scene(texture=sum(bands[1:], bands[0]), duration=DURATION)
    recorder = hr.Recorder(None, scene=scene, method="open", seed=0, rate=RATE, bands=scene.texture.bands(RATE))
    unknown = np.full(n, np.nan)
    rest = {"position": unknown, "normal_load": unknown, "reference": unknown, "flags": np.zeros(n, int)}
    recorder.append(drive=drive, sensed=sensed, motion=np.full((n, 3), np.nan), target=np.zeros((n, 5)), **rest)
    return recorder.finish()


@pytest.mark.parametrize(
    ("drift", "creep"),
    [
        ({"stiffness_1": 0.01, "damping_1": 0.1}, 0.0),  # a coil that warms
        ({"stiffness_1": -0.005, "stiffness_2": -0.01}, 3e-6),  # a suspension that creeps: 3 um are 136 mN
    ],
    ids=["warm coil", "creeping suspension"],
)
def test_changes_of_the_plate_are_followed(drift, creep, rng):
    found = analyse_finger(drifting(drift, creep, TOUCH, rng))
    assert found.plate.measured
    for name, values in found.plate.values.items():
        errors = found.plate.standard_errors[name]
        truth = getattr(PlateParameters(), name) * (1 + drift.get(name, 0.0) * found.plate.time / DURATION)
        assert (np.abs(values - truth) < 4 * errors).all(), name
        if name in drift:  # and a plate that does not change would not do
            assert abs(drift[name]) * truth[0] > 5 * errors.max(), name
    load = found.normal_load.value[(found.time > TOUCH[0] + 0.1) & (found.time < TOUCH[1] - 0.1)]
    assert (np.abs(load - LOAD) < 0.02).all()
    (touch,) = found.of_kind(2)
    assert max(abs(touch.start - TOUCH[0]), abs(touch.stop - TOUCH[1])) < 0.01
    z = found.impedance
    error = (z.value - LIGHT_SECOND.impedance(z.frequency)) / z.standard_error
    assert np.mean(np.abs(np.r_[error.real, error.imag]) < 2) > 0.85  # 95 % of 2 x 9 windows x 5 bands, 3 sigma below


def test_without_an_unloaded_span_the_profile_is_taken_and_said(rng):
    """With its uncertainty, where it has one."""
    recording = drifting({}, 0.0, (0.0, DURATION + 1), rng)
    found = analyse_finger(recording)
    assert not found.plate.measured
    assert any("no unloaded span" in note for note in found.notes)
    spread = [found.plate.standard_errors[name][0] / getattr(PlateParameters(), name) for name in found.plate.values]
    np.testing.assert_allclose(spread, [0.02, 0.02, 0.1, 0.1], rtol=1e-9)
    device = {"stiffness_1": 22.4e3, "stiffness_2": 22.9e3}
    profile = hr.DeviceProfile(kind="vt-plate", device=device, uncertainty=dict.fromkeys(device, 5.0))
    found = analyse_finger(recording, profile)
    assert found.plate.standard_errors["stiffness_1"][0] == pytest.approx(5.0)
    assert found.normal_load.standard_error[20_000] < 0.003  # 0.006 N by 2 % of the stiffness, 0.0023 N by noise
