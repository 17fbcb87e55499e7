"""The hot loops are vectorised: read from the compiled code, since a clock on a shared machine proves nothing."""

import platform
import re
from dataclasses import replace

import numpy as np
import pytest

from hapticrender.accuracy.plate import SLIDING, tones
from hapticrender.batch import LANES, Scenario, batch_state
from hapticrender.compiled.lanes import aligned
from hapticrender.compiled.late import cells, code_of, wanted
from hapticrender.control import analyser
from hapticrender.control.bank import batch as bank_batch
from hapticrender.control.bank import kernels as bank_kernels
from hapticrender.control.blocks import kernels as block_kernels
from hapticrender.control.methods import METHODS
from hapticrender.control.polar import batch as polar_batch
from hapticrender.control.polar import passes as polar_passes
from hapticrender.plants import batch_kernels
from hapticrender.plants import kernels as plate_kernels
from hapticrender.plants.vibrotactile import Plate, PlateParameters

PACKED = re.compile(r"\bv?(?:fn?m(?:add|sub)\d*|mul|add|sub)(p[sd])\b.*%([xyz])mm")
RECORDED = 3 + 2 + 2 + 1  # rows a sample: motion, sensors, drive, flags
WIDEST = {"x": 16, "y": 32, "z": 64}  # bytes of a register


def compiled(run, *arguments):
    """Code of a kernel for the types of these arguments, compiled anew, as what comes from the cache shows none."""
    fresh = type(run)(run.py_func, cached=False)
    fresh(*arguments)
    (made,) = fresh.overloads.values()
    return code_of(made)


def instructions(run, *arguments):
    """Assembly of a kernel."""
    return compiled(run, *arguments).get_asm_str()


def late_instructions(kernel, run, *arguments):
    """Assembly of a late part of a kernel."""
    (args,) = [args for late, args in (wanted(text) for _, text in cells(compiled(run, *arguments))) if late is kernel]
    fresh = type(run)(kernel.part.py_func, "part", cached=False)
    fresh.compile(args)
    return code_of(fresh.overloads[args]).get_asm_str()


def packed(assembly, suffix):
    """Count of packed arithmetic of one precision, and of those instructions on the widest registers there are."""
    found = [register for kind, register in PACKED.findall(assembly) if kind == suffix]
    return len(found), sum(register == max(found, key=WIDEST.get) for register in found)


def a_bank(precision):
    model = PlateParameters().band_model(5000.0, 1)
    controller = METHODS["h2"].design(model, tones(np.linspace(20.0, 400.0, 8), 1e-6), precision=precision)
    return bank_kernels.bank_run, controller, np.zeros((2, 8), complex)


def a_polar(precision):
    model = PlateParameters().band_model(5000.0, 1)
    controller = METHODS["paper"].design(model, tones(np.linspace(20.0, 400.0, 8), 1e-6), precision=precision)
    return polar_passes.polar_run, controller, np.zeros((2, 8), complex)


def a_block(precision):
    model = replace(PlateParameters().band_model(5000.0, 16), block=16)
    controller = METHODS["h2"].design(model, tones(np.linspace(20.0, 400.0, 8), 1e-6), precision=precision)
    return block_kernels.block_run, controller, np.zeros((1, 8), complex)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
@pytest.mark.parametrize(("precision", "suffix"), [("double", "pd"), ("single", "ps")])
@pytest.mark.parametrize("kind", [a_bank, a_block, a_polar])
def test_controllers_work_on_whole_registers(kind, precision, suffix):
    """Some hundred packed instructions on the widest registers, and no call of the C library's sine or cosine."""
    run, controller, target = kind(precision)
    n = 16 if kind is a_block else 2
    arguments = (np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros((n, 2)), target, np.zeros(n, np.int64))
    assembly = instructions(run, controller.tables, controller.state, *arguments)
    every, widest = packed(assembly, suffix)
    assert every > 200
    assert widest > 0.8 * every
    assert not re.search(r"\b(?:sin|cos|atan2)f?\b", assembly)
    assert re.search(r"and\w?\s+\$-64, %rsp", assembly)  # what does not fit the registers is put aside in whole lines


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
@pytest.mark.parametrize(("precision", "suffix"), [("double", "pd"), ("single", "ps")])
def test_a_settled_sample_works_on_whole_registers(precision, suffix):
    """It is compiled apart."""
    run, controller, target = a_bank(precision)
    arguments = (np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.zeros((2, 2)), target, np.zeros(2, np.int64))
    tables, state = controller.tables, controller.state
    assembly = late_instructions(bank_kernels.settled_sample, run, tables, state, *arguments)
    every, widest = packed(assembly, suffix)
    assert every > 100
    assert widest > 0.8 * every
    assert re.search(r"and\w?\s+\$-64, %rsp", assembly)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
def test_the_analyser_works_on_whole_registers():
    found = analyser.Analyser([50.0, 90.0], 5.0, 5000.0)
    signal, envelopes = np.zeros((2, 1)), np.zeros((2, 1, 2), complex)
    assembly = instructions(analyser.analyse_run, *found._arrays, signal, envelopes)
    every, widest = packed(assembly, "pd")
    assert every > 40
    assert widest > 0.8 * every


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
@pytest.mark.parametrize(("method", "batch_of"), [("h2", bank_batch.batch_of), ("paper", polar_batch.batch_of)])
def test_a_batch_works_on_whole_registers(method, batch_of):
    """Eight scenarios side by side: controllers and plates in one loop."""
    scenarios = [Scenario(bands=tones([50.0], 1e-6), finger=SLIDING) for _ in range(LANES)]
    control, state = batch_of([each.design(method) for each in scenarios])
    plates = [Plate(each.plate, each.finger) for each in scenarios]
    rows = [aligned((2, *shape, LANES)) for shape in ((3,), (2,), (), (2,), (3,), (2,))]
    arguments = (*batch_state(plates), control, state)
    last, target, flags = aligned((2, LANES)), aligned((1, 2, LANES)), aligned((2, LANES)).view(np.int64)
    assembly = instructions(batch_kernels.closed_batch_run, *arguments, last, *rows, target, flags)
    every, widest = packed(assembly, "pd")
    assert every > 500
    assert widest > 0.8 * every
    past_caches = re.findall(r"\bv?movnt\w+\s+%([xyz])mm", assembly)
    assert sum(WIDEST[register] for register in past_caches) == LANES * 8 * RECORDED


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
def test_the_plate_works_on_whole_registers():
    plate = Plate(PlateParameters(), SLIDING)
    n = 2
    arguments = (np.zeros((n, 2)), np.zeros((n, 3)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 3)))
    run = plate_kernels.plate_run
    assembly = instructions(run, plate._tables, plate._state, *arguments, np.zeros(n, np.int64))
    every, widest = packed(assembly, "pd")
    assert every > 100
    assert widest > 0.8 * every
