"""What cannot be is refused by a sentence with the name, the value, the bound and the unit."""

import re
from dataclasses import replace

import numpy as np
import pytest
from electroadhesive import tone as friction_tone
from subjects import make_impedance
from synthetic import make_bands, make_recording
from tables import SIMULATED, scene_on, tables
from test_kernel import plate_controller
from waves import Own

import hapticrender as hr
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.loopshape import reduced_controller
from hapticrender.control.methods import Resonant, method_named
from hapticrender.drivers import protocol
from hapticrender.drivers.audio import AudioDriver
from hapticrender.drivers.base import BaseDriver
from hapticrender.drivers.nu32 import NU32Board
from hapticrender.drivers.serial import BoardClient
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.drivers.wavefile import WaveFileDriver
from hapticrender.export import board_design
from hapticrender.loop import prepare
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.plants.friction_laws import FitLaw
from hapticrender.plants.hybrid import HybridPlant
from hapticrender.plants.levels import least_model
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.plants.ultrasonic import UltrasonicParameters
from hapticrender.realtime_entry import RealtimeEntry
from hapticrender.renderers.shaped import Port, ShapedDriver, WrappedDriver
from hapticrender.sampled_texture import SampledTexture
from hapticrender.sweep import sweep
from hapticrender.touch.mechanics import LIGHT_SECOND, NONE
from hapticrender.touch.motion import SineMotion
from hapticrender.touch.motion_estimator import MotionEstimator
from hapticrender.touch.perception import detection_threshold, drop_unfelt, from_velocity
from hapticrender.touch.touch_panel import TouchPanel

TONE = hr.Grating(frequency=100.0, velocity=10e-3)
SLIDE = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
PANEL = TouchPanel()
WHITE = {"samples": [0.0, 1.0], "rate": 100.0}


class Louder(ShapedDriver):
    """A driver that a compiled callback, which takes the steps that it inherits, would play as no louder."""

    def play(self, drive):
        return super().play(2.0 * drive)


def grating(**changes):
    return hr.Grating(**{"amplitude": 1e-6, "frequency": 20.0} | changes)


def carriers(**changes):
    good = {"frequency": [20.0, 0.0], "wavenumber": [0.0, 1e3], "phase": [-1.0, 9.0], "envelope": [1e-6, -1e-6j]}
    return hr.Bands(**good | changes)


def opened(device, texture=TONE, finger=SLIDE, driver=None, **parameters):
    return hr.prepare(scene_on(device, texture, finger, 1.0, **parameters), driver=driver)


def plate(gradient=0.0, **parameters):
    return hr.prepare(hr.Scene(texture=TONE, finger=SLIDE, duration=1.0, gradient=gradient, **tables(parameters)))


def exported(bands=0, **changes):
    scene = {"texture": TWO_TONES, "duration": 1.0}
    return board_design(hr.prepare(hr.Scene(**scene | changes)), bands)


def demodulator(**changes):
    return hr.Demodulator(**{"frequency": [100.0], "bandwidth": 5.0, "rate": 5000.0} | changes)


def tracker(**changes):
    return hr.FingerTracker(PlateParameters(), **changes)


def limited(device, **limits):
    texture = hr.Grating(frequency=100.0, amplitude=20e-6)
    return hr.prepare(hr.Scene(texture=texture, finger=SLIDE, device=device, duration=0.1, limits=limits))


def sampled(waveform, spatial=False):
    return SampledTexture(Own(waveform, spatial), 5000.0)


def in_blocks(size=25):
    return plate_controller(make_bands(47.0, 1e-6), delay=size, block=size)


def entry():
    return RealtimeEntry(in_blocks(1))


def played_late(method, delay=25_000, bands=None):
    late = PlateParameters(delay=delay).device_model(5000.0, delay)
    return method.design(late, make_bands(47.0, 1e-5) if bands is None else bands)


def fitted(order=None, **changes):
    return hr.fit_finger(replace(IMPEDANCE, **changes), order)


def analysed(profile=None, rows=5000, block=1, **changes):
    recording = hr.Recording(replace(ANALYSED.header, **changes), ANALYSED.frames[:rows], ANALYSED.scene)
    return hr.analyse_finger(recording, profile, block=block)


