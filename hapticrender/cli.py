"""The command line.

Arguments and scenes are checked before anything is written.  Exit status: 0
done, 1 a scene misses its tolerance (``validate``), 2 bad input or no
permission to write, 130 interrupted; each error is one line.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from hapticrender import __version__, defaults
from hapticrender.errors import HapticError, SceneError
from hapticrender.formatting import printable

if TYPE_CHECKING:
    from hapticrender.protocols import Rendering
    from hapticrender.report.outputs import Outputs
    from hapticrender.report.progress import Progress
    from hapticrender.touch.device_profile import DeviceProfile
    from hapticrender.touch.scene import Scene

LOOK = 0.25  # s between two looks at what plays
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
    """An argument parser whose errors are raised like all others: one line, status 2."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (``sys.argv`` by default) and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        arguments = _parser().parse_args(argv)
        method = getattr(arguments, "method", None)
        if method not in (None, *defaults.METHODS):
            raise ValueError(f"--method = {method!r}: must be one of {', '.join(defaults.METHODS)}")
        status = arguments.run(arguments)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader of our output has closed it, as in `hapticrender scenes | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return _fail("interrupted; what is written so far can be read", 130)
    except MemoryError as error:
        return _fail(f"not enough memory: {error}", 2)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), 2)
    except (ValueError, HapticError) as error:
        return _fail(str(error), 2)


def _fail(message: str, status: int) -> int:
    """Write exactly one line to standard error and return the exit status."""
    print(f"hapticrender: {printable(' '.join(message.split()))}", file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="hapticrender",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hapticrender {__version__}")
    parser.set_defaults(run=lambda _: print(parser.format_help(), end="") or 0)
    verbs = parser.add_subparsers(title="verbs", metavar="VERB")

    demo = _add_verb(verbs, "demo", _demo, "render the built-in scenes and make a page of sounds, pictures and figures")
    _add_out(demo, Path("out/demo"))
    _add_run(demo)

    render = _add_verb(verbs, "render", _render, "render one scene into a folder")
    render.add_argument("scene", metavar="SCENE", help="a TOML file, or the name of a built-in scene")
    _add_out(render, None)
    _add_run(render, driver=True)
    render.add_argument("--least-model", action="store_true", help="leave out of the model what a scene does not need")
    render.add_argument("--verbose", "-v", action="store_true", help="print all figures and notes on the controller")

    text = "play one scene live until Ctrl-C or its end: a line a band, with target, achieved and flags"
    play = _add_verb(verbs, "play", _play, text)
    play.add_argument("scene", metavar="SCENE", help="a TOML file, or the name of a built-in scene")
    play.add_argument("--seconds", metavar="S", type=float, help="how long (default: the scene's duration)")
    text = "folder for sound, picture, figures, journal and a page about it; made if it is not there"
    play.add_argument("--out", "-o", metavar="DIR", type=_path, help=text)
    play.add_argument("--force", action="store_true", help="overwrite files that are not from an earlier run")
    _add_run(play, driver=True)

    scenes = _add_verb(verbs, "scenes", _scenes, "list the built-in scenes, or print one as TOML")
    scenes.add_argument("scene", metavar="NAME", nargs="?", help="the scene to print")

    validate = _add_verb(verbs, "validate", _validate, "render scenes and exit 1 when one misses its tolerance")
    validate.add_argument("scenes", metavar="SCENE", nargs="*", help="TOML files or built-in names (default: all)")
    validate.add_argument(
        "--suite", metavar="NAME", choices=["accuracy"], help="instead of scenes: accuracy, all targets of the library"
    )
    validate.add_argument("--json", metavar="FILE", type=_path, help="write all figures as JSON")
    validate.add_argument("--junit", metavar="FILE", type=_path, help="write the JUnit XML that CI systems read")
    text = "folder for the files of each scene that does not pass"
    validate.add_argument("--out", "-o", metavar="DIR", type=_path, help=text)
    validate.add_argument("--jobs", "-j", metavar="N", type=_whole(1, 999), default=1, help="processes (default: 1)")
    _add_run(validate, driver=True)

    show = _add_verb(verbs, "show", _show, "print the figures of a recording, finished or cut off by a crash")
    show.add_argument("path", metavar="PATH", type=_path, help="a recording, or the folder of a rendered scene")

    identify = _add_verb(
        verbs, "identify", _identify, "identify a plate or an ultrasonic surface without a finger, or a screen"
    )
    text = "scene whose [device] is the expected one, and [simulation] the simulated one (default: the paper's plate)"
    identify.add_argument("--scene", metavar="SCENE", help=text)
    text = "of a glass end (default: 100e-6)"
    identify.add_argument("--amplitude", metavar="M", type=float, default=100e-6, help=text)
    identify.add_argument("--seconds", metavar="S", type=float, default=1.0, help="length of the record (default: 1)")
    text = "write the result as a profile (TOML), which a scene takes by device = FILE"
    identify.add_argument("--out", "-o", metavar="FILE", type=_path, help=text)
    identify.add_argument("--name", metavar="TEXT", help="which device it is (default: the file's name)")
    identify.add_argument("--by", metavar="TEXT", default="", help="who measures it")
    _add_run(identify, method=False, driver=True)

    latency = _add_verb(
        verbs,
        "latency",
        _latency,
        "measure the delay of a loop by a cable from a driver's first output to its first input",
    )
    latency.add_argument("--driver", metavar="NAME[:ARG]", required=True, help="driver of the device, such as audio:0")
    latency.add_argument(
        "--runs", metavar="N", type=_whole(1, 999), default=5, help="runs, which must agree (default: 5)"
    )
    text = "of the noise, of full scale on a sound card, in A or V elsewhere (default: 0.1)"
    latency.add_argument("--amplitude", metavar="A", type=float, default=0.1, help=text)
    text = "profile (TOML) whose [calibration] gets the delay; made if it is not there"
    latency.add_argument("--out", "-o", metavar="FILE", type=_path, help=text)

    export = _add_verb(verbs, "export", _export, "write a scene's controller as C sources for a microcontroller")
    export.add_argument("scene", metavar="SCENE", help="a TOML file, or the name of a built-in scene")
    text = "most bands that the board can be set to (default: 8, or as many as the scene has)"
    export.add_argument("--bands", metavar="N", type=_whole(1, 64), default=0, help=text)
    _add_out(export, None)

    _add_verb(verbs, "devices", _devices, "list kinds of device, drivers, and the cards and ports that are there")
    return parser


def _add_verb(verbs: Any, name: str, run: Any, text: str) -> argparse.ArgumentParser:
    verb = verbs.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")
    verb.set_defaults(run=run)
    return verb


def _add_out(verb: argparse.ArgumentParser, default: Path | None) -> None:
    text = "folder to write into; made if it is not there" + (f" (default: {default})" if default else "")
    verb.add_argument("--out", "-o", metavar="DIR", type=_path, default=default, required=default is None, help=text)
    verb.add_argument("--force", action="store_true", help="overwrite files that are not from an earlier run")


def _add_run(verb: argparse.ArgumentParser, *, method: bool = True, driver: bool = False) -> None:
    if method:
        text = f"control method: one of {', '.join(defaults.METHODS)} (default: the scene's, or {defaults.METHOD})"
        verb.add_argument("--method", metavar="NAME", help=text)
    if driver:
        text = "simulated (default), wavefile:FILE, module:callable or another; see `hapticrender devices`"
        verb.add_argument("--driver", metavar="NAME[:ARG]", default="simulated", help=text)
    seed = _whole(0, 10**18 - 1)
    verb.add_argument("--seed", metavar="N", type=seed, help="seed of the noise (default: the scene's)")


def _made(path: Path) -> Path:
    """Return `path`, its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _path(text: str) -> Path:
    """Read the name of a file or folder; an empty one would silently mean the folder that one stands in."""
    if not text:
        raise argparse.ArgumentTypeError("'': must be a name (a dot is the folder that you are in)")
    return Path(text)


def _whole(least: int, most: int) -> Any:
    """Reader of a whole number from `least` to `most`."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) <= 18 and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number from {least} to {most}")
        return int(text)

    return read


def _demo(arguments: argparse.Namespace) -> int:
    from hapticrender.report import outputs
    from hapticrender.report.page import refuse_foreign_page, write_page
    from hapticrender.report.text import overview
    from hapticrender.touch.builtin_scenes import builtin_scenes

    scenes = builtin_scenes()
    for name in scenes:
        outputs.check_folder("--out", arguments.out / name)
        if not arguments.force:
            outputs.refuse_to_overwrite(arguments.out / name)
            refuse_foreign_page(arguments.out)
    renderings = _prepare(scenes, arguments)
    progress = _progress(renderings)
    finished: list[Outputs] = []
    try:
        for name, rendering in zip(scenes, renderings, strict=True):
            with progress.scene(name) as tick:
                finished.append(outputs.run_into(arguments.out / name, rendering, progress=tick))
    finally:
        if finished:
            page = write_page(arguments.out, finished)
    print(printable(overview([scene.summary for scene in finished])))
    print(f"page: {page}")
    return 0


def _render(arguments: argparse.Namespace) -> int:
    from hapticrender.report.outputs import check_folder, refuse_to_overwrite, run_into
    from hapticrender.report.text import verdict

    check_folder("--out", arguments.out)
    scene = _scene(arguments.scene)
    if not arguments.force:
        refuse_to_overwrite(arguments.out, Path(arguments.scene))
    notes = ""
    if arguments.least_model:
        from hapticrender.plants.levels import least_model

        with _naming(arguments.scene):
            found = least_model(scene)
        scene, notes = found.scene, found.text
    with _naming(arguments.scene):
        driver = _driver(arguments.driver, scene)
    [rendering] = renderings = _prepare({arguments.scene: scene}, arguments, driver)
    with _progress(renderings).scene(arguments.scene) as tick:
        outputs = run_into(arguments.out, rendering, progress=tick)
    if arguments.verbose:
        _print_figures(outputs.summary)
        notes = "\n".join(filter(None, [getattr(rendering.controller(), "note", ""), notes]))
    else:
        lines = [f"{scene.name} on {scene.device}: {verdict(outputs.summary)}", *outputs.summary["notes"]]
        print(printable("\n".join(lines)))
    print("wrote " + "\n      ".join(map(str, outputs.files)))
    if notes:
        print(notes)
    return 0


def _play(arguments: argparse.Namespace) -> int:
    from dataclasses import replace

    from hapticrender.player import Player
    from hapticrender.report import outputs
    from hapticrender.report.live_lines import LiveLines
    from hapticrender.report.page import refuse_foreign_page, write_page

    scene, out = _scene(arguments.scene), arguments.out
    changes = {name: getattr(arguments, name) for name in ("method", "seed") if getattr(arguments, name) is not None}
    scene = replace(scene, **changes)
    seconds = scene.duration if arguments.seconds is None else arguments.seconds
    if not 0.0 < seconds < float("inf"):
        raise ValueError(f"--seconds = {seconds}: must be finite and > 0 s")
    if out:
        outputs.check_folder("--out", out / scene.name)
        if not arguments.force:
            outputs.refuse_to_overwrite(out / scene.name)
            refuse_foreign_page(out)
    lines, journal = LiveLines(sys.stdout), None
    try:
        with _naming(arguments.scene), Player(scene, _driver(arguments.driver, scene)) as player:
            player.play(scene.texture)
            if out:
                journal = outputs.begin_outputs(out / scene.name, scene)
                player.record(journal)
            while player.time < seconds:
                player.sleep(min(LOOK, seconds - player.time))
                lines.show(printable(str(player.state())), int(player.time))
    finally:
        if journal is not None and journal.exists():
            from hapticrender.recordings.recording import Recording

            made = outputs.write_outputs(out / scene.name, Recording.load(journal))
            print(f"page: {write_page(out, [made])}")
    return 0


def _scenes(arguments: argparse.Namespace) -> int:
    from hapticrender.formatting import table
    from hapticrender.report.text import describe
    from hapticrender.touch.builtin_scenes import builtin_scenes

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
    from hapticrender.report.outputs import check_file, check_folder
    from hapticrender.report.text import overview
    from hapticrender.touch.builtin_scenes import builtin_scenes
    from hapticrender.validate import exit_status, validate, write_json, write_junit

    reports = [("--json", arguments.json, write_json), ("--junit", arguments.junit, write_junit)]
    references = arguments.scenes or list(builtin_scenes())
    for option, path, _ in reports:
        if path:
            check_file(option, path)
            if path.exists() and any(Path(other).exists() and path.samefile(other) for other in references):
                raise ValueError(f"{option} = {str(path)!r}: is a scene, must be another file")
    if arguments.out:
        check_folder("--out", arguments.out)
    options = {"method": arguments.method, "seed": arguments.seed, "jobs": arguments.jobs, "out": arguments.out}
    options["driver"] = arguments.driver
    verdicts = validate(references, **options, progress=sys.stderr)
    for _, path, write in reports:
        if path:
            write(_made(path), verdicts)
    if rendered := [verdict.summary for verdict in verdicts if verdict.summary]:
        print(printable(overview(rendered)))
    for verdict in verdicts:
        if verdict.verdict == "error":
            _fail(str(verdict), 2)
    return exit_status(verdicts)


def _suite(arguments: argparse.Namespace) -> int:
    """Run the accuracy suite with the chosen method and with "paper"; exit status 1 where it misses a bound."""
    from hapticrender.accuracy.figures import as_rows, write_json
    from hapticrender.accuracy.suite import run_suite
    from hapticrender.formatting import table
    from hapticrender.report.outputs import check_file

    chosen = arguments.method or defaults.METHOD
    simulated = arguments.driver == "simulated"
    if arguments.scenes or arguments.junit or arguments.out or arguments.jobs > 1 or not simulated:
        raise ValueError("--suite runs no scenes, on simulated devices, and writes --json only")
    if arguments.json:
        check_file("--json", arguments.json)
    methods = list(dict.fromkeys((chosen, "paper")))
    figures = run_suite(methods, progress=lambda line: print(line, file=sys.stderr))
    print(table(as_rows(figures, methods)))
    if arguments.json:
        write_json(_made(arguments.json), figures)
    return 0 if all(figure.passed for figure in figures if figure.method == chosen) else 1


def _identify(arguments: argparse.Namespace) -> int:
    from hapticrender.loop import registered
    from hapticrender.plants.electroadhesion import ElectroadhesionScreen
    from hapticrender.plants.identify import identify
    from hapticrender.plants.identify_friction import identify_resonance, identify_screen
    from hapticrender.plants.plate import Plate
    from hapticrender.plants.ultrasonic import UltrasonicPlate
    from hapticrender.report.outputs import check_file
    from hapticrender.touch.finger import Finger

    if arguments.out:
        check_file("--out", arguments.out)
    scene = _scene(arguments.scene or "grating-20")  # any on the paper's plate
    found: Any
    with _naming(arguments.scene or "identify"):
        if scene.device not in ("vt-plate", "ultrasonic", "electroadhesion"):
            raise ValueError(f"device.kind = {scene.device!r}: must be vt-plate, ultrasonic or electroadhesion")
        setup = registered("renderers", scene.device)().read(scene, None)
        seed = scene.seed if arguments.seed is None else arguments.seed
        driver = _driver(arguments.driver, scene)
        if driver is None:
            plants = {
                "vt-plate": lambda: Plate(setup.simulated, Finger.absent(), seed),
                "ultrasonic": lambda: UltrasonicPlate(setup.simulated.carrier_mode, Finger.absent(), seed),
                "electroadhesion": lambda: ElectroadhesionScreen(setup.simulated, scene.finger, seed),
            }
            driver = registered("drivers", "simulated")(plants[scene.device]())
        with driver:
            if scene.device == "ultrasonic":
                found = identify_resonance(driver, setup.assumed)
            elif scene.device == "electroadhesion":
                found = identify_screen(driver, setup.assumed, scene.finger)
            else:
                found = identify(driver, setup.assumed, seconds=arguments.seconds, amplitude=arguments.amplitude)
    print(found.text())
    for difference in found.differences(setup.assumed) if scene.device == "vt-plate" else ():
        print(f"differs from [device]: {difference}")
    if arguments.out:
        _profile(found, scene, arguments).save(_made(arguments.out))
        print(f"wrote {arguments.out}")
    return 0


def _profile(found: Any, scene: Scene, arguments: argparse.Namespace) -> DeviceProfile:
    """Profile of an identified device; limits, and what else the scene says of the device, are kept."""
    from datetime import date

    own, device = scene.device_profile, found.profile()
    uncertainty = {name: value for name, value in found.uncertainty().items() if name in device}
    return replace(
        own,
        name=arguments.name or arguments.out.stem,
        measured_by=arguments.by,
        measured_with=f"hapticrender {__version__} identify, driver {arguments.driver}",
        measured_on=date.today(),
        device={**own.device, **device},
        uncertainty=uncertainty,
    )


def _latency(arguments: argparse.Namespace) -> int:
    from hapticrender.devices import open_driver
    from hapticrender.latency import measure_latency, write_delay
    from hapticrender.report.outputs import check_file

    if arguments.out:
        check_file("--out", arguments.out)
    driver = open_driver(arguments.driver)
    if driver is None:
        raise ValueError("--driver = 'simulated': must be a device with a cable, such as audio:0")
    found = measure_latency(driver, runs=arguments.runs, amplitude=arguments.amplitude)
    print(printable(f"{arguments.driver}: {found}"))
    if arguments.out:
        write_delay(_made(arguments.out), found)
        print(f"wrote {arguments.out}")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from hapticrender.export import export
    from hapticrender.loop import prepare
    from hapticrender.report.outputs import check_folder

    check_folder("--out", arguments.out)
    scene = _scene(arguments.scene)
    with _naming(arguments.scene):
        rendering = prepare(scene)
        written = export(rendering, arguments.out, bands=arguments.bands, force=arguments.force)
    print(f"wrote {len(written)} files into {arguments.out}; build them with: make -C {arguments.out}")
    return 0


def _show(arguments: argparse.Namespace) -> int:
    from hapticrender.recordings.recording import Recording

    path = arguments.path / "recording.au" if arguments.path.is_dir() else arguments.path
    with _naming(str(path)):
        summary = Recording.load(path).summary()
    _print_figures(summary)
    return 0


def _devices(arguments: argparse.Namespace) -> int:
    from hapticrender.devices import text

    print(text())
    return 0


def _print_figures(summary: Any) -> None:
    from hapticrender.report.text import conditions, figures

    print(printable(f"{conditions(summary)}\n{figures(summary)}"))


def _scene(reference: str) -> Scene:
    """Read a scene: a built-in one by its name, any other from its file."""
    from hapticrender.validate import open_scene

    with _naming(reference):
        return open_scene(reference)


def _prepare(scenes: dict[str, Scene], arguments: argparse.Namespace, driver: Any = None) -> list[Rendering]:
    """Design everything that will run; the renderer refuses here what the device cannot do."""
    from hapticrender.loop import prepare

    renderings = []
    for reference, scene in scenes.items():
        with _naming(reference):
            renderings.append(prepare(scene, driver=driver, method=arguments.method, seed=arguments.seed))
    return renderings


def _driver(text: str, scene: Scene) -> Any:
    """Make the driver of ``--driver``, calibrated as the scene says; None for the simulated device.

    A module of the user's is looked for in the folder that the command is run in, too.
    """
    from hapticrender.devices import open_driver

    if "" not in sys.path:
        sys.path.insert(0, "")
    return open_driver(text, scene.device_profile)


def _progress(renderings: list[Rendering]) -> Progress:
    """Make the progress bar of what will run, and say before it runs that there will be no pictures."""
    from hapticrender.report.progress import Progress

    if find_spec("matplotlib") is None:
        print(PICTURES_HINT, file=sys.stderr)
    return Progress([rendering.scene.duration for rendering in renderings])


@contextmanager
def _naming(where: str) -> Iterator[None]:
    """Name the file, or the scene, in every error about it."""
    try:
        yield
    except OSError:
        raise
    except (ValueError, TypeError, ArithmeticError, RecursionError, HapticError) as error:
        message = str(error)
        raise SceneError(message if message.startswith(where) else f"{where}: {message}") from error
