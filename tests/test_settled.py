"""A sample in which little happens is left out of nothing: what is spared there changes no drive."""

from dataclasses import replace

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.batch import Scenario, simulate
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.settled import settled
from hapticrender.control.methods import METHODS
from hapticrender.plants.vibrotactile import Plate, PlateParameters

RATE, SAMPLES = 5000.0, 6000
QUIET = PlateParameters(current_bits=0, sensor_noise=0.0)  # what is rounded off hides nothing
MODEL = QUIET.band_model(RATE, 1)
# as in test_bank: some hundred roundings a sample, each kept for good by the integrals
ROUNDING = 100 * SAMPLES * np.finfo(float).eps
FINGER = hr.Finger.still(normal_load=0.6, mechanics="heavy", touches=((0.4, 0.7), (0.9, 1.1)))


def tones(frequency, envelope):
    return Bands(
        frequency=np.array(frequency),
        wavenumber=np.zeros(len(frequency)),
        phase=np.zeros(len(frequency)),
        envelope=np.asarray(envelope, complex),
    )


def played(bands, finger=FINGER, *, at_length=False, piece=100):
    """Drive, target and flags of a run, and in which share of its pieces the controller ended settled.

    A target that is a factor away from constant is never settled, also where the factor is always 1.
    """
    controller, plate = METHODS["h2"].design(MODEL, bands), Plate(QUIET, finger)
    controller.tables = controller.tables._replace(numbers=controller.tables.numbers._replace(modulated=at_length))
    rows, calm = [], []
    for _ in range(0, SAMPLES, piece):
        drive, target, flags, _ = plate.closed_loop(controller, np.ones(piece))
        rows.append((drive, target, flags))
        calm.append(settled(controller.state))
    return *(np.concatenate(column) for column in zip(*rows, strict=True)), np.mean(calm)


def same(spared, at_length):
    drive, target, flags, _ = spared
    expected, same_target, same_flags, none = at_length
    assert none == 0.0
    np.testing.assert_allclose(drive, expected, rtol=0, atol=ROUNDING * abs(expected).max())
    np.testing.assert_array_equal(target, same_target)
    np.testing.assert_array_equal(flags, same_flags)


@pytest.mark.parametrize("frequency", [(47.0,), (23.0, 47.0, 150.0, 189.0, 261.0), tuple(np.linspace(20.0, 380.0, 19))])
def test_a_settled_sample_equals_the_same_sample_taken_at_length(frequency):
    """A finger that comes and goes, twice, on one, five and nineteen bands."""
    bands = tones(frequency, 1e-6 * np.exp(0.4j * np.arange(len(frequency))))
    spared = played(bands)
    assert spared[3] > 0.8
    same(spared, played(bands, at_length=True))


@pytest.mark.parametrize("amplitude", [4e-4, 6e-4])
def test_the_limit_is_met_alike(amplitude):
    """Once within an overload, and once between; flags are those of the drive's envelope."""
    bands = tones((47.0, 261.0), (amplitude, 1j * amplitude))
    spared = played(bands)
    assert (spared[2] & 1).any() == (amplitude > 5e-4)
    assert 0.0 < spared[3] < 1.0
    same(spared, played(bands, at_length=True))


def pulses(share):
    """A comb whose drive reaches `share` of its limit, while the drive's quadrature reaches 2.4 times as far."""
    count = 40
    order = np.arange(1, count + 1)
    frequency, spectrum = 9.0 * order, -1j * np.sinc(order / (count + 1)) / order
    wave = (spectrum[:, None] * np.exp(2j * np.pi * order[:, None] * np.linspace(0.0, 1.0, 20_000))).sum(axis=0)
    assert abs(wave.imag).max() > 2.3 * abs(wave.real).max()
    turn = 2j * np.pi * frequency
    force = MODEL.stiffness[0, 0] + turn * MODEL.damping[0, 0] + turn**2 * MODEL.mass[0, 0]
    force = force * np.exp(1.5 / RATE * turn) / np.sinc(frequency / RATE)
    full = MODEL.drive_limit / abs(np.linalg.pinv(MODEL.force_from_drive)[0, 0])
    return tones(frequency, share * full / abs(wave.real).max() * spectrum / force)


def test_pulses_are_known_by_their_envelope():
    """Of a drive whose samples stay below half of the limit the envelope leaves it: settled or not, it is scaled."""
    bands = pulses(0.47)
    spared = played(bands, hr.Finger.absent())
    assert (spared[2] & 1).any()
    same(spared, played(bands, hr.Finger.absent(), at_length=True))


def test_a_lane_beside_one_at_its_limit_is_its_own_run():
    """Lanes are settled together or not at all; neither way tells them apart."""
    pair = [Scenario(bands=pulses(share), plate=QUIET) for share in (0.2, 0.9)]
    found, limited = simulate(pair, 1.0)
    alone = simulate(pair[:1], 1.0)[0]
    assert (limited.flags & 1).any()
    assert not alone.flags.any()
    np.testing.assert_array_equal(found.flags, alone.flags)
    np.testing.assert_allclose(found.drive, alone.drive, rtol=0, atol=ROUNDING * abs(alone.drive).max())


def three_coordinates():
    """A plate whose glass bends, sensed and driven on its own, coupled to heave through mass."""

    def grown(matrix, own, coupled=0.0):
        whole = np.zeros((3, 3))
        whole[:2, :2], whole[2, 2], whole[0, 2], whole[2, 0] = matrix, own, coupled, coupled
        return whole

    place = np.pad(MODEL.place_from_coordinate, ((0, 0), (0, 1)))
    return replace(
        MODEL,
        mass=grown(MODEL.mass, 0.03, 0.002),
        damping=grown(MODEL.damping, 1.5),
        stiffness=grown(MODEL.stiffness, 4e4),
        force_from_drive=grown(MODEL.force_from_drive, 5.0),
        coordinate_from_sensed=grown(MODEL.coordinate_from_sensed, 1.0),
        side_from_coordinate=grown(MODEL.side_from_coordinate, 1.0),
        place_from_coordinate=place,
        shape=(1.0, 0.2, -0.5),
    )


def test_a_third_coordinate_is_known_as_well(rng):
    """Nothing is moved by the drive: what the sensors show is the same for both."""
    bands = tones((47.0, 150.0, 261.0), 1e-6 * np.exp(0.4j * np.arange(3)))
    sensed, nowhere = 1e-7 * rng.standard_normal((1500, 3)), np.full(1500, np.nan)
    drives = []
    for modulated in (False, True):
        controller = METHODS["h2"].design(three_coordinates(), bands)
        numbers = controller.tables.numbers._replace(modulated=modulated, drive_step=0.0)
        controller.tables = controller.tables._replace(numbers=numbers)
        drives.append(controller.run(sensed, nowhere, np.ones(1500))[0])
        assert settled(controller.state) != modulated
    np.testing.assert_allclose(drives[0], drives[1], rtol=0, atol=ROUNDING * abs(drives[1]).max())
    assert (abs(drives[0][-500:]).max(axis=0) > 1e-3 * abs(drives[0]).max()).all()


@pytest.mark.parametrize("precision", ["double", "single"])
def test_either_precision_settles(precision):
    """1 um is no single-precision number: what is asked for is compared as the bands keep it."""
    controller = METHODS["h2"].design(MODEL, tones((47.0, 111.0), (1e-6, 3e-6)), precision=precision)
    Plate(QUIET, hr.Finger.absent()).closed_loop(controller, np.zeros(1000))
    assert settled(controller.state)
    assert (controller.state.pace == row.STEADY).all()
