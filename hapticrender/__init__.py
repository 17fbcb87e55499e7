"""hapticrender: renders textures for a bare finger on a surface, in closed loop.

>>> import hapticrender as hr
>>> scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=10e-6), duration=2.0)
>>> recording = hr.render(scene)
>>> f"{1e6 * recording.summary()['bands'][0]['target']:.1f} um"
'10.0 um'

The public names are loaded when they are first used, so that importing the package costs next to nothing.
"""

import typing as _typing
from importlib import import_module as _import_module
from pathlib import Path as _Path

# A wheel holds renderers/ and drivers/ inside this package; in a source checkout they lie beside it, so look there too.
_here = _Path(__file__).parent
if not (_here / "renderers").is_dir():
    __path__.append(str(_here.parent))

__version__ = "0.2.0"

_HOMES = {
    "analysis.analyse": "analyse_finger",
    "analysis.records": "FingerRecord",
    "analysis.tracker": "FingerTracker",
    "analysis.models": "fit_finger",
    "bands": "Bands",
    "control.demodulator": "Demodulator",
    "errors": "DesignError DeviceFault DeviceLost DeviceNotFound DeviceTimeout DriverError HapticError PlateMismatch "
    "ProtocolError SceneError WatchdogTimeout",
    "loop": "prepare render run",
    "plants.identify": "Identified identify",
    "player": "Player",
    "protocols": "Controller Driver Flag Method Motion Plant Renderer Rendering Sensed Texture",
    "recordings.recording": "Recorder Recording",
    "touch.builtin_scenes": "builtin_scenes",
    "touch.composed": "Chirp Playlist Sum",
    "touch.device_profile": "DeviceProfile",
    "touch.finger": "Finger",
    "touch.grating": "Grating",
    "touch.latency_budget": "finest_wavelength phase_error",
    "touch.mechanics": "FingerMechanics",
    "touch.motion": "Sampled TriangleMotion Still SineMotion",
    "touch.motion_estimator": "Encoder MotionEstimator",
    "touch.perception": "detection_threshold roughness sensation_level",
    "touch.curve": "strongest_carriers",
    "touch.recorded": "Recorded",
    "touch.scene": "Scene",
    "touch.touch_panel": "TouchPanel",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}

__all__ = sorted(_HOME_OF)

if _typing.TYPE_CHECKING:
    from hapticrender.analysis.analyse import analyse_finger as analyse_finger
    from hapticrender.analysis.models import fit_finger as fit_finger
    from hapticrender.analysis.records import FingerRecord as FingerRecord
    from hapticrender.analysis.tracker import FingerTracker as FingerTracker
    from hapticrender.bands import Bands as Bands
    from hapticrender.control.demodulator import Demodulator as Demodulator
    from hapticrender.errors import DesignError as DesignError
    from hapticrender.errors import DeviceFault as DeviceFault
    from hapticrender.errors import DeviceLost as DeviceLost
    from hapticrender.errors import DeviceNotFound as DeviceNotFound
    from hapticrender.errors import DeviceTimeout as DeviceTimeout
    from hapticrender.errors import DriverError as DriverError
    from hapticrender.errors import HapticError as HapticError
    from hapticrender.errors import PlateMismatch as PlateMismatch
    from hapticrender.errors import ProtocolError as ProtocolError
    from hapticrender.errors import SceneError as SceneError
    from hapticrender.errors import WatchdogTimeout as WatchdogTimeout
    from hapticrender.loop import prepare as prepare
    from hapticrender.loop import render as render
    from hapticrender.loop import run as run
    from hapticrender.plants.identify import Identified as Identified
    from hapticrender.plants.identify import identify as identify
    from hapticrender.player import Player as Player
    from hapticrender.protocols import Controller as Controller
    from hapticrender.protocols import Driver as Driver
    from hapticrender.protocols import Flag as Flag
    from hapticrender.protocols import Method as Method
    from hapticrender.protocols import Motion as Motion
    from hapticrender.protocols import Plant as Plant
    from hapticrender.protocols import Renderer as Renderer
    from hapticrender.protocols import Rendering as Rendering
    from hapticrender.protocols import Sensed as Sensed
    from hapticrender.protocols import Texture as Texture
    from hapticrender.recordings.recording import Recorder as Recorder
    from hapticrender.recordings.recording import Recording as Recording
    from hapticrender.touch.builtin_scenes import builtin_scenes as builtin_scenes
    from hapticrender.touch.composed import Chirp as Chirp
    from hapticrender.touch.composed import Playlist as Playlist
    from hapticrender.touch.composed import Sum as Sum
    from hapticrender.touch.curve import strongest_carriers as strongest_carriers
    from hapticrender.touch.device_profile import DeviceProfile as DeviceProfile
    from hapticrender.touch.finger import Finger as Finger
    from hapticrender.touch.grating import Grating as Grating
    from hapticrender.touch.latency_budget import finest_wavelength as finest_wavelength
    from hapticrender.touch.latency_budget import phase_error as phase_error
    from hapticrender.touch.mechanics import FingerMechanics as FingerMechanics
    from hapticrender.touch.motion import Sampled as Sampled
    from hapticrender.touch.motion import SineMotion as SineMotion
    from hapticrender.touch.motion import Still as Still
    from hapticrender.touch.motion import TriangleMotion as TriangleMotion
    from hapticrender.touch.motion_estimator import Encoder as Encoder
    from hapticrender.touch.motion_estimator import MotionEstimator as MotionEstimator
    from hapticrender.touch.perception import detection_threshold as detection_threshold
    from hapticrender.touch.perception import roughness as roughness
    from hapticrender.touch.perception import sensation_level as sensation_level
    from hapticrender.touch.recorded import Recorded as Recorded
    from hapticrender.touch.scene import Scene as Scene
    from hapticrender.touch.touch_panel import TouchPanel as TouchPanel


def __getattr__(name: str) -> _typing.Any:
    if name == "sweep":  # the module, whether or not anything has imported it
        return _import_module(f"{__name__}.sweep")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
