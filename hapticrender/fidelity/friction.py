"""What the models of the surfaces that make friction can leave out for a scene, and the error bound of one that does.

What is compared is the friction under the finger while both levels are driven alike, with what the friction loop has to
ask for: the target, led by the contact's lag.  Without noise that is computed.  In noise an ultrasonic surface's
amplitude loop wakes by chance, which no formula tells: both levels are played, in noise of their own.  Of the finger
nothing is left out.  Its mechanics move its skin and change no friction, and simpler ones take as long; one that rests
feels none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.compiled.jit import kernel
from hapticrender.control.gap import VACUUM
from hapticrender.fidelity.plate import LOOK_AHEAD, NoBound, Option
from hapticrender.fidelity.windows import BETWEEN, Windows, compared_with, ease, fade, look
from hapticrender.loop import registered
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen, finger_rows
from hapticrender.plants.fidelity_screen import attractions
from hapticrender.plants.fidelity_surface import AmplitudeLoop
from hapticrender.plants.friction_laws import friction_ratios, wanted_amplitudes
from hapticrender.plants.sliding import SlidingParameters
from hapticrender.plants.surface import SurfaceParameters, UltrasonicSurface, surface_tables
from hapticrender.protocols import Array
from hapticrender.touch.motion import Sliding, Swiping
from hapticrender.touch.scene import Scene

LEAD = 0.5  # s of a scene that are followed before its judgement, at least
TAIL = 0.02  # s behind it, in which what an amplitude loop makes of the end dies away
GROWTH = 0.05  # s in which a target grows after a touch
SETTLING = 10.0  # time constants between the last touch and the judgement
BRIEF, STEADY = 0.125, 0.5  # share of that time within which a load may change by so much of itself
ACCURACY = 5e-5  # relative error below which nothing is told
SMALL_SIGNAL = 1.15  # of an amplitude loop's error by its linear model: at large modulation
HEARD = 0.8  # of a detector's level: a deviation that may open it, as it hears twice the carrier as well
CHANCES = 1000.0  # runs of which noise makes the error larger than the bound in one, as foretold
TELLING = (2.0, 5.0, 10.0)  # windows' worth of the largest errors that were played, from which larger ones are foretold
OFTEN, SELDOM = 16.0, 32.0  # s of the judged time that are played where the texture wakes the loop, or noise alone
MOST_RUNS = 32
UNSEEN = 1.4  # of what chance adds where noise alone wakes the loop
SEED = 20210617  # of the first of them
DRIVEN = 0.9  # of the drive's limit: what the amplitude may ask for, as feedback asks for some on top
LOADS = 5  # of a finger that presses more or less, at which an amplitude loop is computed
POSITION, LOAD, _, SPEED = range(4)  # columns of the finger


class _Track(NamedTuple):
    """A stretch of a scene, sample by sample: its finger, and what is wanted of friction."""

    rate: float  # Hz
    judged: slice  # samples that are judged
    rise: float  # K: of the temperature, at the end
    finger: Array  # (n, 4) position (m), load (N), strength, speed (m/s)
    kept: Array  # (n,) share of its friction that the contact keeps over a sample
    phase: Array  # (n, bands) rad
    frequency: Array  # (n, bands) Hz
    envelope: Array  # (n, bands) N, complex

    @property
    def touched(self) -> Array:
        """Where the finger presses (n,)."""
        return np.isfinite(self.finger[:, SPEED]) & (self.finger[:, LOAD] > 0.0)


@kernel
def follow_friction(steady, kept, friction):
    """Friction (N) at the start of every sample, which goes after `steady` (N) by all but `kept` (1) of its way."""
    here = 0.0
    for n in range(steady.shape[0]):
        friction[n] = here
        here = steady[n] + (here - steady[n]) * kept[n]


def bound(scene: Scene, lesser: Scene) -> float:
    """Largest relative error (1) of the friction in a lesser model; see `hapticrender.fidelity.choice.fidelity`."""
    if lesser == scene:
        return ACCURACY
    renderer = registered("renderers", scene.device)()
    full, less = (renderer.plant(each, 0) for each in (scene, lesser))
    model = renderer.band_model(scene, registered("drivers", "simulated")(full))
    bands = renderer.bands(scene, model)
    if bands.envelope is None:
        raise NoBound("its texture has no constant envelopes, so no tight bound is known")
    if not bands.envelope.any():
        return 0.0
    parameters, highest = full.parameters, model.highest_frequency
    track = _track(scene, parameters, bands, highest, max(map(_lead, (full, less))))
    asked = _asked(track)
    frictions = [_frictions(each, track, asked) for each in (full, less)]
    if isinstance(full, UltrasonicSurface) and _noisy(full):
        whole = _track(scene, parameters, bands, highest, math.inf)
        plants = [partial(renderer.plant, each) for each in (scene, lesser)]
        seldom = any("quiet" in each for each in frictions)
        worst = _played(whole, bands, plants, scene.tolerance, seldom)
        return float(worst.max()) + ACCURACY
    margin, worst = BETWEEN if isinstance(full, ElectroadhesionScreen) else SMALL_SIGNAL, np.zeros(len(bands))
    for one, other in product(*(each.values() for each in frictions)):
        apart = np.empty(len(asked))
        follow_friction(one - other, track.kept, apart)
        seen = _seen(bands, track, apart)
        found = seen.apart[:, 0].max(axis=0, initial=0.0) / compared_with(seen.target, scene.tolerance)
        worst = np.maximum(worst, margin * found)
    return float(worst.max()) + ACCURACY


def _noisy(surface: UltrasonicSurface) -> bool:
    """Whether its sensor or its drive adds something that is chance."""
    mode = surface.parameters.mode
    return bool(mode.sensor_noise or mode.sensor_bits or mode.drive_bits)


def _played(
    track: _Track, bands: Bands, plants: Sequence[Callable[[int], Any]], tolerance: float, seldom: bool
) -> Array:
    """Largest relative error of each band where noise wakes an amplitude loop by chance: played, both levels apart.

    What `plants` make is played from the scene's start on, again and again.  Where noise alone wakes it, `seldom`, more
    runs are played, and what chance adds to the windows' means is taken UNSEEN times: no run may show the worst.
    """
    asked, judged = _asked(track)[:, None], (track.judged.stop - track.judged.start) / track.rate
    played, rare = (SELDOM, UNSEEN) if seldom else (OFTEN, 1.0)
    runs = []
    for run in range(math.ceil(min(played / judged, MOST_RUNS))):
        one, other = (np.asarray(make(SEED + 2 * run + i).run(asked).motion) for i, make in enumerate(plants))
        runs.append(_seen(bands, track, (one - other)[:, 0]))
    apart, read, found = np.stack([run.apart[:, 0] for run in runs]), runs[0].read, np.zeros(len(bands))
    for k in np.flatnonzero(read.any(axis=0)):
        told = apart[:, read[:, k], k]
        mean = float(told.mean(axis=0).max())
        found[k] = mean + rare * (_beyond(told.ravel(), runs[0].lengths * read[:, k].mean(), len(runs)) - mean)
    return BETWEEN * found / compared_with(runs[0].target, tolerance)


def _beyond(seen: Array, many: float, runs: int) -> float:
    """Magnitude that one run of `many` windows in CHANCES would pass, by those `seen` in all windows of some `runs`.

    The excess over a level that some pass is taken for exponential.
    """
    worst = float(seen.max())
    for telling in TELLING:
        share = min(telling / max(many * runs, 1.0), 0.5)
        level = np.quantile(seen, 1.0 - share)
        excess = seen[seen >= level].mean() - level
        worst = max(worst, float(level + excess * math.log(max(share * many * CHANCES, 1.0))))
    return worst


def _lead(plant: Any) -> float:
    """Time (s) in which a plant settles after a touch."""
    p = plant.parameters
    if isinstance(plant, UltrasonicSurface):
        numbers = plant.loop.tables.numbers
        return SETTLING / min(pace for pace in (numbers.adapt, numbers.lock) if pace > 0.0)
    if not p.current_offset:
        return LEAD
    charging = p.insulator_capacitance * float(p.area(1.0)) / p.servo_conductance if p.servo_conductance else math.inf
    return max(LEAD, SETTLING * charging)


def _track(scene: Scene, parameters: Any, bands: Bands, highest: float, lead: float) -> _Track:
    """What is followed of a scene, from `lead` (s) before its judgement on."""
    begin = scene.settle if scene.duration >= 2 * scene.settle else scene.duration / 2
    end = min(scene.duration, begin + LOOK_AHEAD)
    if end < scene.duration and not isinstance(scene.finger.motion, Sliding | Swiping):
        raise NoBound(f"its finger's path is longer than {LOOK_AHEAD:g} s and no repetition")
    if min(lead, begin) > LOOK_AHEAD:
        raise NoBound(f"it has to be followed for more than {LOOK_AHEAD:g} s before it is judged")
    rate = float(parameters.rate)
    first, last = math.floor(max(begin - max(lead, LEAD), 0.0) * rate), math.ceil((end + TAIL) * rate)
    finger = finger_rows(scene.finger, first, last - first, rate)
    frequency = bands.instantaneous_frequency(np.nan_to_num(finger[:, SPEED]))
    mode = getattr(parameters, "mode", None)
    return _Track(
        rate=rate,
        judged=slice(math.ceil(begin * rate) - first, math.floor(end * rate) - first),
        rise=mode.temperature_rise * min(end / mode.temperature_time, 1.0) if mode else 0.0,
        finger=finger,
        kept=_kept(parameters, finger[:, SPEED]),
        phase=bands.carrier_phase(np.arange(first, last) / rate, finger[:, POSITION]),
        frequency=frequency,
        envelope=_envelope(bands, frequency, np.isfinite(finger[:, SPEED]), highest, rate),
    )


def _kept(parameters: SlidingParameters, speed: Array) -> Array:
    """Share of its friction that the contact keeps over each sample (n,)."""
    speed = abs(np.nan_to_num(speed))
    renewed = speed / (parameters.rate * parameters.memory_length)
    return np.where(speed >= parameters.least_speed, np.exp(-renewed), 1.0)


def _envelope(bands: Bands, frequency: Array, down: Array, highest: float, rate: float) -> Array:
    """Wanted envelopes (N, (n, bands)): they grow after a touch, and fade where a carrier is too slow or too fast."""
    count = np.arange(len(down))
    since = count - np.maximum.accumulate(np.where(down, -1, count))
    weight = ease(since / (GROWTH * rate))[:, None] * fade(bands, frequency, highest, rate)
    envelope = weight * np.asarray(bands.envelope)
    return 2j * np.pi * frequency * envelope if bands.differentiated else envelope


def _asked(track: _Track) -> Array:
    """Steady friction (N, (n,)) that makes the wanted one, around its mean: none where the contact sticks."""
    wanted, kept = _waveform(track), track.kept
    renewed = np.where(kept < 1.0, 1.0 - kept, np.inf)
    return (np.append(wanted[1:], wanted[-1]) - kept * wanted) / renewed


def _waveform(track: _Track) -> Array:
    """Wanted friction (N, (n,))."""
    return (track.envelope * np.exp(1j * track.phase)).real.sum(axis=1)


def _frictions(plant: Any, track: _Track, asked: Array) -> dict[str, Array]:
    """Steady frictions (N, (n,)) that a plant may make of what is asked for, one for every state that it may be in."""
    if isinstance(plant, ElectroadhesionScreen):
        return {"": _screen_friction(plant, track, asked)}
    return _surface_frictions(plant, track, asked)


def _screen_friction(screen: ElectroadhesionScreen, track: _Track, asked: Array) -> Array:
    """Friction of an electroadhesion screen, but for that of the load, which no level changes."""
    p, root = screen.parameters, screen.compensation
    if root is None or root.straight:
        raise NoBound("its drive is no attraction, so what the scene asks of it is not known")
    area = p.area(np.where(track.touched, track.finger[:, LOAD], 1.0))
    gain = p.unevenness * p.leakage / (4 * p.omega**2 * VACUUM * area)
    current = np.minimum(root(asked / p.friction_coefficient * root.gain / gain), p.current_limit)
    carrier, envelope, voltage = attractions(p, current, track.finger)
    if voltage > p.voltage_limit:
        raise NoBound(f"its source may come to the end of its compliance of {p.voltage_limit:g} V")
    return p.friction_coefficient * (carrier if p.level == "carrier" else envelope)


def _surface_frictions(surface: UltrasonicSurface, track: _Track, asked: Array) -> dict[str, Array]:
    """Frictions of an ultrasonic surface."""
    p, load, speed = surface.parameters, track.finger[:, LOAD], track.finger[:, SPEED]
    rest = _lead(surface)
    first = track.judged.start - math.floor(rest * track.rate)
    if first < 0 or not track.touched[first : track.judged.stop].all():
        raise NoBound(f"it is judged less than {rest:.3g} s after its finger last came or went, or while it is up")
    _check_load(track.finger[first : track.judged.stop, LOAD], track.rate, rest)
    if p.mode.temperature_rise and not p.lock:
        raise NoBound("its resonance drifts, and nothing follows it")
    tables = surface_tables(p, surface.loop, surface.finger, (1.0, 1.0))  # nominal touch: for a finger that is up
    load, pace = np.where(track.touched, load, 1.0), np.maximum(abs(np.nan_to_num(speed)), p.least_speed)
    whole = tables.friction * load
    wanted, found = np.empty(len(asked)), dict[str, Array]()
    wanted_amplitudes(tables.law, np.clip(p.bias + asked / whole, tables.least, 1.0), load, pace, wanted)
    for state, amplitude in _amplitudes(surface, track, wanted, load).items():
        left = np.empty(len(asked))
        friction_ratios(tables.law, amplitude, load, pace, left)
        found[state] = whole * left
    return found


def _check_load(load: Array, rate: float, rest: float) -> None:
    """Refuse a load (N) that changes too fast for a loop to be as it is where it has settled, in `rest` (s)."""
    span = max(1, math.ceil(BRIEF * rest * rate))
    least = np.minimum(load[:-span], load[span:])
    if len(least) and (abs(load[span:] - load[:-span]) > STEADY * least).any():
        raise NoBound(f"its load changes by more than {STEADY:.0%} within {BRIEF * rest:.3g} s")


def _amplitudes(surface: UltrasonicSurface, track: _Track, wanted: Array, load: Array) -> dict[str, Array]:
    """Amplitudes (m) that the loop may make of the wanted one, without noise.

    They are its state's, or those between which it changes state.  A detector that the calmer state opens, and that the
    livelier one does not keep open, opens and closes: then the deviation is hardly above what it hears, which is as
    much of the way from one state to the other.
    """
    numbers = surface.loop.tables.numbers
    calm, moved = _followed(surface, track, wanted, load, "quiet")
    found = {"quiet": calm}
    for state, level, time in (
        ("stirred", math.sqrt(numbers.slow_level), numbers.slow_time),
        ("awake", math.sqrt(numbers.fast_level), numbers.fast_time),
    ):
        heard = float(moved[state].max())
        if heard < HEARD * level:
            continue
        lively, moved = _followed(surface, track, wanted, load, state)
        span = max(1, int(time / numbers.rate * track.rate))
        least = np.maximum.reduceat(moved[state], np.arange(0, len(moved[state]), span))[:-1].min(initial=math.inf)
        found = {state: lively}
        if least <= level:
            found["between"] = lively + min(level / heard, 1.0) * (calm - lively)
        calm = lively
    return found


def _followed(
    surface: UltrasonicSurface, track: _Track, wanted: Array, load: Array, state: str
) -> tuple[Array, dict[str, Array]]:
    """Amplitude (m) of a loop in this state, under a finger of changing load, and what its detectors hear."""
    p, judged = surface.parameters, track.judged
    least, most = float(load[judged].min()), float(load[judged].max())
    tabled = np.linspace(least, most, LOADS if most > least else 1)
    place = np.interp(load, tabled, np.arange(len(tabled))) if len(tabled) > 1 else np.zeros(len(load))
    amplitude, heard = np.zeros(len(load)), dict.fromkeys(("stirred", "awake"), np.zeros(len(load[judged])))
    for k, each in enumerate(tabled):
        loop = AmplitudeLoop(parameters=p, tables=surface.loop.tables, load=float(each), rise=track.rise, state=state)
        if np.max(loop.needed(wanted)[judged]) > DRIVEN * p.mode.drive_limit:
            raise NoBound(f"its amplitude may ask for more than {p.mode.drive_limit:g} V")
        weight = np.clip(1.0 - abs(place - k), 0.0, 1.0)
        played, slow, fast = loop.follow(wanted)
        amplitude += weight * played
        for state_heard, more in (("stirred", slow), ("awake", fast)):
            heard[state_heard] = heard[state_heard] + (weight * more)[judged]
    return amplitude, heard


def _seen(bands: Bands, track: _Track, apart: Array) -> Windows:
    """What the judge reads of frictions that are `apart` (N, (n,))."""
    late = track.judged
    asked = (track.envelope != 0.0)[late] & track.touched[late, None]
    signals, rates = (apart[late, None], _waveform(track)[late]), (track.rate, track.rate)
    return look(bands, rates, track.finger[late, POSITION], track.phase[late], signals, asked)


def _carrier_at_once(scene: Scene) -> Scene | str | None:
    """Leave out the carrier, or where it lies."""
    plant = scene.plant
    if plant.get("level", LEVEL[scene.device]) == "envelope":
        return None
    if scene.device == "electroadhesion" and plant.get("sensor") == "impedance":
        return "what is sensed is the gap's impedance at the carrier"
    return replace(scene, plant={**plant, "level": "envelope"})


LEVEL = {"electroadhesion": ElectroadhesionParameters.level, "ultrasonic": SurfaceParameters.level}
SCREEN_OPTIONS = (Option("level", "envelope", "every turn of the carrier", _carrier_at_once),)
SURFACE_OPTIONS = (Option("level", "envelope", "where the carrier lies", _carrier_at_once),)
