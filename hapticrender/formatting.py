"""Format numbers, bands and tables as text, the same on the command line, in reports and on pages."""

import json
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))


@contextmanager
def closed_pipes() -> Iterator[None]:
    """End the block, and write nothing more, where the reader of our output has closed it, as `| head -1` does."""
    try:
        with suppress(BrokenPipeError):
            yield
    finally:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            try:
                stream.flush()
            except OSError as error:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
                if not isinstance(error, BrokenPipeError):  # a full disk
                    raise


def quantity(value: float | None, unit: str) -> str:
    """Format a measured `value` (SI) with a prefix and three digits, a dash for none.

    >>> quantity(1.0016e-5, "m"), quantity(None, "s"), quantity(2e-7, "m")
    ('10.0 µm', '–', '200 nm')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if abs(value) < _PREFIXES[-1][0]:
        return f"0 {unit}"
    scale, prefix = _prefix(value)
    return f"{_digits(value / scale)} {prefix}{unit}"


def short(value: float, unit: str, digits: int = 4) -> str:
    """Format a chosen `value` (SI) with a prefix and no more digits than it needs.

    >>> short(1e-3, "m"), short(62.5, "Hz"), short(468.3e-6, "m", 3)
    ('1 mm', '62.5 Hz', '468 µm')
    """
    value = float(f"{value:.{digits}g}")
    scale, prefix = _prefix(value)
    return f"{float(f'{value / scale:.{digits}g}'):.10g} {prefix}{unit}"


def percent(ratio: float | None) -> str:
    """Format a relative error (1) in percent with three digits; a dash for none."""
    return "–" if ratio is None or not math.isfinite(ratio) else f"{_digits(100 * ratio)} %"


def degrees(angle: float | None) -> str:
    """Format an angle (rad) in degrees; a dash for none."""
    return "–" if angle is None or not math.isfinite(angle) else f"{round(math.degrees(angle), 1) + 0.0:.1f}°"


def band_label(band: Mapping[str, Any]) -> str:
    """Name a band: its frequency, or its wavelength and the median frequency at which it was judged.

    >>> band_label({"frequency": 62.5, "wavelength": None}), band_label({"frequency": 171.2, "wavelength": 468.3e-6})
    ('62.5 Hz', '468 µm (171 Hz)')
    """
    frequency, wavelength = band.get("frequency"), band.get("wavelength")
    if not wavelength:
        return short(frequency, "Hz") if frequency else "0 Hz"
    return short(wavelength, "m", 3) + (f" ({short(frequency, 'Hz', 3)})" if frequency else "")


def bands_label(bands: Sequence[Mapping[str, Any]]) -> str:
    """Name one band, or state their number, the first and the last."""
    labels = [band_label(band) for band in bands]
    return labels[0] if len(labels) == 1 else f"{len(labels)} bands, {labels[0]} to {labels[-1]}"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Align `rows` in columns, the first and the last to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    last = len(widths) - 1
    lines = (
        "  ".join(cell if i == last else f"{cell:{'>' if i else '<'}{widths[i]}}" for i, cell in enumerate(row))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def as_json(report: Any) -> str:
    """Format `report` as strict JSON, with null for every figure that is not finite; a lone surrogate is escaped."""
    text = json.dumps(_finite(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return text.encode("utf-8", "backslashreplace").decode()


def _finite(value: Any) -> Any:
    """Replace every float that JSON cannot hold by None, and arrays by lists."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def printable(text: str) -> str:
    r"""Replace every character but line feeds that a terminal would not print by its escape.

    >>> printable("a\x1b[2J")
    'a\\x1b[2J'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def _prefix(value: float) -> tuple[float, str]:
    """Choose the SI prefix with which `value` has one to three digits before the point; none above 1."""
    return next((entry for entry in _PREFIXES if abs(value) >= 0.9995 * entry[0]), _PREFIXES[-1])


def _digits(value: float) -> str:
    """Format three significant digits, never in exponent form below a million."""
    if abs(value) >= 99.95:
        return f"{value:.0f}" if abs(value) < 1e6 else f"{value:.1e}"
    return f"{value:.3g}" if abs(value) < 1e-3 else f"{value:.{2 - math.floor(math.log10(abs(value) * 1.0005))}f}"
