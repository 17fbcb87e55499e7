"""Export a scene's controller for a microcontroller: tables of the design in C, beside copies of the portable sources.

The sources are those of ``drivers/firmware``; they play what method ``inverse`` designs for a plate, and for an
electroadhesive screen without sensors, whose drive is the peak of a carrier that the board's hardware makes.
"""

import math
from copy import copy
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.controller import lowest_carrier, spacing
from hapticrender.control.inverse import WaveformController
from hapticrender.control.kernel import CONFIDENCE_FADE
from hapticrender.loop import prepare
from hapticrender.protocols import Rendering

MOST_BANDS, MOST_DELAY = 64, 64  # bands; samples
BANDS = 8  # of a board at least: set-points may need more than the scene does
CHANGE = 20e-3  # s: of a change of gain, amplitude or carrier
MEASURING, MEASURING_DC = 10.0, 6.0  # Hz: widest bandwidth of the measured envelopes and of their offset
GENERATED = "/* Written by `hapticrender export`; export the scene again instead of editing. */\n"
BYTES = {"BANDS": 156, "DELAY": 48, "DAMPER_TAPS": 8, "PAST": 16, "SENSORS": 32, "CHANNELS": 4136}  # of board_t, each
OTHER_BYTES = 12_520  # of the rest, with the textures' own
HUGE = 1e30  # a bound that is none, in float32 too
SUFFIXES = (".c", ".h", ".ld", "Makefile")  # of the portable sources

_CONTROLLER = """
drive_limit drive_step sensor_limit highest highest_edge coordinate_from_sensor drive_from_force pattern
damper_high damper_limit release
""".split()
_LAW = """
mass damping stiffness lever_per_metre gate_threshold high_pass_smoothing mean_square_smoothing filters
sensor_filter pole_step omega_n pole pole_damping fade_step decay scale_smoothing noise model_error
levelling_smoothing prior initial_variance prior_covariance
""".split()
_SUPERVISION = """
invalid_smoothing frozen_drive low high corner top_gain omega energy_smoothing power_smoothing
drive_smoothing ring_corner ring_top_gain ring_smoothing lever danger_motion danger_drive most_motion most_drive
large_drive most_damping sensed_bound drive_limit heat_smoothing heat_gain slow_smoothing fade_out fade_now
mass damping stiffness bound noise ringing
""".split()
_TIMES = "invalid frozen inconsistent active drive ring ring_wait ring_stop suspension beyond slow limit".split()
_GAINS = """
scale innovation mean_smoothing window_smoothing step_state step_force filter_gain
sensor_from_coordinate force_of_actuator
""".split()
_SAMPLES = "damper_time hold learning_delay relearning_delay initial_end report_delay loss_time".split()


def export(rendering: Rendering, folder: Path, *, bands: int = 0, force: bool = False) -> list[Path]:
    """Write design.c, design.h and the firmware's sources into `folder`, which is made; return what was written.

    `rendering` is a scene, prepared for the device that the board drives (`hapticrender.prepare`).  The board can be
    set to `bands` at most, at most 64, by default 8, or the scene's number if that is larger.  `force` overwrites
    sources that were changed since they were written.  A ValueError where the board cannot play the scene, or a file of
    `folder` would be overwritten that is not as it was written.
    """
    if _law(rendering) == "screen":
        board: Any = copy(rendering.device)
        board.sensed_channels = 0
        rendering = prepare(rendering.scene, driver=board, compiled=False)
    sizes, design, supervision = board_design(rendering, bands)
    texts = {path.name: path.read_text(encoding="utf-8") for path in sources()}
    for name, text in {} if force else {**texts, "design.h": GENERATED, "design.c": GENERATED}.items():
        path = folder / name
        if path.exists() and not path.read_text(encoding="utf-8", errors="replace").startswith(text):
            raise ValueError(f"{str(path)!r}: is not as it was written: choose another folder, or add --force")
    defines = "".join(f"#define LAW_{name} {value}\n" for name, value in sizes.items())
    texts["design.h"] = f"{GENERATED}#ifndef DESIGN_H\n#define DESIGN_H\n\n{defines}\n{_memory(sizes)}\n#endif\n"
    tables = _table("design_t design", design), _table("supervision_t supervision", supervision)
    texts["design.c"] = f'{GENERATED}#include "supervisor.h"\n\n{tables[0]}\n{tables[1]}'
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in sorted(texts)]


def _law(rendering: Rendering) -> str:
    """Return which law of the firmware plays a rendering, see `Rendering.board_law`."""
    if rendering.board_law is None:
        raise ValueError(f"{rendering.scene.device}: its renderer names no law of a board: must set `board_law`")
    return rendering.board_law()


def _memory(sizes: dict[str, int]) -> str:
    """State the static memory of a board of these sizes."""
    taken = -(-(OTHER_BYTES + sum(each * sizes[name] for name, each in BYTES.items())) // 8) * 8
    note = f"/* Bytes of board_t, with real_t and pointers of 4: {taken + 65_536} with the textures of texture.h. */"
    return f"{note}\n#define BOARD_BYTES ({taken}u + 8u * TEXTURE_RING + 4u * TEXTURE_POINTS)\n"


def sources() -> list[Path]:
    """Paths of the portable sources as installed."""
    folder = Path(str(files("hapticrender.drivers"))) / "firmware"
    return sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIXES))