def rendered(texture=TONE, **arguments):
    return hr.render(hr.Scene(texture=texture, duration=0.1), **arguments)


def driver(**changes):
    return BaseDriver(**{"rate": 5000.0, "drive_channels": 2, "sensed_channels": 1, "block": 4} | changes)


RECORDED = hr.Recorded(samples=np.sin(np.arange(20000) * 0.1), rate=1e4, amplitude=1e-5, carriers=8)


def on_users(device, parameters=None, **changes):
    users = BaseDriver(**{"rate": 192e3, "block": 16, "drive_channels": 1, "sensed_channels": 1} | changes)
    return opened(device, driver=users, **parameters or {})


CHIRP = hr.Chirp(start=20.0, stop=400.0, duration=2.0, amplitude=5e-6)
PARTS = hr.Scene(texture=TONE + CHIRP, duration=1.0).to_toml().replace("chirp", "chimp")
TONE_TOML = 'duration = 1.0\n[texture]\nkind = "grating"\nfrequency = 50.0\namplitude = 1e-6\n'
TWO_FINGERS = TONE_TOML + 2 * '[[finger]]\nmotion = "still"\n'
ROUND = hr.Playlist([(hr.Grating(wavelength=1e-3, amplitude=1e-6), 1.0)])
IMPEDANCE = make_impedance(np.random.default_rng(0), LIGHT_SECOND, 3, (0.1, 0.49))
ANALYSED = make_recording(make_bands(100.0, 1e-5), 0.0, duration=1.0)
BARE = hr.Finger.sliding(speed=0.05)
FELT = {"top_speed": 0.1, "lowest": 10.0, "highest": 400.0}
FAINT = make_bands([500.0, 20.0, 20.0], [1e-12, 1e-6, 1e-12])
MODEL = PlateParameters().device_model(5000.0, 1)
IN_SPACE = {"frequency": None, "wavelength": 1e-3, "amplitude": None}
HOT = {"level": "envelope", "temperature_rise": 100.0, "temperature_coefficient": -600e-6, "rate": 48e3}
A_COLUMN = np.zeros((5, 1))
SKIN = {"order": 4, "mass": 1e-4, "damping": 1.0, "stiffness": 1e3, "phalanx_damping": 1.0}
MASSLESS = hr.Finger.still(normal_load=0.5, mechanics=SKIN)
UNIT = {"order": 2, "mass": 1e-3, "phalanx_mass": 1e-3}
SCREEN = friction_tone(100.0)


def hybrid(velocity_per_force=0.64, **parameters):
    screen = ElectroadhesionScreen(ElectroadhesionParameters(), SLIDE)
    return HybridPlant(Plate(PlateParameters(**parameters), SLIDE), screen, velocity_per_force)


BY_CARRIERS = {"texture": hr.builtin_scenes(carriers=6)["recorded-texture"].texture, "finger": SLIDE}
STRONG, FAST = friction_tone(100.0, force=2.0), hr.Grating(frequency=100.0, velocity=0.2)
FAR_UP = hr.Grating(velocity=1.5, frequency=250.0)
TO_CARRIER, SLOW = ("electroadhesion", {"output": "carrier"}), {"rate": 79_999, "sensed_channels": 0}
TWO_TONES = hr.Grating(frequency=60.0, amplitude=1e-5, partials=((1.0, 1.0, 0.0), (2.4, 0.4, 1.0)))

