"""The plain complex methods as a controller: from a band model and a few rules to numbers of their compiled step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank.controller import RAMP_TIME
from hapticrender.control.bank.rows import TRACK_ROWS
from hapticrender.control.cartesian.kernels import (
    CARRIER_ROWS,
    LOOP_ROWS,
    WANTED_ROWS,
    ComplexNumbers,
    ComplexState,
    ComplexTables,
    complex_run,
)
from hapticrender.control.envelope_loop import EnvelopeLoop, section
from hapticrender.control.stdft import StarSTDFT
from hapticrender.protocols import Array


@dataclass(frozen=True, kw_only=True)
class ComplexRules:
    """What tells the plain complex methods apart.

    Parameters
    ----------
    dynamic : bool
        Invert D + D' d/dt; D alone otherwise.
    feed_forward : bool
        Add the reference to what the loop commands; targets are then ramped, so that they do not strike the modes.
    deviation : bool
        Listen to the deviation from the reference, so that reference and signal pass the same low pass; otherwise the
        reference is compared with the low-passed signal.
    """

    dynamic: bool
    feed_forward: bool = False
    deviation: bool = False


class ComplexController:
    """Complex low-pass loops in the device's coordinates behind the `Controller` protocol.

    Parameters
    ----------
    method : str
        Name of the method that designed it.
    tables : ComplexTables
        Parameters of the compiled step.
    """

    def __init__(self, method: str, tables: ComplexTables) -> None:
        coordinates, bands = len(tables.listen), tables.tone.shape[1]
        self.method = method
        self.n_bands = bands
        self.tables = tables
        self.state = ComplexState(
            band=np.zeros((CARRIER_ROWS, bands)),
            wanted=np.zeros((WANTED_ROWS, bands), complex),
            loop=np.zeros((coordinates * LOOP_ROWS, bands), complex),
            track=np.zeros(TRACK_ROWS),
            coordinate=np.zeros((2, coordinates)),
            doubt=np.zeros(1),
        )

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        drive = np.zeros((n, len(self.tables.speak)))
        target = np.zeros((n, self.n_bands), complex)
        flags = np.zeros(n, np.int64)
        complex_run(
            self.tables, self.state, np.ascontiguousarray(sensed, float), position, wanted, drive, target, flags
        )
        return drive, target, flags


def design_complex(
    method: str, model: BandModel, bands: Bands, rules: ComplexRules, loop: EnvelopeLoop, *, feedback: bool = True
) -> ComplexController:
    """Set up the compiled step of a method; without `feedback` the reference alone is inverted."""
    forward = rules.feed_forward or not feedback
    numbers = ComplexNumbers(
        rate=float(model.rate),
        feedback=feedback,
        analysed=bands.envelope is None,
        presence=model.finger.presence,
        least_speed=model.finger.least_speed,
        modulated=bands.modulated,
        differentiated=bands.differentiated,
        forward=forward,
        deviation=rules.deviation,
        dynamic=rules.dynamic,
        lead=(model.delay + 0.5) / model.rate,
        ramp=1.0 / (RAMP_TIME * model.rate) if forward else 1.0,
        lowest=float(model.lowest_frequency),
        highest=min(model.highest_frequency, 0.4 * model.rate),
        drive_limit=float(model.drive_limit),
        sensed_limit=float(model.sensed_limit),
        analysis=section(StarSTDFT(bandwidth=model.lowest_frequency / 2, rate=model.rate).coefficients),
        filter=loop.filter,
        law=loop.law,
    )
    tables = ComplexTables(
        numbers=numbers,
        tone=bands.tone(),
        listen=np.ascontiguousarray(model.coordinate_from_sensed),
        speak=np.linalg.pinv(model.force_from_drive),
        mass=model.mass,
        damping=model.damping,
        stiffness=model.stiffness,
        shape=np.eye(len(model.mass))[0],
    )
    return ComplexController(method, tables)
