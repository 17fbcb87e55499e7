"""The verbs of the command line; `hapticrender.cli` reads their arguments."""

import argparse
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hapticrender import __version__, defaults
from hapticrender import validate as validation
from hapticrender.checks import number, require
from hapticrender.cli import fail
from hapticrender.devices import SIMULATED, imported, naming_driver, open_driver, registered
from hapticrender.devices import text as devices_text
from hapticrender.errors import naming
from hapticrender.export import export as export_design
from hapticrender.formatting import closed_pipes, printable, table
from hapticrender.latency import measure_latency, write_delay
from hapticrender.loop import opened as open_at_rest
from hapticrender.loop import prepare
from hapticrender.player import Player
from hapticrender.protocols import Rendering
from hapticrender.recordings.recording import Recording
from hapticrender.report import outputs
from hapticrender.report.page import write_page
from hapticrender.report.text import conditions, describe, figures, overview, progress, verdict
from hapticrender.touch.builtin_scenes import builtin_scenes
from hapticrender.touch.device_profile import DeviceProfile, table_of
from hapticrender.touch.scene import Scene

LOOK = 0.25  # s between two looks at what plays
PICTURES_HINT = 'no pictures without matplotlib; to get them: pip install "hapticrender[plot]"'


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _check_run_folders(folders: list[Path], arguments: argparse.Namespace, source: Path | None = None) -> None:
    """Refuse folders that cannot be written, or, without ``--force``, that hold files of others, or a page of others.

    The page is in the folder of ``--out``, where `folders` are below it.
    """
    for folder in folders:
        outputs.check_folder("--out", folder)
        if not arguments.force:
            outputs.refuse_to_overwrite(folder, source)
            if folder != arguments.out:
                outputs.refuse_other_page(arguments.out)


def demo(arguments: argparse.Namespace) -> int:
    """Render the built-in scenes and make a page about them."""
    scenes = builtin_scenes(carriers=None if arguments.method in (None, "inverse") else 6)
    _check_run_folders([arguments.out / name for name in scenes], arguments)
    renderings = _prepare(scenes, arguments)
    finished: dict[Path, dict[str, Any]] = {}
    try:
        for number, (name, rendering) in enumerate(zip(scenes, renderings, strict=True), 1):
            with progress(f"{number}/{len(scenes)} {name}", sys.stderr) as tick:
                finished[arguments.out / name] = outputs.run_into(arguments.out / name, rendering, progress=tick)
    finally:
        if finished:
            page = write_page(arguments.out, finished)
    print(printable(table(overview(list(finished.values())))))
    print(f"page: {page}")
    return 0


def render(arguments: argparse.Namespace) -> int:
    """Render a scene into a folder."""
    scene, notes = validation.open_scene(arguments.scene), ""
    _check_run_folders([arguments.out], arguments, Path(arguments.scene))
    with naming(arguments.scene):
        if arguments.least_model:
            from hapticrender.plants.levels import least_model

            found = least_model(scene)
            scene, notes = found.scene, found.text
        driver = open_driver(arguments.driver, scene.device_profile, arguments.force)
    [rendering] = _prepare({arguments.scene: scene}, arguments, driver)
    with progress(f"1/1 {arguments.scene}", sys.stderr) as tick, naming_driver(arguments.driver):
        summary = outputs.run_into(arguments.out, rendering, progress=tick)
    if arguments.verbose:
        _print_figures(summary)
        notes = "\n".join(filter(None, [getattr(rendering.controller(), "note", ""), notes]))
    else:
        print(printable("\n".join([f"{scene.name} on {scene.device}: {verdict(summary)}", *summary["notes"]])))
    _print_written(outputs.written_in(arguments.out))
    if notes:
        print(notes)
    return 0


def play(arguments: argparse.Namespace) -> int:
    """Play a scene live, with a line for every band: target, achieved and flags."""
    scene, out = validation.open_scene(arguments.scene), arguments.out
    changes = {name: getattr(arguments, name) for name in ("method", "seed") if getattr(arguments, name) is not None}
    scene = replace(scene, **changes)
    seconds = number("--seconds", scene.duration if arguments.seconds is None else arguments.seconds, "s", above=0.0)
    if out:
        _check_run_folders([out / scene.name], arguments)
    journal, above, second = None, 0, 0
    try:
        with naming(arguments.scene):
            player = Player(scene, open_driver(arguments.driver, scene.device_profile, arguments.force))
        with outputs.naming_full(out or ""), naming_driver(arguments.driver), player:
            with naming(arguments.scene), naming_driver(arguments.driver, ValueError, TypeError):
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
            made = outputs.write_outputs(journal.parent, _recording(journal))
            print(f"page: {write_page(out, {journal.parent: made})}")
    return 0


