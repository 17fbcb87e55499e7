"""What the benchmarks run: bands, controllers and plates, made through the library's own doors."""

from dataclasses import replace

import numpy as np

import hapticrender as hr
from hapticrender.accuracy.plate import SLIDING
from hapticrender.bands import Bands
from hapticrender.batch import Scenario, designs, together
from hapticrender.control.blocks.controller import BlockController
from hapticrender.control.methods import METHODS
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY

PLATE = PlateParameters()
CARD = 48000.0  # Hz: a sound card
BLOCK = 64  # samples
PIECE = 4.0  # s: longer arrays than these cost page faults, which no loop has part in
TOUCHING = replace(SLIDING, touches=((0.0, 36_000.0),))  # a heavy finger, sliding from the start


def comb(bands, amplitude=1e-6, highest=400.0):
    """Fixed carriers from 20 Hz to `highest`, of equal amplitude and odd phases."""
    frequency = np.linspace(20.0, highest, bands)
    return Bands(
        frequency=frequency,
        wavenumber=np.zeros(bands),
        phase=np.linspace(0.0, 5.0, bands),
        envelope=np.full(bands, amplitude * np.exp(0.5j)),
    )


def polar(bands, precision="double"):
    """The paper's controller at 5 kHz, with a limit that no drive reaches."""
    controller = METHODS["paper"].design(PLATE.band_model(PLATE.rate, 1), comb(bands), precision=precision)
    controller.tables = controller.tables._replace(numbers=controller.tables.numbers._replace(drive_limit=1e9))
    return controller


def in_blocks(bands, precision="double", **numbers):
    """The default method on a sound card, 64 samples a block.

    `numbers` replaces some of the design.
    Designed for 8 bands and then given as many as asked for: the design check is not what is measured here.
    """
    parameters = replace(PLATE, rate=CARD, delay=BLOCK)
    model = replace(parameters.band_model(CARD, BLOCK), block=1)
    few = METHODS["h2"].design(model, comb(8))
    many = comb(bands, amplitude=1e-9, highest=1000.0)
    few.tables = few.tables._replace(tone=many.tone(), numbers=few.tables.numbers._replace(observer=1e-4, **numbers))
    few.n_bands = bands
    return BlockController(few, BLOCK, precision)


def closed_loop(method, bands, samples, finger=TOUCHING, parameters=PLATE):
    """A run of plate and controller in one compiled loop, as a function, in pieces of `PIECE` seconds at most."""
    controller = METHODS[method].design(parameters.band_model(parameters.rate, parameters.delay), comb(bands))
    plate, piece = Plate(parameters, finger), np.zeros(min(int(PIECE * parameters.rate), samples))

    def run():
        for start in range(0, samples, len(piece)):
            plate.closed_loop(controller, piece[: samples - start])

    return run


RESTING = hr.Finger.still(normal_load=0.5, mechanics=HEAVY)


def scenarios(count, finger, noise):
    """Scenarios of 8 bands that differ in the plate's mass and the noise's seed."""
    plate = replace(PLATE, sensor_noise=noise)
    return [
        Scenario(bands=comb(8), finger=finger, plate=replace(plate, mass=0.032 * (1 + 1e-4 * i)), known=plate, seed=i)
        for i in range(count)
    ]


class Batch:
    """Scenarios side by side, designed already: what `simulate` does a chunk at a time."""

    def __init__(self, many, method):
        self.many = many
        self.controllers = designs(many, method)

    def advance(self, seconds):
        """Play them from the start."""
        return together(self.many, self.controllers, seconds)


def absent():
    """No finger."""
    return hr.Finger.absent()
