"""The finger out of recordings of simulated subjects with known truth, with what the analysis says of its errors."""

import re
from dataclasses import replace

import numpy as np
import pytest
from subjects import OFF, ON, Subject, population
from test_analysis_plate import open_loop

import hapticrender as hr
from hapticrender.analysis.records import DOUBTFUL, LOADED
from hapticrender.analysis.smoothing import spread_of
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.mechanics import LIGHT

SAMPLED = slice(None, None, 331)  # of the series: 66 ms apart, where their errors are independent


@pytest.fixture(scope="module")
def studied():
    """Subjects, their recordings and what is found in them."""
    recordings = [(subject, subject.record()) for subject in population(10)]
    return [(subject, recording, hr.analyse_finger(recording)) for subject, recording in recordings]


def judged(found):
    """Samples of a touch, 0.1 s from its edges, where 10 Hz have settled."""
    return np.flatnonzero((found.time > ON + 0.1) & (found.time < OFF - 0.1))


def glass_force(subject, recording, n):
    """True force on the glass (N) as 10 Hz pass it: load, less stiffness times sag, and what passes of the carriers."""
    m = subject.mechanics
    f, amplitude = np.array(subject.frequencies), subject.amplitudes
    passed = np.exp(-0.5 * (2 * np.pi * f * spread_of(10.0)) ** 2) * m.impedance(f) * 2j * np.pi * f * amplitude
    time = np.arange(n) / recording.rate
    skin = m.stiffness if m.order == 2 else 1 / (1 / m.stiffness + 1 / m.phalanx_stiffness)
    load = recording.normal_load[:n]
    plate = PlateParameters.with_overrides(recording.scene.simulation)
    reach = plate.displacement(np.nan_to_num(recording.position[:n]))[:, :2]
    sag = np.einsum("ni,ij,nj->n", reach, np.linalg.inv(plate.stiffness_matrix), reach)  # m/N
    carriers = (np.exp(2j * np.pi * np.outer(time, f)) @ passed).real
    return load / (1 + skin * m.load_factor(load) * sag) + m.load_factor(load) * carriers


def test_load_position_and_contact_are_within_their_bounds(studied):
    """5 % or 20 mN; 1 mm in the middle 30 mm above 150 mN; 10 ms."""
    judged_once = False
    for subject, recording, found in studied:
        errors = subject.errors(recording, found)
        assert (errors.load < 1.0).all(), subject
        assert (errors.position < 1e-3).all(), subject
        judged_once |= errors.position.size > 0
        assert found.least_load < 0.15
        assert (errors.touches, errors.edge < 0.01) == (1, True), subject
    assert judged_once


def test_standard_errors_are_right(studied):
    """60 to 76 % of the errors are inside one, over all subjects, times and bands; of impedance and of the series."""
    inside = {"impedance": [], "load": [], "position": [], "velocity": []}
    for subject, recording, found in studied:
        error = subject.errors(recording, found).impedance
        inside["impedance"] += [np.abs(np.r_[error.real, error.imag]).ravel() < 1]
        at = judged(found)[SAMPLED]
        n = len(found.time)
        velocity = np.gradient(recording.position[:n]) * recording.rate
        truths = {"load": glass_force(subject, recording, n), "position": recording.position[:n], "velocity": velocity}
        series = (found.normal_load, found.position, found.velocity)
        if subject.speed < 0.06:  # beyond it 10 Hz are too few for the turns of a swipe: not an error of noise
            for (name, truth), each in zip(truths.items(), series, strict=True):
                inside[name] += [np.abs(each.value[at] - truth[at]) < each.standard_error[at]]
    shares = {name: np.concatenate(each).mean() for name, each in inside.items()}
    counts = {name: np.concatenate(each).size for name, each in inside.items()}
    assert counts["impedance"] > 1000
    assert all(counts[name] > 150 for name in counts)
    assert all(0.60 < share < 0.76 for share in shares.values()), shares


