"""Draw every chart and renew the pictures in docs/.

Run: python -m benchmarks.charts [story waveforms pareto devices stability latency] [--out docs]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.charts import draw, latency, measure, stability, story, waveforms
from benchmarks.charts.stability_map import damper_map

ROOT = Path(__file__).parents[2]


def draw_story(out: Path) -> None:
    """Four ways to play the same noise under the same finger; their figures are printed."""
    runs = story.measure()
    for name, run in runs.items():
        print(f"  {name}: " + ", ".join(f"{what} {value:.2f} %" for what, value in story.over_time(run)[2].items()))
    story.draw(runs).savefig(out / "picture.png", dpi=110)


def draw_waveforms(out: Path) -> None:
    """The error of whole waveforms by signal, finger and speed."""
    found = []
    for row in waveforms.rows():
        found.append(row)
        print("  {}, {}, {}, {:g} m/s: {:.2f} / {:.2f} %".format(*row), flush=True)
    _write(out / "waveforms", waveforms.draw(found), [row._asdict() for row in found])


def draw_pareto(out: Path) -> None:
    """Methods and settings on the plate."""
    points = measure.measure(measure.methods_and_settings())
    swept = measure.over_frequency([each.setting for each in points if each.setting.what == "default"])
    _write(out / "pareto", draw.pareto(points, swept), _as_data(points, swept))


def draw_devices(out: Path) -> None:
    """Methods and levels on every simulated device."""
    points = measure.measure(measure.devices_and_levels())
    swept = measure.over_frequency([measure.Setting(method="inverse", device=device) for device in measure.LEVELS])
    _write(out / "device-chart", draw.devices(points, swept), _as_data(points, swept))


def draw_stability(out: Path) -> None:
    """Stability of every method."""
    rows, dampers = stability.measure(), [damper_map(case) for case in stability.CASES]
    stability.draw(rows, dampers).savefig(out / "stability.png", dpi=70)
    for case, each in zip(stability.CASES, dampers, strict=True):
        held, margin = stability.limits(each)
        print(f"  inverse, {case.title}: ".replace("\n", " ") + f"stable to {held:g} samples, margin {margin:.2f}")
    modulus = {name: np.array([each.modulus for each in row]) for name, row in rows.items()}
    np.savez(_data() / "stability.npz", inverse=np.array([each.modulus for each in dampers]), **modulus)


def draw_latency(out: Path) -> None:
    """Phase error of gratings behind sensors of the finger, and the table of docs/devices.md."""
    print(latency.table())
    latency.draw().savefig(out / "latency.png", dpi=110)


CHARTS: dict[str, Callable[[Path], None]] = {
    "story": draw_story, "waveforms": draw_waveforms, "pareto": draw_pareto, "devices": draw_devices,
    "stability": draw_stability, "latency": draw_latency,
}  # fmt: skip


def _as_data(points: list[measure.Point], swept: dict[str, list[float]]) -> dict[str, object]:
    """What a chart shows; an error is infinite where a scene is lost."""
    return {"points": [asdict(each) for each in points], "frequency": measure.SWEEP.tolist(), "errors": swept}


def _data() -> Path:
    folder = ROOT / "out" / "charts"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _write(path: Path, figure: object, data: object) -> None:
    """Write a picture, and its data into out/charts."""
    figure.savefig(path.with_suffix(".png"), dpi=110)  # type: ignore[attr-defined]
    (_data() / f"{path.name}.json").write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("charts", nargs="*", metavar="CHART", help=f"of {', '.join(CHARTS)}; all by default")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the pictures")
    chosen = parser.parse_args()
    unknown = [name for name in chosen.charts if name not in CHARTS]
    if unknown:
        parser.error(f"{unknown[0]!r}: must be one of {', '.join(CHARTS)}")
    chosen.out.mkdir(parents=True, exist_ok=True)
    for name in chosen.charts or CHARTS:
        print(f"chart: {name}", flush=True)
        CHARTS[name](chosen.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
