"""The verbs of the command line; `hapticrender.cli` reads their arguments."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hapticrender import __version__, defaults
from hapticrender.devices import SIMULATED, imported, naming_driver, open_driver, registered
from hapticrender.devices import text as devices_text
from hapticrender.errors import naming
from hapticrender.formatting import printable, table
from hapticrender.report.text import conditions, describe, figures, overview, verdict

if TYPE_CHECKING:
    from hapticrender.protocols import Rendering
    from hapticrender.recordings.recording import Recording
    from hapticrender.report.outputs import Outputs
    from hapticrender.touch.device_profile import DeviceProfile
    from hapticrender.touch.scene import Scene

LOOK = 0.25  # s between two looks at what plays
PICTURES_HINT = 'no pictures without matplotlib; to get them: pip install "hapticrender[plot]"'


def fail(message: str, status: int) -> int:
    """Write exactly one line to standard error and return the exit status."""
    print(f"hapticrender: {printable(' '.join(message.split()))}", file=sys.stderr)
    return status


def _made(path: Path) -> Path:
    """Return `path`, its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _check_run_folder(folder: Path, arguments: argparse.Namespace, source: Path | None = None) -> None:
    """Refuse a folder that cannot be written, or, without ``--force``, that holds files of others."""
    from hapticrender.report.outputs import check_folder, refuse_to_overwrite

    check_folder("--out", folder)
    if not arguments.force:
        refuse_to_overwrite(folder, source)


def demo(arguments: argparse.Namespace) -> int:
    """Render the built-in scenes and make a page about them."""
    from hapticrender.report import outputs
    from hapticrender.report.page import write_page
    from hapticrender.report.progress import progress
    from hapticrender.touch.builtin_scenes import builtin_scenes

    scenes = builtin_scenes()
    for name in scenes:
        _check_run_folder(arguments.out / name, arguments)
    if not arguments.force:
        outputs.refuse_other_page(arguments.out)
    renderings = _prepare(scenes, arguments)
    finished: list[Outputs] = []
    try:
        for number, (name, rendering) in enumerate(zip(scenes, renderings, strict=True), 1):
            with progress(f"{number}/{len(scenes)} {name}", sys.stderr) as tick:
                finished.append(outputs.run_into(arguments.out / name, rendering, progress=tick))
    finally:
        if finished:
            page = write_page(arguments.out, finished)
    print(printable(table(overview([scene.summary for scene in finished]))))
    print(f"page: {page}")
    return 0


def render(arguments: argparse.Namespace) -> int:
    """Render a scene into a folder."""
    from hapticrender.report.outputs import run_into, written_in
    from hapticrender.report.progress import progress

    scene, notes = _scene(arguments.scene), ""
    _check_run_folder(arguments.out, arguments, Path(arguments.scene))
    with naming(arguments.scene):
        if arguments.least_model:
            from hapticrender.plants.levels import least_model

            found = least_model(scene)
            scene, notes = found.scene, found.text
        driver = _driver(arguments.driver, scene, arguments.force)
    [rendering] = _prepare({arguments.scene: scene}, arguments, driver)
    with progress(f"1/1 {arguments.scene}", sys.stderr) as tick, naming_driver(arguments.driver):
        outputs = run_into(arguments.out, rendering, progress=tick)
    if arguments.verbose:
        _print_figures(outputs.summary)
        notes = "\n".join(filter(None, [getattr(rendering.controller(), "note", ""), notes]))
    else:
        lines = [f"{scene.name} on {scene.device}: {verdict(outputs.summary)}", *outputs.summary["notes"]]
        print(printable("\n".join(lines)))
    _print_written(written_in(arguments.out))
    if notes:
        print(notes)
    return 0


