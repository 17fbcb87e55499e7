"""The command line: one thin face over the library.

Everything that can be wrong with what was asked is found before anything is
written.  Exit status: 0 done, 1 a scene misses its tolerance (``validate``),
2 bad input or nowhere to write, 130 interrupted; each trouble gets one line.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from hapticrender import __version__, defaults
from hapticrender.errors import HapticError, SceneError

if TYPE_CHECKING:
    from hapticrender.loop import Session
    from hapticrender.outputs import Outputs
    from hapticrender.progress import Progress
    from hapticrender.touch.scene import Scene

PICTURES_HINT = 'no pictures without matplotlib; to get them: pip install "hapticrender[plot]"'

_DESCRIPTION = "Make a finger feel a texture on a surface, in closed loop, on a device or on a model of one."
_EXAMPLES = """\
start here:
  hapticrender demo                               all built-in scenes; then open out/demo/index.html
  hapticrender scenes                             what is built in
  hapticrender scenes grating-47 > mine.toml      a scene of your own: edit it ...
  hapticrender render mine.toml --out mine        ... and render it

`hapticrender VERB --help` says more about each verb.
"""


class _Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are errors like all others: one line, status 2."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (``sys.argv`` by default) and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        arguments = _parser().parse_args(argv)
        status = arguments.run(arguments)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read our output has had enough, as in `hapticrender scenes | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return _complain("interrupted; what is written so far can be read", 130)
    except MemoryError as error:
        return _complain(f"not enough memory: {error}", 2)
    except OSError as error:
        return _complain(f"{error.filename}: {error.strerror}" if error.filename else str(error), 2)
    except (ValueError, HapticError) as error:
        return _complain(str(error), 2)


def _complain(message: str, status: int) -> int:
    """Write exactly one line to standard error and return the exit status."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))
    print(f"hapticrender: {line}", file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="hapticrender",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hapticrender {__version__}")
    parser.set_defaults(run=lambda _: _help(parser))
    verbs = parser.add_subparsers(title="verbs", metavar="VERB")

    demo = _add_verb(verbs, "demo", _demo, "render the built-in scenes and make a page of sounds, pictures and figures")
    _add_out(demo, Path("out/demo"))
    _add_method(demo)

    render = _add_verb(verbs, "render", _render, "render one scene into a folder")
    render.add_argument("scene", metavar="SCENE", help="a TOML file, or the name of a built-in scene")
    _add_out(render, None)
    _add_method(render)
    render.add_argument("--least-model", action="store_true", help="leave out of the model what a scene does not need")

    scenes = _add_verb(
        verbs, "scenes", _scenes, "list the built-in scenes, or print one as TOML to start your own from"
    )
    scenes.add_argument("scene", metavar="NAME", nargs="?", help="the scene to print")

    validate = _add_verb(verbs, "validate", _validate, "render scenes and exit 1 when one misses its tolerance")
    validate.add_argument("scenes", metavar="SCENE", nargs="*", help="TOML files or built-in names (default: all)")
    validate.add_argument(
        "--suite", metavar="NAME", choices=["accuracy"], help="instead of scenes: accuracy, all targets of the library"
    )
    validate.add_argument("--json", metavar="FILE", type=_path, help="write all figures as JSON")
    validate.add_argument("--junit", metavar="FILE", type=_path, help="write the JUnit XML that CI systems read")
    _add_method(validate)

    show = _add_verb(verbs, "show", _show, "print the figures of a recording, finished or cut off by a crash")
    show.add_argument("path", metavar="PATH", type=_path, help="a recording, or the folder of a rendered scene")

    identify = _add_verb(verbs, "identify", _identify, "find what the plate is made of, while no finger is on it")
    identify.add_argument("--out", "-o", metavar="FILE", type=_path, help="write it as the [plant] table of a scene")
    identify.add_argument("--seed", metavar="N", type=_seed, default=0, help="seed of the noise (default: %(default)s)")

    chart = _add_verb(verbs, "chart", _chart, "draw accuracy against cost, stability, or two methods")
    chart.add_argument(
        "name",
        metavar="NAME",
        choices=["pareto", "stability", "story", "devices"],
        help="pareto, stability, story, devices",
    )
    chart.add_argument("--learnt", action="store_true", help="the finger already learnt, not the moment of touch")
    _add_out(chart, Path("out/chart"))

    paper = _add_verb(
        verbs, "paper", _paper, "compute the paper's tables and figures again, those without participants"
    )
    _add_out(paper, Path("out/paper"))

    _add_verb(verbs, "devices", _devices, "list the kinds of device, what each needs, and whether it is there")
    return parser


def _help(parser: argparse.ArgumentParser) -> int:
    """Help whoever came without a verb."""
    parser.print_help()
    return 0


def _add_verb(verbs: Any, name: str, run: Any, text: str) -> argparse.ArgumentParser:
    verb = verbs.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")
    verb.set_defaults(run=run)
    return verb


def _add_out(verb: argparse.ArgumentParser, default: Path | None) -> None:
    text = "folder to write into; made if it is not there" + (f" (default: {default})" if default else "")
    verb.add_argument("--out", "-o", metavar="DIR", type=_path, default=default, required=default is None, help=text)


def _add_method(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--method", metavar="NAME", default=defaults.METHOD, help="control method (default: %(default)s)")
    verb.add_argument("--seed", metavar="N", type=_seed, default=0, help="seed of the noise (default: %(default)s)")


def _path(text: str) -> Path:
    """Read the name of a file or folder; an empty one would silently mean the folder that one stands in."""
    if not text:
        raise argparse.ArgumentTypeError("'': must be a name (a dot is the folder that you are in)")
    return Path(text)


def _seed(text: str) -> int:
    """Read a seed, a whole number >= 0."""
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number from 0 to 10^18 - 1")
    return int(text)


def _demo(arguments: argparse.Namespace) -> int:
    from hapticrender.outputs import run_into
    from hapticrender.touch.builtin import builtin_scenes

    scenes = builtin_scenes()
    for name in scenes:
        _check_folder("--out", arguments.out / name)
    sessions = _prepare(scenes, arguments)
    progress = _progress(sessions)
    finished: list[Outputs] = []
    try:
        for name, session in zip(scenes, sessions, strict=True):
            with progress.scene(name) as tick:
                finished.append(run_into(arguments.out / name, session, progress=tick))
    finally:
        if finished:
            page = _write_page(arguments, finished)
    print(_overview([scene.summary for scene in finished]))
    _hint_at_pictures(finished)
    print(f"page: {page}")
    return 0


def _write_page(arguments: argparse.Namespace, scenes: list[Outputs]) -> Path:
    """Write ``summary.json`` of all scenes and the page about them."""
    from hapticrender.charts.page import write_page
    from hapticrender.validate import as_json

    report = {
        "hapticrender": __version__,
        "method": arguments.method,
        "seed": arguments.seed,
        "scenes": [scene.summary for scene in scenes],
    }
    (arguments.out / "summary.json").write_text(as_json(report), encoding="utf-8")
    return write_page(arguments.out, scenes)


def _render(arguments: argparse.Namespace) -> int:
    from hapticrender.fidelity.choice import fidelity
    from hapticrender.outputs import run_into

    _check_folder("--out", arguments.out)
    scene, used = _scene(arguments.scene), arguments.least_model
    sessions = _prepare({arguments.scene: scene}, arguments)
    with _blaming(arguments.scene):
        found = fidelity(scene)
    if used:
        sessions = _prepare({arguments.scene: found.least}, arguments)
    with _progress(sessions).scene(arguments.scene) as tick:
        outputs = run_into(arguments.out, sessions[0], progress=tick)
    _print_figures(outputs.summary)
    if note := getattr(sessions[0].controller(), "note", ""):
        print(f"\n{note}")
    print(f"\n{found.text(used)}")
    _hint_at_pictures([outputs])
    return 0


def _scenes(arguments: argparse.Namespace) -> int:
    from hapticrender.touch.builtin import builtin_scenes
    from hapticrender.wording import describe, table

    scenes = builtin_scenes()
    if arguments.scene is None:
        print(table([[name, describe(scene)] for name, scene in scenes.items()]))
    elif arguments.scene in scenes:
        print(scenes[arguments.scene].to_toml(), end="")
    else:
        raise ValueError(f"{arguments.scene}: no such built-in scene; there are {', '.join(scenes)}")
    return 0


def _validate(arguments: argparse.Namespace) -> int:
    if arguments.suite:
        return _suite(arguments)
    from hapticrender.touch.builtin import builtin_scenes
    from hapticrender.validate import run_and_judge, write_json, write_junit

    wishes = (("--json", arguments.json, write_json), ("--junit", arguments.junit, write_junit))
    reports = [(path, write) for _, path, write in wishes if path]
    for option, path, _ in wishes:
        if path:
            _check_file(option, path)
    scenes = {reference: _scene(reference) for reference in arguments.scenes or builtin_scenes()}
    sessions = _prepare(scenes, arguments)
    verdicts = run_and_judge(sessions, _progress(sessions))
    for path, write in reports:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, verdicts)
    print(_overview([verdict.summary for verdict in verdicts]))
    return 0 if all(verdict.passed for verdict in verdicts) else 1


def _suite(arguments: argparse.Namespace) -> int:
    """Run the accuracy suite: the chosen method beside the paper's; exit 1 where it misses a bound."""
    from hapticrender.accuracy.figures import as_rows, write_json
    from hapticrender.accuracy.suite import run_suite
    from hapticrender.control.methods import METHODS
    from hapticrender.wording import table

    if arguments.method not in METHODS:
        raise ValueError(f"--method = {arguments.method!r}: must be one of {', '.join(METHODS)}")
    if arguments.scenes or arguments.junit:
        raise ValueError("--suite runs no scenes and writes --json only")
    if arguments.json:
        _check_file("--json", arguments.json)
    methods = list(dict.fromkeys((arguments.method, "paper")))
    figures = run_suite(methods, progress=lambda line: print(line, file=sys.stderr))
    print(table(as_rows(figures, methods)))
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        write_json(arguments.json, figures)
    return 0 if all(figure.passed for figure in figures if figure.method == arguments.method) else 1


def _identify(arguments: argparse.Namespace) -> int:
    from hapticrender.loop import registered
    from hapticrender.plants.identify import MECHANICAL, compare, identify
    from hapticrender.plants.vibrotactile import Plate, PlateParameters
    from hapticrender.touch.finger import Finger
    from hapticrender.touch.toml import dumps

    if arguments.out:
        _check_file("--out", arguments.out)
    believed = PlateParameters()
    with registered("drivers", "simulated")(Plate(believed, Finger.absent(), arguments.seed)) as driver:
        found = identify(driver, believed)
    print(found.text())
    for difference in compare(found, believed):
        print(f"differs from the design: {difference}")
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        plant = {name: getattr(found.parameters, name) for name in (*MECHANICAL, "delay")}
        arguments.out.write_text(dumps({"plant": plant}), encoding="utf-8")
    return 0


def _chart(arguments: argparse.Namespace) -> int:
    _check_folder("--out", arguments.out)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{arguments.name}.png"
    if arguments.name == "story":
        from hapticrender.charts.story import draw_story

        draw_story(path)
    elif arguments.name == "pareto":
        from hapticrender.charts.pareto import pareto

        pareto(path, progress=lambda what: print(what, file=sys.stderr))
    elif arguments.name == "devices":
        from hapticrender.charts.devices import device_chart

        device_chart(path, progress=lambda what: print(what, file=sys.stderr))
    else:
        from hapticrender.charts import stability as chart

        chart.stability(path, adapted=arguments.learnt)
    print(path)
    return 0


def _paper(arguments: argparse.Namespace) -> int:
    from hapticrender.paper.reproduce import reproduce
    from hapticrender.wording import table

    _check_folder("--out", arguments.out)
    found = reproduce(arguments.out, progress=lambda name: print(name, file=sys.stderr))
    print(table(found.rows()))
    if not found.pictures:
        print(PICTURES_HINT)
    print(f"page: {found.page}")
    return 0


def _show(arguments: argparse.Namespace) -> int:
    from hapticrender.recordings.recording import Recording

    path = arguments.path / "recording.au" if arguments.path.is_dir() else arguments.path
    with _blaming(str(path)):
        summary = Recording.load(path).summary()
    _print_figures(summary)
    return 0


def _devices(arguments: argparse.Namespace) -> int:
    from hapticrender.inventory import text

    print(text())
    return 0


def _overview(summaries: list[Any]) -> str:
    from hapticrender.wording import overview

    return overview(summaries)


def _print_figures(summary: Any) -> None:
    from hapticrender.recordings.judge import text
    from hapticrender.wording import conditions

    print(conditions(summary))
    print(text(summary))


def _hint_at_pictures(scenes: list[Outputs]) -> None:
    if not all(scene.picture for scene in scenes):
        print(PICTURES_HINT)


def _scene(reference: str) -> Scene:
    """Read a scene: a built-in one by its name, any other from its file."""
    from hapticrender.touch.builtin import builtin_scenes
    from hapticrender.touch.scene import Scene

    if reference in (scenes := builtin_scenes()):
        return scenes[reference]
    if not Path(reference).exists():
        raise ValueError(f"{reference}: no such file, nor a built-in scene (see `hapticrender scenes`)")
    with _blaming(reference):
        return Scene.from_toml(reference)


def _prepare(scenes: dict[str, Scene], arguments: argparse.Namespace) -> list[Session]:
    """Design all that will run; the renderer refuses here what the device cannot do, before anything is written."""
    from hapticrender.control.methods import METHODS
    from hapticrender.loop import prepare

    if arguments.method not in METHODS:
        raise ValueError(f"--method = {arguments.method!r}: must be one of {', '.join(METHODS)}")
    sessions = []
    for reference, scene in scenes.items():
        with _blaming(reference):
            sessions.append(prepare(scene, method=arguments.method, seed=arguments.seed))
    return sessions


def _progress(sessions: list[Session]) -> Progress:
    from hapticrender.progress import Progress

    return Progress([session.scene.duration for session in sessions])


@contextmanager
def _blaming(where: str) -> Iterator[None]:
    """Name the file, or the scene, in every complaint about it."""
    try:
        yield
    except OSError:
        raise
    except (ValueError, TypeError, ArithmeticError, RecursionError, HapticError) as error:
        message = str(error)
        raise SceneError(message if message.startswith(where) else f"{where}: {message}") from error


def _check_folder(option: str, folder: Path, told: Path | None = None) -> None:
    """Refuse a folder that could not be made or written into, without making it; `told` is what `option` was given."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists() or path.is_symlink())
    given = f"{option} = {str(told or folder)!r}"
    if not nearest.is_dir():
        raise ValueError(f"{given}: {str(nearest)!r} is a file, must be a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"{given}: no permission to write into {str(nearest)!r}")


def _check_file(option: str, path: Path) -> None:
    """Refuse a report file that could not be written."""
    if path.is_dir():
        raise ValueError(f"{option} = {str(path)!r}: is a folder, must be a file")
    if path.exists() and not os.access(path, os.W_OK):
        raise ValueError(f"{option} = {str(path)!r}: no permission to write it")
    _check_folder(option, path.parent, told=path)
