"""The compiled step of the methods with low passes against its equations, and what it looks up."""

import dataclasses

import numpy as np
import pytest
from naive_low_pass import NaiveLowPass
from synthetic import make_bands

import hapticrender as hr
from hapticrender.control.controller import setpoint_rows
from hapticrender.control.methods import METHODS, Polar, Resonant, frequency_table
from hapticrender.plants.plate import PlateParameters

RATE, COUNT = 5000.0, 600
MODEL = PlateParameters().device_model(RATE, 1)
LOW_PASS = ("paper", "paper-common", "boxcar", "static", "stiffness", "resonant")
# of the largest drive: angles are good to 2.3e-10 rad and magnitudes to 1.8e-10 of themselves, which both loops
# integrate, and products of 64 turns to 64 roundings
CLOSE = 3e-9


def bands_of(frequency, wavenumber=0.0, envelope=1e-6):
    """Carriers with odd phases and envelopes."""
    k = np.arange(len(frequency))
    return make_bands(frequency, envelope * np.exp(1j * k) / (k + 1), wavenumber, 0.3 * k)


MIXED = bands_of([47.0, 0.0, 111.3, 0.0], [0.0, 1000.0, 0.0, 2500.0])
MANY = bands_of(np.linspace(20.0, 400.0, 19))  # more than a tile holds


def signals(rng, count=COUNT):
    """Noise, a finger that turns round, and lifts after 90 ms, and a waveform."""
    time = np.arange(count) / RATE
    position = np.where((time > 0.09) & (time < 0.1), np.nan, 0.02 * np.sin(20 * time))
    return 1e-6 * rng.standard_normal((count, 2)), position, 1e-6 * np.sin(2 * np.pi * 61.0 * time)


def check(method, bands, columns, feedback=True):
    """Compare a run with its equations, sample by sample."""
    controller = method.design(MODEL, bands, feedback=feedback)
    drive, target, flags = controller.run(*columns)
    p = {name: controller.settings[name] for name in controller.settings.dtype.names}
    rows = setpoint_rows(controller.bands)[:, : controller.n_bands]
    naive = NaiveLowPass(p, rows, controller._arrays.get("gains"))
    expected, aims = (
        np.array(each) for each in zip(*(naive.step(*row) for row in zip(*columns, strict=True)), strict=True)
    )
    assert abs(expected).max() > 1e-4
    np.testing.assert_allclose(drive, expected, rtol=0, atol=CLOSE * abs(expected).max())
    np.testing.assert_allclose(target, aims, rtol=0, atol=1e-12 * abs(aims).max())
    return drive, flags


FIXED = [(name, MANY) for name in ("boxcar", "stiffness")]


@pytest.mark.parametrize(("name", "bands"), [*FIXED, *((name, MIXED) for name in LOW_PASS)])
def test_a_run_is_its_equations(name, bands, rng):
    """The finger reverses at 79 and 236 ms, where a mirror image is followed, and is away for 10 ms.

    30 ms of NaN from sample 700 on: no drive after 20 ms, and it comes back within 20 ms of good samples.
    """
    sensed, position, waveform = signals(rng, 1300)
    sensed[700:850, 1] = np.nan
    drive, flags = check(METHODS[name], bands, (sensed, position, waveform))
    assert not drive[800:850].any()
    assert drive[851:].any(axis=1).all()
    assert np.array_equal(flags & hr.Flag.NONFINITE > 0, np.isnan(sensed[:, 1]))


@pytest.mark.parametrize(
    "method",
    [
        Polar(clamp=False),
        Polar(subtract=True),
        Polar(common=True, bandwidths=(3.0, 9.0)),
        Polar(boxcar=True, subtract=True),
        dataclasses.replace(METHODS["stiffness"], feed_forward=True),
        dataclasses.replace(METHODS["stiffness"], feed_forward=True, filtered=False),
        Resonant(gain=3.0),
    ],
    ids=str,
)
def test_options_are_their_equations(method, rng):
    check(method, MIXED, signals(rng))


@pytest.mark.parametrize("name", ["paper-common", "boxcar", "stiffness"])
def test_a_waveform_is_analysed_and_the_model_driven_open_loop_by_their_equations(name, rng):
    sensed, position, wanted = signals(rng)
    check(METHODS[name], dataclasses.replace(MIXED, envelope=None), (sensed, position, wanted))
    check(METHODS[name], MIXED, (np.zeros((COUNT, 0)), position, wanted), feedback=False)


