"""Measure every figure that the library claims about its speed, beside its target.

Ratios are the verdict: candidate and reference run in turns in this process, on one core, and the figure is the median
of the pairs' ratios.  Absolute figures depend on the machine and are shown beside them.

Run: python benchmarks/run.py [--short] [--only WORD ...] [--margin 2] [--json FILE]
"""

import argparse
import json
import platform
import sys
from dataclasses import asdict
from pathlib import Path

from cases import Absent, Figure, NoCompiler, every_case
from pairing import keep_to_one_core


def show(figure: Figure) -> None:
    sign = ">=" if figure.at_least else "<="
    verdict = "met" if figure.met else "MISSED"
    measured = f"{figure.measured:.3g} {figure.unit}"
    print(f"{figure.name:<76} {measured:>18} {sign} {figure.target:<7g} {verdict:<7} {figure.reference} {figure.note}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="few pairs and small sizes; fail beyond the margin")
    parser.add_argument("--only", nargs="*", default=[], metavar="WORD", help="cases whose names hold one of these")
    parser.add_argument("--margin", type=float, default=2.0, help="with --short: how much worse a ratio may be")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    keep_to_one_core()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    figures = []
    for name, case in every_case(arguments.short):
        if arguments.only and not any(word in name for word in arguments.only):
            continue
        try:
            for figure in case():
                show(figure)
                sys.stdout.flush()
                figures.append(figure)
        except (Absent, NoCompiler) as missing:
            print(f"{name}: left out: {missing}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(each) | {"met": each.met} for each in figures], indent=2) + "\n")
    beyond = [each.name for each in figures if not each.within(arguments.margin)]
    if arguments.short and beyond:
        print(f"beyond {arguments.margin:g} times the target: {'; '.join(beyond)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
