"""Which part of a playlist plays live, and until when."""

import math
from collections import deque
from collections.abc import Sequence

from hapticrender.protocols import Rendering, Texture
from hapticrender.touch.composed import Playlist

LEAST_PART = 0.1  # s: twice the time between two looks at what is due


def parts_of(texture: Texture) -> Sequence[tuple[Texture, float]]:
    """Textures that are taken up one by one, and how long each plays (s); a ValueError where one is too short."""
    parts = texture.parts if isinstance(texture, Playlist) and texture.spatial else ((texture, math.inf),)
    shortest = min(seconds for _, seconds in parts)
    if shortest < LEAST_PART:
        raise ValueError(f"a part of {shortest:g} s of a playlist along the surface: must be >= {LEAST_PART:g} s")
    return parts


class LivePlaylist:
    """Renderings of `parts_of` a texture, which follow each other in turn."""

    def __init__(self) -> None:
        self._parts: deque[tuple[Rendering, float]] = deque()  # and how long (s); the first plays ...
        self._until = math.inf  # s: ... until then

    def begin(self, renderings: list[Rendering], parts: Sequence[tuple[Texture, float]], time: float) -> None:
        """Note that the first of the renderings plays from `time` (s) on."""
        self._parts = deque(zip(renderings, (seconds for _, seconds in parts), strict=True))
        self._until = time + self._parts[0][1]

    def due(self, time: float) -> Rendering | None:
        """Return the next rendering once it is to play, None before."""
        if time < self._until:
            return None
        self._parts.rotate(-1)
        rendering, seconds = self._parts[0]
        self._until += seconds
        return rendering
