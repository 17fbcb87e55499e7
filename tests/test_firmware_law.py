"""The control law in C against the library's kernel, on the simulated plate, and under sanitisers."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest
from board import ROOT, SANITISED, compile_c
from laws import DEVICES, FINGERS, KINDS, PARTS, RATE, SAMPLES, TEXTURES, White, ahead_of, close, kernel_of
from test_supervisor import Rewired
from waves import waveform_error

import hapticrender as hr
from hapticrender.control import supervisor_kernel as causes
from hapticrender.loop import MISMATCH
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Flag

LOW_LIMIT = 0.05  # A: every texture here needs more


def assert_same(found, drive, flags):
    """Drive (A) to what rounding leaves, 2e-13 A, and flags to the bit."""
    assert abs(found[0][: len(drive)] - drive).max() < 1e-9
    assert np.array_equal(found[1], flags)


CASES = [(name, finger, None) for name in TEXTURES for finger in FINGERS] + [
    (name, "slide", LOW_LIMIT) for name in TEXTURES
]
CASES.remove(("grating", "touch", None))  # a texture over position without a finger that moves is nothing new


@pytest.mark.parametrize(("name", "finger", "limit"), CASES)
def test_double_equals_the_kernel(exports, name, finger, limit):
    """Sample for sample on what the kernel's plate showed."""
    texture = TEXTURES[name]
    drive, flags, signals, _ = close(kernel_of(exports, name, limit), FINGERS[finger], texture)
    law = exports.law(name, "double")
    if limit is not None:
        assert law.code.law_limit(law.address, limit)
    sensed, position = (np.ascontiguousarray(array) for array in (signals.sensed, signals.position))
    assert_same(law.run(sensed, position, ahead_of(texture)), drive[1:], flags)
    assert abs(drive).max() > 0.01, "nothing was played"
    assert np.isfinite(position).any()
    assert (limit is not None) == bool((flags & Flag.SATURATED).any())


@pytest.mark.parametrize(
    ("finger", "stiffer", "limit", "found"),
    [
        (hr.Finger.absent(), 1.0, 0.3, (1e-4, MISMATCH)),
        (hr.Finger.absent(), 1.05, 0.3, (MISMATCH, 1.0)),
        (hr.Finger.absent(), 1.05, 0.01, (0.0, 0.0)),
        (FINGERS["touch"], 1.05, 0.3, (0.0, 0.0)),
    ],
    ids=["right", "wrong", "saturated", "touched 0.8 s ago"],
)
def test_both_find_the_same_difference_of_a_device_from_its_model(exports, finger, stiffer, limit, found):
    """Springs that are right, or 5 % stiffer; 0, unknown, at the drive's limit, or after a finger."""
    nominal = PlateParameters(current_bits=0)
    springs = {name: stiffer * getattr(nominal, name) for name in ("stiffness_1", "stiffness_2")}
    plate, kernel = Plate(replace(nominal, **springs), finger, seed=1), kernel_of(exports, "tones", limit)
    signals = plate.closed_loop(kernel, np.zeros(SAMPLES))[3]
    law = exports.law("tones", "double")
    assert law.code.law_limit(law.address, limit)
    law.run(*(np.ascontiguousarray(each) for each in (signals.sensed, signals.position)), np.zeros(SAMPLES))
    assert law.code.law_differs(law.address) == pytest.approx(kernel.mismatch, rel=1e-9)
    assert found[0] <= kernel.mismatch <= found[1]


@pytest.mark.parametrize("device", DEVICES)
def test_double_equals_the_kernel_on_other_devices(exports, device):
    """One coordinate; a longer delay; another rate; a sound card's; a damper of more taps."""
    parameters = PlateParameters(current_bits=0, **DEVICES[device])
    plate, samples = Plate(parameters, FINGERS["slide"], seed=1), max(5000, round(0.4 * parameters.rate))
    drive, _, flags, signals = plate.closed_loop(kernel_of(exports, device), np.zeros(samples))
    sensed, position = (np.ascontiguousarray(array) for array in (signals.sensed, signals.position))
    found = exports.law(device, "double").run(sensed, position, np.zeros(samples), parameters.coils)
    assert_same(found, drive[1:], flags)
    assert np.isfinite(position).any()


