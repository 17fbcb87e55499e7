"""Reads and writes the TOML of scenes and profiles (the standard library only reads it)."""

import json
import os
import re
import stat
import tomllib
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

LARGEST_FILE = 1 << 26  # bytes of TOML
LONGEST_LINE = 100  # characters of a list, about
_BARE = re.compile(r"[A-Za-z0-9_-]+")


def read_text(path: str | os.PathLike[str]) -> str:
    """Text of a file, less a byte order mark; a ValueError where it is no regular file of UTF-8 text, or too large."""
    try:
        found = Path(path).stat()
        usable = stat.S_ISREG(found.st_mode) and found.st_size <= LARGEST_FILE
        text = Path(path).read_bytes().decode("utf-8-sig") if usable else ""
    except UnicodeDecodeError as problem:
        raise ValueError(f"byte {problem.start}: must be UTF-8 text") from problem
    except (OSError, ValueError) as problem:
        raise ValueError(f"must be a readable file ({getattr(problem, 'strerror', problem)})") from problem
    if not usable:
        raise ValueError(f"must be a regular file of at most {LARGEST_FILE} bytes")
    return text


def loads(text: str) -> dict[str, Any]:
    """Tables of a TOML text; a ValueError of one line."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as problem:
        twice = ": a key is there twice, or as a value and as a table" if "overwrite" in str(problem) else ""
        raise ValueError(f"must be TOML ({' '.join(str(problem).split())[:200]}{twice})") from problem


def dumps(table: Mapping[str, Any]) -> str:
    """TOML text of nested tables, lists, strings, dates, numbers and booleans; floats survive to the last bit.

    A long list takes several lines, and is the last of its table.

    >>> print(dumps({"name": "a", "texture": {"amplitude": 1e-05}}))
    name = "a"
    <BLANKLINE>
    [texture]
    amplitude = 1e-05
    <BLANKLINE>
    """
    lines = [f"{_key(key)} = {_value(value)}" for key, value in table.items() if not isinstance(value, Mapping)]
    for key, value in table.items():
        if isinstance(value, Mapping):
            entries = (f"{_key(inner)} = {_value(entry)}" for inner, entry in value.items())
            lines += ["", f"[{_key(key)}]", *sorted(entries, key=lambda entry: "\n" in entry)]
    return "\n".join(lines) + "\n"


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _text(text: str | bool) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def _value(value: Any) -> str:
    if isinstance(value, bool | str):
        return _text(value)
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        entries = [repr(each) if type(each) is float else _value(each) for each in value]
        line = ", ".join(entries)
        if len(line) <= LONGEST_LINE:
            return f"[{line}]"
        count = max(1, LONGEST_LINE // (max(map(len, entries)) + 2))
        rows = (", ".join(entries[i : i + count]) for i in range(0, len(entries), count))
        return "[\n  " + ",\n  ".join(rows) + ",\n]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items()) + "}"
    raise TypeError(f"a {type(value).__name__} has no place in TOML")
