"""The loop: block by block equals sample by sample, refusals come before anything is played, crashes end at rest."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from live_devices import Told
from strangers_plate import StrangersPlate

import hapticrender as hr
from hapticrender import loop
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.composed import is_in_time
from hapticrender.touch.perception import VELOCITY_PER_FORCE

SPATIAL = hr.Scene(
    texture=hr.Grating(wavelength=1e-3, amplitude=10e-6),
    finger=hr.Finger.sliding(speed=0.08, normal_load=0.8, mechanics="heavy", touches=((0.05, 0.7), (0.9, 2.0))),
    duration=1.2,
)
RECORDED = hr.builtin_scenes(carriers=6)["recorded-texture"]
TONE = hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=0.5)
COLUMNS = ("drive", "sensed", "motion", "position", "normal_load", "target", "flags", "reference")


class Blocks(SimulatedDriver):
    """A driver that is handed blocks alone, and keeps them."""

    device_loop, probe = None, False

    def __init__(self, plant):
        super().__init__(plant)
        self.played = []

    def play(self, drive):
        self.played.append(drive.copy())
        return super().play(drive)


class Losing(Blocks):
    """It loses its 2nd and its 100th block."""

    def play(self, drive):
        sensed = super().play(drive)
        lost = len(self.played) in {2, 100}
        return sensed._replace(flags=np.full(len(drive), int(hr.Flag.OVERRUN))) if lost else sensed


def simulated(scene, seed=0, block=1, kind=SimulatedDriver, **overrides):
    return kind(Plate(PlateParameters(**overrides), scene.finger, seed, block))


def equal(one, other, columns=COLUMNS, rounding=0.0):
    for name in columns:
        right = getattr(other, name)
        largest = np.nanmax(abs(right), initial=0.0) if rounding else 0.0
        np.testing.assert_allclose(getattr(one, name), right, rtol=0, atol=rounding * largest, err_msg=name)


@pytest.mark.parametrize(
    ("scene", "method"),
    [(SPATIAL, "paper"), (RECORDED, "paper-common")],
    ids=["space", "file"],
)
def test_compiled_loop_equals_the_ring_of_blocks(scene, method):
    """Sample for sample; the paper's blocks do the same operations, in another order.

    Its low pass forgets roundings; its amplitude and phase (below 1 rad) sum them up, one a sample, in either run.
    """
    scene = dataclasses.replace(scene, duration=0.4)
    expected = hr.render(scene, method=method, seed=5)
    equal(
        expected,
        hr.render(scene, method=method, seed=5, driver=simulated(scene, 5, kind=Blocks)),
        rounding=2 * len(expected.drive) * np.finfo(float).eps,
    )


class Scaling(Blocks):
    """Converts the drive in place, and stops by itself from block 1000 on."""

    def play(self, drive):
        sensed = super().play(drive.copy())
        drive *= 3.0
        stops = len(self.played) > 1000
        return sensed._replace(flags=np.full(len(drive), int(hr.Flag.STOPPED))) if stops else sensed


def test_a_driver_may_convert_the_drive_in_place_and_stop_the_device():
    driver = simulated(TONE, kind=Scaling)
    with pytest.raises(hr.DeviceFault, match=r"stopped at 0\.2 s: the device stopped itself") as stopped:
        hr.render(TONE, driver=driver)
    drive = stopped.value.recording.drive
    np.testing.assert_array_equal(drive, np.concatenate(driver.played)[: len(drive)])
    with hr.Player(driver=simulated(TONE, kind=Scaling), paced=False) as player:
        player.play(TONE.texture)
        with pytest.raises(hr.DeviceFault, match=r"stopped at 0\.2 s: the device stopped itself"):
            player.sleep(0.5)


class Reusing(Blocks):
    """Fills the same arrays again and again, where it `reuses` them; of a device that states no motion."""

    probe = True

    def __init__(self, plant, reuses):
        super().__init__(plant)
        self.kept = [] if reuses else None

    def play(self, drive):
        sensed = super().play(drive)._replace(motion=None)
        if self.kept is None:
            return sensed
        self.kept = self.kept or [each if each is None else each.copy() for each in sensed]
        for own, new in zip(self.kept, sensed, strict=True):
            if own is not None:
                own[:] = new
        return hr.Sensed(*self.kept)


@pytest.mark.parametrize("name", ["grating-47", "one-texture-electroadhesion"])
def test_a_driver_may_use_its_arrays_again(name):
    """The probe of a plate keeps blocks until its end, and a screen's tribometer shows friction later."""
    scene = dataclasses.replace(hr.builtin_scenes()[name], duration=0.3, settle=0.1)
    found = [hr.render(scene, driver=Reusing(hr.prepare(scene).plant, reuses)) for reuses in (False, True)]
    equal(*found, [column for column in COLUMNS if column != "motion"])
    np.testing.assert_array_equal(found[0].motion, found[1].motion)


