"""The profile of a device: what is known of one, by which measurement, and what it must never be driven beyond."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import date
from pathlib import Path
from typing import Any, Self

from hapticrender import checks
from hapticrender.checks import Validated, checked, mapping, parameter
from hapticrender.errors import naming
from hapticrender.touch import toml_text

ENDING = ".toml"  # of a device's name that is a file
Scales = float | tuple[float, ...]
HEAD = ("kind", "name", "measured_by", "measured_with", "measured_on", "probe")  # the table [profile] of a file


@dataclass(frozen=True, kw_only=True)
class Limits(Validated):
    """Limits of a device, which protect skin, coils and glass; None is no limit beside those of [device].

    The drive is in the device's unit: A of a plate's coils and of a screen, V of an ultrasonic plate.
    """

    peak_drive: float | None = parameter(None, about="drive unit: largest magnitude of each channel", above=0.0)
    rms_drive: float | None = parameter(None, about="drive unit: largest rms of a channel over `rms_time`", above=0.0)
    rms_time: float = parameter(10.0, "s", "time constant of that mean, of the coil's heat", least=0.1, most=1e4)
    displacement: float | None = parameter(None, "m", "largest magnitude sensed, static load included", above=0.0)


@dataclass(frozen=True, kw_only=True)
class Calibration(Validated):
    """Numbers between a converter and SI units, and how sure the sensors' gain is; None: not measured."""

    drive_per_full_scale: Scales | None = checked(
        checks.scales, None, about="A or V at a sample of 1.0 played, of all channels or a list, one each; > 0"
    )
    sensed_per_full_scale: Scales | None = checked(
        checks.scales, None, about="m or N at a sample of 1.0 recorded, alike; > 0"
    )
    delay: float | None = parameter(None, "samples", "from a sensed sample to the drive computed from it", above=0.0)
    gain_uncertainty: float = parameter(0.0, about="relative standard uncertainty of the sensors' gain", most=1.0)


def table_of(part: Validated) -> dict[str, Any]:
    """Entries of `part` that differ from their defaults, as a table of a file has them."""
    values = ((each.name, getattr(part, each.name), each.default) for each in fields(part))  # type: ignore[arg-type]
    return {name: value for name, value, default in values if value != default}


def _day(key: str, value: Any) -> date:
    """Return a date, or the date that a text "2026-11-22" is."""
    try:
        return date.fromisoformat(value) if isinstance(value, str) else date(value.year, value.month, value.day)
    except (AttributeError, TypeError, ValueError):
        checks.refuse(key, value, "a date such as 2026-11-22")


def _uncertainty(key: str, value: Any) -> dict[str, float]:
    table = checks.table(key, value)
    return {name: checks.number(f"{key}.{checks.plain(name)}", each, least=0.0) for name, each in table.items()}


@dataclass(frozen=True, kw_only=True)
class DeviceProfile(Validated):
    """All that is known of one device, and where it comes from; a TOML file.

    A scene takes it by the file's name (``Scene(device="plate.toml")``); `hapticrender identify` writes one.  In a file
    the first six are the table ``[profile]``, the others a table of their name each.

    Examples
    --------
    >>> plate = DeviceProfile(kind="vt-plate", name="plate 3", device={"mass": 0.0321}, limits={"rms_drive": 0.5})
    >>> print(plate.to_toml())
    [profile]
    kind = "vt-plate"
    name = "plate 3"
    <BLANKLINE>
    [device]
    mass = 0.0321
    <BLANKLINE>
    [limits]
    rms_drive = 0.5
    <BLANKLINE>
    """

    kind: str = checked(checks.name, about="kind of device: name of a renderer")
    name: str = checked(checks.text, "", about="which device it is")
    measured_by: str = checked(checks.text, "", about="who measured it")
    measured_with: str = checked(checks.text, "", about="with what")
    measured_on: date | None = checked(_day, None, about='when, also as a text "2026-11-22"')
    probe: bool = checked(checks.flag, True, about="whether the device is probed before the loop closes")
    device: Mapping[str, Any] = mapping(checks.table, "parameters (number, str or bool), as in a scene's ``[device]``")
    uncertainty: Mapping[str, float] = mapping(_uncertainty, "standard uncertainty of parameters, in their units")
    calibration: Calibration = checked(Calibration.read, Calibration(), about="also as a table")
    limits: Limits = checked(Limits.read, Limits(), about="also as a table")

    def __post_init__(self) -> None:
        super().__post_init__()
        if strangers := set(self.uncertainty) - set(self.device):
            raise ValueError(f"uncertainty.{min(strangers)}: must be of a parameter in [device]")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a profile; its file's stem is the name of one that has none.

        A `SceneError` states in one line file, key, value, bound and unit.
        """
        with naming(path):
            found = cls.from_table(toml_text.loads(toml_text.read_text(path)))
        return found if found.name else cls(**{**vars(found), "name": Path(path).stem})

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """Make a profile from the tables of its file; a ValueError or TypeError names the entry that is wrong."""
        known = ("profile", "device", "uncertainty", "calibration", "limits")
        for key, value in table.items():
            bound = f"one of the tables {', '.join(known)}; a scene's file is read by hr.Scene.from_toml"
            checks.require(key in known and isinstance(value, Mapping), checks.plain(key), value, bound)
        head, device = table.get("profile", {}), dict(table.get("device", {}))
        with checks.inside("profile"):
            checks.check_names(head, HEAD)
            checks.require("kind" in head, "kind", None, "the name of a renderer, such as 'vt-plate'")
        if (kind := device.pop("kind", head["kind"])) != head["kind"]:
            checks.refuse("device.kind", kind, f"{head['kind']!r}, as in [profile]")
        return cls(**head, device=device, **{key: table[key] for key in known[2:] if key in table})

    def to_toml(self) -> str:
        """TOML text that `from_table` reads back to an equal profile."""
        head = {key: getattr(self, key) for key in HEAD if getattr(self, key) not in ("", None, True)}
        tables = {"profile": head, "device": self.device, "uncertainty": self.uncertainty}
        tables |= {"calibration": table_of(self.calibration), "limits": table_of(self.limits)}
        return toml_text.dumps({key: table for key, table in tables.items() if table}).lstrip("\n")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the profile."""
        Path(path).write_text(self.to_toml(), encoding="utf-8")

    def __str__(self) -> str:
        """Which device it is, and who measured it when."""
        origin = ", ".join(str(each) for each in (self.measured_by, self.measured_on) if each)
        return (self.name or self.kind) + (f" ({origin})" if origin else "")
