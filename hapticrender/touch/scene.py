"""The scene: what is touched, by what, on which device, for how long; the unit of reproducibility."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.errors import SceneError
from hapticrender.protocols import Texture
from hapticrender.touch import checks, toml
from hapticrender.touch.finger import Finger
from hapticrender.touch.foreign import ForeignMotion, ForeignTexture
from hapticrender.touch.grating import Grating
from hapticrender.touch.mechanics import NAMED, FingerMechanics
from hapticrender.touch.motion import LONGEST_TIME, Nowhere, Sampled, Sliding, Still, Swiping, Tracked
from hapticrender.touch.recorded import Recorded, Swipe, Synthetic

TEXTURES: dict[str, type[Any]] = {kind.kind: kind for kind in (Grating, Recorded, Swipe, Synthetic, ForeignTexture)}
MOTIONS: dict[str, type[Any]] = {
    kind.kind: kind for kind in (Nowhere, Still, Sliding, Swiping, Sampled, Tracked, ForeignMotion)
}
LARGEST_FILE = 1 << 26  # bytes of TOML
PlantValue = float | int | str | bool


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that a rendering depends on, in SI; frozen, compared by value, TOML in and out.

    Parameters
    ----------
    texture : Texture
        `Grating`, `Recorded`, `Swipe`, `Synthetic`, or any object that follows ``protocols.Texture``.
    finger : Finger
        Default: none; a texture that is read at the finger's position needs one.
    device : str
        Name of a renderer.
    duration : float, s
        > 0 and <= 360 000 (100 h).
    tolerance : float
        Relative amplitude error to be judged by, > 0 and <= 10.  Default 0.1:
        errors up to 10 % lie under every just noticeable difference.
    settle : float, s
        Left out of the judgement at the beginning, >= 0; of a scene shorter
        than twice this the last half is judged.
    keep_unfelt : bool
        Whether bands below the safe detection threshold are rendered all the
        same; default: they are left out.
    name : str
        Also names files: 1 to 100 printable characters.
    gradient : float, 1/m
        The wanted amplitude grows by this share of itself per metre along the surface, from its middle on; -1000 to
        1000.  Only a plate with two coils can do so.  What noise leaves does not shrink with it: near a mode of the
        plate it is tenths of a micrometre at a weak end as well.
    plant : mapping of str to number, str or bool
        Parameters of the simulated device that differ from its defaults.

    Examples
    --------
    >>> from hapticrender.touch.grating import Grating
    >>> scene = Scene(texture=Grating(amplitude=1e-05, frequency=100.0), duration=2.0)
    >>> Scene.from_toml_text(scene.to_toml()) == scene
    True
    """

    texture: Texture
    finger: Finger = field(default_factory=Finger.absent)
    device: str = "vt-plate"
    duration: float
    tolerance: float = 0.1
    settle: float = 1.0
    keep_unfelt: bool = False
    gradient: float = 0.0
    name: str = "scene"
    plant: Mapping[str, PlantValue] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        checks.word("name", self.name)
        checks.word("device", self.device)
        duration = checks.number("duration", self.duration, "s", above=0, most=LONGEST_TIME)
        tolerance = checks.number("tolerance", self.tolerance, "", above=0, most=10)
        settle = checks.number("settle", self.settle, "s", least=0, most=LONGEST_TIME)
        checks.keep(self, keep_unfelt=checks.flag("keep_unfelt", self.keep_unfelt))
        checks.keep(self, gradient=checks.number("gradient", self.gradient, "1/m", least=-1e3, most=1e3))
        checks.keep(self, duration=duration, tolerance=tolerance, settle=settle, plant=_read_plant(self.plant))
        if not isinstance(self.texture, Texture):
            checks.refuse("texture", self.texture, "a texture with bands(rate) and waveform(time, position)", TypeError)
        if not isinstance(self.finger, Finger):
            checks.refuse("finger", self.finger, "a Finger", TypeError)
        if isinstance(self.finger.motion, Nowhere) and getattr(self.texture, "spatial", False):
            raise ValueError("finger.motion = 'none': a texture over position needs a finger")

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Scene:
        """Read a scene file; files that it names are taken from its own folder, and read as well.

        Raises
        ------
        SceneError
            In one line: file, key, value, bound and unit.
        """
        where = " ".join(str(path).split())
        try:
            size = Path(path).stat().st_size
            if size > LARGEST_FILE:
                raise SceneError(f"{where}: has {size} bytes: must be <= {LARGEST_FILE} bytes")
            text = Path(path).read_bytes().decode("utf-8")
        except UnicodeDecodeError as problem:
            raise SceneError(f"{where}: byte {problem.start}: must be UTF-8 text") from problem
        except SceneError:
            raise
        except (OSError, ValueError) as problem:
            raise SceneError(f"{where}: must be a readable file ({_reason(problem)})") from problem
        return cls.from_toml_text(text, where, folder=Path(path).parent, name=Path(path).stem)

    @classmethod
    def from_toml_text(
        cls,
        text: str,
        where: str = "scene",
        *,
        folder: str | os.PathLike[str] = "",
        name: str = "scene",
    ) -> Scene:
        """Read a scene from TOML; `where` begins every complaint, `folder` holds the files, `name` is the default."""
        try:
            table = tomllib.loads(text)
        except (ValueError, RecursionError) as problem:
            raise SceneError(f"{where}: must be TOML ({_reason(problem)})") from problem
        try:
            scene = _read_scene(table, Path(folder), name)
            _check_files(scene)
        except (ValueError, TypeError) as problem:
            raise SceneError(f"{where}: {problem}") from problem
        return scene

    def to_toml(self) -> str:
        """TOML text that `from_toml_text` reads back to an equal scene (textures of your own: by description only)."""
        keys = ("name", "device", "duration", "tolerance", "settle", "keep_unfelt", "gradient")
        head = {key: getattr(self, key) for key in keys}
        texture: Any = self.texture if type(self.texture) in TEXTURES.values() else ForeignTexture(repr(self.texture))
        return toml.dumps(
            head
            | {"texture": {"kind": texture.kind} | _write_fields(texture), "finger": _write_finger(self.finger)}
            | ({"plant": dict(self.plant)} if self.plant else {})
        )