def test_double_equals_the_kernel_through_faults(exports, rng):
    """Sensors that fail one by one and all together, a position that leaps or is lost, a waveform that is no number."""
    n = 6000
    sensed = 1e-6 * rng.standard_normal((n, 2))
    position = np.where(np.arange(n) % 2500 > 700, 1e-5 * (np.arange(n) % 2500), np.nan)
    waveform = TEXTURES["white"].values[:n].copy()
    for start, length in ((1500, 3), (1600, 150), (3300, 40)):  # 20 ms, 100 samples, take the confidence away
        sensed[start : start + length, rng.integers(2)] = np.nan
    sensed[4000:4004] = 1.1e-3
    position[[900, 901, 1000]] = np.nan, 0.9, 2e3
    waveform[[500, 2000]] = np.nan, 2e3
    drive, _, flags = kernel_of(exports, "white").run(sensed, position, waveform)
    found = exports.law("white", "double").run(sensed, position, waveform)
    assert_same(found, drive, flags)
    assert (found[0][1720:1750] == 0.0).all()
    assert (flags & Flag.NONFINITE).any()
    assert (flags & Flag.SENSOR_CLIPPED).any()


FAULTS = {
    "none": (0, lambda sensed: sensed),
    "not finite": (causes.INVALID, lambda sensed: np.nan * sensed),
    "every third": (causes.INVALID, lambda sensed: np.where(np.arange(len(sensed)) % 3, sensed, np.nan)),
    "5 ms are lost": (0, lambda sensed: np.where(np.arange(len(sensed)) % 507 < 25, np.nan, sensed)),
    "inverted, every fourth lost": (
        causes.SENSOR_GAIN,
        lambda sensed: np.where(np.arange(len(sensed)) % 4, -sensed, np.nan),
    ),
    "frozen": (causes.FROZEN, lambda sensed: 0.0 * sensed + 1e-6),
    "inverted": (causes.INCONSISTENT, lambda sensed: -sensed),
    "swings far": (causes.OVERMOTION, lambda sensed: 0.95e-3 * np.sin(0.12 * np.arange(len(sensed)))),
    "rings": (causes.RINGING, lambda sensed: sensed + 15e-6 * np.sin(1.6 * np.arange(len(sensed)))),
    "moves the damper's force far": (
        causes.ACTIVE,
        lambda sensed: sensed + 4e-4 * np.sin(0.5 * np.arange(len(sensed))),
    ),
    "another tone": (causes.ACTIVE, lambda sensed: 100e-6 * np.sin(0.25 * np.arange(len(sensed)))),
}


def assert_both_stop(exports, cause, sensed, position):
    """The library's supervised law and those in C for the same cause; in double it is sample for sample."""
    n, controller = len(sensed), exports.rendering("tones").controller()
    drive, _, flags = controller.run(sensed, position, np.zeros(n))
    assert (controller.fault.cause if controller.fault else 0) == cause
    for kind in KINDS:
        law = exports.law("tones", kind, "supervised")
        found, found_flags = law.run(sensed, position, np.zeros(n))
        assert law.code.supervised_cause(law.address) == cause, kind
        stops = [np.argmax(each & Flag.STOPPED) for each in (flags, found_flags)]
        assert abs(np.diff(stops)) <= (0 if kind == "double" else 5), kind
        if kind == "double":
            assert_same((found, found_flags), drive, flags)
    return stops[0]


@pytest.mark.parametrize("fault", FAULTS)
def test_the_supervisor_equals_the_librarys(exports, fault):
    """A sensor fails after 0.9 s; in float its tests see what rounding leaves, and stop for the same cause."""
    cause, disturb = FAULTS[fault]
    texture = TEXTURES["tones"]
    signals = close(kernel_of(exports, "tones"), FINGERS["slide"], texture)[2]
    sensed, position = signals.sensed[:9000].copy(), np.ascontiguousarray(signals.position[:9000])
    sensed[4500:, 0] = disturb(sensed[4500:, 0])
    assert_both_stop(exports, cause, sensed, position)


