"""Record the goldens: ``python tests/goldens/record.py [--commit HASH]``, from the root of a checkout.

Writes ``goldens.npz`` (three segments of drive of every case) and ``figures.json``
(figures and flags of every case, and the spread of each figure over `SEEDS`).  Recording anew means that what must not
change has changed: say why in the commit.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
if __name__ == "__main__":
    sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from goldens import figures as judge  # noqa: E402
from goldens.cases import CASES, Case  # noqa: E402
from goldens.play import play  # noqa: E402

SEEDS = range(1, 9)  # of the sensor noise, for the spread of every figure; the recorded run has the case's own
ARRAYS, FIGURES = HERE / "goldens.npz", HERE / "figures.json"


def main() -> None:
    """Record every case, and the suite where it is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commit", default="", help="of the code that is recorded")
    arguments = parser.parse_args()
    kept = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.exists() else {"commit": ""}
    arrays, cases = {}, {}
    for case in CASES.values():
        cases[case.name], found = record(case)
        arrays |= {f"{case.name}/{key}": value for key, value in found.items()}
        print(case.name, cases[case.name]["figures"], cases[case.name]["flags"], flush=True)
    report = {"commit": arguments.commit or kept["commit"], "cases": cases}
    np.savez_compressed(ARRAYS, **arrays)
    FIGURES.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def record(case: Case) -> tuple[dict, dict[str, np.ndarray]]:
    """Figures, their spread and flags of a case; its drive."""
    played = play(case)
    figures = judge.figures(played, case.window, case.settle)
    others = [judge.figures(play(replace(case, seed=seed)), case.window, case.settle) for seed in SEEDS]
    told = {
        "method": case.method,
        "figures": figures,
        "spread": {key: spread([other[key] for other in others]) for key in figures},
        "flags": judge.flags(played),
    }
    return told, {"drive": judge.drive_of(played)}


def spread(values: list[float | None]) -> float | None:
    """Standard deviation of a figure over seeds; None where a run has none."""
    return None if None in values else float(np.std(values, ddof=1))


if __name__ == "__main__":
    main()