def scenes(arguments: argparse.Namespace) -> int:
    """List the built-in scenes, or print one."""
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
    reports = [("--json", arguments.json, validation.write_json), ("--junit", arguments.junit, validation.write_junit)]
    references = arguments.scenes or list(builtin_scenes())
    for option, path, _ in reports:
        if path:
            outputs.check_file(option, path)
            if path.exists() and any(Path(other).exists() and path.samefile(other) for other in references):
                raise ValueError(f"{option} = {str(path)!r}: is a scene, must be another file")
    if arguments.json and arguments.junit and arguments.json.resolve() == arguments.junit.resolve():
        raise ValueError(f"--json, --junit = {str(arguments.json)!r}: must be two files")
    if arguments.out:
        outputs.check_folder("--out", arguments.out)
    options = {name: getattr(arguments, name) for name in ("method", "seed", "jobs", "out", "driver")}
    verdicts = validation.validate(references, **options, progress=sys.stderr)
    status = validation.exit_status(verdicts, strict=arguments.strict)
    for option, path, write in reports:
        try:
            if path:
                write(_made(path), verdicts)
        except OSError as error:  # the other report is written all the same
            status = fail(f"{option} = {str(path)!r}: {error.strerror or error}", 2)
    with closed_pipes():
        if rendered := [each.summary for each in verdicts if each.summary]:
            print(printable(table(overview(rendered))))
        print(validation.counted(verdicts), flush=True)
        for each in verdicts:
            if each.verdict == "error":
                fail(str(each), 2)
    return status


def _suite(arguments: argparse.Namespace) -> int:
    """Run the accuracy suite; exit status 1 where the chosen method misses a bound.

    On simulated devices "paper" beside it; on plates that a driver's callable makes, their cases alone.
    """
    from hapticrender.accuracy import plate
    from hapticrender.accuracy.suite import CASES, as_rows, run_suite, write_json

    chosen = arguments.method or defaults.METHOD
    if arguments.junit or arguments.out or arguments.jobs > 1:
        raise ValueError("--suite runs in one process, and writes --json only")
    if arguments.json:
        outputs.check_file("--json", arguments.json)
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
    if arguments.json:
        write_json(_made(arguments.json), figures)
    with closed_pipes():
        print(table(as_rows(figures, methods)))
    return 0 if all(figure.passed for figure in figures if figure.method == chosen) else 1


def identify(arguments: argparse.Namespace) -> int:
    """Identify a device, and write its profile."""
    from hapticrender.plants.electroadhesion import ElectroadhesionScreen
    from hapticrender.plants.identify import identify
    from hapticrender.plants.identify_friction import identify_resonance, identify_screen
    from hapticrender.plants.plate import Plate
    from hapticrender.plants.ultrasonic import UltrasonicPlate
    from hapticrender.process_signals import stopped_by_signal
    from hapticrender.touch.finger import Finger

    scene = validation.open_scene(arguments.scene or "grating-20")  # any on the paper's plate
    if arguments.out:
        outputs.check_file("--out", arguments.out)
        scene = _kept(arguments.out, scene)
    found: Any
    named = naming(arguments.scene or "identify"), naming_driver(arguments.driver, ValueError, TypeError)
    with stopped_by_signal(), named[0], named[1]:
        known = scene.device in ("vt-plate", "ultrasonic", "electroadhesion")
        require(known, "device.kind", scene.device, "vt-plate, ultrasonic or electroadhesion")
        setup = registered("renderers", scene.device)().read(scene, None)
        seed = scene.seed if arguments.seed is None else arguments.seed
        driver = open_driver(arguments.driver, scene.device_profile)
        plants: dict[str, Callable[[], Any]] = {
            "vt-plate": lambda: Plate(setup.simulated, Finger.absent(), seed),
            "ultrasonic": lambda: UltrasonicPlate(setup.simulated.carrier_mode, Finger.absent(), seed),
            "electroadhesion": lambda: ElectroadhesionScreen(setup.simulated, scene.finger, seed),
        }
        device = registered("drivers", "simulated")(plants[scene.device]()) if driver is None else driver
        with open_at_rest(device, device) as opened:
            if scene.device == "ultrasonic":
                found = identify_resonance(opened, setup.assumed)
            elif scene.device == "electroadhesion":
                found = identify_screen(opened, setup.assumed, scene.finger)
            else:
                options = {"amplitude": arguments.amplitude, "limits": scene.device_profile.limits}
                found = identify(opened, setup.assumed, seconds=arguments.seconds, **options)
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


