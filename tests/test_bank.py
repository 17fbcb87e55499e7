"""The compiled band bank against its slow twin, sample by sample, through everything that a finger can do to it."""

import functools

import numpy as np
import pytest
from naive_bank import NaiveBank

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.finger import TRACKER_POLE
from hapticrender.control.bank.state import across_bands
from hapticrender.control.methods import METHODS
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.protocols import Flag

RATE = 5000.0
SAMPLES = 2500
TIME = np.arange(SAMPLES + 1) / RATE
PATH = 15e-3 * np.sin(2 * np.pi * 3.0 * TIME)  # up to 280 mm/s, turning round at 83, 250 and 417 ms
IDEAL = {"current_bits": 0}
OURS = ("h", "h2")
# some hundred roundings a sample, each kept for good by the integrals and worth at most the largest number about
ROUNDING = 100 * SAMPLES * np.finfo(float).eps


def mixed(fixed, wavenumbers, amplitude):
    """Fixed and finger-locked carriers, none in phase with another; `amplitude` None leaves targets to analysis."""
    count = len(fixed) + len(wavenumbers)
    return Bands(
        frequency=np.array([*fixed, *np.zeros(len(wavenumbers))]),
        wavenumber=np.array([*np.zeros(len(fixed)), *wavenumbers]),
        phase=np.linspace(0.0, 2.0, count),
        envelope=None if amplitude is None else amplitude * np.exp(0.4j * np.arange(count)),
    )


SCENES = {  # bands, plate
    "wide": (mixed([47.0, 189.0], [500.0], 3e-5), IDEAL),
    "crowded": (mixed([150.0, 170.0, 190.0], [], 3e-5), IDEAL),
    "analysed": (mixed([47.0, 111.0], [1000.0], None), IDEAL),
    "analysed and crowded": (mixed([20.0, 40.0], [500.0, 1000.0], None), IDEAL),
    "locked only": (mixed([], [500.0], 3e-5), IDEAL),
    "rounded to 12 bit": (mixed([47.0, 261.0], [], 1e-6), {}),
}
FINGER = hr.Finger.sampled(PATH, rate=RATE, normal_load=0.8, touches=((0.04, 0.3), (0.4, 0.45)), mechanics="heavy")


def waveform(bands):
    """Wanted (m): a chord on the carriers' own frequencies, where it has to be analysed."""
    if bands.envelope is not None:
        return np.zeros(SAMPLES)
    return 3e-5 * np.cos(bands.carrier_phase(TIME[:-1], PATH[:-1])).sum(axis=1)


def twin_run(tables, sensed, position, wanted):
    """Drive, target and flags by the twin, and what it went through."""
    twin = NaiveBank(tables, TRACKER_POLE)
    rows, events = [], set()
    for n in range(len(sensed)):
        rows.append(twin.step(sensed[n], position[n], wanted[n]))
        events |= {"touch"} if twin.contact else {"free", "left"} if "touch" in events else {"free"}
        events |= {name for name, opening in zip(("fast", "slow"), twin.open, strict=True) if opening == 1}
        events |= {"adapted"} if any((twin.m, twin.b, twin.k)) else set()
        events |= {"backwards"} if twin.velocity < -0.05 else {"forwards"} if twin.velocity > 0.05 else set()
        events |= {"scaled"} if twin.scale < 1 else set()
    drive, target, flags = (np.array(column) for column in zip(*rows, strict=True))
    return drive, target, flags, events


@functools.cache
def closed(method, scene):
    """Tables, and what happened when plate and compiled bank were closed under the moving finger."""
    bands, plate = SCENES[scene]
    parameters = PlateParameters(**plate)
    controller = METHODS[method].design(parameters.band_model(RATE, 1), bands)
    return controller.tables, Plate(parameters, FINGER).closed_loop(controller, waveform(bands))


def agree(found, expected):
    assert abs(expected).max() > 0
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING * abs(expected).max())


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("method", OURS)
def test_the_kernel_equals_its_naive_twin(method, scene):
    """Touch, slide, reversal, lift-off and a second touch; row n + 1 of the drive is what sample n led to."""
    tables, (drive, target, flags, sensed) = closed(method, scene)
    wanted = waveform(SCENES[scene][0])
    expected, twin_target, twin_flags, events = twin_run(tables, sensed.sensed, sensed.position, wanted)
    agree(drive[1:], expected[:-1])
    agree(target, twin_target)
    assert np.array_equal(flags & (Flag.SATURATED | Flag.NONFINITE), twin_flags)
    assert {"touch", "fast", "adapted", "forwards", "backwards"} <= events
    assert "left" in events or scene == "analysed and crowded"  # its DC band is too slow for so short a lift


def test_the_runs_went_through_the_slow_detector_too():
    tables, (_, _, _, sensed) = closed("h2", "wide")
    assert "slow" in twin_run(tables, sensed.sensed, sensed.position, np.zeros(SAMPLES))[3]
    assert np.isfinite(tables.numbers.slow_level)
    assert np.isinf(closed("h2", "crowded")[0].numbers.slow_level)


