"""The command line.

Arguments and scenes are checked before anything is written.  Exit status: 0 done, 1 a scene misses its tolerance
(``validate``), 2 bad input, a driver that failed or no permission to write, 130 interrupted; each error is one line,
with its traceback where Python runs with ``-X dev``.
"""

import argparse
import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from hapticrender import __version__, defaults
from hapticrender.errors import HapticError
from hapticrender.formatting import closed_pipes, printable

_DESCRIPTION = "Render a texture for a finger on a surface, in closed loop, on a device or on a model of one."
_EXAMPLES = """\
start here:
  hapticrender demo                               all built-in scenes; then open out/demo/index.html
  hapticrender scenes                             what is built in
  hapticrender scenes grating-47 > mine.toml      a scene of your own: edit it ...
  hapticrender render mine.toml --out mine        ... and render it

`hapticrender VERB --help` describes each verb.  An error is one line; its traceback: python -X dev -m hapticrender VERB
"""
_STATUS = """Exit status: 0 no scene misses its tolerance, 1 one does, 2 one cannot be rendered, or a report is not
written.  A scene that cannot be judged is counted, skipped in JUnit, and no pass in JSON."""
_SUITE = """instead of scenes: accuracy, all targets of the library, or the cases with SCENE in their names; --driver
module:callable plays those of plates on yours (hapticrender.accuracy.plate.Bench)"""
_FREE_START = "nothing touches in the first 0.5 s: take the sensors' zero from there (default: they read zero at rest)"
_EXPECTED = "scene whose [device] is the expected one, and [simulation] the simulated one (default: the paper's plate)"
_FULL_SCALE = "of full scale on a sound card, in A or V elsewhere"


def _option(names: str, value: str, text: str, kind: Any = str, **settings: Any) -> tuple[list[str], dict[str, Any]]:
    """An option by its names, or an argument, and its settings; where its `value` has no name it is a switch."""
    own = {"metavar": value, "type": kind} if value else {"action": "store_true"}
    return names.split(), {"help": text, **own, **settings}


def _path(text: str) -> Path:
    """Read the name of a file or folder; an empty one would silently mean the folder that one stands in."""
    if not text:
        raise argparse.ArgumentTypeError("'': must be a name (a dot is the folder that you are in)")
    return Path(text)


def _whole(least: int, most: int) -> Any:
    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) <= 18 and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number from {least} to {most}")
        return int(text)

    return read