def play(arguments: argparse.Namespace) -> int:
    """Play a scene live, with a line for every band: target, achieved and flags."""
    from hapticrender.checks import number
    from hapticrender.player import Player
    from hapticrender.report import outputs
    from hapticrender.report.page import write_page

    scene, out = _scene(arguments.scene), arguments.out
    changes = {name: getattr(arguments, name) for name in ("method", "seed") if getattr(arguments, name) is not None}
    scene = replace(scene, **changes)
    seconds = number("--seconds", scene.duration if arguments.seconds is None else arguments.seconds, "s", above=0.0)
    if out:
        _check_run_folder(out / scene.name, arguments)
        if not arguments.force:
            outputs.refuse_other_page(out)
    journal, above, second = None, 0, 0
    try:
        with (
            outputs.naming_full(out or ""),
            naming_driver(arguments.driver),
            naming(arguments.scene),
            Player(scene, _driver(arguments.driver, scene, arguments.force)) as player,
        ):
            player.play(scene.texture)
            if out:
                journal = outputs.begin_outputs(out / scene.name, scene)
                player.record(journal)
            while player.time < seconds:
                player.sleep(min(LOOK, seconds - player.time))
                text = printable(str(player.state()))
                if sys.stdout.isatty():  # over the lines before it (ANSI: up, and clear what follows)
                    print((f"\x1b[{above}A\x1b[J" if above else "") + text, flush=True)
                    above = text.count("\n") + 1
                elif player.time >= second:  # in a file or a pipe, once a second
                    print(text, flush=True)
                    second = int(player.time) + 1
    finally:
        if journal is not None and journal.exists():
            made = outputs.write_outputs(out / scene.name, _recording(journal))
            print(f"page: {write_page(out, [made])}")
    return 0


def scenes(arguments: argparse.Namespace) -> int:
    """List the built-in scenes, or print one."""
    from hapticrender.touch.builtin_scenes import builtin_scenes

    scenes = builtin_scenes()
    if arguments.scene is None:
        print(table([[name, describe(scene)] for name, scene in scenes.items()]))
    elif arguments.scene in scenes:
        print(scenes[arguments.scene].to_toml(), end="")
    else:
        raise ValueError(f"{arguments.scene}: no such built-in scene; there are {', '.join(scenes)}")
    return 0


def validate(arguments: argparse.Namespace) -> int:
    """Render scenes, or the accuracy suite; exit status 1 where one misses its tolerance (--strict: is not judged)."""
    if arguments.suite:
        return _suite(arguments)
    from hapticrender.report.outputs import check_file, check_folder
    from hapticrender.touch.builtin_scenes import builtin_scenes
    from hapticrender.validate import counted, exit_status, validate, write_json, write_junit

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
    if rendered := [each.summary for each in verdicts if each.summary]:
        print(printable(table(overview(rendered))))
    print(counted(verdicts), flush=True)
    for each in verdicts:
        if each.verdict == "error":
            fail(str(each), 2)
    status = exit_status(verdicts, strict=arguments.strict)
    for option, path, write in reports:
        try:
            if path:
                write(_made(path), verdicts)
        except OSError as error:  # the other report is written all the same
            status = fail(f"{option} = {str(path)!r}: {error.strerror or error}", 2)
    return status


def _suite(arguments: argparse.Namespace) -> int:
    """Run the accuracy suite; exit status 1 where the chosen method misses a bound.

    On simulated devices "paper" beside it; on plates that a driver's callable makes, their cases alone.
    """
    from hapticrender.accuracy import plate
    from hapticrender.accuracy.suite import CASES, as_rows, run_suite, write_json
    from hapticrender.report.outputs import check_file

    chosen = arguments.method or defaults.METHOD
    if arguments.junit or arguments.out or arguments.jobs > 1:
        raise ValueError("--suite runs in one process, and writes --json only")
    if arguments.json:
        check_file("--json", arguments.json)
    methods, cases, bench = list(dict.fromkeys((chosen, "paper"))), CASES, dict[str, Any]()
    if arguments.driver != SIMULATED:
        methods, cases = [chosen], tuple(case for case in plate.CASES if case != "overload")  # that has its own plate
        bench["make"] = imported(arguments.driver, *arguments.driver.partition(":")[::2])
    if arguments.seed is not None:
        bench["seed"] = arguments.seed
    if arguments.scenes:
        named = {text: [case for case in cases if text in case] for text in arguments.scenes}
        if unknown := [text for text, found in named.items() if not found]:
            raise ValueError(f"{unknown}: must be names of cases, or parts of them; there are {', '.join(cases)}")
        chosen_cases = {case for text, found in named.items() for case in ([text] if text in found else found)}
        cases = tuple(case for case in cases if case in chosen_cases)
    with naming_driver(arguments.driver):
        figures = run_suite(methods, cases, lambda line: print(line, file=sys.stderr), **bench)
    print(table(as_rows(figures, methods)))
    if arguments.json:
        write_json(_made(arguments.json), figures)
    return 0 if all(figure.passed for figure in figures if figure.method == chosen) else 1


