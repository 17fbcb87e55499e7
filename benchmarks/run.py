"""Measure every figure that the library claims about its speed, beside its floor.

Ratios decide: candidate and reference run in turns in this process, and the figure is the median of the pairs' ratios.

Run: python -m benchmarks.run [--short] [--only TEXT ...] [--margin 2] [--json FILE]
"""

import argparse
import json
import platform
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.cases import every_case
from benchmarks.timing import Absent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="few pairs and small sizes; fail beyond the margin")
    parser.add_argument("--only", nargs="*", default=[], metavar="TEXT", help="cases whose names contain one of these")
    parser.add_argument("--margin", type=float, default=2.0, help="with --short: how much worse a ratio may be")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    figures = []
    for name, case in every_case(arguments.short).items():
        if arguments.only and not any(text in name for text in arguments.only):
            continue
        try:
            for figure in case():
                print(figure, flush=True)
                figures.append(figure)
        except Absent as missing:
            print(f"{name}: left out: {missing}")
    if arguments.json:
        rows = [asdict(each) | {"met": each.within()} for each in figures]
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    beyond = [each.name for each in figures if each.unit == "x" and not each.within(arguments.margin)]
    if arguments.short and beyond:
        print(f"beyond {arguments.margin:g} times the floor: {'; '.join(beyond)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
