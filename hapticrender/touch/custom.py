"""Stand-in for a texture or motion made in Python, which a scene file can describe but not hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from hapticrender import checks
from hapticrender.errors import SceneError

LONGEST = 500  # characters


def _one_line(key: str, value: Any) -> str:
    return "".join(filter(str.isprintable, " ".join(str(value).split())))[:LONGEST]


@dataclass(frozen=True)
class Custom(checks.Validated):
    """One printable line about an object made in Python: keeps recordings readable, refuses to play."""

    kind: ClassVar[str] = "custom"

    description: str = checks.checked(_one_line)

    def bands(self, *arguments: Any) -> Any:
        """Raise a `SceneError`: of the object there is only this line."""
        raise SceneError(f"description = {self.description!r}: what was made in Python cannot be played from a file")

    waveform = position = load = bands
