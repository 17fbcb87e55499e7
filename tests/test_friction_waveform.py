"""Whole waveforms as friction: recordings, ridges under swipes and turns, of the true friction, without any fit."""

from itertools import product

import numpy as np
import pytest
import waves
from electroadhesive import Screen
from scipy.signal import butter, hilbert, lfilter, sosfiltfilt
from strangers_resonator import Resonator
from test_identify_friction import Screen as StrangersScreen
from test_ultrasonic_rendering import friction_of, watched

import hapticrender as hr
from hapticrender.control.probe_resonance import DURATION, REST
from hapticrender.plants.electroadhesion import DRY, MOIST, NORMAL, ElectroadhesionParameters
from hapticrender.plants.identify_friction import identify_resonance, identify_screen
from hapticrender.plants.ultrasonic_surface import SurfaceParameters

RATE = 5000.0
MUST = 0.03  # of the waveform: what the project has set itself
FINGERS = {
    "light": hr.Finger.sliding(speed=0.04, normal_load=0.25, span=0.1),
    "usual": hr.Finger.sliding(speed=0.08, normal_load=0.4, span=0.18),
    "heavy": hr.Finger.sliding(speed=0.12, normal_load=1.0, span=0.26),
}  # none of them turns within 2 s
DEVICES = {
    "ultrasonic, amplitude": ("ultrasonic", {"sensor": "amplitude"}, {}),
    "ultrasonic, tribometer": ("ultrasonic", {"sensor": "tribometer"}, {}),
    "screen, dry": ("electroadhesion", {}, {"gap_resistance": DRY}),
    "screen, normal": ("electroadhesion", {}, {"gap_resistance": NORMAL}),
    "screen, moist and stated": ("electroadhesion", {"gap_resistance": MOIST}, {}),
    "screen, moist and identified": ("electroadhesion", None, {"gap_resistance": MOIST}),
}
CASES = [case for case in product(DEVICES, FINGERS) if case[1] == "usual" or "identified" not in case[0]]


def white(seconds=2.0, rms=3e-6):
    """Noise of 20 to 400 Hz, `rms` (m)."""
    return hr.Recorded(samples=waves.white(round(seconds * RATE), rms, seed=3), rate=RATE, gain=1.0)


def waveform_error(recording):
    return recording.waveform["places"]["friction"]["waveform_error"]


@pytest.mark.parametrize(("device", "finger"), CASES)
def test_white_noise_is_played_whole(device, finger):
    (kind, profile, simulation), finger = DEVICES[device], FINGERS[finger]
    if profile is None:
        with Screen(blind=False, block=10, finger=finger, **simulation) as screen:
            profile = identify_screen(screen, ElectroadhesionParameters(), finger).profile()
    fields = {"profile": profile, "simulation": simulation}
    recording = hr.render(hr.Scene(texture=white(), finger=finger, device=kind, duration=2.0, **fields))
    assert waveform_error(recording) < MUST
    assert recording.waveform["share_in_band"] > 0.99
    assert not (recording.flags & hr.Flag.SATURATED).any()


@pytest.mark.parametrize(
    ("texture", "finger"),
    [(white(), "light"), (white(rms=0.3e-6), "usual"), (hr.Grating(frequency=100.0, velocity=3e-3), "heavy")],
)
def test_a_moist_finger_that_nothing_states_fails_the_verdict(texture, finger):
    """Its gain is an eighth of the design's: the bias allows twice the swing, so that no law could play it whole."""
    fields = {"finger": FINGERS[finger], "simulation": {"gap_resistance": MOIST}, "keep_unfelt": True}
    scene = hr.Scene(texture=texture, device="electroadhesion", duration=1.0, **fields)
    assert hr.render(scene).summary()["verdict"] == "failed"


@pytest.mark.parametrize("area", [0.7, 1.3])
def test_a_finger_with_another_contact_area_is_learned(area):
    """Within the scene's tolerance after a second; a gain that is 30 % off would be 30 % of the waveform."""
    fields = {"finger": FINGERS["usual"], "simulation": {"area_scale": area}}
    scene = hr.Scene(texture=white(), device="electroadhesion", duration=2.0, settle=1.0, **fields)
    recording = hr.render(scene)
    assert waveform_error(recording) < scene.tolerance == 0.1
    begin = slice(round(0.1 * recording.rate), round(0.3 * recording.rate))
    left = np.diff(recording.motion[begin, 0]) - np.diff(recording.reference[begin])
    assert left.std() > 0.1 * np.diff(recording.reference[begin]).std()  # 2 % where the area is what was believed


def ridges(wavelength=1e-3, speed=0.05, rate=10e3):
    along = np.arange(0.0, 0.2, speed / rate)
    return hr.Recorded(samples=np.sin(2 * np.pi * along / wavelength), rate=rate, amplitude=5e-6, speed=speed)


