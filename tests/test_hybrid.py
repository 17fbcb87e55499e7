"""The hybrid: shares that sum to the target, two controllers as one, plate and screen under one finger."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from live_devices import ROUNDING, Told, slide
from tables import scene_on
from waves import white

import hapticrender as hr
from hapticrender import loop
from hapticrender.control.state_transfer import drive_limits
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.plants.hybrid import HybridPlant
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Sensed
from hapticrender.renderers.hybrid import HybridSettings

RATE = 10_000
SLIDE = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
START = 100.0 / 1.5  # Hz, F of the default crossover
FELT = 0.01  # a tenth of the least noticeable difference (docs/theory.md, "Perception"), as in the accuracy suite


def scene(texture, finger=SLIDE, duration=1.2, **plant):
    return scene_on("hybrid", texture, finger, duration, settle=0.6, keep_unfelt=True, **plant)


def tone(frequency, velocity=0.02):
    return hr.Grating(velocity=velocity, frequency=frequency)


def test_shares_sum_to_one():
    settings = HybridSettings()
    frequency = np.linspace(0.0, 400.0, 4001)
    share = settings.share_of_screen(frequency)
    assert (share[frequency <= START] == 0.0).all()
    assert (share[frequency >= 2 * START] == 1.0).all()
    assert settings.share_of_screen(settings.crossover) == pytest.approx(0.5)
    assert (np.diff(share) >= 0.0).all()
    x = np.clip(frequency / START - 1, 0.0, 1.0)
    np.testing.assert_allclose(share, 3 * x**2 - 2 * x**3, atol=1e-15)
    mirrored = settings.share_of_screen(3 * START - frequency)  # around the crossover, where the plate has it
    np.testing.assert_allclose(share + mirrored, 1.0, atol=1e-14)


def test_fixed_carriers_are_shared_out_by_their_frequency():
    partials = [(1, 1.0, 0.3), (2, 0.5, 1.0), (5, 0.2, 2.0)]  # 50, 100 and 250 Hz
    bands = loop.prepare(scene(hr.Grating(amplitude=8e-6, frequency=50.0, partials=partials))).bands
    assert bands.plate_index.tolist() == [0, 1]
    assert bands.friction_index.tolist() == [1, 2]
    total = np.zeros(3, complex)
    total[bands.plate_index] += 2j * np.pi * bands.plate.frequency * bands.plate.envelope
    total[bands.friction_index] += 0.64 * bands.friction.envelope
    np.testing.assert_allclose(total, 2j * np.pi * bands.frequency * bands.envelope, rtol=1e-12)
    np.testing.assert_allclose(abs(bands.plate.envelope), [8e-6, 2e-6], rtol=1e-12)


@pytest.mark.parametrize("frequency", [40.0, 100.0, 250.0])
def test_a_tone_is_felt_whole(frequency):
    """Within 1 % of the velocity, on the plate, on both, or on the screen alone: then the other is left alone."""
    recording = hr.render(scene(tone(frequency)))
    figures = recording.summary()
    assert figures["unit"] == "m/s"
    (band,) = figures["bands"]
    assert band["target"] == pytest.approx(0.02, rel=1e-6)
    assert band["rms_error_skin"] < FELT
    assert not recording.flags.any()
    moved, rubbed = abs(recording.drive[:, :2]).max(), abs(recording.drive[:, 2]).max()
    assert (moved > 0.0) == (frequency < 2 * START)
    assert (rubbed > 0.0) == (frequency > START)


@pytest.mark.parametrize(("played", "found"), [(1.0, "passed"), (0.0, "failed")])
def test_a_lift_takes_the_fingers_own_friction_along_and_is_no_error(played, found, tmp_path):
    """Of 0.21 m/s, 50 times the texture; read from a file, with the texture taken off before the lift or not."""
    finger = replace(SLIDE, touches=((0.0, 1.5),))
    recording = hr.render(scene(hr.Grating(frequency=90.0, amplitude=1e-5), finger, 2.0))
    recording.save(tmp_path / "lift.npz")
    recording = hr.Recording.load(tmp_path / "lift.npz")
    columns = recording.header.slices
    recording.frames = np.array(recording.frames[:])
    recording.frames[:, columns["motion"]] -= (1.0 - played) * recording.frames[:, columns["reference"]]
    figures = recording.summary()
    assert figures["verdict"] == found
    assert (figures["waveform"]["places"]["skin"]["waveform_error"] < FELT) == (found == "passed")


def test_a_carrier_that_follows_the_finger_is_felt_whole_while_it_is_handed_over():
    """Under constant acceleration of 0.3 m/s2, judged from 60 Hz on, the screen taking all from 133 Hz on."""
    time = np.linspace(0.0, 0.7, 1401)
    finger = hr.Finger.sampled(0.15 * time**2 - 0.04, rate=2000.0, normal_load=0.4, mechanics="light")
    sweep = replace(scene(hr.Grating(amplitude=1e-5, wavelength=1e-3), finger, 0.7), settle=0.2)
    assert hr.render(sweep).summary()["bands"][0]["rms_error_skin"] < FELT


def test_a_recording_over_position_is_shared_out_by_the_fades():
    """Both banks analyse the same waveform; components at 34, 168 and 304 Hz at 0.08 m/s that swell by a half."""
    turn = 2 * np.pi * np.arange(3000)[:, None] / 2000
    swelling = (1 + 0.5 * np.cos(np.array([0.4, 0.5, 0.6]) * turn)) * np.cos(np.array([42.7, 210.4, 380.8]) * turn)
    texture = hr.Recorded(samples=swelling.sum(axis=1) / 4.5, rate=2e3, speed=0.1, gain=2e-5, carriers=3)
    figures = hr.render(scene(texture, duration=1.6)).summary()
    assert len(figures["bands"]) == 3
    for band in figures["bands"]:
        assert band["rms_error_skin"] < 0.07  # sensor noise is in it, and the analysis of the swelling waveform


WHOLE = {
    "noise": hr.Recorded(samples=white(25_000, 3e-6, rate=RATE), rate=RATE, gain=1.0),
    "chirp": hr.Chirp(start=60.0, stop=300.0, duration=1.0, amplitude=5e-6),
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_waveform_is_the_plates_alone(name):
    """Within 3 %, the demand on friction; its velocity weighs 400 Hz 20 times as much as 20."""
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light", span=0.1)
    recording = hr.render(hr.Scene(device="hybrid", texture=WHOLE[name], finger=finger, duration=2.5, settle=1.0))
    assert recording.summary()["waveform"]["places"]["skin"]["waveform_error"] < 0.03
    assert not recording.drive[:, 2].any()


@pytest.mark.parametrize(
    "textures",
    [("noise", 100.0, "chirp"), (250.0, "noise", "chirp", 250.0)],
    ids=["with both parts", "with the screen alone"],
)
def test_whole_waveforms_and_gratings_change_into_each_other_live(textures):
    """From 0.25 s after a change on: within a tenth of the target, and of the share of it that `render` achieves."""
    played = [WHOLE[each] if each in WHOLE else tone(each) for each in textures]
    with hr.Player("hybrid", paced=False) as player:
        place, found = -0.05, []
        player.finger(place, 0.05, 0.4)
        for texture in played:
            player.play(texture)
            place = slide(player, 0.5, start=place)
            found += player.state().bands  # of the last 0.25 s
        assert not player.state().flags
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light", span=0.1)
    for row, texture in zip(found, played, strict=True):
        recording = hr.render(hr.Scene(device="hybrid", texture=texture, finger=finger, duration=0.9, settle=0.4))
        wanted, moved = (each[-2500:].std() for each in (recording.reference, recording.motion[:, 0]))
        assert row.error < (0.1 if texture is WHOLE["noise"] else 0.03)
        assert row.achieved / row.target == pytest.approx(moved / wanted, rel=0.1)


def test_a_plate_that_comes_in_takes_no_motion_of_before_for_a_step():
    """A chirp is handed over while noise moves the plate, and comes in 62 ms later, after a tone of the screen alone.

    Its drive is that of a touch under the chirp alone at most, but for rounding; it was 1 A.
    """
    largest = []
    for textures in ([WHOLE["chirp"]], [tone(100.0), WHOLE["noise"], tone(250.0), WHOLE["chirp"]]):
        with hr.Player("hybrid", paced=False) as player:
            place = -0.05
            player.finger(place, 0.05, 0.4)
            for texture in textures:
                player.play(texture)
                place = slide(player, 0.03, start=place)
            slide(player, 0.2, start=place)
            largest.append(abs(player._loop.log(1500 if len(textures) > 1 else 0)["drive"][:, :2]).max())
    assert 0.0 < largest[1] <= largest[0] + 2 * ROUNDING


@pytest.mark.parametrize("first", [100.0, 250.0])
def test_a_whole_waveform_after_a_grating_leaves_the_screen_at_its_bias(first):
    """Its attraction neither falls nor moves, once the grating has faded out; a stop ends it."""
    device = bench()
    with hr.Player("hybrid", device, paced=False) as player:
        player.finger(-0.02, 0.08, 0.4)
        player.play(tone(first))
        place = slide(player, 0.2)
        player.play(WHOLE["noise"])
        slide(player, 0.2, start=place)
        envelope = np.concatenate(device.played)[-1000:, 2]
    assert envelope.min() > 1e-3
    assert np.ptp(envelope) < 1e-9
    assert not device.played[-1].any()


def bench(sensed_channels=3, spoil=lambda sample, sensed: sensed, block=10):
    """A user's device: a plate and a screen that take currents, in blocks, and tell nothing but what is sensed."""
    plate = Plate(PlateParameters(rate=RATE), SLIDE, 1)
    screen = ElectroadhesionScreen(ElectroadhesionParameters(), SLIDE, 2)
    tell = lambda sample, sensed: Sensed(spoil(sample, sensed.sensed))  # noqa: E731
    device = Told(HybridPlant(plate, screen, 0.64), tell)
    device.block = device.delay = block
    device.sensed_channels, device.probe = sensed_channels, True
    return device