def test_a_finger_on_a_third_party_s_plate_is_measured_as_well():
    """Bending glass, whose mode the profile has 2 % too low, in blocks; 3 sigma of the share of 4 x 2 x 64 errors."""
    inside = np.array([], bool)
    for subject in population(16, 101)[4:8]:
        recording = subject.record_elsewhere((1250.0, 30.0, 0.1), block=20)
        believed = {"delay": 20, "bending_frequency": 1225.0, "bending_damping": 1 / 60, "bending_coil": 0.1}
        found = hr.analyse_finger(recording, PlateParameters(**believed))
        assert not found.notes
        errors = subject.errors(recording, found, grows=False)
        assert (errors.touches, errors.edge < 0.01) == (1, True)
        assert (errors.load < 1.0).all()
        assert (errors.position < 1e-3).all()
        inside = np.append(inside, np.abs(np.r_[errors.impedance.real, errors.impedance.imag]) < 1)
    assert any("its glass may bend" in note for note in hr.analyse_finger(recording).notes)  # as rigid glass
    assert inside.size == 4 * 2 * 64
    assert inside.mean() == pytest.approx(0.683, abs=3 * np.sqrt(0.683 * 0.317 / inside.size))


def test_recorded_truth_is_not_read(studied):
    """A recording from hardware has no position, load and motion."""
    _, recording, found = studied[0]
    blind = recording.frames.copy()
    for name in ("position", "normal_load", "motion", "reference", "target"):
        blind[:, recording.header.slices[name]] = np.nan
    again = hr.analyse_finger(hr.Recording(recording.header, blind, recording.scene))
    np.testing.assert_array_equal(again.normal_load.value, found.normal_load.value)
    np.testing.assert_array_equal(again.impedance.value, found.impedance.value)