@pytest.mark.parametrize("device", ["ultrasonic", "electroadhesion"])
def test_recorded_ridges_follow_a_finger_that_swipes(device):
    swipe = hr.Finger.swiping(frequency=3.0, speed=0.05, normal_load=0.4)
    recording = hr.render(hr.Scene(texture=ridges(), finger=swipe, device=device, duration=2.0, seed=2))
    assert waveform_error(recording) < MUST  # ultrasonic: 2.53 to 2.65 % over three seeds of the noise; a screen 0.96 %


def test_a_turn_in_no_time_leaves_nothing_behind_after_20_ms():
    """It makes the prediction jump and the drive saturate for a moment; the texture is not held down for longer."""
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4)
    recording = hr.render(hr.Scene(texture=ridges(), finger=finger, device="electroadhesion", duration=1.0))
    turn = int(np.flatnonzero(np.diff(recording.position) < 0.0)[0])
    left = recording.motion[:, 0] - recording.reference
    left = sosfiltfilt(butter(2, 20.0, "highpass", fs=recording.rate, output="sos"), left)
    size = recording.reference.std()
    at, after = (left[turn + round(start * recording.rate) :][: round(0.05 * recording.rate)] for start in (0.0, 0.02))
    assert at.std() > 0.2 * size  # nobody foresees it
    assert after.std() < MUST * size


class SeenScreen(StrangersScreen):
    """Keeps the friction at the end of every sample; its sensor shows it at once."""

    def __init__(self, blind=False, **screen):
        super().__init__(seed=2, **screen)
        self.true, self.sensed_channels = [], 0 if blind else 1

    def play(self, drive):
        sensed = super().play(drive)
        self.true.append(self.friction)
        return sensed._replace(sensed=sensed.sensed[:, : self.sensed_channels])


STIFF = {"tribometer_frequency": 5000.0, "tribometer_damping": 0.05}
EARLY = 2 * np.pi * 237 * 159e-6  # of the rms of 237 Hz: with the design's sensor, which is 2 zeta/w_0 = 159 us late
SHARES = {"dry": 1.0 / 0.9, "normal": 1.0, "moist": 0.12 / 0.9}  # of a normal finger's gain: what their gaps leak


def played_on_a_strangers_screen(texture, finger, profile, *, begin, duration, seed=1, blind=False, **screen):
    """Error of the true friction from `begin` (s) on over the texture as specified, 20 to 500 Hz; the recording."""
    device = SeenScreen(blind=blind, **screen)
    device.rng = np.random.default_rng(seed)
    scene = hr.Scene(texture=texture, finger=finger, device="electroadhesion", duration=duration, profile=profile)
    recording = hr.render(scene, driver=device)
    band = butter(2, [20.0, 500.0], "bandpass", fs=recording.rate, output="sos")
    late = slice(round(begin * recording.rate), round((duration - 0.05) * recording.rate))
    true, asked = np.concatenate(device.true)[: len(recording) - 1], recording.reference[1:]
    true, asked = (sosfiltfilt(band, each)[late] for each in (true, asked))
    return np.std(true - asked) / np.std(asked), recording


def on_a_strangers_screen(skin, mu, identified, finger):
    """Error of white noise whose sensor is as stated, under a load that varies, and the verdict."""
    speed, load = FINGERS[finger].motion.speed, FINGERS[finger].normal_load
    gain = SHARES[skin] * ElectroadhesionParameters().gain(load)
    screen = {"mu": mu, "gain": gain, "speed": speed, "load": load}
    profile = dict(STIFF)
    if identified:
        found = identify_screen(StrangersScreen(**screen), ElectroadhesionParameters(), FINGERS[finger])
        profile |= found.profile()
    error, recording = played_on_a_strangers_screen(
        white(), FINGERS[finger], profile, begin=0.5, duration=1.0, **screen
    )
    return error, recording.summary()["verdict"]


@pytest.mark.parametrize("finger", FINGERS)
@pytest.mark.parametrize(
    ("skin", "mu", "identified"),
    [("dry", 0.8, False), ("normal", 0.84, False), ("normal", 0.6, True), ("moist", 0.6, True)],
)
def test_white_noise_is_played_whole_on_a_screen_that_shares_no_code(skin, mu, identified, finger):
    """A design expects mu = 0.8 and a normal finger; a heavy finger that is dry is the worst."""
    error, verdict = on_a_strangers_screen(skin, mu, identified, finger)
    assert error < MUST
    assert verdict == "passed"