def test_a_driver_of_ones_own_gets_currents_and_is_judged_by_its_sensors():
    device = bench()
    recording = hr.render(replace(scene(tone(100.0), duration=0.6), settle=0.4), driver=device)
    envelope = np.concatenate(device.played)[:, 2]
    assert envelope.max() < 10e-3  # A
    assert envelope[5000 : -device.block].min() > 0.0  # around a bias
    assert not envelope[-device.block :].any()  # closed
    (band,) = recording.summary()["bands"]
    assert band["rms_error_skin"] < FELT
    assert recording.header.motion_source == "sensors"  # a velocity that is computed is none that is known


def test_a_velocity_that_a_driver_states_waits_for_no_sensor():
    """Half a sample of a tone of 250 Hz is 8 % of it."""
    device = bench()
    device.tell = lambda sample, sensed: sensed
    recording = hr.render(replace(scene(tone(250.0), duration=0.6), settle=0.4), driver=device)
    motion, reference = recording.motion[-1000:, 0], recording.reference[-1000:]
    assert (motion - reference).std() < 0.04 * reference.std()


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda sample, sensed: sensed * [-1.0, 1.0, 1.0], "sensor 1 is inverted"),
        (lambda sample, sensed: sensed[:, [1, 0, 2]], "swapped"),
        (lambda sample, sensed: sensed * [1.0, 0.0, 1.0], "sensor 2 (is dead|repeats its values)"),
        (lambda sample, sensed: sensed * [3.0, 3.0, 1.0], "have (2.9|3|3.1) times the gain"),
        (lambda sample, sensed: sensed * [1.0, 1.0, -1.0], ""),
    ],
)
def test_the_plate_of_a_hybrid_is_probed_and_its_screen_without_drive(spoil, named):
    """Whatever the tribometer shows; a scene may leave the probe out."""
    device = bench(spoil=spoil)
    rendering = hr.prepare(scene(tone(250.0)), driver=device)
    with device, pytest.raises(hr.DeviceFault, match=f"probe: .*({named})") if named else nullcontext():
        rendering.probe(device)
    drive = np.concatenate(device.played)
    assert 0.01 < abs(drive[:, :2]).max() < 0.05 * 3.0
    assert not drive[:, 2].any()
    assert abs(drive[-1]).max() == 0.0
    assert hr.prepare(replace(scene(tone(250.0)), rendering={"probe": False}), driver=device).probe is None
    device.probe = False
    assert hr.prepare(scene(tone(250.0)), driver=device).probe is None