def test_no_false_contact_in_ten_minutes():
    """Eight carriers on a plate that is 2 % off its profile, in blocks of 4 s; then 0.1 N are seen at once."""
    rate, block = 5000, 20_000
    subject = Subject(LIGHT, 0.1, 0.0, 11)
    touch = {"normal_load": 0.1, "touches": [(600.5, 700.0)], "mechanics": LIGHT}
    simulated = PlateParameters.with_overrides(subject.scene.simulation)
    plate = Plate(simulated, hr.Finger.still(position=0.005, **touch), seed=6)
    drive = open_loop(np.arange(block) / rate, np.array(subject.frequencies))  # whole periods in a block
    tracker = hr.FingerTracker(PlateParameters())
    found = [tracker.update(drive, plate.run(drive).sensed) for _ in range(601 * rate // block + 1)]
    time, contact = (np.concatenate([getattr(each, name) for each in found]) for name in ("time", "contact"))
    before = contact[time < 600.49]
    assert len(before) > 600 * rate - block
    assert not (before == LOADED).any()
    assert (before == DOUBTFUL).sum() < 100
    assert abs(time[np.argmax(contact == LOADED)] - 600.5) < 0.01  # 2 to 3 ms; one noise in five takes 17


def test_pauses_are_found_on_a_plate_three_deviations_off():
    """0.14 N: the carriers leave as much rms on the profile's plate, which is not yet measured."""
    subject = population(24, seed=1)[13]
    found = hr.analyse_finger(subject.record())
    (touch,) = found.of_kind(LOADED)
    assert max(abs(touch.start - ON), abs(touch.stop - OFF)) < 0.01
    assert len(found.impedance.time) == 8  # windows of 0.36 s in 2.92 s
    assert found.plate.measured
    assert not found.notes


def test_zero_of_the_sensors_is_taken_from_a_free_start(studied):
    """50 um are 2.3 N: without the zero the finger never lifts."""
    _, recording, found = studied[3]
    shifted = recording.frames.copy()
    shifted[:, recording.header.slices["sensed"]] -= 50e-6
    shifted = hr.Recording(recording.header, shifted, recording.scene)
    (always,) = hr.analyse_finger(shifted).of_kind(LOADED)
    assert always.start < 0.1
    assert always.stop > 4.9
    again = hr.analyse_finger(shifted, free_start=True)
    (touch,) = again.of_kind(LOADED)
    assert max(abs(touch.start - ON), abs(touch.stop - OFF)) < 0.01
    at = judged(found)
    assert np.abs(again.normal_load.value[at] - found.normal_load.value[at]).max() < 0.005


@pytest.mark.parametrize("bits", [0, 14])
def test_ideal_sensors_are_no_exception(bits):
    subject = Subject(LIGHT, 0.5, 0.0, 8, frequencies=(111.0,), off=0.0)
    scene = replace(subject.scene, simulation={"sensor_noise": 0.0, "sensor_bits": bits})
    recording = hr.render(scene)
    found = hr.analyse_finger(recording)
    at = judged(found)
    assert len(found.of_kind(LOADED)) == 1
    assert np.abs(found.normal_load.value[at] / glass_force(subject, recording, len(found.time))[at] - 1).max() < 0.005


def test_a_recording_says_in_what_blocks_and_how_late_its_driver_played(tmp_path):
    """Blocks of 4 samples, a delay of 12: late by 8 rows, of 15 degrees each at 210 Hz; an older file does not say."""
    finger = hr.Finger.still(normal_load=0.5, mechanics="heavy", touches=[(1.0, 2.2)])
    tones = hr.Sum([(hr.Grating(frequency=f, amplitude=6e-6), 1.0) for f in (47.0, 111.0, 210.0)])
    scene = hr.Scene(texture=tones, finger=finger, duration=3.0)
    plant = Plate(PlateParameters(delay=12), finger, block=4)
    recording = hr.render(scene, driver=SimulatedDriver(plant))
    assert (recording.header.block, recording.header.delay) == (4, 12)
    recording.save(tmp_path / "run.h5")
    profile = hr.DeviceProfile(kind="vt-plate", device={"delay": 12})
    found = hr.analyse_finger(hr.Recording.load(tmp_path / "run.h5"))
    np.testing.assert_array_equal(
        found.normal_load.value, hr.analyse_finger(recording, profile, block=4).normal_load.value
    )
    assert len(found.of_kind(LOADED)) == 1
    assert not any("delay" in note for note in found.notes)
    other = hr.analyse_finger(recording, PlateParameters(delay=11))
    assert "the profile's delay, 11 samples, is not that of the recording, 12 samples" in other.notes
    older = hr.Recording(replace(recording.header, block=None, delay=None), recording.frames)
    with pytest.raises(ValueError, match=r"plate's delay, 1: state delay, .* in \[device\] of the profile"):
        hr.analyse_finger(older, block=4)


def test_what_was_lost_or_is_not_one_finger_is_not_taken_for_one(studied):
    """100 ms without samples, as live play marks them, under a finger: no other touch, no window there, and a note."""
    subject, recording, found = studied[0]
    frames, columns = recording.frames[:].copy(), recording.header.slices
    lost = slice(round(2.0 * recording.rate), round(2.1 * recording.rate))
    frames[lost, columns["drive"]], frames[lost, columns["sensed"]] = 0.0, np.nan
    frames[lost, columns["flags"]] = int(hr.Flag.OVERRUN)
    spoiled = hr.analyse_finger(hr.Recording(recording.header, frames, recording.scene))
    assert any(note.startswith("samples were lost") for note in spoiled.notes)
    assert not any(note.startswith("samples were lost") for note in found.notes)
    inside = (spoiled.time > 1.9) & (spoiled.time < 2.2)
    assert set(spoiled.contact[inside]) == {DOUBTFUL}
    assert not ((spoiled.impedance.time > 1.95) & (spoiled.impedance.time < 2.15)).any()


@pytest.mark.parametrize(
    ("signal", "scale", "offset", "message"),
    [
        ("sensed", 1e6, 0.0, "check units, signs and scales"),  # micrometres that are taken for metres
        ("drive", -1.0, 0.0, "check units, signs and scales"),
        ("sensed", 1.0, 1e-3, "the sensors show -4[0-9].* N while unloaded"),  # the plate's 45 kN/m
    ],
)
def test_nonsense_is_named(studied, signal, scale, offset, message):
    _, recording, _ = studied[0]
    frames, columns = recording.frames[:].copy(), recording.header.slices[signal]
    frames[:, columns] = scale * frames[:, columns] + offset
    wrong = hr.Recording(recording.header, frames, recording.scene)
    found = hr.analyse_finger(wrong)
    assert any(re.search(message, note) for note in found.notes)
    if offset:
        assert not hr.analyse_finger(wrong, free_start=True).notes