@pytest.mark.parametrize("scene", ["wide", "rounded to 12 bit"])
def test_both_detectors_hear_what_the_twin_hears(scene):
    """Finger-locked carriers, and fixed ones; the slow detector listens to the fast one, every eighth sample."""
    bands, plate = SCENES[scene]
    _, (_, _, _, sensed) = closed("h2", scene)
    controller = METHODS["h2"].design(PlateParameters(**plate).band_model(RATE, 1), bands)
    controller.run(sensed.sensed, sensed.position, np.zeros(SAMPLES))
    twin = NaiveBank(controller.tables, TRACKER_POLE)
    for n in range(SAMPLES):
        twin.step(sensed.sensed[n], sensed.position[n], 0.0)
    for at, heard in ((row.FAST_RE, twin.fast), (row.SLOW_RE, twin.slow)):
        for c in range(2):
            re, im = (
                across_bands(controller.state.loop, c * row.LOOP_ROWS + at + r, controller.n_bands) for r in range(2)
            )
            agree(re + 1j * im, heard[c])


@pytest.mark.parametrize("method", OURS)
def test_the_twin_agrees_through_an_overload(method):
    """The limit is lowered to half of what the carriers need before the touch; overload is left and entered again."""
    bands, plate = SCENES["wide"]
    model = PlateParameters(**plate).band_model(RATE, 1)
    _, (drive, _, _, sensed) = closed(method, "wide")
    controller = METHODS[method].design(model, bands)
    limit = float(abs(drive[:200]).max()) / 2
    controller.tables = controller.tables._replace(numbers=controller.tables.numbers._replace(drive_limit=limit))
    wanted = np.zeros(SAMPLES)
    found, _, flags = controller.run(sensed.sensed, sensed.position, wanted)
    expected, _, twin_flags, events = twin_run(controller.tables, sensed.sensed, sensed.position, wanted)
    assert "scaled" in events
    assert 0 < np.count_nonzero(flags) < SAMPLES
    assert np.array_equal(flags, twin_flags)
    agree(found, expected)


@pytest.mark.parametrize("method", OURS)
def test_the_twin_agrees_on_junk(method, rng):
    """Single samples, and a sensor that is dead for 60 ms; a finger that leaps; a wanted waveform beyond all sense."""
    bands, _ = SCENES["analysed"]
    _, (_, _, _, sensed) = closed(method, "analysed")
    values, position, wanted = sensed.sensed.copy(), sensed.position.copy(), waveform(bands)
    junk = [np.nan, np.inf, -np.inf, 1e30, -1e30]
    values[rng.integers(0, SAMPLES, 30), rng.integers(0, 2, 30)] = rng.choice(junk, 30)
    values[1700:2000, 0] = np.nan
    position[rng.integers(0, SAMPLES, 10)] = rng.choice([*junk, 0.05], 10)
    wanted[rng.integers(0, SAMPLES, 10)] = rng.choice(junk, 10)
    controller = METHODS[method].design(PlateParameters().band_model(RATE, 1), bands)  # 12 bit
    found, _, flags = controller.run(values, position, wanted)
    expected, _, twin_flags, _ = twin_run(controller.tables, values, position, wanted)
    assert np.array_equal(flags, twin_flags)
    assert np.count_nonzero(flags & Flag.NONFINITE) > 330
    assert not expected[1800:2000].any()
    agree(found, expected)


@pytest.mark.parametrize("method", OURS)
def test_any_split_into_blocks_and_the_closed_loop_give_the_same(method, rng):
    bands, plate = SCENES["analysed"]
    _, (drive, target, flags, sensed) = closed(method, "analysed")
    controller = METHODS[method].design(PlateParameters(**plate).band_model(RATE, 1), bands)
    edges = [0, *sorted(rng.integers(0, SAMPLES, 6)), SAMPLES]
    wanted = waveform(bands)
    parts = [
        controller.run(sensed.sensed[i:j], sensed.position[i:j], wanted[i:j])
        for i, j in zip(edges, edges[1:], strict=False)
    ]
    found, envelopes, _ = (np.concatenate(column) for column in zip(*parts, strict=True))
    assert np.array_equal(found[:-1], drive[1:])
    assert np.array_equal(envelopes, target)


def test_without_sensors_the_twin_drives_alike():
    bands = mixed([47.0, 261.0], [500.0], 1e-5)
    controller = METHODS["h2"].design(PlateParameters(**IDEAL).band_model(RATE, 1), bands, feedback=False)
    found, _, flags = controller.run(np.zeros((1000, 0)), PATH[:1000], np.zeros(1000))
    tables = controller.tables._replace(listen=np.zeros((2, 0)))
    agree(found, twin_run(tables, np.zeros((1000, 0)), PATH[:1000], np.zeros(1000))[0])
    assert not flags.any()
