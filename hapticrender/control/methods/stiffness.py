"""Complex envelopes in the device's coordinates, inverted by its dynamic stiffness (FACTS section 3): H and H2.

H watches the signal with a residual-coupled observer and follows a filtered
reference.  H2 watches the error, damps the deviation at sample rate, and runs
at two speeds: quiet until a detector or a touch wakes it.
"""

from __future__ import annotations

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank.controller import PROMPT, BankController, BankRules, design_bank, spacing
from hapticrender.control.blocks.controller import BlockController

CROWDED = 40.0  # Hz: carriers closer than this share what the detectors see

SIGNAL = BankRules(
    error_observer=False,
    observer=(10.0, 10.0),
    integral=(17.0, 17.0, 17.0),
    adapt=(100.0, 100.0),
    detect=False,
)
ERROR = BankRules(
    error_observer=True,
    observer=(10.0, 20.0),
    integral=(2.0, 15.0, 25.0),
    adapt=(1.0, 100.0),
    inner=(0.0, 1.0),
)
ERROR_CROWDED = BankRules(
    error_observer=True,
    observer=(20.0, 20.0),
    integral=(1.5, 1.5, 15.0),
    adapt=(2.0, 100.0),
    rest=(0.05, 5.0),
    inner=(0.2, 1.0),
    level=3.5,
    detect=False,
    awake_time=0.4,
    release=0.3,
)


class SignalObserver:
    """H: constant speed, no inner loop."""

    name = "h"

    def design(
        self, model: BandModel, bands: Bands, *, feedback: bool = True, precision: str = "double"
    ) -> BankController | BlockController:
        """Bank on the sensed signal; in blocks, on the error."""
        return in_its_blocks(design_bank(self.name, model, bands, SIGNAL, feedback=feedback), model, precision)


class ErrorObserver:
    """H2: error observer, inner damping, two speeds."""

    name = "h2"

    def design(
        self, model: BandModel, bands: Bands, *, feedback: bool = True, precision: str = "double"
    ) -> BankController | BlockController:
        """Bank on the error; carriers nearer than 40 Hz, or that may come so near, are watched without detectors."""
        crowded = spacing(bands) < CROWDED or (bands.wavenumber > 0.0).sum() > 1
        rules = ERROR_CROWDED if crowded else ERROR
        return in_its_blocks(design_bank(self.name, model, bands, rules, feedback=feedback), model, precision)


def in_its_blocks(controller: BankController, model: BandModel, precision: str) -> BankController | BlockController:
    """Return the bank as the device of `model` takes it: sample by sample, or in blocks where they are long.

    The block form knows nothing of a finger that is away or of a contact's memory; there the bank steps through them.
    """
    friction = model.finger.presence or model.memory > 0.0
    if model.block > 1 and model.delay > PROMPT and not friction:
        return BlockController(controller, model.block, precision)
    return controller.in_precision(precision)