def test_a_contact_that_begins_or_ends_holds_one_test_of_both(exports):
    """An inverted sensor is inconsistent with the drive within 26 ms, under taps within 28 ms after the last 60 ms.

    A position that is missing for a sample is no lift-off.
    """
    signals = close(kernel_of(exports, "tones"), FINGERS["slide"], TEXTURES["tones"])[2]
    sensed, stops = signals.sensed[:9000].copy(), []
    sensed[4500:, 0] *= -1.0
    for lost, every in ((0, 200), (1, 200), (100, 200)):
        position = np.ascontiguousarray(signals.position[:9000])
        for each in range(4500, 5500, every):
            position[each : each + lost] = np.nan
        stops.append(assert_both_stop(exports, causes.INCONSISTENT, sensed, position))
    assert stops[0] == stops[1] < 4500 + 130
    assert 5400 + 300 + 75 <= stops[2] < 5400 + 300 + 140
    controller = exports.rendering("tones").controller()
    controller.state["p"]["danger_drive"], controller.state["p"]["active_time"] = 0.0, 9000  # always in danger
    controller.run(sensed, position, np.zeros(9000))
    assert controller.fault.cause == causes.INCONSISTENT
    assert 4500 < controller.fault.sample < 4500 + 130


@pytest.mark.parametrize(
    ("shown", "moved", "touch", "cause", "named"),
    [
        (-np.eye(2), np.eye(2), None, causes.SENSOR_GAIN, "sensor 1 and 2"),
        (np.eye(2), -np.eye(2), None, causes.ACTUATOR_GAIN, "actuator 1 and 2"),
        (np.eye(2)[::-1], np.eye(2), (2.0, 0.05), causes.SWAPPED, "sensor 1 and 2"),
        (np.eye(2), np.eye(2)[::-1], (0.8, -0.05), causes.SWAPPED, "sensor 1 and 2"),
    ],
    ids=["sensors inverted", "coils inverted", "sensors swapped", "coils swapped"],
)
def test_changes_of_gains_stop_both(exports, shown, moved, touch, cause, named):
    """The sensors of a closed loop that the library stopped, played back to both; touched: load (N), place (m)."""
    tilt = {"finger": (4e-3, 1.5, 300.0), "load": touch[0], "position": touch[1]} if touch else {}
    known = {"finger": hr.Finger.absent(), "duration": 1.0, "profile": {"bending_frequency": 0.0}}  # as the export
    scene = replace(exports.rendering("tones").scene, **known)
    with pytest.raises(hr.DeviceFault, match=named) as stopped:
        hr.render(scene, driver=Rewired(shown, moved, start=0.9, seed=3, **tilt))
    sensed = np.ascontiguousarray(stopped.value.recording.sensed)
    assert_both_stop(exports, cause, sensed, np.full(len(sensed), np.nan))


def reference_of(texture, finger):
    """Target over a run; 0 while a finger that it follows is away."""
    time = np.arange(SAMPLES) / RATE
    position = finger.position(time)
    follows = isinstance(texture, White) and texture.spatial or getattr(texture, "wavelength", None) is not None
    away = np.isnan(position) if follows else np.zeros(SAMPLES, bool)
    return np.where(away, 0.0, texture.waveform(time, np.nan_to_num(position)))


@pytest.mark.parametrize(("name", "finger", "limit"), CASES)
def test_float_is_as_accurate_as_double(exports, name, finger, limit):
    """In closed loop on the plate as it is, its drive rounded; the bound is the issue's."""
    texture, errors = TEXTURES[name], {}
    for kind in KINDS:
        law = exports.law(name, kind)
        if limit is not None:
            law.code.law_limit(law.address, limit)
        plate = close(law, FINGERS[finger], texture, bits=12)[3]
        errors[kind] = waveform_error(plate.motion[:, 0], reference_of(texture, FINGERS[finger]), 1.0)
    assert errors["float"] < 1.2 * errors["double"]


def test_the_covariance_stays_definite_in_float(exports):
    """Over 24 s of white noise under a sliding finger; its diagonal scaled to ones: its numbers differ by 1e17."""
    law, texture = exports.law("white", "float"), TEXTURES["white"]
    plate = Plate(PlateParameters(), FINGERS["slide"], seed=1)
    least = []
    for _ in range(8):
        plate.closed_loop(law, ahead_of(texture))
        covariance = law.covariance()[:14, :14]
        assert np.array_equal(covariance, covariance.T)
        size = np.sqrt(covariance.diagonal())
        least.append(np.linalg.eigvalsh(covariance / np.outer(size, size))[0])
    assert min(least) > 0.0