@pytest.mark.parametrize("finger", FINGERS)
def test_a_moist_finger_fails_on_a_screen_that_shares_no_code_where_nothing_states_it(finger):
    error, verdict = on_a_strangers_screen("moist", 0.8, False, finger)
    assert error > 0.5
    assert verdict == "failed"


def test_no_verdict_sees_a_sensor_that_is_not_as_stated():
    """With the design's sensor, which resonates at 1.3 kHz, the friction is early: by that sensor nobody can tell."""
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.5, span=0.18)
    found = identify_screen(StrangersScreen(), ElectroadhesionParameters(), finger).profile()
    error, recording = played_on_a_strangers_screen(white(), finger, found, begin=0.5, duration=1.0)
    assert 0.9 * EARLY < error < 1.1 * EARLY
    assert recording.summary()["verdict"] == "passed"


@pytest.mark.parametrize(("wavelength", "above"), [(0.5e-3, 1e-4), (1e-3, 3e-3)])
def test_ridges_on_a_screen_that_shares_no_code(wavelength, above):
    """Its gain as identified, under a load that varies, which open loop knows and closed loop has to learn beside it.

    Ridges of 1 mm are 0.28 % worse than open loop with this one of three seeds of the noise, where they must not be at
    all; who learns their gain without bias from this sensor is off by 0.42 % rms (`benchmarks/bounds.py`).
    """
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.5, span=0.18)
    profile = identify_screen(StrangersScreen(), ElectroadhesionParameters(), finger).profile() | STIFF
    texture = ridges(wavelength, speed=0.08)
    how = {"profile": profile, "begin": 0.55, "duration": 1.0}
    open_loop, closed = (
        played_on_a_strangers_screen(texture, finger, seed=2, blind=blind, **how)[0] for blind in (True, False)
    )
    assert max(open_loop, closed) < 0.02  # what the project has set itself
    assert closed < open_loop + above


def friction_errors(device, recording, speed, load):
    """Errors of the true friction, which is the law's of the true amplitude, and of the inferred, from 0.2 s on."""
    p, steps = SurfaceParameters(), round(device.rate / recording.rate)
    amplitude = abs(hilbert(np.concatenate(device.moved)[:, 0]))
    table = np.linspace(0.0, amplitude.max(), 4000)
    film = p.friction_coefficient * load * np.interp(amplitude, table, p.friction_law.ratio(table, load, speed))
    kept = np.exp(-speed / device.rate / p.memory_length)
    true = lfilter([1.0 - kept], [1.0, -kept], film)[steps - 1 :: steps]
    band = butter(2, [20.0, 400.0], "bandpass", fs=recording.rate, output="sos")
    late = slice(round(0.2 * recording.rate), round(0.4 * recording.rate))
    signals = true[: len(recording) - 1], recording.motion[1:, 0], recording.reference[1:]
    true, inferred, reference = (sosfiltfilt(band, each)[late] for each in signals)
    return [np.std(each - reference) / np.std(reference) for each in (true, inferred)]


@pytest.mark.parametrize(
    ("speed", "load", "block"),
    [(0.04, 0.25, 16), (0.08, 0.4, 48), (0.12, 1.0, 4), (0.12, 1.0, 16)],
)
def test_white_noise_is_played_whole_on_a_resonator_that_shares_no_code(speed, load, block):
    """As identified.  Where its force per volt, 10 % less than by the design, is not, the error is larger."""
    finger, errors = hr.Finger.sliding(speed=speed, normal_load=load, span=0.26), []
    known = identify_resonance(Resonator(), SurfaceParameters()).profile()
    for profile in (known, known | {"force_constant": 1.777})[: 1 + (load == 0.4)]:
        device = Resonator(load=lambda time: load, block=block)
        fields = {"duration": 0.45, "settle": 0.2, "profile": profile}
        scene = hr.Scene(texture=white(0.6), finger=finger, device="ultrasonic", **fields)
        errors.append(friction_errors(device, hr.render(scene, driver=device), speed, load)[0])
    assert errors[0] < MUST
    assert errors == sorted(errors)


