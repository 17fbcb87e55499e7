"""Identification of friction devices that share no code with the library's."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from live_devices import Bench
from scipy.signal import lfilter
from strangers_resonator import Resonator, scaled

import hapticrender as hr
from hapticrender import cli
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.plants.identify_friction import identify_resonance, identify_screen
from hapticrender.plants.ultrasonic_surface import SurfaceParameters


class Screen(Bench):
    """Friction mu (W + g I^2) over 11.5 um of sliding, to and fro; 1 mN of noise, a `load` W (N) that varies."""

    rate, block, delay, drive_channels, sensed_channels = 10e3, 10, 10, 1, 1

    def __init__(self, mu=0.6, gain=1.5e4, speed=0.08, load=0.5, seed=0, unit=1.0, lateral=False, skin=0.0):
        self.unit, self.lateral, self.skin, self.rough = unit, lateral, skin, 0.0
        self.mu, self.gain, self.speed, self.load, self.at, self.friction = mu, gain, speed, load, 0, np.zeros(1)
        self.rng = np.random.default_rng(seed)

    def play(self, drive):
        time = (self.at + np.arange(len(drive))) / self.rate
        self.at += len(drive)
        load = self.load * (1.0 + 0.2 * np.sin(2 * np.pi * 1.3 * time))
        whole = self.mu * (load + self.gain * drive[:, 0] ** 2)
        kept = np.exp(-self.speed / (self.rate * 11.5e-6))
        before = self.friction[-1]
        self.friction = lfilter([1 - kept], [1.0, -kept], whole, zi=[kept * before])[0]
        sensed = np.r_[before, self.friction[:-1]][:, None]
        rough, noise = self.rng.standard_normal((len(drive), 2)).T
        if self.skin:
            came, left = self.skin * np.sqrt(2 / 50) * rough, 1 - 1 / 50  # within 5 ms
            rough = lfilter([1.0], [1.0, -left], came, zi=[left * self.rough])[0]
            sensed[:, 0] += np.r_[self.rough, rough[:-1]]
            self.rough = rough[-1]
        position = 0.02 * (1 - 2 * abs((time * self.speed / 0.04) % 2 - 1)) if self.speed else np.zeros(len(drive))
        if self.lateral:
            sensed *= np.where((time * self.speed / 0.04) % 2 < 1, 1.0, -1.0)[:, None]
        sensed = self.unit * (sensed + 1e-3 * noise[:, None])
        return hr.Sensed(sensed, position, normal_load=load)


@pytest.mark.parametrize(("frequency", "expected"), [(30.1e3, 30e3), (19.95e3, 20e3)])
def test_a_resonance_half_a_percent_off_is_found(frequency, expected):
    """f within 1 Hz, Q and force .2 %."""
    found = identify_resonance(Resonator(frequency), SurfaceParameters.with_overrides({"frequency": expected}))
    truth = {"frequency": frequency, "quality": 150.0, "force_constant": 1.6}
    for name, within in (("frequency", 1.0), ("quality", 0.3), ("force_constant", 0.0032)):
        estimate = found.estimates[name]
        assert estimate.value == pytest.approx(truth[name], abs=within)
    assert SurfaceParameters.with_overrides(found.profile()).mode.quality == found.profile()["quality"]


@pytest.mark.parametrize("kind", [{}, {"unit": -1.0}, {"lateral": True}])
def test_a_screens_gain_and_friction_are_found_under_a_sliding_finger(kind):
    """mu and g within 1 %, whatever the sensor's sign means; a profile that the renderer takes."""
    found = identify_screen(Screen(**kind), ElectroadhesionParameters(), hr.Finger.absent())
    assert found.profile() == pytest.approx({"friction_coefficient": 0.6, "open_loop_gain": 1.5e4}, rel=0.01)
    texture, finger = hr.Grating(frequency=100.0, amplitude=50e-6), hr.Finger.sliding(speed=0.08, normal_load=0.5)
    scene = hr.Scene(texture=texture, finger=finger, duration=0.1, device="electroadhesion", profile=found.profile())
    assert hr.prepare(scene, driver=Screen()).driver.state["gain"] == pytest.approx(1.5e4, rel=0.01)
    assert set(found.uncertainty()) == set(found.profile())


