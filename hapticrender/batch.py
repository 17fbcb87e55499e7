"""Many plates at once: scenarios that differ in finger, plate, noise or targets run side by side, a lane each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from hapticrender.bands import Bands
from hapticrender.compiled.lanes import ALIGNMENT, aligned
from hapticrender.control.bank import batch as bank
from hapticrender.control.bank.batch import LANES, side_by_side
from hapticrender.control.bank.controller import BankController
from hapticrender.control.methods import method_named
from hapticrender.control.methods.paper import PolarController
from hapticrender.control.polar import batch as polar
from hapticrender.control.remembered import contents
from hapticrender.plants.batch_kernels import SHARED, BatchState, closed_batch_run
from hapticrender.plants.kernels import PlateTables
from hapticrender.plants.propagator import COLUMNS, FORCES, STATES, shifts
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.protocols import Array, Controller
from hapticrender.touch.finger import Finger

CHUNK = 5000  # samples: what is handed over stays in the cache
FAMILIES: dict[type, ModuleType] = {BankController: bank, PolarController: polar}  # how their controllers are stacked


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One run of a sweep.

    Parameters
    ----------
    bands : Bands
        Targets, of constant envelope.
    finger : Finger, optional
        On the plate; absent by default.
    plate : PlateParameters, optional
        The plate that is simulated.
    known : PlateParameters, optional
        The plate that the controller is designed for; by default the same.
    seed : int
        Of the sensor noise.
    """

    bands: Bands
    finger: Finger = Finger.absent()
    plate: PlateParameters = PlateParameters()
    known: PlateParameters | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.plate.coils != 2:
            raise ValueError(f"plate.coils={self.plate.coils}: must be 2, or render a scene of it")
        if self.known is not None and self.known.rate != self.plate.rate:
            raise ValueError(f"known.rate={self.known.rate:g} Hz: must be that of the plate, {self.plate.rate:g} Hz")

    def design(self, method: str) -> Controller:
        """A controller at rest."""
        known = self.known or self.plate
        return method_named(method).design(known.band_model(known.rate, known.delay), self.bands)


@dataclass(frozen=True, kw_only=True)
class Played:
    """What happened in a scenario, sample by sample.

    Parameters
    ----------
    scenario : Scenario
    motion : ndarray, shape (n, 3), m
        True motion at centre, end 1 and end 2.
    position : ndarray, shape (n,), m
        Of the finger, NaN while lifted.
    drive : ndarray, shape (n, 2), A
    sensed : ndarray, shape (n, 2), m
    flags : ndarray of int, shape (n,)
        `Flag` bits.
    """

    scenario: Scenario
    motion: Array
    position: Array
    drive: Array
    sensed: Array
    flags: Array


def simulate(scenarios: Sequence[Scenario], seconds: float, *, method: str = "h2") -> list[Played]:
    """Play scenarios in closed loop, as many side by side as the processor has lanes.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Those whose controllers share their numbers (method, rate, delay, bandwidths) run side by side, the others one
        by one.
    seconds : float, > 0
    method : str
        Name of the control method; the band bank's (h, h2) and the polar ones (paper, paper-common, boxcar) run side
        by side.

    Returns
    -------
    list of Played
        In the order of the scenarios.

    Raises
    ------
    ValueError
        A number is out of its bound, or a target is no constant envelope.

    Notes
    -----
    What is returned are views of memory that up to `LANES` scenarios share; copy what you keep of a few.
    """
    if not 0 < seconds < np.inf:
        raise ValueError(f"{seconds=}: must be > 0 s and finite")
    for index, scenario in enumerate(scenarios):
        if scenario.bands.envelope is None:
            raise ValueError(f"scenarios[{index}].bands: must have constant envelopes")
    controllers = designs(scenarios, method)
    found: dict[int, Played] = {}
    left = Counter(id(each) for each in controllers)
    for group in _groups(scenarios, controllers):
        few, own = [scenarios[index] for index in group], [controllers[index] for index in group]
        left.subtract(id(each) for each in own)
        if len(few) > 1:
            played = together(few, own, seconds)
        else:  # a controller that others are still to start from stays at rest
            played = [_alone(few[0], few[0].design(method) if left[id(own[0])] else own[0], seconds)]
        found |= dict(zip(group, played, strict=True))
    return [found[index] for index in range(len(scenarios))]


def designs(scenarios: Sequence[Scenario], method: str) -> list[Controller]:
    """Controllers of the scenarios; those that know the same device and want the same are one."""
    made: dict[Hashable, Controller] = {}
    keys = [contents((each.known or each.plate, each.bands)) for each in scenarios]
    for key, scenario in zip(keys, scenarios, strict=True):
        if key not in made:
            made[key] = scenario.design(method)
    return [made[key] for key in keys]


def _groups(scenarios: Sequence[Scenario], controllers: Sequence[Controller]) -> Iterator[list[int]]:
    """Indices of scenarios that can run side by side, at most `LANES` at a time."""
    left = list(range(len(scenarios)))
    while left:
        first, group = left[0], [left[0]]
        for index in left[1:]:
            if len(group) == LANES:
                break
            if _fits(scenarios[first], scenarios[index], controllers[first], controllers[index]):
                group.append(index)
        yield group
        left = [index for index in left if index not in group]