def test_the_sensors_of_a_plate_of_one_coil_show_how_it_rocks():
    """A finger 30 mm off the middle tilts it, which the coil cannot prevent, and each sensor sits at an end."""
    finger = hr.Finger.still(position=0.03, normal_load=0.4, mechanics="heavy")
    tone = hr.Grating(frequency=120.0, amplitude=10e-6)
    scene = hr.Scene(texture=tone, duration=1.5, settle=0.5, finger=finger, profile={"coils": 1})
    true, sensed = hr.render(scene), hr.render(scene, driver=Reusing(hr.prepare(scene).plant, False))
    np.testing.assert_array_equal(true.drive, sensed.drive)
    np.testing.assert_allclose(sensed.motion[:, 1:], sensed.sensed, rtol=0, atol=1e-12)
    noise = 1e-6 + 2e-3 / 2**14  # m rms of a sensor and its step, of six of which none of 7500 is beyond
    np.testing.assert_allclose(sensed.motion, true.motion, rtol=0, atol=6 * noise)
    figures = [each.summary() for each in (true, sensed)]
    assert [(each["verdict"], each["worst"]["place"]) for each in figures] == [("failed", "end 2")] * 2


def test_blocks_of_any_size_give_the_same_samples_for_the_same_delay():
    """With a delay of 6 samples, blocks of 1, 2, 3 and 6 leave 5, 4, 3 and 0 of them inside the device."""
    expected = hr.render(SPATIAL, driver=simulated(SPATIAL, delay=6))
    for block in (3, 6):
        found = hr.render(SPATIAL, driver=simulated(SPATIAL, block=block, delay=6))
        equal(expected, found, [name for name in COLUMNS if name != "drive"])
        later = block - 1  # a longer block is handed over later, and waits less inside
        np.testing.assert_array_equal(found.drive[later:], expected.drive[: len(found.drive) - later])


def test_the_reference_is_the_texture_as_the_scene_asks_for_it():
    """All of it, though what is not felt is left out; on a screen dr/dt over v/F; 0 while the finger is away."""
    faint = ((1.0, 1.0, 0.0), (2.0, 1e-4, 0.3))
    texture = hr.Grating(amplitude=10e-6, wavelength=1e-3, partials=faint)
    scene = dataclasses.replace(SPATIAL, texture=texture, keep_unfelt=False)
    found = hr.render(scene)
    assert len(found.bands) == 1
    away = np.isnan(found.position)
    assert away.any()
    assert not found.reference[away].any()
    texture = scene.texture.waveform(found.time, found.position)
    np.testing.assert_allclose(found.reference, texture, rtol=0, atol=1e-18)
    found = hr.render(dataclasses.replace(scene, device="electroadhesion", tolerance=0.2))
    turns = found.position / 1e-3
    slope = -10e-6 * (np.sin(2 * np.pi * turns) + 2e-4 * np.sin(4 * np.pi * turns + 0.3))
    velocity = np.gradient(found.position) * found.rate
    inside = np.isfinite(velocity)
    expected = slope * 2e3 * np.pi * velocity / VELOCITY_PER_FORCE
    np.testing.assert_allclose(
        found.reference[inside], expected[inside], rtol=0, atol=1e-6 * abs(expected[inside]).max()
    )
    assert not found.reference[np.isnan(found.position)].any()


