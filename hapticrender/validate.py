"""Render scenes against the device models and judge each: within its tolerance or not, and by which figure."""

import itertools
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self, TextIO
from xml.etree import ElementTree

from hapticrender import __version__, defaults
from hapticrender.checks import integer
from hapticrender.control.methods import method_named
from hapticrender.devices import SIMULATED, naming_driver
from hapticrender.errors import HapticError, SceneError
from hapticrender.formatting import as_json, printable
from hapticrender.loop import prepare
from hapticrender.process_signals import Terminated
from hapticrender.protocols import Rendering
from hapticrender.report import outputs
from hapticrender.report.text import progress as progress_of
from hapticrender.report.text import verdict as sentence
from hapticrender.touch.builtin_scenes import builtin_scenes
from hapticrender.touch.scene import Scene, distinct_names

_NO_NAME = re.compile(r"[^\w.-]+|^\.+")
_LOST = "not finished: one of the processes that render was killed, perhaps for lack of memory (fewer --jobs need less)"
GRACE = 1.0  # s: for a process of a pool to leave by itself
Tick = Callable[[float, float], None]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict on one scene.

    "passed", "passed in band" (for the reason, part of the texture cannot be played), "failed", "not judged" (no figure
    can be given, for the reason) or "error" (it cannot be rendered).
    """

    scene: str
    device: str = ""
    method: str
    seed: int
    verdict: str
    reason: str = ""  # where the worst figure is none
    tolerance: float | None = None  # of the scene (relative error, 1)
    figure: str = "waveform_error"  # the worst one
    band: str = "any"
    place: str = "any"
    value: float | None = None  # of the worst figure (relative error, 1)
    bound: float | None = None  # on it
    elapsed: float = 0.0  # s
    warnings: tuple[str, ...] = ()  # how the device differs from its model, see ``PlateMismatch``
    summary: Mapping[str, Any] = field(default_factory=dict, repr=False)  # ``Recording.summary()``

    @classmethod
    def of(cls, summary: Mapping[str, Any], elapsed: float, warnings: tuple[str, ...] = ()) -> Self:
        """Take the verdict from ``Recording.summary()``; `elapsed` is in s."""
        keys = ("scene", "device", "method", "seed", "verdict", "reason", "tolerance")
        own = {key: summary[key] for key in keys} | summary["worst"]
        return cls(**own, elapsed=elapsed, warnings=warnings, summary=summary)

    @property
    def passed(self) -> bool:
        """Whether every figure is within its bound, and all of the texture can be played."""
        return self.verdict == "passed"

    def __str__(self) -> str:
        return f"{self.scene} {sentence(self.summary)}" if self.summary else f"{self.scene}: {self.reason}"


def open_scene(reference: str | Path) -> Scene:
    """Read a scene: a built-in one by its name, any other from its TOML file.

    A ValueError where there is none, or where it would settle for longer than the scene lasts.
    """
    scenes = builtin_scenes()
    if str(reference) in scenes:
        return scenes[str(reference)]
    if not Path(reference).exists():
        raise ValueError(f"{reference}: no such file, nor a built-in scene (see `hapticrender scenes`)")
    scene = Scene.from_toml(reference)
    if scene.settle > max(scene.duration, Scene.settle):  # the default may be longer than a short scene
        bound = f"must be <= {scene.duration:g} s, the scene's duration"
        raise SceneError(f"{reference}: render.settle = {scene.settle:g}: {bound}")
    return scene


def validate(
    scenes: Iterable[Scene | str | Path],
    *,
    method: str | None = None,
    seed: int | None = None,
    driver: str = SIMULATED,
    jobs: int = 1,
    out: str | Path | None = None,
    progress: TextIO | None = None,
) -> list[Verdict]:
    """Render scenes in closed loop against the plant models, or on a device, and judge each, in their order.

    Scenes may be names of built-in ones or TOML files; one that cannot be rendered, whatever was raised, stops no other
    (``python -X dev`` prints the traceback).  `method` and `seed` (>= 0, of the plants' noise) are by default those of
    each scene.  `driver` is a text as ``--driver`` takes it, made anew for each scene.  `jobs` (>= 1) processes render
    side by side, on simulated devices; where one is killed, what is not finished is an error.
    Files of each scene that does not pass go into a folder of its name in `out`.

    >>> [verdict] = validate(["one-texture-electroadhesion"], seed=1)
    >>> verdict.passed
    True
    """
    if method is not None:
        method_named(method)
    integer("jobs", jobs, "processes", least=1)
    if jobs > 1 and driver != SIMULATED:
        raise ValueError(f"{jobs=}: must be 1 process where driver = {driver!r}: a device plays one scene at a time")
    judge = partial(_judge, method=method, seed=seed, driver=driver, out=None if out is None else Path(out))
    entries = _read(scenes)
    count, number = sum(isinstance(scene, Scene) for _, scene, _ in entries), itertools.count(1)
    shown = [(f"{next(number)}/{count} {label}" if isinstance(scene, Scene) else "") for label, scene, _ in entries]
    with ExitStack() as stack:
        calls: list[Callable[[Tick | None], Verdict]] = [partial(judge, *entry) for entry in entries]
        if jobs > 1:
            context = multiprocessing.get_context("spawn")
            watched, alive = context.Pipe(duplex=False)
            pool = stack.enter_context(ProcessPoolExecutor(jobs, context, _end_with, (watched,)))
            stack.enter_context(alive)  # closed first, however this ends
            futures = [pool.submit(_judge_in_pool, judge, *entry) for entry in entries]
            calls = [partial(_result, *each, judge) for each in zip(futures, entries, strict=True)]
        verdicts = []
        for line, call in zip(shown, calls, strict=True):
            with progress_of(line, progress) if line and progress else nullcontext() as tick:
                verdicts.append(call(tick))
        return verdicts


def _end_with(watched: Connection) -> None:
    """End this process of a pool, by SIGTERM, once the other end of a pipe is closed: as its owner ends."""

    def watch() -> None:
        watched.poll(None)
        time.sleep(GRACE)  # a broken pool has sent SIGTERM itself; a second one would cut short what the first began
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def _judge_in_pool(judge: Callable[..., Verdict], *entry: Scene | str) -> Verdict:
    """Judge in a process of a pool; a signal ends the process, where the pool would go on with the next scene."""
    try:
        return judge(*entry, None)
    except (Terminated, KeyboardInterrupt):
        os._exit(128 + signal.SIGTERM)


def _result(
    future: Future[Verdict], entry: tuple[str, Scene | str, str], judge: Callable[..., Verdict], _: Tick | None
) -> Verdict:
    """Wait for a verdict of a pool; a killed process breaks the whole pool, and not every scene can be sent to one."""
    try:
        return future.result()
    except Exception as error:
        return judge(*entry, None, problem=_LOST if isinstance(error, BrokenProcessPool) else _problem(error))


def _read(scenes: Iterable[Scene | str | Path]) -> list[tuple[str, Scene | str, str]]:
    """Labels, scenes, or why one cannot be read, and the file of a scene; those of one name are numbered."""
    found: list[tuple[str, Scene | str, str]] = []
    for reference in scenes:
        try:
            scene = reference if isinstance(reference, Scene) else open_scene(reference)
            own = reference is scene or str(reference) == scene.name
            found.append((scene.name, scene, "" if own else str(reference)))
        except Exception as error:
            found.append((str(reference), _problem(error), ""))
    labels = distinct_names(name for name, _, _ in found)
    return [(label, scene, file) for label, (_, scene, file) in zip(labels, found, strict=True)]


def _judge(
    label: str,
    scene: Scene | str,
    file: str,
    tick: Tick | None,
    *,
    method: str | None,
    seed: int | None,
    driver: str,
    out: Path | None,
    problem: str = "",
) -> Verdict:
    """Render and judge a scene; `scene` may be why it cannot be read, `problem` why it cannot be rendered."""
    start, device = time.perf_counter(), ""
    if isinstance(scene, str):
        problem = scene
    else:
        device, method = scene.device, method or scene.method
        seed = scene.seed if seed is None else seed
        try:
            if problem:
                raise HapticError(problem)
            rendering = prepare(scene, driver=driver, method=method, seed=seed)
            with naming_driver(driver):
                summary, warned = _summary(rendering, out and out / _NO_NAME.sub("_", label), tick)
            return Verdict.of({**summary, "scene": label}, time.perf_counter() - start, warned)
        except Terminated:
            raise
        except (Exception, SystemExit) as error:  # a vendor's library may call sys.exit
            problem = f"{file}: {_problem(error)}" if file else _problem(error)
    reason, method = problem.removeprefix(f"{label}: "), method or defaults.METHOD
    return Verdict(scene=label, device=device, method=method, seed=seed or 0, verdict="error", reason=reason)


def _problem(error: BaseException) -> str:
    """State what was raised: the message alone where it is one of ours, or refuses a value; else its name, too."""
    if sys.flags.dev_mode:
        traceback.print_exception(error)
    known = isinstance(error, ValueError | TypeError | HapticError)
    return str(error) if known else f"{type(error).__name__}: {error}"


def _summary(rendering: Rendering, folder: Path | None, tick: Tick | None) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Run a rendering, whatever its length, and judge it; only what does not pass stays in `folder`.  And warnings."""
    if folder is not None:
        outputs.refuse_to_overwrite(folder)
    with tempfile.TemporaryDirectory() as scratch, outputs.naming_full(place := folder or Path(scratch)):
        recording = outputs.run_to_end(place, rendering, tick)
        summary, warned = recording.summary(), recording.warnings
        if folder is not None and not summary["passed"]:
            return outputs.write_outputs(folder, recording), warned
        del recording  # closes its journal
        outputs.remove_outputs(place)
    return summary, warned


def exit_status(verdicts: Sequence[Verdict], *, strict: bool = False) -> int:
    """2 where a scene cannot be rendered, else 1 where one misses its tolerance (`strict`: is not judged), else 0."""
    found = {verdict.verdict for verdict in verdicts}
    return 2 if "error" in found else int("failed" in found or (strict and "not judged" in found))


def counted(verdicts: Sequence[Verdict]) -> str:
    """Count the verdicts of each kind: "3 scenes: 1 passed, 1 failed, 1 not judged"."""
    counts = Counter(verdict.verdict for verdict in verdicts)
    kinds = ("passed", "passed in band", "failed", "not judged", "error")
    parts = [f"{counts[kind]} {kind.replace('error', 'not rendered')}" for kind in kinds if counts[kind]]
    return f"{len(verdicts)} scene{'s' * (len(verdicts) != 1)}: {', '.join(parts)}"


def write_json(path: str | Path, verdicts: Sequence[Verdict]) -> None:
    """Write verdicts, with their whole summaries, as JSON to `path`; a figure that is not finite becomes null.

    "passed" at the top says whether every scene has "passed": not where one is not judged, or passed in band.
    """
    report = {
        "hapticrender": __version__,
        "passed": all(verdict.passed for verdict in verdicts),
        "scenes": [asdict(verdict) | {"passed": verdict.passed} for verdict in verdicts],
    }
    outputs.write_report(path, as_json(report).encode("utf-8"))


def write_junit(path: str | Path, verdicts: Sequence[Verdict]) -> None:
    """Write verdicts to `path` as JUnit XML (schema of the Apache Ant task): a test case per scene, times in s.

    A scene that is not judged is skipped; one that passed in band passes, with the reason as its output.
    """
    counts = Counter(verdict.verdict for verdict in verdicts)
    seconds = sum(verdict.elapsed for verdict in verdicts)
    totals = {"name": "hapticrender", "tests": str(len(verdicts)), "time": f"{seconds:.3f}"}
    totals |= {"failures": str(counts["failed"]), "errors": str(counts["error"])}
    suites = ElementTree.Element("testsuites", totals)
    suite = ElementTree.SubElement(suites, "testsuite", totals | {"skipped": str(counts["not judged"])})
    for verdict in verdicts:
        _add_case(suite, verdict)
    ElementTree.indent(suites)
    outputs.write_report(path, ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True))


def _add_case(suite: ElementTree.Element, verdict: Verdict) -> None:
    """Add one scene as a test case, with its failure, error, reason for being skipped, or what no device can play."""
    name = f"hapticrender.{verdict.device}.{verdict.method}"
    case = {"classname": printable(name), "name": printable(verdict.scene), "time": f"{verdict.elapsed:.3f}"}
    element = ElementTree.SubElement(suite, "testcase", case)
    if verdict.verdict == "failed":
        attributes = {"message": printable(sentence(verdict.summary)), "type": "tolerance"}
        ElementTree.SubElement(element, "failure", attributes).text = printable(as_json(verdict.summary["waveform"]))
    elif verdict.verdict == "passed in band":
        ElementTree.SubElement(element, "system-out").text = printable(sentence(verdict.summary))
    elif verdict.verdict != "passed":
        tag = "error" if verdict.verdict == "error" else "skipped"
        ElementTree.SubElement(element, tag, {"message": printable(verdict.reason), "type": "scene"})
    if verdict.warnings:
        ElementTree.SubElement(element, "system-err").text = printable("\n".join(verdict.warnings))