def settled(law, seconds=1.0, seed=1):
    """Drive of a free plate under a law for some time."""
    plate = Plate(PlateParameters(current_bits=0, sensor_noise=0.0), hr.Finger.absent(), seed=seed)
    return plate, plate.closed_loop(law, np.zeros(round(seconds * RATE)))[0]


def test_bands_change_without_a_step(exports):
    """Another carrier, another amplitude; the drive's second difference is that of a start or of what is played."""
    law = exports.law("tones", "double")
    plate, start = settled(law)
    before = plate.closed_loop(law, np.zeros(RATE))[0]
    assert law.set_bands((60.0, 0.0, 0.0, 5e-6, 0.0), (110.0, 0.0, 0.25, 8e-6, 0.0))
    during = plate.closed_loop(law, np.zeros(RATE))[0]
    after = plate.closed_loop(law, np.zeros(RATE))[0]

    def roughness(drive):
        return abs(np.diff(drive, 2, axis=0)).max()

    assert roughness(during) < 1.05 * max(roughness(each) for each in (start, before, after))
    for band, wanted in enumerate((5e-6, 8e-6)):
        target, measured = law.envelopes(band)
        assert target == pytest.approx(wanted, rel=1e-12)
        assert abs(measured - target) < 0.01 * wanted


def test_bands_that_are_none_fall_silent(exports):
    law = exports.law("tones", "float")
    plate, _ = settled(law)
    assert law.set_bands()
    plate.closed_loop(law, np.zeros(RATE // 2))
    quiet = plate.closed_loop(law, np.zeros(RATE // 2))[0]
    assert abs(quiet).max() < 1e-3
    assert law.envelopes(0) == (0.0, 0.0)


GOOD = (100.0, 0.0, 0.0, 5e-6, 0.0)


@pytest.mark.parametrize(
    ("field", "good", "bad"),
    [
        (0, 0.4 * RATE, 0.4 * RATE + 1.0),
        (0, 0.0, -1.0),
        (1, 1e5, 1.1e5),
        (1, 0.0, -1.0),
        (2, -1.0, -1.1),
        (3, 0.999e-3, 1.001e-3),
        (4, -0.999e-3, np.nan),
        (0, 1.0, np.inf),
    ],
)
def test_a_band_out_of_range_changes_nothing(exports, field, good, bad):
    law = exports.law("tones", "float")
    values = list(GOOD)
    values[field] = good
    values[3] = values[3] if field == 3 else 0.0
    assert law.set_bands(values)
    before = law.state.copy()
    values[field] = bad
    assert not law.set_bands(GOOD, values)
    assert np.array_equal(law.state, before)


def test_numbers_of_bands_gains_and_limits_have_bounds(exports):
    law = exports.law("tones", "float")
    assert law.set_bands(*8 * [GOOD])
    assert not law.set_bands(*9 * [GOOD])
    limit = float(exports.rendering("tones").model.drive_limit)
    for setter, goods, bads in (
        (law.code.law_gain, (0.0, 1.0), (-0.01, 1.01, np.nan)),
        (law.code.law_limit, (1e-3, 0.999 * limit), (0.0, 1.001 * limit, np.nan)),
    ):
        assert all(setter(law.address, each) for each in goods)
        assert not any(setter(law.address, each) for each in bads)


def test_sanitisers_find_nothing_whatever_the_inputs_are(exports):
    """Numbers at random, huge and none at all; the drive is finite and within its limit in every sample."""
    exports.law("tones", "float")
    folder = exports.folder / "tones"
    files = [*(folder / f"{name}.c" for name in PARTS), ROOT / "tests" / "law_inputs.c"]
    program = compile_c(folder / "inputs", files, *SANITISED, f"-I{folder}")
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "60000\n", "")


@pytest.mark.parametrize("option", ["-ffast-math", "-ffinite-math-only"])
def test_options_that_rule_nan_out_are_refused(exports, option, capfd):
    """`-ffinite-math-only` made the first drive NaN."""
    exports.law("tones", "float")
    folder = exports.folder / "tones"
    with pytest.raises(subprocess.CalledProcessError):
        compile_c(folder / "law.o", [folder / "law.c"], option, "-c")
    assert "a lifted finger is NaN" in capfd.readouterr().err
