"""The scene: texture, finger, device and duration; the unit of reproducibility."""

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields
from itertools import count
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hapticrender import checks, defaults
from hapticrender.checks import Validated, checked, mapping, parameter
from hapticrender.errors import SceneError, naming
from hapticrender.protocols import Texture
from hapticrender.touch import toml_text
from hapticrender.touch.composed import Chirp, Playlist, Sum
from hapticrender.touch.device_profile import ENDING, Calibration, DeviceProfile, table_of
from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.mechanics import NAMED
from hapticrender.touch.motion import LONGEST_TIME, Nowhere, Sampled, SineMotion, Still, TriangleMotion
from hapticrender.touch.recorded import Recorded
from hapticrender.touch.touch_panel import TouchPanel

LONGEST_LINE = 500  # characters


@dataclass(frozen=True)
class Custom(Validated):
    """One printable line about a texture or motion made in Python: keeps recordings readable, refuses to play."""

    kind: ClassVar[str] = "custom"

    description: str

    def __post_init__(self) -> None:
        line = "".join(filter(str.isprintable, " ".join(str(self.description).split())))
        checks.keep(self, description=line[:LONGEST_LINE])

    def bands(self, *arguments: Any) -> Any:
        """Raise a `SceneError`: of the object there is only this line."""
        raise SceneError(f"description = {self.description!r}: what was made in Python cannot be played from a file")

    waveform = position = load = bands


Kinds = dict[str, type[Any]]
TEXTURES: Kinds = {one.kind: one for one in (Grating, Recorded, Chirp, Sum, Playlist, Custom)}
MOTIONS: Kinds = {one.kind: one for one in (Nowhere, Still, TriangleMotion, SineMotion, Sampled, Custom)}
TABLES = {  # field of a scene: table of a file
    "profile": "device",
    "limits": "limits",
    "calibration": "calibration",
    "simulation": "simulation",
    "rendering": "render",
    "touch_panel": "touch_panel",
}
OWN = {  # keys of these tables that are fields of a scene: table, key, field
    ("device", "kind"): "device",
    ("device", "source"): "source",
    ("simulation", "seed"): "seed",
    **{("render", key): key for key in ("method", "tolerance", "settle", "keep_unfelt", "gradient")},
}
Value = float | int | str | bool


def _calibration(name: str, values: Any) -> dict[str, Any]:
    return table_of(Calibration.read(name, values))


def _read_table(name: str, values: Any) -> dict[str, Value]:
    """Return a table of numbers, texts and booleans in Python's own types, so that TOML can hold them."""
    found: dict[str, Value] = {}
    for key, value in checks.table(name, values).items():
        checks.require(isinstance(key, str), name, key, "a table with texts as keys", TypeError)
        if (TABLES[name], key) in OWN:
            raise ValueError(f"{name}.{key}: is not part of this table: give it to Scene as {OWN[TABLES[name], key]}")
        if isinstance(value, bool | np.bool_):
            value = bool(value)
        elif not isinstance(value, str):
            checks.number(f"{name}.{checks.plain(key)}", value)
            value = int(value) if isinstance(value, Integral) else float(value)
        found[key] = value
    return found


def _texture(key: str, value: Any) -> Texture:
    known = isinstance(value, Texture) and not isinstance(value, type)
    checks.require(known, key, value, "a texture with bands(rate) and waveform(time, position)", TypeError)
    return value  # type: ignore[no-any-return]


def _finger(key: str, value: Any) -> Finger:
    """Refuse several fingers, too: a device senses the sum of all touches, and the law has one finger's model."""
    if isinstance(value, list | tuple):
        raise ValueError(f"{key}: {len(value)} fingers are stated: must be one, a device renders for one finger")
    checks.require(isinstance(value, Finger), key, value, "a Finger", TypeError)
    return value  # type: ignore[no-any-return]


