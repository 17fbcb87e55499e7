"""Stand-ins for textures and motions made in Python, which a scene file can describe but not hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NoReturn

from hapticrender.bands import Bands
from hapticrender.errors import SceneError
from hapticrender.protocols import Array

LONGEST = 500  # characters


@dataclass(frozen=True)
class _Description:
    """One printable line about an object made in Python: keeps recordings readable, refuses to play."""

    kind: ClassVar[str] = "custom"
    what: ClassVar[str]

    description: str

    def __post_init__(self) -> None:
        text = " ".join(str(self.description).split())
        object.__setattr__(self, "description", "".join(filter(str.isprintable, text))[:LONGEST])

    def _refuse(self) -> NoReturn:
        raise SceneError(
            f"description = {self.description!r}: a {self.what} made in Python cannot be played from its description"
        )


class CustomTexture(_Description):
    """Description of a texture of the user's own."""

    what = "texture"

    def bands(self, rate: float) -> Bands:
        """Refuse."""
        self._refuse()

    def waveform(self, time: Array, position: Array) -> Array:
        """Refuse."""
        self._refuse()


class CustomMotion(_Description):
    """Description of a motion of the user's own."""

    what = "motion"

    def position(self, time: Array) -> Array:
        """Refuse."""
        self._refuse()

    def load(self, time: Array) -> Array:
        """Refuse."""
        self._refuse()
