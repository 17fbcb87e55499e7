"""The law and the board on a real Cortex-M4, emulated by QEMU."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from board import FIRMWARE, ROOT, SOURCES, compile_c
from laws import FINGERS, PARTS, RATE

import hapticrender as hr
from hapticrender.export import export

SCREEN = "electroadhesion"
CROSS, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
M4 = "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16"
SIZE = '#include <stdio.h>\n#include "law.h"\nint main(void) { return printf("%zu", sizeof(law_t)) < 0; }\n'
COUNTS = ("nops", "free", "new", "touched", "most", "textures", "frame")
NOISE = 0.7e-6 * np.sqrt(4 * np.pi * 10.0 / RATE)  # m: mean of two sensors, times the root of the observer's gain


def cross_tools():
    missing = [tool for tool in (CROSS, QEMU) if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"no {' and no '.join(missing)} here: make packages installs them (gcc-arm-none-eabi, ...)")


def built(folder, rendering, target, *options):
    cross_tools()
    export(rendering, folder, force=True)
    subprocess.run(["make", "-s", "-C", folder, target, *options], check=True)
    return folder / target


def m4_symbols(folder, *options):
    """Words that `nm` prints of every symbol of the portable objects in a folder: all that `make` builds."""
    cross_tools()
    subprocess.run(["make", "-s", "-C", folder, f"CC={CROSS} {M4}"], check=True)
    command = [CROSS.replace("gcc", "nm"), *options, *sorted(path.name for path in folder.glob("*.o"))]
    symbols = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    return [line.split() for line in symbols.splitlines() if " " in line]


def test_law_and_board_need_no_heap_no_output_and_no_double_on_a_cortex_m4(exports, tmp_path):
    """All that they ask of a C library; double arithmetic would be functions of its own there."""
    export(exports.rendering("tones"), tmp_path)
    listed = m4_symbols(tmp_path, "-g")
    assert {path.stem for path in tmp_path.glob("*.o")} == {*PARTS, *SOURCES} - {"plate", "hardware_posix"}
    defined = {words[-1] for words in listed if len(words) == 3}
    asked = {words[-1] for words in listed if len(words) == 2 and words[0] == "U"}
    hardware = set(re.findall(r"\bhardware_\w+", (FIRMWARE / "hardware.h").read_text(encoding="utf-8")))
    assert asked - defined - hardware <= {"memcpy", "memmove", "memset", "rintf", "sqrtf", "cosf"}


@pytest.mark.parametrize(
    ("device", "bands"),
    [({}, 8), ({}, 9), ({}, 64), ({"coils": 1}, 9), ({"delay": 3}, 8), ({"rate": 48e3, "delay": 40}, 8), (SCREEN, 8)],
)
def test_the_memory_of_a_board_is_what_design_h_states(tmp_path, device, bands):
    """To the byte on a Cortex-M4, and with other textures; a board that takes more does not compile."""
    cross_tools()
    fields = {"device": SCREEN, "finger": FINGERS["slide"]} if device == SCREEN else {"profile": device}
    scene = hr.Scene(texture=hr.Grating(frequency=60.0, amplitude=5e-6), duration=0.3, **fields)
    export(hr.prepare(scene, compiled=False), tmp_path, bands=bands)
    (tmp_path / "size.c").write_text('#include "board.h"\nchar found[sizeof(board_t)], stated[BOARD_BYTES];\n')
    for sizes in (), ("-DTEXTURE_RING=1024u", "-DTEXTURE_POINTS=2048u"):
        compile_m4(tmp_path, "size.c", *sizes)
        command = [CROSS.replace("gcc", "nm"), "-S", tmp_path / "size.o"]
        listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
        found = {words[-1]: int(words[1], 16) for words in map(str.split, listed)}
        assert found["found"] == found["stated"]
        if not sizes:
            assert f": {found['found']} with" in (tmp_path / "design.h").read_text(encoding="utf-8")
    board = (tmp_path / "board.h").read_text(encoding="utf-8")
    (tmp_path / "board.h").write_text(board.replace("} board_t;", "    real_t more[2];\n} board_t;"))
    with pytest.raises(subprocess.CalledProcessError):
        compile_m4(tmp_path, "size.c")


def compile_m4(folder, source, *options):
    subprocess.run(
        [CROSS, *M4.split(), "-std=c99", *options, "-c", source], cwd=folder, check=True, capture_output=True
    )


@pytest.fixture(scope="module")
def board(exports, tmp_path_factory):
    """Program of the whole board, with a plate model."""
    return built(tmp_path_factory.mktemp("board"), exports.rendering("tones"), "board-m4.elf", "OPTIMISE=-O1")


def measured(program):
    """Lines that measure.c prints on the emulated machine, by name; counts in instructions."""
    machine = [QEMU, "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none"]
    machine += ["-semihosting-config", "enable=on,target=native", "-icount", "shift=6", "-kernel", program]
    done = subprocess.run(machine, capture_output=True, text=True, check=True, timeout=120)
    lines = [line.split() for line in (done.stdout + done.stderr).splitlines()]
    found = {words[0]: [float(word) for word in words[1:]] for words in lines}
    return found | {name: [found[name][0] / 1.6] for name in COUNTS}


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    """Folder, rendering and figures of eight ridges that follow the finger, the dearest bands, under supervision."""
    partials, folder = tuple((1.0 + 0.25 * k, 1.0, 0.0) for k in range(8)), tmp_path_factory.mktemp("eight")
    texture = hr.Grating(amplitude=40e-6 / 9, wavelength=1e-3, partials=partials)
    rendering = hr.prepare(hr.Scene(texture=texture, finger=FINGERS["slide"], duration=1.0, keep_unfelt=True))
    program = built(folder, rendering, "measure-m4.elf", "OPTIMISE=-O3 -funroll-loops -DSUPERVISED")
    return folder, rendering, measured(program)


def test_eight_bands_leave_a_third_of_a_cortex_m4(eight):
    """At 168 MHz and 5 kHz a sample has 33 600 cycles, 1.6 of them an instruction at most (benchmarks/board.py)."""
    found = eight[2]
    # the difference of two counts, of which each is that of two readings of a timer of 40 ns: two of 1/1.6
    assert found["nops"][0] == pytest.approx(1000.0, abs=1.26), "instructions are not what is counted"
    assert 1.6 * found["new"][0] < 168e6 / 5000 * 2 / 3
    assert 1.6 * found["most"][0] < 168e6 / 5000
    assert found["free"][0] < found["touched"][0] < found["new"][0] < found["most"][0]
    assert found["flags"] == [0.0]


def test_a_texture_leaves_time_for_the_line_on_a_cortex_m4(exports, tmp_path):
    """In the dearest sample of the law two textures fade into each other, and a frame of samples ends."""
    found = measured(built(tmp_path, exports.rendering("white"), "measure-m4.elf"))
    assert 1.6 * (found["most"][0] + found["textures"][0] + found["frame"][0]) < 168e6 / 5000
    assert found["frames_read"] == [2.0], "the frame that was measured is none"


def test_the_board_fits_into_the_stated_memory(board):
    """128 kB of RAM with 8 kB for the stack, which takes less than 1 kB, and for what the machine itself needs."""
    size = subprocess.run([CROSS.replace("gcc", "size"), board], capture_output=True, text=True, check=True).stdout
    flash, data, zeroed = map(int, size.splitlines()[1].split()[:3])
    assert data + zeroed < (128 - 8) * 1024
    assert f"{(data + zeroed) / 1e3:.1f} kB of RAM" in (ROOT / "docs" / "firmware.md").read_text(encoding="utf-8")


def test_a_cortex_m4_measures_what_is_asked(eight):
    """Telemetry of a band after 0.5 s of a sliding finger, in um, within 2 % of the target and the observer's noise."""
    folder, rendering, lines = eight
    _, re_wanted, im_wanted, re_found, im_found = lines["band"]
    wanted, found = complex(re_wanted, im_wanted), complex(re_found, im_found)
    assert abs(wanted) == pytest.approx(abs(rendering.bands.envelope[1]) * 1e6, rel=1e-3)
    assert abs(found - wanted) < 0.02 * abs(wanted) + 3e6 * NOISE
    (folder / "size.c").write_text(SIZE)
    program = compile_c(folder / "size", [folder / "size.c"], f"-I{folder}")
    size = int(subprocess.run([program], capture_output=True, text=True, check=True).stdout)
    assert 0 <= size - lines["state"][0] <= 8, "more than a shorter pointer"
