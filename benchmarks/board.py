"""Measure what the control law takes on a Cortex-M4: flash, RAM, instructions a sample, and the rates that follow.

QEMU counts the instructions (``-icount``).  They are not cycles: the law's own instructions, as QEMU traces them, are
weighted by the tables of the Cortex-M4 technical reference manual (ARM 100166, instruction timing of the processor and
of its floating-point unit), with memory that answers at once: loads and stores 2, multiple ones 1 more than registers,
a taken branch 3, VDIV and VSQRT 14, all other 1, and 1 more where a floating-point result is used by the next
instruction.  A Cortex-M7 issues up to two instructions a cycle: it is taken as no faster a cycle.

Run: python -m benchmarks.board
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.export import export

PREFIX = "arm-none-eabi-"
FLAGS = "-std=c99 -O3 -funroll-loops -ffp-contract=off -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16"
LINK = "-nostartfiles -T m4.ld -ffunction-sections -fdata-sections -Wl,--gc-sections"
MACHINE = "qemu-system-arm -M mps2-an386 -display none -monitor none -serial none"
MACHINE += " -semihosting-config enable=on,target=native -icount shift=6"
SCALE = 1.6  # of a count of measure.c to an instruction
TRACED, LANDS = 120, 20  # samples whose instructions are traced; the sample at which the finger lands
PROCESSORS = {"168 MHz M4F": 168e6, "600 MHz M7": 600e6}  # Hz
SPARE = 1 / 3  # of the cycles
ARITHMETIC = ("vadd", "vsub", "vmul", "vdiv", "vsqrt", "vcvt", "vneg", "vabs")


class White:
    """A waveform, played whole."""

    def bands(self, rate):
        return Bands.none(spatial=False)

    def waveform(self, time, position):
        return 5e-6 * np.sin(400.0 * np.asarray(time)) * np.sin(90.0 * np.asarray(time))


def textures():
    """Ridges that follow the finger, the costliest bands; fixed ones; a waveform."""
    found = {}
    for count in (1, 4, 8):
        partials = tuple((1.0 + 0.25 * k, 1.0, 0.0) for k in range(count))
        found[f"{count} bands"] = hr.Grating(amplitude=9e-6 / count, wavelength=1e-3, partials=partials)
    partials = tuple((1.0 + 0.6 * k, 1.0, 0.0) for k in range(8))
    return found | {"8 fixed bands": hr.Grating(amplitude=1e-6, frequency=60.0, partials=partials), "waveform": White()}


def cost(name, text):
    """Cycles of an instruction without its branch taken and without waiting for a result."""
    base = name.split(".")[0]
    listed = re.search(r"\{(.*?)\}", text)
    if listed and base.startswith(("vldm", "vstm", "vpush", "vpop", "ldm", "stm", "push", "pop")):
        spans = [re.findall(r"\d+", part) for part in listed[1].split(",")]
        return 1 + sum(int(span[-1]) - int(span[0]) + 1 if len(span) > 1 else 1 for span in spans)
    if base in ("vdiv", "vsqrt"):
        return 14
    if base in ("vfma", "vfms", "vmla", "vmls"):
        return 3
    if base in ("udiv", "sdiv"):
        return 12
    if base in ("ldrd", "strd"):
        return 3
    return 2 if base.startswith(("vldr", "vstr", "ldr", "str")) else 1


def disassemble(program):
    """Size, cycles, result and operands of every instruction by its address; addresses of the functions."""
    code, functions = {}, {}
    listing = subprocess.run([f"{PREFIX}objdump", "-d", program], capture_output=True, text=True, check=True).stdout
    for line in listing.splitlines():
        if head := re.match(r"([0-9a-f]+) <(\w+)>:", line):
            functions[head[2]] = int(head[1], 16)
        if one := re.match(r"\s*([0-9a-f]+):\t((?:[0-9a-f]{4} ?)+)\s*\t(\S+)\s*(.*)", line):
            base, text = one[3].split(".")[0], one[4]
            result = text.split(",")[0] if base in ARITHMETIC else None
            operands = text if base.startswith(("vst", "vcmp")) else text.partition(",")[2]
            size = len(one[2].replace(" ", "")) // 2
            code[int(one[1], 16)] = size, cost(one[3], text), result, set(re.findall(r"\bs\d+\b", operands))
    return code, functions


def cycles_per_instruction(program):
    """Ratio over the samples of a program, from the trace of its law."""
    code, functions = disassemble(program)
    start, end = functions["law_step"], functions["plate_sense"]
    with tempfile.TemporaryDirectory() as folder:
        trace = Path(folder) / "trace"
        options = ["-singlestep", "-d", "exec,nochain", "-dfilter", f"{start:#x}..{end - 1:#x}", "-D", trace]
        subprocess.run([*MACHINE.split(), *options, "-kernel", program], capture_output=True, check=True)
        instructions = cycles = 0
        following = result = None
        with trace.open() as lines:
            for line in lines:
                if not line.startswith("Trace"):
                    continue
                at = line.index("/") + 1
                place = int(line[at : at + 8], 16)
                size, own, written, operands = code[place]
                instructions += 1
                cycles += own + 2 * (place != following) + (result in operands)
                following, result = place + size, written
    return cycles / instructions


def build(folder, *options):
    """Program that measures a design."""
    sources = "law learning carriers supervisor gains design plate frames texture measure startup_m4".split()
    program = folder / "measure.elf"
    files = [f"{name}.c" for name in sources]
    command = [f"{PREFIX}gcc", *FLAGS.split(), *LINK.split(), *options, "-o", program, *files, "-lm"]
    subprocess.run(command, check=True, cwd=folder)
    return program


def flash_of(folder, more):
    """Bytes of code and tables of the law, and of one more part."""
    parts = f"law learning carriers design {more}".split()
    subprocess.run([f"{PREFIX}gcc", *FLAGS.split(), "-c", *(f"{name}.c" for name in parts)], check=True, cwd=folder)
    objects = [f"{name}.o" for name in parts]
    sizes = subprocess.run([f"{PREFIX}size", *objects], check=True, cwd=folder, capture_output=True, text=True).stdout
    return sum(int(line.split()[0]) + int(line.split()[1]) for line in sizes.splitlines()[1:])


def measure(name, texture, *options, **device):
    """Print the row of a texture; RAM and flash are those of the law alone, or with its supervisor."""
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4)
    rendering = hr.prepare(hr.Scene(texture=texture, finger=finger, duration=1.0, keep_unfelt=True, **device))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        export(rendering, folder, bands=max(len(rendering.bands), 1))
        done = subprocess.run(
            [*MACHINE.split(), "-kernel", build(folder, *options)], capture_output=True, text=True, check=True
        )
        lines = (done.stdout + done.stderr).splitlines()  # semihosting's console is either
        counted = {name: float(value) for name, value, *_ in map(str.split, lines)}
        ratio = cycles_per_instruction(build(folder, *options, f"-DSAMPLES={TRACED}u", f"-DLANDS={LANDS}u"))
        flash = flash_of(folder, "supervisor gains" if options else "")
    free, touched, new, most = (counted[each] / SCALE for each in ("free", "touched", "new", "most"))
    ram = counted["state"] + (counted["supervisor"] if options else 0.0)
    rates = [f"{(1 - SPARE) * hertz / (ratio * new) / 1e3:.1f}" for hertz in PROCESSORS.values()]
    tops = [f"{hertz / (ratio * most) / 1e3:.1f}" for hertz in PROCESSORS.values()]
    numbers = [f"{flash:.0f}", f"{ram:.0f}", *(f"{each:.0f}" for each in (free, touched, new, most))]
    print(" | ".join([name, *numbers, f"{ratio:.2f}", f"{ratio * new:.0f}", f"{ratio * most:.0f}", *rates, *tops]))


def main():
    names = ["texture", "flash (B)", "RAM (B)", "instructions: free", "touched", "new contact", "most", "cycles each"]
    names += ["cycles: new contact", "most", *(f"kHz, {each}, a third spare" for each in PROCESSORS)]
    print(" | ".join([*names, *(f"kHz, {each}, most" for each in PROCESSORS)]))
    for name, texture in textures().items():
        measure(name, texture)
    measure("8 bands, supervised", textures()["8 bands"], "-DSUPERVISED")
    measure("screen, waveform", White(), device="electroadhesion", profile={"rate": 5e3})
    return 0


if __name__ == "__main__":
    sys.exit(main())
