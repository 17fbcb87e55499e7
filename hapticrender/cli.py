"""The command line.

Arguments and scenes are checked before anything is written.  Exit status: 0
done, 1 a scene misses its tolerance (``validate``), 2 bad input, a driver that
failed or no permission to write, 130 interrupted; each error is one line, with
its traceback where Python runs with ``-X dev``.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from hapticrender import __version__, defaults, verbs
from hapticrender.errors import HapticError

_DESCRIPTION = "Render a texture for a finger on a surface, in closed loop, on a device or on a model of one."
_EXAMPLES = """\
start here:
  hapticrender demo                               all built-in scenes; then open out/demo/index.html
  hapticrender scenes                             what is built in
  hapticrender scenes grating-47 > mine.toml      a scene of your own: edit it ...
  hapticrender render mine.toml --out mine        ... and render it

`hapticrender VERB --help` describes each verb.  An error is one line; its traceback: python -X dev -m hapticrender VERB
"""


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are raised like all others: one line, status 2."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (``sys.argv`` by default) and return its exit status."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of small matrices: threads that wait take the other cores
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        arguments = _parser().parse_args(argv)
        method = getattr(arguments, "method", None)
        if method not in (None, *defaults.METHODS):
            raise ValueError(f"--method = {method!r}: must be one of {', '.join(defaults.METHODS)}")
        status = _run(arguments)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader of our output has closed it, as in `hapticrender scenes | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt as error:
        notes = getattr(error, "__notes__", ["what is written so far can be read"])
        return verbs.fail("; ".join(["interrupted", *notes]), 130)
    except (MemoryError, OSError, ValueError, HapticError) as error:
        if sys.flags.dev_mode:
            traceback.print_exception(error)
        return verbs.fail(_line(error), 2)


def _run(arguments: argparse.Namespace) -> int:
    """Run a verb; what ends the program within, other than a signal, is an error, whatever status it gives."""
    try:
        return arguments.run(arguments)  # type: ignore[no-any-return]
    except SystemExit as error:
        from hapticrender.process_signals import Terminated

        if isinstance(error, Terminated):
            raise
        raise HapticError(f"the driver, or what it uses, ended the program: {error!r}") from error


def _line(error: Exception) -> str:
    """What is wrong, for a line on standard error."""
    if isinstance(error, MemoryError):
        return f"not enough memory: {error}"
    named = isinstance(error, OSError) and error.filename
    return f"{error.filename}: {error.strerror}" if named else str(error)  # type: ignore[attr-defined]


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="hapticrender",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hapticrender {__version__}")
    parser.set_defaults(run=lambda _: print(parser.format_help(), end="") or 0)
    choices = parser.add_subparsers(title="verbs", metavar="VERB")
    for add in (_add_players, _add_checks, _add_measurements, _add_lists):
        add(choices)
    return parser


def _add_players(choices: Any) -> None:
    """Add the verbs that play scenes."""
    text = "render the built-in scenes and make a page of sounds, pictures and figures"
    demo = _add_verb(choices, "demo", verbs.demo, text)
    _add_out(demo, default=Path("out/demo"))
    _add_run(demo, driver=False)

    render = _add_verb(choices, "render", verbs.render, "render one scene into a folder")
    _add_scene(render)
    _add_out(render, required=True)
    _add_run(render)
    render.add_argument("--least-model", action="store_true", help="leave out of the model what a scene does not need")
    render.add_argument("--verbose", "-v", action="store_true", help="print all figures and notes on the controller")

    text = "play one scene live until Ctrl-C or its end: a line a band, with target, achieved and flags"
    play = _add_verb(choices, "play", verbs.play, text)
    _add_scene(play)
    play.add_argument("--seconds", metavar="S", type=float, help="how long (default: the scene's duration)")
    _add_out(play)
    _add_run(play)


def _add_checks(choices: Any) -> None:
    """Add the verbs that judge."""
    validate = _add_verb(choices, "validate", verbs.validate, "render scenes and exit 1 when one misses its tolerance")
    validate.epilog = (
        "Exit status: 0 no scene misses its tolerance, 1 one does, 2 one cannot be rendered, or a report not written.  "
        "A scene that cannot be judged is counted, skipped in JUnit, and no pass in JSON."
    )
    validate.add_argument("scenes", metavar="SCENE", nargs="*", help="TOML files or built-in names (default: all)")
    text = "instead of scenes: accuracy, all targets of the library, or the cases with SCENE in their names; "
    text += "--driver module:callable plays those of plates on yours (hapticrender.accuracy.plate.Bench)"
    validate.add_argument("--suite", metavar="NAME", choices=["accuracy"], help=text)
    validate.add_argument("--json", metavar="FILE", type=_path, help="write all figures as JSON; its folder is made")
    text = "write the JUnit XML that CI systems read; its folder is made"
    validate.add_argument("--junit", metavar="FILE", type=_path, help=text)
    text = "folder for the files of each scene that does not pass"
    validate.add_argument("--out", "-o", metavar="DIR", type=_path, help=text)
    validate.add_argument("--jobs", "-j", metavar="N", type=_whole(1, 999), default=1, help="processes (default: 1)")
    validate.add_argument("--strict", action="store_true", help="exit 1 also where a scene is not judged")
    _add_run(validate)

    show = _add_verb(choices, "show", verbs.show, "print the figures of a recording, finished or cut off by a crash")
    show.add_argument("path", metavar="PATH", type=_path, help="a recording, or the folder of a rendered scene")


def _add_measurements(choices: Any) -> None:
    """Add the verbs that measure a device, or the finger on it, and the one that exports a controller."""
    text = "measure the finger in a recording of a plate: load, position, contact, impedance"
    finger = _add_verb(choices, "finger", verbs.finger, text)
    finger.add_argument("path", metavar="PATH", type=_path, help="a recording, or the folder of a rendered scene")
    text = "profile (TOML) of the plate, as identify writes it (default: that of the scene of the recording)"
    finger.add_argument("--profile", metavar="FILE", type=_path, help=text)
    text = "samples of a block of the driver that recorded (default: as the recording says, or 1)"
    finger.add_argument("--block", metavar="N", type=_whole(1, 99999), help=text)
    text = "nothing touches in the first 0.5 s: take the sensors' zero from there (default: they read zero at rest)"
    finger.add_argument("--free-start", action="store_true", help=text)
    _add_out(finger, required=True)

    text = "identify a plate or an ultrasonic surface without a finger, or a screen"
    identify = _add_verb(choices, "identify", verbs.identify, text)
    text = "scene whose [device] is the expected one, and [simulation] the simulated one (default: the paper's plate)"
    identify.add_argument("--scene", metavar="SCENE", help=text)
    text = "of a glass end (default: 100e-6)"
    identify.add_argument("--amplitude", metavar="M", type=float, default=100e-6, help=text)
    identify.add_argument("--seconds", metavar="S", type=float, default=1.0, help="length of the record (default: 1)")
    text = "write the result as a profile (TOML), which a scene takes by device = FILE"
    identify.add_argument("--out", "-o", metavar="FILE", type=_path, help=text)
    identify.add_argument("--name", metavar="TEXT", help="which device it is (default: the file's name)")
    identify.add_argument("--by", metavar="TEXT", default="", help="who measures it")
    _add_run(identify, method=False)

    text = "measure the delay of a loop by a cable from a driver's first output to its first input"
    latency = _add_verb(choices, "latency", verbs.latency, text)
    latency.add_argument("--driver", metavar="NAME[:ARG]", required=True, help="driver of the device, such as audio:0")
    text = "runs, which must agree (default: 5)"
    latency.add_argument("--runs", metavar="N", type=_whole(1, 999), default=5, help=text)
    text = "of the noise, of full scale on a sound card, in A or V elsewhere (default: 0.1)"
    latency.add_argument("--amplitude", metavar="A", type=float, default=0.1, help=text)
    text = "profile (TOML) whose [calibration] gets the delay; made if it is not there"
    latency.add_argument("--out", "-o", metavar="FILE", type=_path, help=text)

    export = _add_verb(choices, "export", verbs.export, "write a scene's controller as C sources for a microcontroller")
    _add_scene(export)
    text = "most bands that the board can be set to (default: 8, or as many as the scene has)"
    export.add_argument("--bands", metavar="N", type=_whole(1, 64), default=0, help=text)
    _add_out(export, required=True)


def _add_lists(choices: Any) -> None:
    """Add the verbs that list."""
    scenes = _add_verb(choices, "scenes", verbs.scenes, "list the built-in scenes, or print one as TOML")
    scenes.add_argument("scene", metavar="NAME", nargs="?", help="the scene to print")
    text = "list kinds of device, drivers, and the cards and ports that are there"
    _add_verb(choices, "devices", verbs.devices, text)


def _add_verb(choices: Any, name: str, run: Any, text: str) -> argparse.ArgumentParser:
    verb = choices.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")
    verb.set_defaults(run=run)
    return verb


def _add_scene(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("scene", metavar="SCENE", help="a TOML file, or the name of a built-in scene")


def _add_out(verb: argparse.ArgumentParser, *, default: Path | None = None, required: bool = False) -> None:
    text = "folder to write into; made if it is not there" + (f" (default: {default})" if default else "")
    verb.add_argument("--out", "-o", metavar="DIR", type=_path, default=default, required=required, help=text)
    verb.add_argument("--force", action="store_true", help="overwrite files that are not from an earlier run")


def _add_run(verb: argparse.ArgumentParser, *, method: bool = True, driver: bool = True) -> None:
    if method:
        text = f"control method: one of {', '.join(defaults.METHODS)} (default: the scene's, or {defaults.METHOD})"
        verb.add_argument("--method", metavar="NAME", help=text)
    if driver:
        text = "simulated (default), wavefile:FILE, module:callable or another; see `hapticrender devices`"
        verb.add_argument("--driver", metavar="NAME[:ARG]", default="simulated", help=text)
    seed = _whole(0, 10**18 - 1)
    verb.add_argument("--seed", metavar="N", type=seed, help="seed of the noise (default: the scene's)")


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