def _fits(one: Scenario, other: Scenario, mine: Controller, yours: Controller) -> bool:
    same = all(getattr(one.plate, name) == getattr(other.plate, name) for name in ("rate", "delay"))
    flexible = (one.plate.bending_frequency > 0.0) == (other.plate.bending_frequency > 0.0)
    family = FAMILIES.get(type(mine)) if type(mine) is type(yours) else None
    return same and flexible and family is not None and family.alike(mine, yours)


def _alone(scenario: Scenario, controller: Controller, seconds: float) -> Played:
    plate = Plate(scenario.plate, scenario.finger, scenario.seed)
    samples = int(round(seconds * plate.rate))
    drive, _, flags, sensed = plate.closed_loop(controller, np.zeros(samples))
    position = np.asarray(sensed.position)
    return Played(
        scenario=scenario,
        motion=np.asarray(sensed.motion),
        position=position,
        drive=drive,
        sensed=sensed.sensed,
        flags=flags,
    )


def together(scenarios: Sequence[Scenario], controllers: Sequence[Controller], seconds: float) -> list[Played]:
    """At most `LANES` scenarios that fit each other."""
    plates = [Plate(each.plate, each.finger, each.seed) for each in scenarios]
    samples = int(round(seconds * plates[0].rate))
    control, control_state = FAMILIES[type(controllers[0])].batch_of(controllers)
    (tables, state), last = batch_state(plates), aligned((2, LANES))
    target, nothing = np.zeros((0, 0, 0)), aligned((1, LANES))
    motion, sensed, drive, flags = _side_by_side(samples, (3, 2, 2, 1))
    raised = flags[:, 0].view(np.int64)
    fingers = _fingers(plates)
    noisy = any(each.parameters.sensor_noise > 0.0 for each in plates)
    noise, finger = aligned((CHUNK if noisy else 1, 2, LANES)), aligned((CHUNK, 3, len(fingers)))
    position = np.empty((len(fingers), samples))
    for start in range(0, samples, CHUNK):
        part = slice(start, min(start + CHUNK, samples))
        count = part.stop - start
        if start == 0 or not all(each.constant for each in fingers):
            time = np.arange(part.start, part.stop) / plates[0].rate
            for lane, each in enumerate(fingers):
                finger[:count, :, lane] = each.touch(time)
        position[:, part] = finger[:count, 0].T
        _draw(plates, noise[:count])
        closed_batch_run(
            tables,
            state,
            control,
            control_state,
            last,
            finger[:count],
            noise[:count],
            nothing,
            sensed[part],
            motion[part],
            drive[part],
            target,
            raised[part],
        )
    return [
        Played(
            scenario=scenario,
            motion=motion[..., lane],
            position=position[min(lane, len(fingers) - 1)],
            drive=drive[..., lane],
            sensed=sensed[..., lane],
            flags=raised[:, lane],
        )
        for lane, scenario in enumerate(scenarios)
    ]


def _side_by_side(samples: int, widths: Sequence[int]) -> Iterator[Array]:
    """Arrays (samples, width, LANES) in one piece of memory, not yet written: its pages come together and cost less."""
    line = ALIGNMENT // 8
    room = np.empty(samples * sum(widths) * LANES + line)
    start = -room.ctypes.data // 8 % line
    for width in widths:
        size = samples * width * LANES
        yield room[start : start + size].reshape(samples, width, LANES)
        start += size


def _fingers(plates: Sequence[Plate]) -> list[Finger]:
    """Fingers of the lanes, or the one that all of them share: it is asked once."""
    every = [plates[min(lane, len(plates) - 1)].finger for lane in range(LANES)]
    return every[:1] if all(each is every[0] for each in every) else every


def _draw(plates: Sequence[Plate], noise: Array) -> None:
    """Noise of every lane that has any."""
    if any(plate.parameters.sensor_noise > 0.0 for plate in plates):
        drawn = np.zeros((LANES, *noise.shape[:-1]))
        for lane, plate in enumerate(plates):
            if plate.parameters.sensor_noise > 0.0:
                plate._rng.standard_normal(out=drawn[lane])
        noise[:] = np.moveaxis(drawn, 0, -1)


def batch_state(plates: Sequence[Plate]) -> tuple[PlateTables, BatchState]:
    """What plates have in common, and their state at rest, a lane each."""
    tables = [plate._tables for plate in plates]
    system, finger = aligned((STATES, STATES, LANES)), aligned((2, LANES))
    system[:], finger[:] = shifts()[..., None], np.inf
    return tables[0]._replace(terms=max(each.terms for each in tables)), BatchState(
        z=aligned((1, STATES, LANES)),
        system=system,
        push=aligned((FORCES, 3, LANES)),
        step=aligned((COLUMNS, STATES, LANES)),
        finger=finger,
        rest=np.zeros(1, np.int64),
        number=side_by_side([_numbers(each) for each in tables]),
        pending=aligned((plates[0].delay - 1, 2, LANES)),
        cursor=np.zeros(1, np.int64),
        current=aligned((2, LANES)),
        shown=aligned((2, LANES)),
    )


def _numbers(tables: PlateTables) -> Array:
    """Those numbers of a plate that others need not share, one after another."""
    own = [value for name, value in zip(tables._fields, tables, strict=True) if name not in SHARED]
    return np.array([number for value in own for number in (value if isinstance(value, tuple) else (value,))])
