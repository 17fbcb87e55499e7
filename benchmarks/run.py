"""Measure every figure that the library claims about its speed, beside its target.

Ratios are the verdict: candidate and reference run in turns in this process, on one core, and the figure is the median
of the pairs' ratios.  Absolute figures depend on the machine and are shown beside them, as measured and as they would
be on a core as fast as that of the targets, by what naive C takes on either.

Run: python benchmarks/run.py [--short] [--only WORD ...] [--margin 2] [--json FILE]
"""

import argparse
import json
import platform
import sys
from dataclasses import asdict
from pathlib import Path

from cases import THEIRS, Absent, Figure, NoCompiler, core_pace, every_case
from pairing import keep_to_one_core


def show(figure: Figure, slower: float | None) -> None:
    sign = ">=" if figure.at_least else "<="
    told = f"{figure.measured:.3g} {figure.unit}"
    line = f"{figure.name:<76} {told:>18} {sign} {figure.target:<7g} {figure.verdict:<8} {figure.reference}"
    print(f"{line} {figure.note}".rstrip() + (figure.on_their_core(slower) if slower else ""))


def told_pace(short: bool) -> float | None:
    """How many times as long naive C takes here as on the core that absolute targets come from; it is printed, too."""
    try:
        slower = core_pace(3 if short else 9)
    except NoCompiler as missing:
        print(f"the pace of this core: left out: {missing}")
        return None
    print(
        f"naive C takes {slower * THEIRS:.0f} ns a band-sample and channel here, and some {THEIRS:.0f} on the core "
        f"that the targets in s/s and % come from: figures are judged as they are, and told for that pace as well"
    )
    return slower


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="few pairs and small sizes; fail beyond the margin")
    parser.add_argument("--only", nargs="*", default=[], metavar="WORD", help="cases whose names hold one of these")
    parser.add_argument("--margin", type=float, default=2.0, help="with --short: how much worse a ratio may be")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    keep_to_one_core()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    slower, figures = told_pace(arguments.short), []
    for name, case in every_case(arguments.short):
        if arguments.only and not any(word in name for word in arguments.only):
            continue
        try:
            for figure in case():
                show(figure, slower)
                sys.stdout.flush()
                figures.append(figure)
        except (Absent, NoCompiler) as missing:
            print(f"{name}: left out: {missing}")
    if arguments.json:
        rows = [asdict(each) | {"met": each.met, "slower": slower} for each in figures]
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")
    beyond = [each.name for each in figures if not each.within(arguments.margin)]
    if arguments.short and beyond:
        print(f"beyond {arguments.margin:g} times the target: {'; '.join(beyond)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