def test_without_sensors_both_parts_are_driven_open_loop():
    """From the free device: a finger of 0.4 N takes a little of the plate's half, friction comes as designed."""
    device = bench(sensed_channels=0)
    recording = hr.render(scene(tone(100.0), duration=0.5), driver=device)
    assert np.isnan(recording.motion).all()
    assert abs(recording.target[-1, 0]) == pytest.approx(0.02, rel=1e-6)
    peaks = abs(np.concatenate(device.played)[3000:]).max(axis=0)
    assert (peaks[:2] > 0.02).all()
    assert peaks[2] > 1e-3


@pytest.mark.parametrize(
    ("before", "after"),
    [(tone(250.0), tone(100.0)), (WHOLE["noise"], tone(100.0)), (tone(100.0), WHOLE["noise"])],
    ids=["screen to both", "whole to both", "both to whole"],
)
def test_a_fault_of_a_part_stops_the_whole_device_at_the_time_it_is_said_to(before, after):
    """Live: the plate, and its supervisor, play from 0.2 s on; a fault takes 7 ms to be seen, a fade 2 ms."""

    def failing(sample, sensed):
        """The first sensor gives no numbers from 0.3 s on, after 0.3 s of the probe."""
        return sensed * [np.nan if sample >= 0.6 * RATE else 1.0, 1.0, 1.0]

    driver = bench(spoil=failing)
    with hr.Player("hybrid", driver, paced=False) as player:
        player.finger(-0.02, 0.08, 0.4)
        player.play(before)
        place = slide(player, 0.2)
        player.play(after)
        with pytest.raises(hr.DeviceFault, match=r"stopped at 0\.307\d s: sensor 1: samples are no numbers"):
            slide(player, 0.3, start=place)
        log = player._loop.log(0)
    first = int(np.argmax(log["flags"] & hr.Flag.STOPPED > 0))
    assert abs(log["drive"][first - 100 : first, : 3 if isinstance(after, hr.Grating) else 2]).max(axis=0).all()
    assert not log["drive"][first + round(0.002 * RATE) + driver.delay :].any()
    assert not driver.played[-1].any()


