"""A renderer against its plant: whether every scene stays inside its tolerance, and by which figure it is judged."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from hapticrender import __version__, defaults, wording
from hapticrender.loop import Session, prepare, run
from hapticrender.progress import Progress
from hapticrender.touch.scene import Scene

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What a scene's recording came to.

    Parameters
    ----------
    scene, device, method : str
        What was rendered, on what, and how.
    seed : int
        Seed of the plant's noise.
    passed : bool
        Whether the worst figure stays inside the tolerance.
    tolerance : float
        Bound on the figure (relative error, 1).
    figure, band, place : str
        The worst figure: its name, the band and the place on the surface where it stood.
    value : float or None
        The worst figure (relative error, 1); None where nothing could be judged.
    elapsed : float
        Time that the rendering took (s).
    summary : dict
        Everything that ``Recording.summary()`` says.
    """

    scene: str
    device: str
    method: str
    seed: int
    passed: bool
    tolerance: float
    figure: str
    band: str
    place: str
    value: float | None
    elapsed: float
    summary: Mapping[str, Any] = field(repr=False)

    @classmethod
    def of(cls, summary: Mapping[str, Any], elapsed: float) -> Verdict:
        """Read the verdict off ``Recording.summary()``; `elapsed` is in s."""
        shared = {key: summary[key] for key in ("scene", "device", "method", "seed", "passed", "tolerance")}
        worst = {key: summary["worst"][key] for key in ("figure", "value", "band", "place")}
        return cls(**shared, **worst, elapsed=elapsed, summary=summary)

    def __str__(self) -> str:
        return f"{self.scene} {wording.verdict(self.summary)}"


def validate(
    scenes: Iterable[Scene],
    *,
    method: str = defaults.METHOD,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Verdict]:
    """Render scenes in closed loop against the plant model and judge each.

    Parameters
    ----------
    scenes : iterable of Scene
        What to render; all are prepared before the first sample of any runs.
    method : str
        Name of the control method.
    seed : int, >= 0
        Seed of the plant's noise.
    progress : Progress, optional
        Shows how far the work has come.

    Returns
    -------
    list of Verdict
        In the order of the scenes.

    Raises
    ------
    ValueError
        For a scene that the device cannot render, or an unknown method.

    Examples
    --------
    >>> from hapticrender.touch.builtin import builtin_scenes
    >>> [verdict] = validate([builtin_scenes()["grating-20"]], seed=1)
    >>> verdict.passed
    True
    """
    return run_and_judge([prepare(scene, method=method, seed=seed) for scene in scenes], progress)


def run_and_judge(sessions: Iterable[Session], progress: Progress | None = None) -> list[Verdict]:
    """Run prepared sessions to their ends and judge each."""
    verdicts = []
    for session in sessions:
        start = time.perf_counter()
        with nullcontext() if progress is None else progress.scene(session.scene.name) as tick:
            summary = run(session, progress=tick).summary()
        verdicts.append(Verdict.of(summary, time.perf_counter() - start))
    return verdicts


def write_json(path: str | Path, verdicts: Sequence[Verdict]) -> None:
    """Write verdicts, with their whole summaries, as JSON to `path`; a figure that is not finite becomes null."""
    report = {
        "hapticrender": __version__,
        "passed": all(verdict.passed for verdict in verdicts),
        "scenes": [asdict(verdict) for verdict in verdicts],
    }
    Path(path).write_text(as_json(report), encoding="utf-8")


def write_junit(path: str | Path, verdicts: Sequence[Verdict]) -> None:
    """Write verdicts to `path` as the JUnit XML that continuous-integration systems read: a test case per scene.

    Notes
    -----
    The schema is that of the Apache Ant JUnit task: ``testsuites/testsuite/testcase/failure``, times in s.
    """
    failures = sum(not verdict.passed for verdict in verdicts)
    totals = {
        "name": "hapticrender",
        "tests": str(len(verdicts)),
        "failures": str(failures),
        "errors": "0",
        "skipped": "0",
        "time": f"{sum(verdict.elapsed for verdict in verdicts):.3f}",
    }
    suites = ElementTree.Element("testsuites", {key: totals[key] for key in totals if key != "skipped"})
    suite = ElementTree.SubElement(suites, "testsuite", totals)
    for verdict in verdicts:
        _add_case(suite, verdict)
    ElementTree.indent(suites)
    ElementTree.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)


def as_json(report: Any) -> str:
    """Strict JSON text of `report`, with null for every figure that is not finite."""
    return json.dumps(_finite(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _add_case(suite: ElementTree.Element, verdict: Verdict) -> None:
    """Add one scene as a test case, with its failure where it missed its tolerance."""
    case = {
        "classname": _xml(f"hapticrender.{verdict.device}.{verdict.method}"),
        "name": _xml(verdict.scene),
        "time": f"{verdict.elapsed:.3f}",
    }
    element = ElementTree.SubElement(suite, "testcase", case)
    if not verdict.passed:
        attributes = {"message": _xml(wording.verdict(verdict.summary)), "type": "tolerance"}
        failure = ElementTree.SubElement(element, "failure", attributes)
        failure.text = _xml(as_json(verdict.summary["bands"]))


def _finite(value: Any) -> Any:
    """Replace every float that JSON cannot hold by None."""
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _xml(text: str) -> str:
    """`text` without the characters that XML 1.0 (section 2.2) forbids."""
    return _NOT_XML.sub("\ufffd", text)