TEXTURES = [
    (lambda: grating(level=20), r"amplitude, velocity, level: exactly .* amplitude = 1e-06 and level = 20.0 are"),
    (lambda: grating(amplitude=None, velocity=1.0, frequency=5e-324), r"velocity = 1.0: must be <= 0.01 m .* is inf m"),
    (lambda: grating(amplitude=None, level=20, frequency=1001), r"level = 20.0: must be stated at 1 to 1000 Hz"),
    (lambda: grating(**IN_SPACE, level=20), r"speed is missing: must be .* m/s"),
    (lambda: grating(amplitude=10.0), r"amplitude = 10.0: must be .* <= 0.01 m"),
    (lambda: grating(wavelength=1e-3), r"frequency, wavelength: exactly one must be given; frequency = 20.0"),
    (lambda: grating(shape="sawtooth"), r"shape = 'sawtooth': must be one of sine, square, triangle"),
    (lambda: grating(partials=[{"order": 1}]), r"partials\[0\] = .*: must be order, amplitude, phase"),
    (lambda: carriers(frequency=[np.nan, 1.0]), r"frequency\[0\] = nan: must be finite and >= 0 \(Hz\)"),
    (lambda: carriers(wavenumber=[0.0]), r"wavenumber has shape \(1,\): must be .* as many as frequency has"),
    (lambda: hr.Recorded(amplitude=1e-6, samples=[0.0, 1.0]), "rate is missing"),
    (lambda: hr.Recorded(amplitude=1e-6, rate=9.0, samples=np.ma.masked_greater(np.arange(4.0), 2)), "masked: fill"),
    (lambda: hr.Recorded(amplitude=1e-6, file="a.wav", rate=100.0), "rate = 100.0: must be left out, as the file has"),
    (lambda: hr.Recorded(amplitude=1e-6, file="a.wav", **WHITE), "file, samples: exactly one must be given"),
    (lambda: hr.Sum([(TONE, 1.0), ("tone", 1.0)]), r"parts\[1\] = .*: must be 1 to 4096 pairs of a texture and a num"),
    (lambda: drop_unfelt(FAINT, **FELT), "^no band can be felt: 20 Hz: target 1 µm is below .*, 3.16 µm .*keep_unfelt"),
    (lambda: SampledTexture(ROUND, 5e3), "Playlist with a part along the surface: play its parts one after another"),
    (lambda: sampled(lambda t, x: np.sin(x)), "Own: must not change with the finger's position"),
    (lambda: sampled(lambda t, x: t * np.isfinite(x)), "Own: must not change with the finger's position or contact"),
    (lambda: sampled(lambda t, x: t + x, True),
     "Own: must not change with time on a board: it is a function of position"),
    (lambda: hr.Scene.from_toml_text(PARTS), r"texture\.parts\[1\]\[0\]\.kind = 'chimp': must be one of"),
    (lambda: detection_threshold(np.nan), r"frequency = .*: must be finite numbers >= 0 Hz$"),
    (lambda: from_velocity(0.1, 0.0), r"frequency = .*: must be finite numbers > 0 Hz$"),
]  # fmt: skip
FINGERS = [
    (lambda: hr.Finger.still(normal_load=-0.1), r"normal_load = -0.1: must be .* >= 0 and <= 20 N"),
    (lambda: hr.Finger.still(normal_load=[[0.0, 1.0], [0.2]]), r"normal_load\[0\] = .*: must be 1 rising times in s"),
    (lambda: hr.Finger.still(touches=[(1.0, 0.5)]), r"touches\[0\] = \(1.0, 0.5\): must be pairs of on < off in s"),
    (lambda: hr.Finger.still(mechanics="strong"), r"mechanics = 'strong': must be one of auto, none, light"),
    (lambda: hr.Finger.still(mechanics=UNIT | {"mass": -1e-3}), r"mechanics.mass = -0.001: must be .* kg"),
    (lambda: hr.Finger.still(mechanics=UNIT), r"mechanics.phalanx_mass = 0.001: must be 0"),
    (lambda: NONE.skin_velocity_per_force(np.array([20.0])), "order = 0: must be 2 or 4"),
    (lambda: LIGHT_SECOND.impedance(np.array([0.0])), r"frequency = .*: must be finite numbers > 0 Hz"),
    (lambda: hr.Scene(texture=TONE, finger=[SLIDE, SLIDE], duration=1.0), "finger: 2 fingers are stated: must be one"),
    (lambda: hr.Scene.from_toml_text(TWO_FINGERS), "finger: 2 fingers are stated: must be one"),
    (lambda: fitted(standard_error=0 * IMPEDANCE.standard_error), "standard_error = 0.0: must be > 0 N s/m"),
    (lambda: hr.fit_finger(3), "impedance = 3: must be what analyse_finger returns"),
    (lambda: fitted(3), "order = 3: must be 2, 4 or None"),
    (lambda: fitted(2).interval("mass", 1), "level = 1: must be > 0 and < 1"),
    (lambda: analysed(sensed_channels=1), "1 sensors in m: must be 2 in m"),
    (lambda: analysed(unit="N"), "2 sensors in N: must be 2 in m"),
    (lambda: analysed(rows=4999), "0.9998 s long: must be >= 1 s"),
    (lambda: analysed(hr.DeviceProfile(kind="ultrasonic")), "profile.kind = 'ultrasonic': must be vt-plate"),
    (lambda: analysed(block=2), "block=2 samples: must be an integer from 1 to the plate's delay, 1"),
    (lambda: SineMotion(frequency=3.0), r"speed, stroke: exactly one must be given"),
]
SENSORS = [
    (lambda: MotionEstimator(), "one must be > 1e-09 m"),
    (lambda: hr.Encoder(0.5e-6, bits=70), "bits = 70: must be an integer >= 2 and <= 64"),
    (lambda: hr.Encoder(0.5e-6).update(0.0, 2.5), "position = 2.5: must be a whole number of counts"),
    (lambda: hr.phase_error(PANEL, 0.05, 0.0), "wavelength = 0.0: must be a finite number > 0 m"),
    (lambda: hr.finest_wavelength(PANEL, 0.05, degrees=0.0), "degrees = 0.0: .* > 0"),
    (lambda: hr.Scene(texture=TONE, duration=1.0, touch_panel={"hz": 1}), "touch_panel.hz = .*: unknown key"),
    (lambda: hr.Player("vt-plate", touch_panel={"rate": 60.0}), "touch_panel: has no effect on the positions that"),
]
TRACKER = [
    (lambda: tracker(lookahead=-1), "lookahead = -1: must be a finite number >= 0 s"),
    (lambda: tracker(rate=499.9), "rate = 499.9: must be a finite number >= 500 Hz"),
    (lambda: tracker(noise=[1e-6]), r"noise = array\(\[1.e-06\]\): must be two numbers"),
    (lambda: hr.FingerTracker(3), "plate = 3: must be a PlateParameters or a Course"),
    (lambda: tracker().update(A_COLUMN, np.zeros((5, 2))),
     r"shapes \(5, 1\) and \(5, 2\): must be \(5, 2\) and \(5, 2\)"),
]  # fmt: skip
PLANTS = [
    (lambda: PlateParameters.with_overrides({"mass": 0.0}), r"mass = 0.0: must be .*> 0 .*kg"),
    (lambda: PlateParameters.with_overrides({"masss": 1.0}), r"masss = 1.0: unknown key; known: .*mass"),
    (lambda: PlateParameters(bending_frequency=6000.0), r"bending_frequency = 6000.0: must be <= rate = 5000 Hz"),
    (lambda: Plate(PlateParameters(), MASSLESS), r"phalanx_mass = 0.0 kg: must be .*> 0"),
    (lambda: Plate(PlateParameters(delay=2), SLIDE, block=3), r"block = 3: must be between 1 and the loop's delay of"),
    (lambda: Plate(PlateParameters(), SLIDE).run(np.zeros((9, 1))), r"drive of shape \(9, 1\): must be \(samples, 2\)"),
    (lambda: least_model(hr.Scene(texture=TONE, duration=1.0), tolerance=0.0), "tolerance=0.0: must be > 0 and <= 10"),
    (lambda: UltrasonicParameters(rate=48e3), r"rate = 48000.0: must be .*>= 66666.7 .*Hz for a carrier of 30000 Hz"),
    (lambda: UltrasonicParameters(finger_damping=2e3),
     r"finger_damping = 2000.0: damping ratio 3.63 at 20 N .* must be .*<= 0.5"),
    (lambda: UltrasonicParameters(**HOT),
     "temperature_rise = 100.0: shifts the resonance by up to -1800 Hz, must be within 1500 Hz"),
    (lambda: FitLaw().amplitude(0.1, 0.5, 0.1), r"ratio = 0.1: must be .*>= 0.100001 .*and <= 1"),
]  # fmt: skip
SCENES = [
    (lambda: plate(2.0, coils=1), "gradient = 2.0: must be 0 1/m: a plate with one coil"),
    *(
        (lambda kind=kind: limited(kind, displacement=1e-3), "displacement = 0.001: must be left out: it bounds")
        for kind in ("electroadhesion", "ultrasonic")
    ),
    (lambda: limited("vt-plate", peak_drive=2000.0), r"peak_drive = 2000 A: must be <= 3 A, the largest drive of"),
    (lambda: limited("ultrasonic", rms_drive=500.0), r"rms_drive = 500 V: must be <= .* V, the largest drive of"),
    (lambda: limited("vt-plate", displacement=400.0),
     r"displacement = 400 m: must be <= 0.001 m, the sensors' range of"),
    (lambda: limited("vt-plate", peak=1), "limits.peak = 1: unknown key; known: displacement, peak_drive, rms_drive"),
    (lambda: opened("tea-tray"), "'tea-tray'.* vt-plate"),
    (lambda: plate(19.0), "gradient = 19.0: must be <= 18.1818 1/m"),
    (lambda: opened("electroadhesion", finger=hr.Finger.still(normal_load=1.0)), r"finger: must slide faster than 0.0"),
    (lambda: hr.prepare(STRONG), "asks for an attraction of 10.* N: must be <= 2.23 N, at 0.01 A under a nominal"),
    (lambda: hr.prepare(replace(STRONG, gradient=1.0)), "gradient = 1.0: must be 0 1/m"),
    (lambda: opened("electroadhesion", force_range=1e-3), "friction of 0.3.. N: must be <= 0.001 N, the tribometer's"),
    (lambda: opened("electroadhesion", friction_coefficient=0.0), "device.friction_coefficient = 0.0: must be .* > 0"),
    (lambda: opened("ultrasonic", bias=0.1), r"device.bias = 0.1: must be > 0.109, the least that the law leaves"),
    (lambda: opened("ultrasonic", scale=1e-4), "asks for a vibration of .* V under 0.4 N: must be <= 10 V"),
    (lambda: opened("ultrasonic", finger=hr.Finger.still(normal_load=0.4)), r"must slide faster than 0.001 m/s"),
    (lambda: opened("ultrasonic", FAST), "0.313 N of friction: must be <= 0.144 N"),
    *(
        (lambda device=device: opened(device, RECORDED, velocity_per_force=0.0), "must be > 0 .* for a recording")
        for device in ("electroadhesion", "ultrasonic")
    ),
    *(
        (lambda device=device: opened(device, finger=BARE, velocity_per_force=0.0), "finger.mechanics")
        for device in ("electroadhesion", "ultrasonic")
    ),
    (lambda: sweep([TONE], at_a_time=0), "at_a_time = 0: must be an integer >= 1 scenes"),
    (lambda: rendered(renderer=object()), r"renderer: must be an object with open\(scene, driver\).*not object"),
    (lambda: rendered(Own(TONE.waveform, bands=0)), "Own.bands returned int: must be hapticrender.Bands"),
    (lambda: rendered(Own(TONE.waveform, bands=make_bands([0.0, 47.0], 1e-6))), "frequency = 0.0: must be > 0 Hz"),
    (lambda: opened("hybrid", crossover=30.0), r"render.crossover = 30.0: must be .* >= 40 and <= 400 Hz"),
    (lambda: opened("hybrid", replace(BY_CARRIERS["texture"], speed=None)), "a recording over time on carriers is not"),
    (lambda: opened("hybrid", FAR_UP), "texture.amplitude asks for an attraction of"),
]  # fmt: skip
DRIVERS = [
    (lambda: rendered(driver=SimulatedDriver), "driver = SimulatedDriver: must be an instance, not the class"),
    (lambda: protocol.encode(protocol.Frame(1, 0, bytes(250))), "payload of 250 bytes: must be <= 249"),
    (lambda: RealtimeEntry(object()), "controller of type object: must have a compiled step"),
    (lambda: RealtimeEntry(in_blocks(), converter=Port(1e3, 1, 1)), "converter of type Port: must have compiled steps"),
    (
        lambda: RealtimeEntry(in_blocks(), converter=WrappedDriver(Port(1e3, 1, 1))),
        "converter of type WrappedDriver: must have compiled steps",
    ),
    (
        lambda: RealtimeEntry(in_blocks(), converter=Louder(Port(1e3, 1, 1), None)),
        "converter of type Louder: must have compiled steps of its own beside its own `play`",
    ),
    (lambda: RealtimeEntry(in_blocks(), frames=64), "frames = 64: must be a multiple of the controller's block of 25"),
    (lambda: entry().finger(0.0, np.nan), "must be finite"),
    (lambda: driver(rate=0.0), r"BaseDriver: rate=0.0 must be finite and > 0 Hz"),
    (lambda: driver(block=0), r"block=0 must be a whole number >= 1"),
    (lambda: driver(delay=3), r"delay=3 must be a whole number >= 4"),
    (lambda: AudioDriver("0", channels=()), r"channels=\(\): must name at least one output"),
    (lambda: AudioDriver("0", channels=(0, 1)), r"channels=\(0, 1\): must be different whole numbers >= 1"),
    (lambda: AudioDriver("0", drive_per_full_scale=0.0), "drive_per_full_scale = 0.0: must be a finite number > 0"),
    (lambda: AudioDriver("0", delay=63.0), "delay=63.0 samples: must be >= block = 64 and <= 10 s"),
    (lambda: WaveFileDriver("a.mp3"), r"a\.mp3: the ending '\.mp3' must be one of \.wav, \.w64"),
    (lambda: NU32Board("COM7", timeout=0.0), "timeout = .*: must be a finite number > 0 s"),
    (lambda: NU32Board("COM7").set_bands(make_bands([20.0, 47.0], 1e-6)), "bands: must be one fixed tone"),
    (lambda: BoardClient("x", reconnect=np.inf), r"reconnect = .*: must be a finite number >= 0 s"),
    (lambda: on_users("ultrasonic", rate=100e3),
     "driver.rate = 100000.0: must be a whole multiple of device.rate = 12000 Hz"),
    (lambda: on_users("ultrasonic", rate=48e3, block=4), "rate = 48000.0: must be >= 66666.7 Hz for a carrier"),
    (lambda: on_users("ultrasonic", {"sensor": "tribometer"}), "device.sensor = 'tribometer': must be 'amplitude'"),
    (lambda: on_users(*TO_CARRIER, **SLOW),
     "driver.rate = 79999: must be >= 80000 Hz where output = 'carrier', 4 samples a turn"),
    (lambda: on_users(*TO_CARRIER), "driver.sensed_channels = 1: must be 0 where output = 'carrier'"),
    (lambda: opened("vt-plate", driver=driver(drive_channels=1)),
     r"driver.drive_channels = 1: must be 2 \(one a coil; of a plate with 1: \[device\] coils = 1\)"),
    (lambda: opened("hybrid", driver=driver(rate=10e3)), r"driver.drive_channels = 2: must be 3"),
]  # fmt: skip
DESIGNS = [
    (lambda: method_named("papper"), r"method = 'papper': must be one of paper, paper-common"),
    (lambda: Resonant(gain=17.0).design(MODEL, make_bands(47.0, 1e-5)), r"gain=17 1/s must be below 16\.1 1/s"),
    *(
        (lambda gain=gain: Resonant(gain=gain), "gain = .*: must be a finite number > 0 1/s")
        for gain in (-1.0, 0, np.nan)
    ),
    *(
        (lambda method=method: played_late(method_named(method)), "margin|unstable|sensitivity")
        for method in ("boxcar", "static", "stiffness", "resonant")
    ),
    (lambda: in_blocks().run(*map(np.zeros, ((30, 2), 30, 30))), "30 samples: must be a multiple of the block of 25"),
    (
        lambda: in_blocks().run(*map(np.zeros, ((25, 1), 25, 25))),
        r"of shapes \(\(25, 1\), \(25,\), \(25,\)\): must be \(\(25, 2\)",
    ),
    (lambda: in_blocks().run(*map(np.zeros, ((25, 2), 1, 25))), r"\(1,\), \(25,\)\): must be \(\(25, 2\), \(25,\)"),
    (lambda: demodulator(frequency=[]), "at least one number"),
    (lambda: demodulator(frequency=[2501.0]), "half the rate, 2500 Hz"),
    (lambda: demodulator(frequency=[-1.0]), r"frequency = \[-1.0\]: must be finite numbers >= 0 Hz"),
    (lambda: demodulator(frequency="loud"), "frequency = 'loud': must be finite numbers >= 0 Hz"),
    (lambda: hr.detection_threshold("loud"), "frequency = 'loud': must be finite numbers >= 0 Hz"),
    (lambda: demodulator().run(np.zeros((4, 2))), r"must be \(n, 1\)"),
    (lambda: StarSTDFT(bandwidth=2500.0, rate=5000.0), "bandwidth=2500.0 Hz must lie between 0 and half the rate"),
    (lambda: reduced_controller(5.0, 5.0), "loop_bandwidth=5.0 Hz: must be > 0 and below filter_bandwidth=5.0 Hz"),
    (lambda: exported(method="h2"), "method = 'h2': a board plays \"inverse\" only"),
    (lambda: exported(**BY_CARRIERS), "texture Recorded: a board plays a whole waveform, without `carriers`"),
    (lambda: exported(profile={"delay": 65}), "delay = 65 samples: must be <= 64"),
    (lambda: exported(1), "bands = 1: must be 2 .* to 64"),
]
KINDS = {
    "texture": TEXTURES, "finger": FINGERS, "sensor": SENSORS, "tracker": TRACKER, "plant": PLANTS, "scene": SCENES,
    "driver": DRIVERS, "design": DESIGNS,
}  # fmt: skip
EACH = [pytest.param(*row, id=f"{kind} {n}") for kind, rows in KINDS.items() for n, row in enumerate(rows)]