_METHODS = f"one of {', '.join(defaults.METHODS)} (default: the scene's, or {defaults.METHOD})"
_METHOD = _option("--method", "NAME", f"control method: {_METHODS}")
_KINDS = "simulated (default), audio:NAME, serial:PORT, wavefile:FILE, module:callable; see `hapticrender devices`"
_DRIVER = _option("--driver", "NAME[:ARG]", _KINDS, default="simulated")
_SEED = _option("--seed", "N", "seed of the noise (default: the scene's)", _whole(0, 10**18 - 1))
_SCENE = _option("scene", "SCENE", "a TOML file, or the name of a built-in scene")
_RECORDING = _option("path", "PATH", "a recording, or the folder of a rendered scene", _path)
_FOLDER, _DEMO = "folder to write into; made if it is not there", Path("out/demo")
_FORCE = _option("--force", "", "overwrite files that are not from an earlier run")
_OUT = _option("--out -o", "DIR", _FOLDER, _path, required=True)
_VERBS: dict[str, list[Any]] = {  # line of help and options of each; `hapticrender.verbs` has a function of each name
    "demo": [
        "render the built-in scenes and make a page of sounds, pictures and figures",
        _option("--out -o", "DIR", f"{_FOLDER} (default: {_DEMO})", _path, default=_DEMO),
        *(_FORCE, _METHOD, _SEED),
    ],
    "render": [
        "render one scene into a folder",
        *(_SCENE, _OUT, _FORCE, _METHOD, _DRIVER, _SEED),
        _option("--least-model", "", "leave out of the model what a scene does not need"),
        _option("--verbose -v", "", "print all figures and notes on the controller"),
    ],
    "play": [
        "play one scene live until Ctrl-C or its end: a line a band, with target, achieved and flags",
        _SCENE,
        _option("--seconds", "S", "how long (default: the scene's duration)", float),
        _option("--out -o", "DIR", _FOLDER, _path),
        *(_FORCE, _METHOD, _DRIVER, _SEED),
    ],
    "validate": [
        "render scenes and exit 1 when one misses its tolerance",
        _option("scenes", "SCENE", "TOML files or built-in names (default: all)", nargs="*"),
        _option("--suite", "NAME", _SUITE, choices=["accuracy"]),
        _option("--json", "FILE", "write all figures as JSON; its folder is made", _path),
        _option("--junit", "FILE", "write the JUnit XML that CI systems read; its folder is made", _path),
        _option("--out -o", "DIR", "folder for the files of each scene that does not pass", _path),
        _option("--jobs -j", "N", "processes (default: 1)", _whole(1, 999), default=1),
        _option("--strict", "", "exit 1 also where a scene is not judged"),
        *(_METHOD, _DRIVER, _SEED),
    ],
    "show": ["print the figures of a recording, finished or cut off by a crash", _RECORDING],
    "finger": [
        "measure the finger in a recording of a plate: load, position, contact, impedance",
        _RECORDING,
        _option("--profile", "FILE", "profile (TOML) of the plate (default: that of the recording's scene)", _path),
        _option("--block", "N", "samples of the driver's block (default: as recorded, or 1)", _whole(1, 99999)),
        _option("--free-start", "", _FREE_START),
        *(_OUT, _FORCE),
    ],
    "identify": [
        "identify a plate or an ultrasonic surface without a finger, or a screen",
        _option("--scene", "SCENE", _EXPECTED),
        _option("--amplitude", "M", "of a glass end (default: 100e-6)", float, default=100e-6),
        _option("--seconds", "S", "length of the record (default: 1)", float, default=1.0),
        _option("--out -o", "FILE", "write the result as a profile (TOML), for device = FILE in a scene", _path),
        _option("--name", "TEXT", "which device it is (default: the file's name)"),
        _option("--by", "TEXT", "who measures it", default=""),
        *(_DRIVER, _SEED),
    ],
    "latency": [
        "measure the delay of a loop by a cable from a driver's first output to its first input",
        _option("--driver", "NAME[:ARG]", "driver of the device, such as audio:0", required=True),
        _option("--runs", "N", "runs, which must agree (default: 5)", _whole(1, 999), default=5),
        _option("--amplitude", "A", f"of the noise, {_FULL_SCALE} (default: 0.1)", float, default=0.1),
        _option("--out -o", "FILE", "profile (TOML) whose [calibration] gets the delay; made if not there", _path),
    ],
    "export": [
        "write a scene's controller as C sources for a microcontroller",
        _SCENE,
        _option("--bands", "N", "most on the board (default: 8, or the scene's number)", _whole(1, 64), default=0),
        *(_OUT, _FORCE),
    ],
    "scenes": [
        "list the built-in scenes, or print one as TOML",
        _option("scene", "NAME", "the scene to print", nargs="?"),
    ],
    "devices": ["list kinds of device, drivers, and the cards and ports that are there"],
}


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are raised like all others: one line, status 2."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (``sys.argv`` by default) and return its exit status."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of small matrices: threads that wait take the other cores
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed, as by `>&-`
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        arguments = _parser().parse_args(argv)
        method = getattr(arguments, "method", None)
        if method not in (None, *defaults.METHODS):
            raise ValueError(f"--method = {method!r}: must be one of {', '.join(defaults.METHODS)}")
        status = 0
        with closed_pipes():
            status = _run(arguments)
        return status
    except KeyboardInterrupt as error:
        notes = getattr(error, "__notes__", ["what is written so far can be read"])
        return fail("; ".join(["interrupted", *notes]), 130)
    except (MemoryError, OSError, ValueError, HapticError) as error:
        if sys.flags.dev_mode:
            traceback.print_exception(error)
        return fail(_line(error), 2)


def fail(message: str, status: int) -> int:
    """Write exactly one line to standard error and return the exit status."""
    print(f"hapticrender: {printable(' '.join(message.split()))}", file=sys.stderr)
    return status


def _run(arguments: argparse.Namespace) -> int:
    """Run a verb; what ends the program within, other than a signal, is an error, whatever status it gives."""
    if arguments.verb is None:
        _parser().print_help()
        return 0
    try:
        verb = getattr(import_module("hapticrender.verbs"), arguments.verb)  # which takes a second to import
        if "" not in sys.path:  # a driver's module is looked for in the folder that the command is run in, too
            sys.path.insert(0, "")
        return verb(arguments)  # type: ignore[no-any-return]
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
    text = f"{error.filename}: {error.strerror}" if named else str(error)  # type: ignore[attr-defined]
    return "; ".join([text, *getattr(error, "__notes__", ())])


def _parser() -> argparse.ArgumentParser:
    style = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="hapticrender", description=_DESCRIPTION, epilog=_EXAMPLES, formatter_class=style)
    parser.add_argument("--version", action="version", version=f"hapticrender {__version__}")
    choices = parser.add_subparsers(title="verbs", metavar="VERB", dest="verb")
    for name, (text, *options) in _VERBS.items():
        epilog = _STATUS if name == "validate" else None
        verb = choices.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".", epilog=epilog)
        for names, settings in options:
            verb.add_argument(*names, **settings)
    return parser