class LateHost:
    """A hybrid whose host computes drive two blocks ahead; blocks with which it is late are zeros, and flagged."""

    rate, block, delay, host_delay = float(RATE), 4, 12, 8
    drive_channels = sensed_channels = 3
    probe = False

    def __init__(self, late, gains):
        self.plant, self.late, self.number, self.queue = bench().plant, late, -1, [np.zeros((4, 3))] * 2
        self.gains = gains

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def play(self, drive):
        self.number += 1
        self.queue.append(0.0 * drive if self.number + 2 in self.late else drive)
        sensed = self.plant.run(self.queue.pop(0)).sensed * self.gains
        flags = np.full(4, int(hr.Flag.OVERRUN) if self.number in self.late else 0)
        return Sensed(sensed, flags=flags)


def test_a_host_that_is_late_is_not_taken_for_a_fault_of_the_plate():
    """For 51 ms of every 120, from the first block on; a plate that is inverted is stopped."""
    late = {number for number in range(1250) if 1 <= number % 300 <= 128}
    texture = tone(40.0, 0.01)
    recording = hr.render(scene(texture, duration=0.5), driver=LateHost(late, (1.0, 1.0, 1.0)))
    assert np.count_nonzero(recording.flags & hr.Flag.OVERRUN) == 4 * len(late)
    with pytest.raises(hr.DeviceFault, match=r"samples until then were lost, .*; found was: "):
        hr.render(scene(texture, duration=0.5), driver=LateHost(late, (-1.0, -1.0, 1.0)))