@pytest.mark.parametrize(("make", "message"), EACH)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises((ValueError, TypeError, hr.DesignError), match=message):
        make()


@pytest.mark.parametrize(
    "bad", [{"rate": 5e3}, {"coils": 1}, {"velocity_per_force": 0.0}, {"velocity_per_force": np.nan}]
)
def test_a_hybrid_is_of_a_plate_with_two_coils_at_the_rate_of_the_screen(bad):
    assert hybrid(rate=10e3).rate == 10e3
    with pytest.raises(
        ValueError, match=r"plate.rate, its coils, velocity_per_force = .*: must be 10000 Hz, 2 and > 0 m"
    ):
        hybrid(**{"rate": 10e3} | bad)


def test_a_gain_is_refused_as_it_was_given_and_the_one_stated_is_accepted():
    """0.613 / 0.2 s for each of two bands."""
    bands = make_bands([47.0, 111.0], 1e-6)
    with pytest.raises(hr.DesignError, match=r"gain=10 1/s must be <= 6\.13 1/s of 2 bands behind a delay of 0\.2 s"):
        played_late(Resonant(gain=10.0), 1000, bands)
    assert played_late(Resonant(gain=6.13), 1000, bands)


TEXTURE = hr.Grating(velocity=5e-3, frequency=100.0)
FINGER = hr.Finger.sliding(speed=0.08, normal_load=0.4)
ONE_EACH = {  # of every class of parameters that a kind of device reads from the table
    "vt-plate": {"mass", "bending_frequency"},
    "electroadhesion": {"velocity_per_force", "square_root", "headroom", "floor", "output", "current_limit", "rate"},
    "ultrasonic": {"velocity_per_force", "square_root", "bias", "memory_length", "quality", "rate", "law"},
    "hybrid": {"crossover", "velocity_per_force", "square_root", "mass", "screen_current_limit", "gap_thickness"},
}