@pytest.mark.parametrize("name", LOW_PASS)
@pytest.mark.parametrize("option", ["modulated", "differentiated"])
def test_complex_methods_modulate_and_differentiate_targets_and_polar_ones_refuse_to(name, option, rng):
    (sensed, position, _), bands = signals(rng), dataclasses.replace(MIXED, **{option: True})
    if name in ("static", "stiffness", "resonant"):
        check(METHODS[name], bands, (sensed, position, np.sin(0.02 * np.arange(COUNT))))
    else:
        with pytest.raises(hr.DesignError, match=f"method '{name}' cannot modulate"):
            METHODS[name].design(MODEL, bands)


@pytest.mark.parametrize("name", METHODS)
def test_a_gradient_is_refused_by_methods_that_move_the_surface_as_a_whole(name):
    model = dataclasses.replace(MODEL, shape=(1.0, 0.3))
    if name in LOW_PASS:
        METHODS[name].design(MODEL, MIXED)
        with pytest.raises(hr.DesignError, match="gradient: must be 0 1/m, .*: use 'inverse', 'h2' or 'h'"):
            METHODS[name].design(model, MIXED)
    else:
        METHODS[name].design(model, MIXED)


@pytest.mark.parametrize("name", ["paper", "paper-common", "boxcar"])
def test_a_whole_waveform_is_refused_with_the_method_that_plays_it_on_friction_devices_too(name):
    for differentiated in (False, True):
        bands = dataclasses.replace(hr.Bands.none(spatial=False), differentiated=differentiated)
        with pytest.raises(ValueError, match="no whole waveform: use 'inverse', or a grating"):
            METHODS[name].design(MODEL, bands)


def test_every_channel_is_cut_to_its_limit_and_flagged(rng):
    bands, sensed = bands_of([47.0, 111.0], envelope=1e-3), 1e-6 * rng.standard_normal((COUNT, 2))
    drive, flags = check(METHODS["paper"], bands, (sensed, np.full(COUNT, np.nan), np.zeros(COUNT)))
    limit = PlateParameters().current_limit
    assert abs(drive).max() == limit
    assert np.array_equal(flags & hr.Flag.SATURATED > 0, (abs(drive) == limit).any(axis=1))


def test_silence_keeps_the_phase_and_a_new_target_is_taken_up():
    """A target below 1e-12 m has no direction: the command fades with the last one; set anew, it is there again."""
    bands = bands_of([47.0])
    controller = METHODS["paper-common"].design(MODEL, bands)
    nothing = np.zeros((640, 2)), np.full(640, np.nan), np.zeros(640)
    controller.run(*nothing)
    controller.setpoints[:] = setpoint_rows(dataclasses.replace(bands, envelope=np.array([1e-13 + 0j])))
    controller.run(*nothing)
    assert controller.field("r_phasor_re")[0] == pytest.approx(1.0, abs=1e-12)
    assert controller.field("r_nonzero")[0] == 0.0
    controller.setpoints[:] = setpoint_rows(dataclasses.replace(bands, envelope=np.array([2e-6j])))
    _, target, _ = controller.run(*nothing)
    assert target[-1, 0] == 2e-6j
    assert controller.field("r_phasor_im")[0] == pytest.approx(1.0, abs=1e-12)


def test_the_table_is_the_free_device_behind_its_hold():
    """Heave of the plate is one mode: 1/(k + j w b - w^2 m) by the force of both coils, and the hold's sin(x)/x."""
    sides = MODEL.side_from_coordinate
    gain, lag = frequency_table(MODEL, sides.mean(axis=0)[None], np.ones((2, 1)), True)
    frequency = np.array([20.0, 47.0, 189.0, 400.0])
    w, at = 2 * np.pi * frequency, (frequency / 0.5).astype(int)
    force = MODEL.force_from_drive.sum(axis=1)
    stiffness = MODEL.stiffness - MODEL.mass * w[:, None, None] ** 2 + 1j * MODEL.damping * w[:, None, None]
    motion = np.linalg.solve(stiffness, np.broadcast_to(force[:, None], (4, 2, 1)))[..., 0] @ sides.mean(axis=0)
    x = w / RATE / 2
    np.testing.assert_allclose(gain[at], abs(motion) * np.sin(x) / x, rtol=1e-9)
    np.testing.assert_allclose(lag[at], np.angle(motion), rtol=1e-9)
