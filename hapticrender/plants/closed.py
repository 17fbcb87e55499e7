"""Plate and controller closed in one compiled loop, sample by sample: one kernel a family of methods.

Each does the same as the plate's `plate_run` and the controller's own run
handing single samples to each other, without leaving compiled code.
"""

from __future__ import annotations

from hapticrender._jit import kernel
from hapticrender.control.bank_kernels import BankTables, bank_step
from hapticrender.control.kernels import PolarTables, polar_step
from hapticrender.plants.kernels import plate_advance, plate_drive, plate_sense


@kernel
def polar_plate_run(
    tables, state, polar, polar_state, last, finger, noise, wanted, sensed, motion, drive, target, flags
):
    """Plate and polar controller closed sample by sample; `last` (2,) is the drive computed one sample ago.

    Row n of `drive` is what the plate was handed for interval n, so it is computed from sample n - 1.
    """
    z, frozen, system, push, pending, cursor, current = state
    for n in range(sensed.shape[0]):
        flags[n] = plate_sense(tables, z, noise[n], sensed[n], motion[n])
        plate_drive(tables, pending, cursor, current, last)
        plate_advance(tables, z, frozen, system, push, current, finger[n, 0], finger[n, 1], finger[n, 2])
        drive[n, 0], drive[n, 1] = last[0], last[1]
        flags[n] |= polar_step(polar, polar_state, sensed[n], finger[n, 0], wanted[n], last, target[n])


@kernel
def bank_plate_run(tables, state, bank, bank_state, last, finger, noise, wanted, sensed, motion, drive, target, flags):
    """Plate and band bank closed sample by sample; `last` (2,) is the drive computed one sample ago.

    Row n of `drive` is what the plate was handed for interval n, so it is computed from sample n - 1.
    """
    z, frozen, system, push, pending, cursor, current = state
    for n in range(sensed.shape[0]):
        flags[n] = plate_sense(tables, z, noise[n], sensed[n], motion[n])
        plate_drive(tables, pending, cursor, current, last)
        plate_advance(tables, z, frozen, system, push, current, finger[n, 0], finger[n, 1], finger[n, 2])
        drive[n, 0], drive[n, 1] = last[0], last[1]
        flags[n] |= bank_step(bank, bank_state, sensed[n], finger[n, 0], wanted[n], last, target[n])


CLOSED = {PolarTables: polar_plate_run, BankTables: bank_plate_run}
