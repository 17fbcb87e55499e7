"""Plate and controller closed in one compiled loop, sample by sample, for every family of methods.

The loop does the same as the plate's `plate_run` and the controller's own run
handing single samples to each other, without leaving compiled code.
"""

from __future__ import annotations

from hapticrender.compiled.jit import by_types, simulation
from hapticrender.control.bank.kernels import bank_step
from hapticrender.control.bank.state import BankTables
from hapticrender.control.cartesian.kernels import ComplexTables, complex_step
from hapticrender.control.polar.kernels import PolarTables
from hapticrender.control.polar.pair import in_pairs, polar_pair
from hapticrender.control.polar.steps import polar_step
from hapticrender.plants.kernels import plate_advance, plate_drive, plate_sense

STEPS = {PolarTables: polar_step, ComplexTables: complex_step, BankTables: bank_step}


@by_types
def control_step(tables, *rest):
    """Step of the controller that `tables` belong to."""
    return STEPS[tables.instance_class]


@simulation
def closed_plate_run(
    tables, state, control, control_state, last, finger, noise, wanted, sensed, motion, drive, target, flags
):
    """Plate and controller closed sample by sample; `last` (2,) is the drive computed one sample ago.

    Row n of `drive` is what the plate was handed for interval n, so it is computed from sample n - 1.
    """
    for n in range(sensed.shape[0]):
        drive[n, 0], drive[n, 1] = last[0], last[1]
        plate_drive(tables, state, last)
        flags[n] = plate_sense(tables, state, noise[n], sensed[n], motion[n])
        plate_advance(tables, state, finger[n, 0], finger[n, 1], finger[n, 2])
        flags[n] |= control_step(control, control_state, sensed[n], finger[n, 0], wanted[n], last, target[n])


@simulation
def closed_polar_run(
    tables, state, control, control_state, last, finger, noise, wanted, sensed, motion, drive, target, flags
):
    """`closed_plate_run` of the paper's controller, whose samples are taken in pairs where they may be."""
    count, waiting, pairs = sensed.shape[0], False, in_pairs(control, control_state)
    for n in range(count):
        flags[n] = plate_sense(tables, state, noise[n], sensed[n], motion[n])
        if waiting:
            polar_pair(control, control_state, n - 1, sensed, finger, wanted, drive, last, target, flags)
            waiting = False
        else:
            drive[n, 0], drive[n, 1] = last[0], last[1]
            waiting = pairs and n + 1 < count and control_state.sample[0] % 2 == 0
            if not waiting:
                flags[n] |= polar_step(control, control_state, sensed[n], finger[n, 0], wanted[n], last, target[n])
        plate_drive(tables, state, drive[n])
        plate_advance(tables, state, finger[n, 0], finger[n, 1], finger[n, 2])


CLOSED = dict.fromkeys(STEPS, closed_plate_run) | {PolarTables: closed_polar_run}