def _kept(path: Path, scene: Scene) -> Scene:
    """Take into a scene the limits and the calibration of the profile at `path`, if there is one."""
    if not path.is_file():
        return scene
    there = DeviceProfile.load(path)
    if there.kind != scene.device:
        raise ValueError(f"--out = {str(path)!r}: is the profile of a {there.kind}, must be that of a {scene.device}")
    limits, calibration = table_of(there.limits), table_of(there.calibration)
    return replace(scene, limits={**scene.limits, **limits}, calibration={**scene.calibration, **calibration})


def _profile(found: Any, scene: Scene, arguments: argparse.Namespace) -> DeviceProfile:
    """Profile of an identified device; limits, and what else the scene states of the device, are kept."""
    own, device = scene.device_profile, found.profile()
    uncertainty = {name: value for name, value in found.uncertainty().items() if name in device}
    tool = f"hapticrender {__version__} identify, driver {arguments.driver}"
    origin = {"measured_by": arguments.by, "measured_with": tool, "measured_on": date.today()}
    name, device = arguments.name or arguments.out.stem, {**own.device, **device}
    return replace(own, name=name, device=device, uncertainty=uncertainty, **origin)


def finger(arguments: argparse.Namespace) -> int:
    """Analyse the finger in a recording; write tables and pictures, print a summary."""
    from hapticrender.analysis import output, pictures
    from hapticrender.analysis.analyse import analyse_finger

    outputs.check_folder("--out", arguments.out)
    for path in [] if arguments.force else [arguments.out / name for name in output.FILES]:
        if path.exists():
            raise ValueError(f"{str(path)!r}: is there: choose another folder, or add --force")
    recording = _recording(arguments.path)
    with naming(arguments.path):
        found = analyse_finger(recording, arguments.profile, block=arguments.block, free_start=arguments.free_start)
    written = [*output.write(found, arguments.out), pictures.draw(found, arguments.out)]
    print(printable(output.text(found)))
    _print_written(written)
    return 0


def latency(arguments: argparse.Namespace) -> int:
    """Measure the delay of a loop through a cable, or say where it is stated."""
    if arguments.out:
        outputs.check_file("--out", arguments.out)
    driver: Any = open_driver(arguments.driver)
    stated = "in [device] of the scene" if driver is None else ""
    if hasattr(driver, "by_host"):  # the loop runs on a board
        stated = f"by the design of the board: {driver.delay} samples at {driver.rate:g} Hz"
    if stated:
        print(printable(f"{arguments.driver}: nothing is measured or written: the delay is stated {stated}"))
        return 0
    with naming_driver(arguments.driver):
        found = measure_latency(driver, runs=arguments.runs, amplitude=arguments.amplitude)
    print(printable(f"{arguments.driver}: {found}"))
    if arguments.out:
        setting = f"{found.rate:g} Hz in blocks of {found.block}"
        tool = f"hapticrender {__version__} latency, driver {arguments.driver}, {setting}"
        write_delay(_made(arguments.out), found, tool)
        print(f"wrote {arguments.out}")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write a scene's controller as C sources."""
    outputs.check_folder("--out", arguments.out)
    scene = validation.open_scene(arguments.scene)
    with naming(arguments.scene):
        rendering = prepare(scene, compiled=False)
        written = export_design(rendering, arguments.out, bands=arguments.bands, force=arguments.force)
    folder = shlex.quote(str(arguments.out))
    print(f"wrote {len(written)} files into {arguments.out}; build them with: make -C {folder}")
    if rendering.shape is not None and rendering.driver.sensed_channels:
        print(
            "in open loop, as a board reads no tribometer; in closed loop play it from the host (--driver audio:NAME)"
        )
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
    inside = sorted(str(each.parent) for each in path.glob("*/recording.au"))
    path = path / "recording.au" if path.is_dir() else path
    where = f"; there is one in {', '.join(inside)}" if inside else ""
    if not path.exists():
        raise ValueError(f"{path}: no such file{where}")
    with naming(path):
        return Recording.load(path)


def _prepare(scenes: dict[str, Scene], arguments: argparse.Namespace, driver: Any = None) -> list[Rendering]:
    """Design everything that will run, which refuses what a device cannot do; state before it runs what is missing."""
    renderings = []
    for reference, scene in scenes.items():
        with naming(reference):
            renderings.append(prepare(scene, driver=driver, method=arguments.method, seed=arguments.seed))
    if find_spec("matplotlib") is None:
        print(PICTURES_HINT, file=sys.stderr)
    return renderings
