"""Lines on a terminal that are written over at every look; in a file or a pipe each look is written once a second."""

from __future__ import annotations

from typing import TextIO

OLDER = "\x1b[{}A\x1b[J"  # ANSI: up by so many lines, and clear what follows


class LiveLines:
    """Writes a text of some lines over the one before, to `stream`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._lines, self._shown = stream, 0, 0

    def show(self, text: str, second: int) -> None:
        """Show `text`; where nothing can be written over, only the first of each `second`."""
        terminal = self._stream.isatty()
        if not terminal and second < self._shown:
            return
        self._shown = second + 1
        self._stream.write((OLDER.format(self._lines) if terminal and self._lines else "") + text + "\n")
        self._stream.flush()
        self._lines = text.count("\n") + 1