@dataclass(frozen=True, kw_only=True)
class Scene(Validated):
    """Everything that a rendering depends on, in SI; frozen, compared by value, TOML in and out.

    In TOML, ``[device]`` holds `device` (as ``kind``), `profile` and `source`, ``[limits]`` and ``[calibration]`` hold
    `limits` and `calibration`, ``[simulation]`` holds `simulation` and `seed`, ``[touch_panel]`` holds `touch_panel`,
    ``[render]`` holds `rendering`, `method`, `tolerance`, `settle`, `keep_unfelt` and `gradient`.  ``device =
    "plate.toml"``, or beside parameters ``[device] profile = "plate.toml"``, names the file of a `DeviceProfile`, seen
    from the scene's folder.

    Notes
    -----
    What a scene states of a device goes before what its profile's file does.  Of a scene shorter than twice `settle`
    the last half is judged.  The default `tolerance` lies under every just noticeable difference (2.2 dB of amplitude,
    Israr et al. 2006).  Bands that are left out are still part of what the verdict compares with.  A `gradient` takes a
    plate with two coils.

    Examples
    --------
    >>> from hapticrender.touch.grating import Grating
    >>> scene = Scene(texture=Grating(amplitude=1e-05, frequency=100.0), duration=2.0, simulation={"mass": 0.035})
    >>> Scene.from_toml_text(scene.to_toml()) == scene
    True
    """

    texture: Texture = checked(_texture, about="what is played: see `TEXTURES`, or any ``protocols.Texture``")
    finger: Finger = checked(_finger, Finger.absent(), about="none by default; a texture along the surface needs one")
    device: str = checked(checks.name, "vt-plate", about="name of a renderer, or file (.toml) of a `DeviceProfile`")
    profile: Mapping[str, Value] = mapping(_read_table, "parameters of the device that the controller is designed for")
    limits: Mapping[str, Value] = mapping(_read_table, "entries of `hapticrender.touch.device_profile.Limits`")
    calibration: Mapping[str, Value | tuple[float, ...]] = mapping(_calibration, "entries of `Calibration` beside it")
    source: str = checked(checks.text, "", about="which profile the parameters are from, by whom and when")
    simulation: Mapping[str, Value] = mapping(_read_table, "parameters in which a simulated device differs, its level")
    rendering: Mapping[str, Value] = mapping(_read_table, "settings of the renderer, such as ``crossover``")
    touch_panel: Mapping[str, Value] = mapping(_read_table, "parameters of a `TouchPanel` in simulation; empty: none")
    duration: float = parameter(unit="s", about="length", above=0, most=LONGEST_TIME)
    method: str = checked(checks.name, defaults.METHOD, about="name of the control method")
    tolerance: float = parameter(0.1, "(a share: 0.05 is 5 %)", "relative error to be judged by", above=0, most=1)
    settle: float = parameter(1.0, "s", "left out of the judgement at the beginning", most=LONGEST_TIME)
    keep_unfelt: bool = checked(
        checks.flag, True, about="whether bands below the safe detection threshold are rendered"
    )
    gradient: float = parameter(0.0, "1/m", "growth of the target along the surface, over it", least=-1e3, most=1e3)
    seed: int = parameter(0, about="of the simulated sensor noise")
    name: str = checked(checks.name, "scene", about="also names files: 1 to 100 printable characters")

    def __post_init__(self) -> None:
        if str(self.device).endswith(ENDING):  # its profile has what the scene does not state
            found = DeviceProfile.load(self.device)
            limits, calibration = table_of(found.limits), table_of(found.calibration)
            tables = {"profile": found.device, "limits": limits, "calibration": calibration}
            tables["rendering"] = {} if found.probe else {"probe": False}
            merged = {name: {**table, **_read_table(name, getattr(self, name))} for name, table in tables.items()}
            checks.keep(self, device=found.kind, source=self.source or str(found), **merged)
        super().__post_init__()
        self.device_profile  # noqa: B018 (it refuses what is no limit, and no calibration)
        self.panel  # noqa: B018 (it refuses what is no touch panel)
        if isinstance(self.finger.motion, Nowhere) and getattr(self.texture, "spatial", False):
            cure = "give [finger], or Player(finger=...)"
            raise ValueError(f"finger.motion = 'none': a texture over position needs a finger: {cure}")

    @property
    def device_profile(self) -> DeviceProfile:
        """Profile of the device as the scene states it; a ValueError where a limit or a calibration is wrong."""
        name = self.source or self.device
        tables: dict[str, Any] = {"device": self.profile, "limits": self.limits, "calibration": self.calibration}
        return DeviceProfile(kind=self.device, name=name, **tables)

    @property
    def panel(self) -> TouchPanel | None:
        """Touch panel of the simulated device; None: the position is known without error."""
        return TouchPanel.read("touch_panel", self.touch_panel) if self.touch_panel else None

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> "Scene":
        """Read a scene file; files that it names are taken from its own folder, and read as well.

        A `SceneError` states in one line file, key, value, bound and unit.
        """
        with naming(path):
            text = toml_text.read_text(path)
        return cls.from_toml_text(text, str(path), folder=Path(path).parent, name=Path(path).stem)

    @classmethod
    def from_toml_text(
        cls, text: str, where: str = "scene", *, folder: str | os.PathLike[str] = "", name: str = "scene"
    ) -> "Scene":
        """Read a scene from TOML; `where` begins every message, `folder` holds the files, `name` is the default."""
        with naming(where):
            scene = _read_scene(toml_text.loads(text), Path(folder), name)
            if hasattr(scene.texture, "check"):
                with checks.inside("texture"):
                    scene.texture.check()
        return scene

    def to_toml(self) -> str:
        """TOML text that `from_toml_text` reads back to an equal scene (textures of your own: by description only)."""
        tables: dict[str, dict[str, Any]] = {table: {} for table in TABLES.values()}
        for (table, key), own in OWN.items():
            tables[table][key] = getattr(self, own)
        for own, table in TABLES.items():
            tables[table] |= getattr(self, own)
        if not self.source:
            del tables["device"]["source"]
        tables = {table: values for table, values in tables.items() if values}
        parts = {"texture": _write_texture(self.texture), "finger": _write_finger(self.finger)}
        return toml_text.dumps({"name": self.name, "duration": self.duration} | parts | tables)


