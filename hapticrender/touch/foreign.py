"""Stand-ins for textures and motions made in Python, which a scene file can describe but not hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NoReturn

from hapticrender.bands import Bands
from hapticrender.errors import SceneError
from hapticrender.protocols import Array

LONGEST = 500


def _describe(part: object) -> str:
    text = " ".join(str(part).split())
    return "".join(letter for letter in text if letter.isprintable())[:LONGEST]


def _cannot(what: str, description: str) -> NoReturn:
    raise SceneError(f"description = {description!r}: a {what} made in Python cannot be played from its description")


@dataclass(frozen=True)
class ForeignTexture:
    """Says what a texture of the user's own was; keeps recordings readable, refuses to play."""

    kind: ClassVar[str] = "foreign"

    description: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "description", _describe(self.description))

    def bands(self, rate: float) -> Bands:
        """Refuse."""
        _cannot("texture", self.description)

    def waveform(self, time: Array, position: Array) -> Array:
        """Refuse."""
        _cannot("texture", self.description)


@dataclass(frozen=True)
class ForeignMotion:
    """Says what a motion of the user's own was; keeps recordings readable, refuses to move."""

    kind: ClassVar[str] = "foreign"

    description: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "description", _describe(self.description))

    def position(self, time: Array) -> Array:
        """Refuse."""
        _cannot("motion", self.description)

    def load(self, time: Array) -> Array:
        """Refuse."""
        _cannot("motion", self.description)
