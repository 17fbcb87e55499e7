"""Ultrasonic surface: turns a scene into friction bands, the surface's device model, and the simulated surface.

The target quantity is friction (N), as a change around a bias below that of the surface at rest.  The inverse of the
friction law makes it an amplitude of the plate's mode, which the same controller holds on the resonant carrier.  A
driver of your own gets that carrier (V) at its own rate, and senses the mode's displacement (m), or nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from hapticrender.bands import Bands
from hapticrender.checks import require
from hapticrender.control.device_model import Demand, DeviceModel
from hapticrender.plants.friction_laws import LAWS
from hapticrender.plants.ultrasonic import UltrasonicParameters
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, UltrasonicSurface
from hapticrender.protocols import Driver
from hapticrender.renderers.base import read_tables
from hapticrender.renderers.friction import FrictionRenderer, FrictionSettings, FrictionSetup, carrier_limit
from hapticrender.renderers.resonant import ResonantDriver, amplitude_loop
from hapticrender.renderers.shaped import Port
from hapticrender.touch.scene import Scene

WORST_SKIN = 3.0  # damping of a finger over that assumed
LEAST_NOISE = 1e-6  # of the range: of a friction that is computed from the amplitude
LEVEL = ("level", "oversampling", "envelope_oversampling", "envelope_frequency")  # how finely a surface is modelled
DESIGN = ("bias", "lock")  # of the control alone


@dataclass(frozen=True)
class SurfaceSetup(FrictionSetup):
    """A scene on an ultrasonic plate."""

    assumed: SurfaceParameters
    simulated: SurfaceParameters

    def amplitude(self, swing: float) -> float:
        """Largest amplitude (m) for a `swing` (N) of the friction around the bias."""
        share = swing / (self.assumed.friction_coefficient * self.load)
        least = max(self.assumed.bias - share, self.assumed.least_ratio)
        return float(self.assumed.friction_law.amplitude(least, self.load, self.speed))


class UltrasonicRenderer(FrictionRenderer):
    """Renderer for plates that reduce friction by ultrasonic vibration."""

    name = "ultrasonic"
    needs = "a drive at the carrier's rate (V), the vibration sensed (m), or open loop"
    no_board = (
        "no board plays it: its drive is computed at the carrier's rate, 192 kHz or more: "
        "play it from the host, such as by --driver 'audio:NAME?rate=192000'"
    )

    def read(self, scene: Scene, driver: Driver | None) -> SurfaceSetup:
        """Read the tables of a scene."""
        law = LAWS.get(str({**scene.profile, **scene.simulation}.get("law")), LAWS["fit"])
        more = UltrasonicParameters.names() | law.names()
        settings, assumed, simulated = read_tables(scene, SurfaceParameters, FrictionSettings, LEVEL, more, DESIGN)
        limit = carrier_limit(scene.device_profile.limits, assumed.mode.drive_limit, "V")
        assumed = replace(assumed, mode=replace(assumed.mode, drive_limit=limit))
        return SurfaceSetup(scene, settings, assumed, simulated)

    def plant(self, setup: SurfaceSetup, seed: int) -> UltrasonicSurface:
        """Return the simulated surface with the scene's finger on it."""
        loop, nominal = amplitude_loop(setup.assumed), (setup.load, setup.speed)
        return UltrasonicSurface(setup.simulated, loop, setup.scene.finger, seed, nominal, setup.assumed)

    def connect(self, setup: SurfaceSetup, driver: Driver) -> Driver:
        """Return a device at the carrier's rate as a driver of friction; see `ResonantDriver`."""
        return ResonantDriver(driver, setup.assumed, setup.scene.finger, (setup.load, setup.speed), _demand(setup))

    def probe(self, setup: SurfaceSetup, model: DeviceModel, driver: Driver) -> Callable[[Driver], None] | None:
        """Return what probes the response on the resonance of a surface that senses, unless the scene says no."""
        if setup.settings.probe and isinstance(driver, ResonantDriver) and driver.sensed_channels:
            return driver.calibrate
        return None

    def device_model(self, setup: SurfaceSetup, driver: Driver) -> DeviceModel:
        """Return the device model of the surface behind `driver`; refuses what the law or the drive cannot do."""
        assumed, load = setup.assumed, setup.load
        model = _model(setup, driver)
        whole = assumed.friction_coefficient * load
        headroom = whole * min(1.0 - assumed.bias, assumed.bias - assumed.friction_law.floor)
        need = setup.needed(model).drive
        if need > headroom:
            bound = f"must be <= {headroom:.3g} N, around {assumed.bias:g} of the friction of a finger of {load:.3g} N"
            raise ValueError(f"texture.amplitude asks for {need:.3g} N of friction: {bound}")
        if driver.sensed_channels and assumed.sensor == "tribometer":
            setup.check_range(model, assumed.friction_coefficient * setup.largest_load)
        amplitude, mode = setup.amplitude(need), assumed.mode
        volts = mode.drive_for(amplitude, normal_load=load)
        if volts > mode.drive_limit:  # however slow the texture is
            needs = f"{amplitude:.3g} m, which takes {volts:.3g} V under {load:.3g} N"
            raise ValueError(f"texture.amplitude asks for a vibration of {needs}: must be <= {mode.drive_limit:g} V")
        return replace(model, drive_limit=headroom)

    def bands(self, setup: SurfaceSetup, model: DeviceModel) -> Bands:
        """Carriers and targets of a scene, refused where the amplitude could not follow."""
        bands, highest = super().bands(setup, model), model.highest_frequency
        frequency = float(bands.frequency.max(initial=0.0))
        require(frequency <= highest, "texture.frequency", frequency, f"<= {highest:g} Hz, as fast as the amplitude is")
        return bands


def _demand(setup: SurfaceSetup) -> Demand:
    """Amplitude (m) and drive (V) that the scene needs at most, with a finger that damps `WORST_SKIN` times as much."""
    assumed, mode = setup.assumed, setup.assumed.mode
    need = setup.needed(_model(setup, Port(assumed.rate, 1, 1)))
    amplitude = setup.amplitude(need.drive)
    worst = replace(mode, finger_damping=WORST_SKIN * mode.finger_damping)
    drive = worst.drive_for(amplitude, need.highest, setup.largest_load)
    return Demand(motion=amplitude, drive=drive, lowest=mode.frequency, highest=mode.frequency)


def _model(setup: SurfaceSetup, driver: Driver | Port) -> DeviceModel:
    """Device model without its drive limit; the amplitude's interpolation adds half a sample, and a driver its lag."""
    assumed, lag = setup.assumed, 0.5 / driver.rate + (driver.lag if isinstance(driver, ResonantDriver) else 0.0)
    model = setup.contact(driver, 1.0)
    if driver.sensed_channels and assumed.sensor == "amplitude":  # no contact and no tribometer between
        return replace(setup.inferred(model, lag), sensor_delay=0.0, sensed_noise=LEAST_NOISE * model.sensed_limit)
    mass = model.mass + lag * model.damping + lag**2 / 2 * model.stiffness
    return replace(model, mass=mass, damping=model.damping + lag * model.stiffness)