def identify(arguments: argparse.Namespace) -> int:
    """Identify a device, and write its profile."""
    from hapticrender.plants.electroadhesion import ElectroadhesionScreen
    from hapticrender.plants.identify import identify
    from hapticrender.plants.identify_friction import identify_resonance, identify_screen
    from hapticrender.plants.plate import Plate
    from hapticrender.plants.ultrasonic import UltrasonicPlate
    from hapticrender.process_signals import stopped_by_signal
    from hapticrender.report.outputs import check_file
    from hapticrender.touch.finger import Finger

    if arguments.out:
        check_file("--out", arguments.out)
    scene = _scene(arguments.scene or "grating-20")  # any on the paper's plate
    found: Any
    with stopped_by_signal(), naming_driver(arguments.driver), naming(arguments.scene or "identify"):
        if scene.device not in ("vt-plate", "ultrasonic", "electroadhesion"):
            raise ValueError(f"device.kind = {scene.device!r}: must be vt-plate, ultrasonic or electroadhesion")
        setup = registered("renderers", scene.device)().read(scene, None)
        seed = scene.seed if arguments.seed is None else arguments.seed
        driver = _driver(arguments.driver, scene)
        if hasattr(driver, "driven_by_host"):  # a board, whose own loop is not what is identified
            driver = driver.driven_by_host()
        simulated = registered("drivers", "simulated")

        def device(plant: Any) -> Any:
            return simulated(plant) if driver is None else driver

        if scene.device == "ultrasonic":
            with device(UltrasonicPlate(setup.simulated.carrier_mode, Finger.absent(), seed)) as opened:
                found = identify_resonance(opened, setup.assumed)
        elif scene.device == "electroadhesion":
            with device(ElectroadhesionScreen(setup.simulated, scene.finger, seed)) as opened:
                found = identify_screen(opened, setup.assumed, scene.finger)
        else:
            with device(Plate(setup.simulated, Finger.absent(), seed)) as opened:
                found = identify(opened, setup.assumed, seconds=arguments.seconds, amplitude=arguments.amplitude)
                found = found.shortened(getattr(driver, "host_delay", 0))
    print(found.text())
    assumed = setup.assumed
    if scene.device == "vt-plate" and driver is not None:  # which states a delay of its own, in its blocks
        assumed = replace(assumed, delay=max(assumed.delay, found.driver_delay))
    for difference in found.differences(assumed) if scene.device == "vt-plate" else ():
        print(f"differs from [device]: {difference}")
    if arguments.out:
        _profile(found, scene, arguments).save(_made(arguments.out))
        print(f"wrote {arguments.out}")
    return 0


def _profile(found: Any, scene: Scene, arguments: argparse.Namespace) -> DeviceProfile:
    """Profile of an identified device; limits, and what else the scene states of the device, are kept."""
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


def finger(arguments: argparse.Namespace) -> int:
    """Analyse the finger in a recording; write tables and pictures, print a summary."""
    from hapticrender.analysis import output, pictures
    from hapticrender.analysis.analyse import analyse_finger
    from hapticrender.report.outputs import check_folder

    check_folder("--out", arguments.out)
    for name in output.FILES:
        if (arguments.out / name).exists() and not arguments.force:
            raise ValueError(f"{str(arguments.out / name)!r}: is there: choose another folder, or add --force")
    recording = _recording(arguments.path)
    with naming(arguments.path):
        found = analyse_finger(recording, arguments.profile, block=arguments.block, free_start=arguments.free_start)
    print(printable(output.text(found)))
    written = [*output.write(found, arguments.out), pictures.draw(found, arguments.out)]
    _print_written(written)
    return 0