@pytest.mark.parametrize(("speed", "load", "block"), [(0.08, 0.4, 48), (0.12, 1.0, 16)])
def test_white_noise_is_played_whole_on_a_resonator_that_is_probed_and_not_identified(speed, load, block):
    """Resonance, Q and force per volt are not the design's; the last one, 10 % off, is what costs, and is probed."""
    finger, errors = hr.Finger.sliding(speed=speed, normal_load=load, span=0.26), []
    for probed in (True, False):
        device = Resonator(load=lambda time: load, block=block)
        device.probe = probed
        scene = hr.Scene(texture=white(0.6), finger=finger, device="ultrasonic", duration=0.45, settle=0.2)
        recording = hr.render(scene, driver=device)
        del device.moved[: probed * round((DURATION + REST) * device.rate) // block]
        errors.append(friction_errors(device, recording, speed, load)[0])
    assert errors[0] < MUST < errors[1]


@pytest.mark.parametrize(("speed", "rms", "bound", "off"), [(0.01, 0.5e-6, 0.05, 1.0), (0.1, 2e-6, MUST, 1.5)])
def test_a_third_partys_plate_plays_white_noise_and_the_verdict_says_what_it_cannot_know(speed, rms, bound, off):
    """True friction is the law's, of the true amplitude; what the recording infers is within a point of it.

    Where it is half as large again as by the law that the profile states, the recording shows none of it, but is not
    judged: |1.5 i - r| >= 0.5 |r| - 1.5 |i - r| for the inferred friction i.
    """
    finger = hr.Finger.sliding(speed=speed, normal_load=0.4, span=0.18)
    device = watched(finger, block=32)
    p = SurfaceParameters()
    fields = {"duration": 0.45, "settle": 0.2, "profile": {"friction_coefficient": p.friction_coefficient / off}}
    recording = hr.render(
        hr.Scene(texture=white(0.6, rms), finger=finger, device="ultrasonic", **fields), driver=device
    )
    right, shown = friction_errors(device, recording, speed, 0.4)
    assert shown < bound
    assert right < bound if off == 1.0 else right > 0.5 - 1.5 * bound
    assert abs(right - shown) < 0.01 or off > 1.0
    summary = recording.summary()
    assert summary["verdict"] == "not judged"
    assert "inferred by a law that is assumed" in summary["reason"]


@pytest.mark.parametrize(("tells", "least", "most"), [(True, 0.97, 1.03), (False, 1.5, 3.0)])
def test_the_load_that_a_device_tells_is_used(tells, least, most):
    """A scene states half of it: friction comes out about twice as large where the device does not tell."""
    texture = hr.Grating(frequency=200.0, velocity=10e-3)
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
    heavy, told = hr.Finger.sliding(speed=0.08, normal_load=0.8, mechanics="light"), np.full(48, 0.8) if tells else None
    device = watched(heavy, block=48, tell=lambda sample, sensed: sensed._replace(motion=None, normal_load=told))
    recording = hr.render(
        hr.Scene(texture=texture, finger=finger, device="ultrasonic", duration=0.3, settle=0.2), driver=device
    )
    assert least < friction_of(np.concatenate(device.moved)[:, 0], 200.0, load=0.8) / (10e-3 / 0.64) < most
    assert recording.summary()["verdict"] != "passed"


def test_a_signed_friction_sensor_is_no_worse_than_open_loop():
    """Ridges of 0.5 mm under swipes at 3 Hz: the sign turns with the finger, the friction does not.

    Open loop the finger is exactly what the design assumes, so closed loop can only add what it learns of noise, which
    is not played: it would leave 0.598 % for 0.456.  0.01 % is the last digit of the figures.
    """
    finger, errors = hr.Finger.swiping(frequency=3.0, speed=0.05, normal_load=0.4), []
    way = np.sign(np.diff(finger.position(np.arange(8_000) / 10e3)))

    def signed(sample, sensed):
        return sensed._replace(sensed=sensed.sensed * way[sample], motion=None)

    band = butter(2, [20.0, 500.0], "bandpass", fs=10e3, output="sos")
    late = slice(3_333, 6_667)  # one swipe
    for blind in (True, False):
        screen = Screen(finger=finger, tell=signed, blind=blind)
        scene = hr.Scene(texture=ridges(0.5e-3), finger=finger, device="electroadhesion", duration=0.7)
        recording = hr.render(scene, driver=screen)
        true, asked = np.concatenate(screen.moved)[: len(recording), 0], recording.reference
        played, asked = (sosfiltfilt(band, each)[late] for each in (true, asked))
        errors.append(np.std(played - asked) / np.std(asked))
    assert max(errors) < 0.02  # what the project has set itself
    assert errors[1] < errors[0] + 1e-4


def test_a_contact_area_is_learned_through_noise_larger_than_the_texture():
    """20 mN in 11 mN rms: an area 10 % off is 11 % of the waveform unlearned, and far beyond a standard error."""
    tone = np.sin(2 * np.pi * 100.0 * np.arange(10_000) / RATE)
    noise = {"force_noise": 0.02}
    scene = hr.Scene(
        texture=hr.Recorded(samples=tone, rate=RATE, amplitude=16e-6),
        finger=FINGERS["usual"],
        device="electroadhesion",
        duration=2.0,
        settle=1.0,
        profile=noise,
        simulation=noise | {"area_scale": 0.9},
    )
    assert waveform_error(hr.render(scene)) < 0.11 / 2