@pytest.mark.parametrize("screen_levels", [{}, {"level": "carrier", "sensor": "impedance"}], ids=["force", "gap"])
def test_plate_and_screen_are_those_of_their_own(screen_levels):
    """Sensed, flags and motion are those of plate and screen alone, sample for sample, in blocks or not."""
    finger = hr.Finger.sliding(speed=0.03, normal_load=0.4, span=0.1, mechanics="heavy")
    parameters = PlateParameters(rate=RATE, bending_frequency=1250.0)

    def fresh():
        return Plate(parameters, finger, 1), ElectroadhesionScreen(
            ElectroadhesionParameters(**screen_levels), finger, 2
        )

    plate, screen = fresh()
    hybrid = HybridPlant(*fresh(), 0.64)
    time = np.arange(3000) / RATE
    drive = np.column_stack(
        [0.2 * np.sin(2 * np.pi * 80 * time), 0.05 * np.cos(2 * np.pi * 80 * time), 3e-3 * (1 + np.sin(500 * time))]
    )
    pieces = []
    for part in np.split(drive, [1, 700]):
        both = hybrid.run(part)
        pieces.append((both.sensed, both.motion, hybrid.motion[:, 1:], both.flags))
    sensed, motion, felt, flags = (np.concatenate(column) for column in zip(*pieces, strict=True))
    moved, rubbed = plate.run(drive[:, :2]), screen.run(drive[:, 2:])
    np.testing.assert_array_equal(sensed, np.hstack([moved.sensed, rubbed.sensed]))
    np.testing.assert_array_equal(felt[:, 0], plate.motion[:, 3])
    np.testing.assert_allclose(felt[:, 1], 0.64 * rubbed.motion[:, 0], rtol=1e-14)
    np.testing.assert_allclose(motion[:, 0], felt.sum(axis=1), rtol=1e-12)
    np.testing.assert_array_equal(flags, moved.flags | rubbed.flags)
    assert (abs(felt).max(axis=0) > 1e-3).all()


def test_a_part_that_does_not_play_leaves_the_other_limits():
    """A limit that is infinite would stay so in every exchange after it, for the larger of both counts."""
    for frequency, plays in ((40.0, [1, 1, 0]), (100.0, [1, 1, 1]), (250.0, [0, 0, 1])):
        limits = drive_limits(loop.prepare(scene(tone(frequency))).controller())
        assert np.isfinite(limits).all()
        assert (limits > 0.0).tolist() == [bool(each) for each in plays]


@pytest.mark.parametrize("first", [None, tone(250.0), tone(30.0)], ids=["rendered", "live", "live, after the plate"])
def test_friction_is_judged_at_the_time_of_the_motion(first, tmp_path):
    """A tone of 250 Hz is on the screen alone, and shown 2 zeta/w0 = 159 us late: 25 % of it, where that is left in.

    What remains is 0.65 % of the tribometer beside its delay, 0.3 % of the lines between samples, and the noise of a
    difference of the plate's sensors, 1 um rms each, over 10 000 samples: 0.74 %, five times over.
    """
    plays, driver = replace(scene(tone(250.0), duration=1.5), settle=0.5), bench()
    driver.tell = lambda sample, sensed: Sensed(sensed.sensed, position=sensed.position)  # and where the finger is
    if first:
        with hr.Player(plays, driver, paced=False) as player:
            player.play(first)
            player.play(plays.texture)
            player.sleep(0.5)
            player.record(tmp_path / "live.au")
            player.sleep(1.0)
            recording = player.end_recording()
    else:
        recording = hr.render(plays, driver=driver)
    rows = slice(0 if first else len(recording) - 10_000, len(recording))
    turn = np.exp(-2j * np.pi * 250.0 * np.arange(len(recording)) / RATE)[rows]
    motion, reference = recording.motion[rows, 0] @ turn, recording.reference[rows] @ turn
    assert abs(motion / reference - 1.0) < 0.01 + 5 * 0.0074