def scene_keys(table: str) -> set[str]:
    """Keys of a table of a scene file that are fields of the scene, whatever the device."""
    return {key for where, key in OWN if where == table}


def distinct_names(names: Iterable[str]) -> list[str]:
    """Number the names of scenes that occur more than once: "a", "b (1)", "b (2)".

    >>> distinct_names(["b", "a", "b", "b (1)"])
    ['b (2)', 'a', 'b (3)', 'b (1)']
    """
    names = list(names)
    total, taken = Counter(names), set(names)
    for index, name in enumerate(names):
        if total[name] > 1:
            names[index] = next(numbered for n in count(1) if (numbered := f"{name} ({n})") not in taken)
            taken.add(names[index])
    return names


def _read_scene(table: dict[str, Any], folder: Path, name: str) -> Scene:
    table = _with_profile(table, folder)
    _check_keys(table)
    values: dict[str, Any] = {"duration": table.get("duration"), "name": table.get("name")}
    if values["name"] is None:
        try:
            values["name"] = checks.name("name", name)
        except ValueError:  # no name of a file can be that of every scene
            values["name"] = Scene.name
    for own, where in TABLES.items():
        rest = dict(table.get(where, {}))
        values |= {OWN[where, key]: rest.pop(key) for key in list(rest) if (where, key) in OWN}
        values[own] = rest
    texture = _read_kind(table.get("texture"), "texture", "kind", TEXTURES, folder)
    finger = _read_finger(table["finger"], folder) if "finger" in table else Finger.absent()
    return Scene(texture=texture, finger=finger, **values)