def test_intervals_of_a_screen_hold_what_skin_leaves():
    """5 mN that come and go in 5 ms: of ten 95 % intervals fewer than seven hold the truth once in a thousand.

    As if what is left were white they would be ten times too narrow; lag and delay leave a hundredth of them.
    """
    inside = {"friction_coefficient": 0, "open_loop_gain": 0}
    for seed in range(10):
        screen = Screen(seed=seed, skin=5e-3)
        screen.block = screen.delay = 100
        found = identify_screen(screen, ElectroadhesionParameters(), hr.Finger.absent())
        for name, truth in (("friction_coefficient", 0.6), ("open_loop_gain", 1.5e4)):
            estimate = found.estimates[name]
            inside[name] += abs(estimate.value - truth) < estimate.interval
            assert estimate.interval < 0.05 * truth
    assert min(inside.values()) >= 7


def test_too_short_a_slide_is_refused_since_its_intervals_would_be_none():
    """The scores of one period add to zero: its intervals were 1e-10, of two or three they hold 75 % of the time."""
    with pytest.raises(hr.DesignError, match="more than 3 periods of 0.2 s"):
        identify_screen(Screen(skin=5e-3), ElectroadhesionParameters(), hr.Finger.absent(), seconds=0.8)
    found = identify_screen(Screen(skin=5e-3), ElectroadhesionParameters(), hr.Finger.absent(), seconds=1.0)
    assert found.estimates["open_loop_gain"].interval > 10.0


@pytest.mark.parametrize(
    ("device", "message"),
    [
        (Resonator(force=0.0), "unexplained"),
        (Screen(speed=0.0), "must slide faster than 0.001 m/s"),
        (Screen(gain=-1.5e4), "identified open_loop_gain = -.*: must be a finite number > 0 N"),
        (Resonator(tell=scaled(0.0)), "sensed no motion at any line of the drive: check the sensor's connection"),
        (Resonator(late=2), "sensed 2 samples later than driver.delay = 64 says: must be within 0.5"),
        (Resonator(tell=scaled(-1.0)), "sensed 3.2 samples (later|earlier) .* half a turn, the sensor may be inverted"),
        (Resonator(tell=scaled(1e6)), r"sensor 1: \S+ m at sample \d+: must be within \+-2.5e-05 m; check its unit"),
        (Screen(unit=1e3), r"sensor 1: \S+ N at sample \d+: must be within \+-20 N; check its unit"),
    ],
)
def test_what_cannot_be_identified_or_used_is_refused(device, message):
    screen = isinstance(device, Screen)
    arguments = (ElectroadhesionParameters(), hr.Finger.absent()) if screen else (SurfaceParameters(),)
    with pytest.raises(hr.DesignError, match=message):
        (identify_screen if screen else identify_resonance)(device, *arguments)


def test_a_rate_below_twice_the_carrier_is_refused_before_anything_is_played():
    device = Resonator()
    device.rate = 48e3
    with pytest.raises(ValueError, match="rate = 48000 Hz: must be > 61200 Hz, twice the highest line"):
        identify_resonance(device, SurfaceParameters())
    assert not device.played


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"sensor": "impedance", "level": "carrier"}, "device.sensor"), ({"drive_kind": "voltage"}, "device.drive_kind")],
)
def test_a_screen_is_identified_by_a_tribometer_and_a_current(changes, message):
    with pytest.raises(ValueError, match=f"{message} = .*: must be .* to identify a screen"):
        identify_screen(Screen(), ElectroadhesionParameters(**changes), hr.Finger.absent())


@pytest.mark.parametrize(
    ("kind", "profile", "expected"),
    [
        ("ultrasonic", {"rate": 3e3, "frequency": 22e3}, {"frequency": 22e3, "quality": 200.0}),  # 16 of drive to one
        ("electroadhesion", {"rate": 4e3}, {"friction_coefficient": 0.8}),
    ],
)
def test_the_command_line_identifies_the_device_of_a_scene(tmp_path, kind, profile, expected):
    """The simulated device, from a scene, at a low rate; the profile holds what its parameters say, within .2 %."""
    scene, out = tmp_path / "scene.toml", tmp_path / "device.toml"
    scene.write_text(replace(hr.builtin_scenes()[f"one-texture-{kind}"], profile=profile).to_toml())
    assert cli.main(["identify", "--scene", str(scene), "--out", str(out)]) == 0
    device = tomllib.loads(out.read_text())["device"]
    assert {name: device[name] for name in expected} == pytest.approx(expected, rel=2e-3)