def opened_on(device, **fields):
    return prepare(hr.Scene(texture=TEXTURE, finger=FINGER, device=device, duration=2.0, **fields))


def known_of(device):
    """Names that the refusals of a misspelt one list."""
    known = []
    for field, table in (("profile", "device"), ("simulation", "simulation"), ("rendering", "render")):
        with pytest.raises(ValueError, match=rf"^{table}.mispelt = 1.0: unknown key; known: ") as refused:
            opened_on(device, **{field: {"mispelt": 1.0}})
        names = re.sub(r".*known: |; in a file also .*", "", str(refused.value)).split(", ")
        assert names == sorted(set(names))
        known += [(name, table) for name in names if name]
    return dict(known)


@pytest.mark.parametrize("device", ONE_EACH)
def test_every_name_is_listed_once_in_order_and_accepted(device):
    """A value is refused for what it is, never for its name: all parameters are numbers or options of a few."""
    known = known_of(device)
    assert set(known) >= ONE_EACH[device]
    for name, table in known.items():
        field = "rendering" if table == "render" else "simulation" if name in SIMULATED else "profile"
        with pytest.raises((TypeError, ValueError), match="must be") as refused:
            opened_on(device, **{field: {name: "no such option"}})
        assert re.search(rf"\b{re.sub('^(plate|screen)_', '', name)} = 'no such option'", str(refused.value))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rendering": {"mass": 0.03}}, r"render.mass: belongs in \[device\] or \[simulation\]"),
        ({"profile": {"finger_dynamics": 0}}, r"device.finger_dynamics: belongs in \[simulation\]"),
        ({"simulation": {"rate": 1e4}}, r"simulation.rate: belongs in \[device\]"),
        ({"device": "electroadhesion", "profile": {"headroom": 2.0}}, r"device.headroom: belongs in \[render\]"),
        ({"device": "hybrid", "simulation": {"crossover": 90.0}}, r"simulation.crossover: belongs in \[render\]"),
        *(
            ({"device": device, "profile": {"seed": 1}}, r"device.seed: belongs in \[simulation\]")
            for device in ONE_EACH
        ),
        ({"device": "hybrid", "simulation": {"method": "h2"}}, r"simulation.method: belongs in \[render\]"),
        ({"device": "hybrid", "simulation": {"rate": 1e4}}, r"simulation.rate: belongs in \[device\]"),
        ({"device": "hybrid", "profile": {"level": "carrier"}}, r"device.level: belongs in \[simulation\]"),
        ({"device": "ultrasonic", "simulation": {"lock": 0.0}}, r"simulation.lock: belongs in \[device\]"),
        ({"device": "ultrasonic", "simulation": {"bias": 0.7}}, r"simulation.bias: belongs in \[device\]"),
        *(
            (
                {"device": kind, "simulation": {"open_loop_gain": 1e4}},
                r"simulation.open_loop_gain: belongs in \[device\]",
            )
            for kind in ("electroadhesion", "hybrid")
        ),
    ],
)
def test_a_parameter_in_the_wrong_table_is_sent_to_the_right_one(fields, message):
    with pytest.raises(ValueError, match=message):
        opened_on(**{"device": "vt-plate", **fields})


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic", "hybrid"])
@pytest.mark.parametrize(("table", "wrong"), [("simulation", {"level": "auto"}), ("profile", {"memory_length": -1.0})])
def test_a_wrong_entry_is_named_with_the_table_that_it_stands_in(device, table, wrong):
    """The level counts in the design, too, and is no entry of [device] for that."""
    name = {"simulation": "simulation", "profile": "device"}[table]
    with pytest.raises(ValueError, match=rf"^{name}.{next(iter(wrong))} = "):
        opened_on(device, **{table: wrong})


def test_a_hybrid_lists_what_each_of_its_tables_takes():
    for table, field, others in (
        ("device", "profile", ("level", "degrees_of_freedom")),
        ("simulation",) * 2 + (("rate",),),
    ):
        with pytest.raises(ValueError, match=f"^{table}.tea = 1: unknown key; known: ") as refused:
            opened_on("hybrid", **{field: {"tea": 1}})
        listed = re.findall(r"\w+", str(refused.value))
        assert not set(others) & set(listed)
        assert {"screen_current_limit", "coils", "area_scale"} <= set(listed)