def latency(arguments: argparse.Namespace) -> int:
    """Measure the delay of a loop through a cable, or say where it is stated."""
    from hapticrender.latency import measure_latency, write_delay
    from hapticrender.report.outputs import check_file

    if arguments.out:
        check_file("--out", arguments.out)
    driver: Any = open_driver(arguments.driver)
    stated = "in [device] of the scene" if driver is None else ""
    if hasattr(driver, "driven_by_host"):  # the loop runs on a board
        stated = f"by the design of the board: {driver.delay} samples at {driver.rate:g} Hz"
    if stated:
        print(printable(f"{arguments.driver}: nothing is measured or written: the delay is stated {stated}"))
        return 0
    with naming_driver(arguments.driver):
        found = measure_latency(driver, runs=arguments.runs, amplitude=arguments.amplitude)
    print(printable(f"{arguments.driver}: {found}"))
    if arguments.out:
        write_delay(_made(arguments.out), found)
        print(f"wrote {arguments.out}")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write a scene's controller as C sources."""
    from hapticrender.export import export
    from hapticrender.loop import prepare
    from hapticrender.report.outputs import check_folder

    check_folder("--out", arguments.out)
    scene = _scene(arguments.scene)
    with naming(arguments.scene):
        rendering = prepare(scene)
        written = export(rendering, arguments.out, bands=arguments.bands, force=arguments.force)
    command = f"make -C {shlex.quote(str(arguments.out))}"
    print(f"wrote {len(written)} files into {arguments.out}; build them with: {command}")
    return 0


def show(arguments: argparse.Namespace) -> int:
    """Print the figures of a recording."""
    _print_figures(_recording(arguments.path).summary())
    return 0


def devices(arguments: argparse.Namespace) -> int:
    """List what is installed and what is there."""
    print(devices_text())
    return 0


def _print_written(paths: list[Path]) -> None:
    print("wrote " + "\n      ".join(map(str, paths)))


def _print_figures(summary: Any) -> None:
    print(printable(f"{conditions(summary)}\n{figures(summary)}"))


def _recording(path: Path) -> Recording:
    """Load a recording, also from the folder of a rendered scene."""
    from hapticrender.recordings.recording import Recording

    inside = sorted(str(each.parent) for each in path.glob("*/recording.au"))
    path = path / "recording.au" if path.is_dir() else path
    where = f"; there is one in {', '.join(inside)}" if inside else ""
    if not path.exists():
        raise ValueError(f"{path}: no such file{where}")
    with naming(path):
        return Recording.load(path)


def _scene(reference: str) -> Scene:
    """Read a scene: a built-in one by its name, any other from its file."""
    from hapticrender.validate import open_scene

    with naming(reference):
        return open_scene(reference)


def _prepare(scenes: dict[str, Scene], arguments: argparse.Namespace, driver: Any = None) -> list[Rendering]:
    """Design everything that will run, which refuses what a device cannot do; state before it runs what is missing."""
    from hapticrender.loop import prepare

    renderings = []
    for reference, scene in scenes.items():
        with naming(reference):
            renderings.append(prepare(scene, driver=driver, method=arguments.method, seed=arguments.seed))
    if find_spec("matplotlib") is None:
        print(PICTURES_HINT, file=sys.stderr)
    return renderings


def _driver(text: str, scene: Scene, overwrite: bool = False) -> Any:
    """Make the driver of ``--driver``, calibrated as the scene states; None for the simulated device.

    A module of the user's is looked for in the folder that the command is run in, too.
    """
    if "" not in sys.path:
        sys.path.insert(0, "")
    return open_driver(text, scene.device_profile, overwrite)