def test_an_odd_duration_is_rounded_to_samples_whatever_the_block():
    scene = dataclasses.replace(TONE, duration=0.1003)
    assert hr.render(scene).drive.shape == (502, 2)  # 501.5 rounds to even
    assert hr.render(scene, driver=simulated(scene, block=7, delay=7)).drive.shape == (502, 2)


scene_with = partial(dataclasses.replace, TONE)


def test_a_scene_may_state_a_plate_that_the_controller_does_not_assume():
    """The profile alone, or the same plate simulated behind a wrong profile: the second is noticed."""
    stiff = {"stiffness_1": 1.05 * 22.4e3, "stiffness_2": 1.05 * 22.9e3}
    scene = scene_with(duration=3.0, profile=stiff)
    hr.render(scene)
    wrong = scene_with(duration=3.0, simulation=stiff)
    with pytest.warns(hr.PlateMismatch, match=r"^the device differs.*the controller adds \d"):
        hr.render(wrong)
    with pytest.warns(hr.PlateMismatch, match="^of the samples 14 were lost, which may be all .*the controller adds"):
        hr.render(wrong, driver=simulated(wrong, kind=Losing, block=7, delay=7, **stiff))
    late = loop.prepare(scene_with(simulation={"delay": 5}))
    assert (late.plant.parameters.delay, late.model.delay) == (5, 1)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (scene_with(texture=hr.Grating(frequency=2500.0, amplitude=1e-6)), r"2500.*must be <= 2250 Hz"),
        (scene_with(texture=hr.Grating(frequency=400.0, amplitude=1e-3)), r"0.001 m at 400 Hz needs 10.6 A.*<= 3 A"),
        (scene_with(finger=hr.Finger.still(position=0.06)), r"finger.position reaches 0.06 m.*0.055 m"),
    ],
    ids=["nyquist", "current", "glass"],
)
def test_what_the_device_cannot_do_is_refused_before_anything_is_written(scene, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        hr.render(scene, journal=tmp_path / "run.au")
    assert not list(tmp_path.iterdir())


def play(driver):
    with hr.Player(driver=driver, paced=False) as player:
        player.play(TONE.texture)
        player.sleep(0.5)


@pytest.mark.parametrize("run", [play, partial(hr.render, TONE)], ids=["live", "render"])
def test_motion_that_a_device_states_and_then_does_not_is_refused(run):
    """The rest would come from the sensors, under the name of the first source."""
    plate = Plate(PlateParameters(), hr.Finger.absent())
    driver = Told(plate, lambda sample, sensed: sensed if sample < 1000 else sensed._replace(motion=None))
    driver.probe = False
    with pytest.raises(hr.ProtocolError, match="Told: play: motion is None, and was stated before: must be"):
        run(driver=driver)
    assert len(driver.played) == 1001 + 1  # and zero drive


class LateHost(StrangersPlate):
    """A plate whose host computes drive 192 samples ahead; blocks with which it is late are zeros, and flagged."""

    host_delay, ahead = 192, 2  # samples; blocks that wait, beside the one that is computed

    def __init__(self, late, seed):
        super().__init__(rate=48e3, block=64, told=320, delay=320 - 64 + 1, seed=seed)
        self.late, self.number = late, -1

    def play(self, drive):
        self.number += 1
        sensed = super().play(0.0 * drive if self.number + self.ahead in self.late else drive)
        flags = np.full(64, int(hr.Flag.OVERRUN) if self.number in self.late else 0)
        return hr.Sensed(sensed.sensed, flags=flags)


@pytest.mark.parametrize("seed", range(2))
def test_a_host_that_is_late_is_not_taken_for_a_fault_of_the_device(seed):
    """Up to 32 blocks at a time, at four moments, the start among them; a device that is inverted is stopped."""
    rng = np.random.default_rng(seed)
    begin = [1, *rng.integers(20, 400, 3)]
    late = {number for first in begin for number in range(first, first + int(rng.integers(16, 33)))}
    scene = hr.Scene(texture=hr.Grating(frequency=60.0, amplitude=10e-6), duration=0.6)
    recording = hr.render(scene, driver=LateHost(late, seed))
    assert np.count_nonzero(recording.flags & hr.Flag.OVERRUN) == 64 * len(late & set(range(450)))
    wrong = LateHost(late, seed)
    wrong.true["gain_1"] = wrong.true["gain_2"] = -1.0
    with pytest.raises(hr.DeviceFault, match=r"\d{3,4} of the \d{4} samples until then were lost, .*; found was: "):
        hr.render(scene, driver=wrong)


def test_a_motion_may_end_with_the_last_block():
    """It is evaluated a piece at once: not beyond the samples that are played, but for the checks' two milliseconds."""
    places = np.linspace(0.0, 0.01, 1060)
    motion = type("Ends", (), {"position": lambda self, time: places[np.rint(5000.0 * time).astype(int)]})()
    scene = hr.Scene(texture=TONE.texture, finger=hr.Finger(motion, 0.3), duration=0.21)
    assert len(hr.render(scene, driver=StrangersPlate())) == 1050


class Counted:
    """A recording as a texture of somebody else's, which keeps how many samples it was read at."""

    def __init__(self, recorded):
        self.recorded, self.read = recorded, []

    def bands(self, rate):
        return self.recorded.bands(rate)

    def waveform(self, time, position):
        self.read.append(len(time))
        return self.recorded.waveform(time, position)


class InTime(Counted):
    spatial = False


def test_a_function_of_time_is_read_ahead_of_the_driver_and_any_other_block_by_block():
    noise = np.random.default_rng(1).standard_normal(2000)
    runs, reads = [], []
    for kind in (Counted, InTime):
        texture = kind(hr.Recorded(samples=noise, rate=5000.0, amplitude=5e-6))
        scene = hr.Scene(texture=texture, finger=SPATIAL.finger, duration=0.2)
        rendering = hr.prepare(scene, driver=simulated(scene, kind=Blocks))
        texture.read.clear()
        runs.append(hr.run(rendering))
        reads.append(texture.read.count(1))
    equal(*runs)
    assert reads == [1000, 0]


def test_a_part_that_states_nothing_is_read_where_the_driver_says_that_the_finger_is():
    """In a sum or a playlist, too."""
    here = hr.Chirp(start=50.0, stop=200.0, duration=1.0, amplitude=1e-6)
    for texture in (Counted(here), here + Counted(here), hr.Playlist([(Counted(here), 1.0)])):
        assert not is_in_time(texture)
    for texture in (here, InTime(here), here + InTime(here), hr.Playlist([(here, 1.0)])):
        assert is_in_time(texture)


@pytest.mark.parametrize("closes", ["suppresses", "fails"])
def test_what_a_driver_does_while_it_closes_hides_no_error(closes):
    class Closing(Blocks):
        def play(self, drive):
            if len(self.played) == 50:
                raise hr.DriverError("unplugged")
            return super().play(drive)

        def __exit__(self, *error):
            super().__exit__(*error)
            if closes == "fails":
                raise OSError("closed already")
            return True

    with pytest.raises(hr.DriverError, match="^unplugged") as caught:
        hr.render(TONE, driver=simulated(TONE, kind=Closing))
    notes = "; ".join(getattr(caught.value, "__notes__", ()))
    assert ("closed already" in notes) == (closes == "fails")


def test_a_failure_to_close_is_raised_where_nothing_else_failed():
    class Closing(Blocks):
        def __exit__(self, *error):
            raise OSError("closed already")

    with pytest.raises(OSError, match="closed already"):
        hr.render(TONE, driver=simulated(TONE, kind=Closing))


def test_the_first_motion_that_is_stated_holds_for_what_was_played_before():
    """A device's motion may be known from its second block on."""
    blocks = [{"flags": np.arange(2)}, {"flags": np.arange(2, 5), "motion": np.array([[1.0], [2.0], [3.0]])}]
    joined = loop._joined(blocks)
    assert joined["flags"].tolist() == [0, 1, 2, 3, 4]
    assert joined["motion"].tolist() == [[1.0], [1.0], [1.0], [2.0], [3.0]]