def board_design(rendering: Rendering, bands: int = 0) -> tuple[dict[str, int], dict[str, Any], dict[str, Any]]:
    """Return sizes (in design.h), and fields of `design_t` and `supervision_t`; see `export` for the errors."""
    screen, used = _law(rendering) == "screen", rendering.bands
    if screen and rendering.design and rendering.scene.method == "inverse":  # whatever it plays is a waveform
        used = replace(Bands.none(spatial=False), differentiated=True)
        supervised: Any = rendering.design(used)
    else:
        supervised = rendering.controller()
    controller = getattr(supervised, "controller", supervised)
    most = _checked(rendering, used, controller, bands)
    settings, law, model = controller.settings, controller.law, rendering.model
    sensors, channels, taps = (int(settings[name]) for name in ("sensors", "channels", "n_taps"))
    sizes = {
        "BANDS": most,
        "DELAY": int(law["delay"]),
        "COORDINATES": int(settings["coordinates"]),
        "SENSORS": max(sensors, 1),  # an array of none is no C
        "CHANNELS": channels,
        "DAMPER_TAPS": taps,
        "TAP_STRIDE": int(settings["tap_stride"]),
        "PAST": 1 << (max(taps * int(settings["tap_stride"]), 4) - 1).bit_length(),  # deviations, a power of two
        "FRICTION": int(screen),
    }
    lowest, period = lowest_carrier(model, used), 1.0 / model.rate
    measuring = min(MEASURING, lowest / 2, spacing(used) / (2 * math.pi))
    fields: dict[str, Any] = {
        "rate": float(model.rate),
        "bands_used": len(used),
        "spatial": int(law["spatial"]),
        "learns": int(law["learns"]),
        **{name: settings[name] for name in _CONTROLLER},
        **{name: law[name] for name in _LAW},
        **{name: int(law[name]) for name in _SAMPLES},
        "reversion": 1.0 - law["reversion_factor"],
        "taps": settings["taps"][:, :taps],
        "force_from_drive": law["force_from_drive"][:, :channels],
        "change_step": period / CHANGE,
        "confidence_step": period / CONFIDENCE_FADE,
        "measuring": 4 * math.pi * measuring * period,
        "measuring_dc": 2 * math.pi * min(MEASURING_DC, lowest / 8) * period,
    }
    fields["coordinate_from_sensor"] = fields["coordinate_from_sensor"][:, : sizes["SENSORS"]]
    fields["drive_from_force"] = fields["drive_from_force"][:channels]
    if len(used):
        fields["bands"] = used.set_points()
    return sizes, fields | (_friction(rendering, settings) if screen else {}), supervision_table(supervised)


def _friction(rendering: Rendering, settings: Any) -> dict[str, Any]:
    """Return the fields of `design_t` that a screen has beside those of a plate."""
    root = rendering.shape
    return {
        "contact_length": settings["contact_length"],
        "typical_speed": settings["typical_speed"],
        "least_speed": settings["least_speed"],
        "bias": root.bias,
        "least": root.floor,
        "attraction": root.gain,
    }


def supervision_table(controller: Any) -> dict[str, Any]:
    """Return the fields of `supervision_t` of a supervised controller."""
    if not hasattr(controller, "gains"):
        return {"sensed_bound": HUGE}  # nothing is sensed, and nothing supervised
    settings, gains = controller.state["p"][0], controller.gains[0]
    return {
        **{name: np.clip(settings[name], -HUGE, HUGE) for name in _SUPERVISION},
        **{f"{name}_time": int(settings[f"{name}_time"]) for name in _TIMES},
        "modelled": int(settings["modelled"]),
        "damped": int(settings["controller"] != 0),
        "limited": int(settings["limited"] != 0),
        "compared": int(settings["gains"] != 0),
        "gains": {"duration": int(gains["duration"]), **{name: gains[name] for name in _GAINS}},
    }


def _checked(rendering: Rendering, playing: Bands, controller: Any, bands: int) -> int:
    """Most bands of the board; refuses what its law does not play."""
    scene, model, used, root = rendering.scene, rendering.model, len(playing), rendering.shape
    if not (root or rendering.driver.sensed_channels):
        raise ValueError("driver.sensed_channels = 0: must be 1 or more on a plate's board, which is supervised")
    if scene.method != "inverse":
        raise ValueError(f'method = {scene.method!r}: a board plays "inverse" only, the default')
    if not isinstance(controller, WaveformController):
        playable = "a whole waveform, without `carriers`, or bands of constant amplitude up to 0.24 of the rate"
        raise ValueError(f"texture {type(scene.texture).__name__}: a board plays {playable}")
    if not root and (playing.modulated or playing.differentiated):
        raise ValueError("the target is modulated, or a velocity: a board plays displacements of constant amplitude")
    if model.delay > MOST_DELAY:
        raise ValueError(f"delay = {model.delay} samples: must be <= {MOST_DELAY} on a board")
    most = bands or max(BANDS, used)
    if not used <= most <= MOST_BANDS:
        raise ValueError(f"bands = {most}: must be {max(used, 1)} (those of the scene) to {MOST_BANDS} on a board")
    return most


def _table(declared: str, fields: dict[str, Any]) -> str:
    lines = [f"    .{name} = {_literal(value)},\n" for name, value in fields.items()]
    return f"const {declared} = {{\n{''.join(lines)}}};\n"


def _literal(value: Any) -> str:
    """C initialiser of an integer, a number, an array of numbers, or a record; numbers in full precision."""
    if isinstance(value, dict):
        items = [f".{name} = {_literal(each)}" for name, each in value.items()]
    elif np.ndim(value):
        items = [_literal(each) for each in value]
    else:
        return f"{int(value)}u" if isinstance(value, int) else f"REAL({float(value)!r})"
    joined = ", ".join(items)
    return f"{{{joined}}}" if len(joined) < 80 else "{\n    " + ",\n    ".join(items) + ",\n    }"