def _reason(problem: Exception) -> str:
    """Return the first words of somebody else's message, in one line."""
    return " ".join(str(getattr(problem, "strerror", None) or problem).split())[:200]


def _read_plant(plant: Any) -> dict[str, PlantValue]:
    if not isinstance(plant, Mapping):
        checks.refuse("plant", plant, "a table of the device's parameters", TypeError)
    for key, value in plant.items():
        if not isinstance(key, str):
            checks.refuse("plant", key, "a table with texts as keys", TypeError)
        if not isinstance(value, str | bool | np.bool_):
            checks.number(f"plant.{_plain(key)}", value)
    return {key: _simple(value) for key, value in plant.items()}


def _simple(value: Any) -> PlantValue:
    """Return a number or a word in Python's own type, so that TOML can hold it."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, str):
        return value
    return int(value) if isinstance(value, Integral) else float(value)


def _plain(key: str) -> str:
    return key if key.isidentifier() else checks.show(key)


def _read_scene(table: dict[str, Any], folder: Path, name: str) -> Scene:
    _only_known("", table, [entry.name for entry in fields(Scene)])
    texture = _read_kind(table.get("texture"), "texture", "kind", TEXTURES, folder)
    finger = _read_finger(table["finger"], folder) if "finger" in table else Finger.absent()
    rest = {key: value for key, value in table.items() if key not in ("texture", "finger")}
    rest.setdefault("duration", None)
    rest.setdefault("name", _usable(name))
    return Scene(texture=texture, finger=finger, **rest)


def _usable(name: str) -> str:
    """`name` if it can name a scene, else "scene"."""
    try:
        return checks.word("name", name)
    except ValueError:
        return "scene"


def _only_known(prefix: str, table: Mapping[str, Any], known: list[str]) -> None:
    for key, value in table.items():
        if key not in known:
            raise ValueError(f"{prefix}{_plain(key)} = {checks.show(value)}: unknown key; known: {', '.join(known)}")


def _read_kind(table: Any, key: str, choice: str, kinds: dict[str, type[Any]], folder: Path, extra: Any = ()) -> Any:
    """Make the object that `table[choice]` names from the keys that are its fields; `extra` keys are left alone."""
    if not isinstance(table, dict):
        checks.refuse(key, table, f"a table with {choice} = one of {', '.join(kinds)}", TypeError)
    with checks.inside(key):
        kind = kinds[checks.choice(choice, table.get(choice), kinds)]
        entries = fields(kind)
        _only_known("", table, [choice, *(entry.name for entry in entries), *extra])
        values = {entry.name: table[entry.name] for entry in entries if entry.name in table}
        for entry in entries:
            if entry.default is MISSING and entry.default_factory is MISSING:
                values.setdefault(entry.name, None)
        if isinstance(values.get("file"), str) and values["file"].isprintable():
            values["file"] = str(folder / values["file"]) if values["file"] else ""
        return kind(**values)


def _read_finger(table: Any, folder: Path) -> Finger:
    own = [entry.name for entry in fields(Finger) if entry.name != "motion"]
    motion = _read_kind(table, "finger", "motion", MOTIONS, folder, extra=own)
    values = {key: table[key] for key in own if key in table}
    if isinstance(motion, Tracked):
        values.setdefault("normal_load", None)
    with checks.inside("finger"):
        return Finger(motion, **values)


def _check_files(scene: Scene) -> None:
    for key, part in (("texture", scene.texture), ("finger", scene.finger.motion)):
        check = getattr(part, "check", None)
        if check is not None:
            with checks.inside(key):
                check()


def _write_fields(part: Any) -> dict[str, Any]:
    """Fields of a dataclass as TOML has them; None is left out, for TOML has no word for it."""
    values = {entry.name: getattr(part, entry.name) for entry in fields(part)}
    return {key: value for key, value in values.items() if value is not None}


def _write_finger(finger: Finger) -> dict[str, Any]:
    motion: Any = finger.motion if type(finger.motion) in MOTIONS.values() else ForeignMotion(repr(finger.motion))
    own = _write_fields(finger)
    own["mechanics"] = _write_mechanics(finger.mechanics)
    del own["motion"]
    return {"motion": motion.kind} | _write_fields(motion) | own


def _write_mechanics(mechanics: FingerMechanics) -> str | dict[str, Any]:
    for name, known in NAMED.items():
        if mechanics == known:
            return name
    return _write_fields(mechanics)