def _with_profile(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Take the file of a profile, at the top level or in [device], as the kind of device."""
    device, key = table.get("device"), "device"
    if isinstance(device, dict) and "profile" in device:
        key, file = "device.profile", device["profile"]
        rest = {each: value for each, value in device.items() if each != "profile"}
        checks.require("kind" not in rest, "device.kind", rest.get("kind"), "left out beside profile, which has one")
    elif isinstance(device, str) and device.endswith(ENDING):
        file, rest = device, {}
    else:
        return table
    bound = f"the name of a file that ends in {ENDING}"
    checks.require(isinstance(file, str) and file.endswith(ENDING) and file.isprintable(), key, file, bound)
    return {**table, "device": {"kind": str(folder / file), **rest}}


def _check_keys(table: dict[str, Any]) -> None:
    """Refuse a key that is not at the top level of a scene; state the table of one that belongs elsewhere."""
    moved = {key: f"in the table [{where}]" for where, key in OWN}
    moved |= {"plant": "three tables: [device], [simulation] (where it differs from the device), and [render]"}
    for key, value in table.items():
        if key == "device" and isinstance(value, str):
            checks.refuse(key, value, f"a table: [device] with kind = {checks.show(value)}")
        if key in moved:
            checks.refuse(key, value, moved[key])
        checks.require(key not in TABLES.values() or isinstance(value, dict), key, value, "a table", TypeError)
    checks.check_names(table, ["name", "duration", "texture", "finger", *TABLES.values()])


def _read_kind(table: Any, key: str, choice: str, kinds: Kinds, folder: Path, extra: Any = ()) -> Any:
    """Make the object that `table[choice]` names from the keys that are its fields; `extra` keys are left alone."""
    bound = f"a table with {choice} = one of {', '.join(kinds)}"
    checks.require(isinstance(table, dict), key, table, bound, TypeError)
    with checks.inside(key):
        kind = kinds[checks.choice(choice, table.get(choice), kinds)]
        entries = fields(kind)
        checks.check_names(table, [choice, *(entry.name for entry in entries), *extra])
        required = [entry.name for entry in entries if entry.default is entry.default_factory is MISSING]
        given = {entry.name: table[entry.name] for entry in entries if entry.name in table}
        values: dict[str, Any] = dict.fromkeys(required) | given
        if isinstance(values.get("parts"), list):  # pairs of a texture and a number; others are the texture's to refuse
            values["parts"] = parts = list(values["parts"])
            for i, part in enumerate(parts):
                if isinstance(part, list) and len(part) == 2:
                    parts[i] = _read_kind(part[0], f"parts[{i}][0]", "kind", TEXTURES, folder), part[1]
        if isinstance(values.get("file"), str) and values["file"].isprintable():
            values["file"] = str(folder / values["file"]) if values["file"] else ""
        return kind(**values)


def _read_finger(table: Any, folder: Path) -> Finger:
    if isinstance(table, list):
        _finger("finger", table)
    own = [entry.name for entry in fields(Finger) if entry.name != "motion"]
    motion = _read_kind(table, "finger", "motion", MOTIONS, folder, extra=own)
    values = {key: table[key] for key in own if key in table}
    with checks.inside("finger"):
        return Finger(motion, **values)


def _write_fields(part: Any) -> dict[str, Any]:
    """Fields of a dataclass as TOML has them; None is left out, as TOML has no such value."""
    values = {entry.name: getattr(part, entry.name) for entry in fields(part)}
    return {key: value for key, value in values.items() if value is not None}


def _write_texture(texture: Any) -> dict[str, Any]:
    """Texture as TOML has it, one of other textures with a table for each of them."""
    known: Any = texture if type(texture) in TEXTURES.values() else Custom(repr(texture))
    table = {"kind": known.kind} | _write_fields(known)
    if "parts" in table:
        table["parts"] = [(_write_texture(part), number) for part, number in table["parts"]]
    return table


def _write_finger(finger: Finger) -> dict[str, Any]:
    motion: Any = finger.motion if type(finger.motion) in MOTIONS.values() else Custom(repr(finger.motion))
    own = _write_fields(finger)
    names = [name for name, known in NAMED.items() if known == finger.mechanics]
    own["mechanics"] = names[0] if names else _write_fields(finger.mechanics)
    del own["motion"]
    return {"motion": motion.kind} | _write_fields(motion) | own
