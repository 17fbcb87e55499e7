"""The band bank as a controller: from a band model and a few rules to the numbers of its compiled step."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel, FingerRange
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.carriers import REFRESH
from hapticrender.control.bank.kernels import bank_run
from hapticrender.control.bank.learning import ADAPTATION
from hapticrender.control.bank.state import PRECISIONS, BankNumbers, BankState, BankTables, across_bands, bank_state
from hapticrender.control.damping import choose_damping
from hapticrender.control.kernels import FREQUENCY, WAVENUMBER
from hapticrender.control.remembered import remembered
from hapticrender.control.stability import Checked, Limits, checked_bandwidth
from hapticrender.protocols import Array

RAMP_TIME = 0.05  # s: a target grows this long, so that it does not strike the modes
LEAST_RAMP = 0.5e-3  # s: and whatever the pace no faster, as drives end somewhere
FAST_POLE, FAST_SIGMAS = 30.0, 5.5  # Hz, of the sensor noise behind that pole
SLOW_POLE, SLOW_SIGMAS = 4.0, 5.0
SETTLED = 0.05  # share of a target below which its error counts as settled
LEAST_WANTED = 3e-3  # of the sensors' range: below it the noise makes up for more than the device
LIMITS = Limits(modulus=0.29, gain=1.4)  # crowded bands share one residual: 20 Hz apart they leave 0.30 and 1.42
PROMPT = 8  # samples: a longer delay is that of a block device, where the inner loop would act on stale noise
PHASE_MARGIN = math.pi / 4  # rad: 90 deg less integral gain times (delay + 1/observer pole)
LEARNING_SHARE = 0.5  # of what is found, learnt in a step at most: at 0.8 it swings under a light finger
LEARNING_TIME = 1 / 60  # s: fastest adaptation to what is always there; a delay counts twice
LEARNING_MARGIN = 5.0  # of the observer's pole over the adaptation, where that learns all of D
QUICK_LEVEL = 60.0  # Hz: bandwidth of the DC band while the step of a touch goes into it
BACK_TIME = 0.02  # s: back-calculation at the limit
TOUCHED_FADE = 1000.0  # 1/s: of a held mode at least
LEAST_NOISE = 1e-6  # of the sensors' range: thresholds never fall to nothing
ALWAYS = -1e300  # N: every load is larger


@dataclass(frozen=True, kw_only=True)
class BankRules:
    """How a method sets up the bank; rates in 1/s, bandwidths in Hz, times in s.

    Each pair is (in quiet, awake): a detector of the deviation, or contact, wakes the loop for `awake_time`.
    `integral` has a third number between them, for the slow detector; `level` is the least ratio of the lowest carrier
    to the bandwidth of the DC band.
    """

    error_observer: bool
    observer: tuple[float, float]
    integral: tuple[float, float, float]
    adapt: tuple[float, float]
    rest: tuple[float, float] = (0.0, 0.0)
    inner: tuple[float, float] = (0.0, 0.0)
    level: float = 8.0
    detect: bool = True
    awake_time: float = 0.15
    stirred_time: float = 0.4
    release: float = 0.05


class BankController:
    """The bank behind the `Controller` protocol.

    Parameters
    ----------
    method : str
        Name of the method that designed it.
    tables : BankTables
        Parameters of the compiled step.
    note : str
        What the design chose and why: the inner loop and its margins.
    precision : {"double", "single"}
        Of everything that a band owns; phases, and what the scenario owns, are always double.
    """

    def __init__(self, method: str, tables: BankTables, note: str = "", precision: str = "double") -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"{precision=}: must be one of {', '.join(PRECISIONS)}")
        self.method = method
        self.n_bands = tables.tone.shape[1]
        self.tables = tables
        self.note = note
        self.state = bank_state(tables, PRECISIONS[precision])

    def in_precision(self, precision: str) -> BankController:
        """Return the same design at rest, its bands in single or double precision."""
        return BankController(self.method, self.tables, self.note, precision)

    @property
    def mismatch(self) -> float:
        """Largest share of a fixed band's target that the integral part adds on the untouched device, once settled.

        There the law alone should do: what the integral has to make up for is what the device is not.
        """
        return settled_share(self.tables, self.state)

    @property
    def turns(self) -> Array:
        """Fixed part of each carrier's phase at the next sample (turns, 0 to 1, shape (bands,))."""
        left = -int(self.state.sample[0]) % REFRESH  # samples until the next refresh, for which the phase is kept
        step = np.mod(self.tables.tone[FREQUENCY] / self.tables.numbers.rate, 1.0)
        return np.mod(self.state.phase / 2.0**64 - left * step, 1.0)

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        drive = np.zeros((n, len(self.tables.speak)))
        target = np.zeros((n, self.n_bands), complex)
        flags = np.zeros(n, np.int64)
        bank_run(self.tables, self.state, np.ascontiguousarray(sensed, float), position, wanted, drive, target, flags)
        return drive, target, flags


def settled_share(tables: BankTables, state: BankState) -> float:
    """Largest share of a settled, fixed target that the integral part adds on the untouched device, else 0."""
    touch, band, loop, bands = state.touch, state.band, state.loop, tables.tone.shape[1]
    coordinates = range(0, loop.shape[1], row.LOOP_ROWS)

    def largest(re: int, im: int) -> Array:
        sizes = [np.hypot(*(across_bands(loop, base + part, bands) for part in (re, im))) for base in coordinates]
        return np.max(sizes, axis=0)

    size = np.hypot(*(across_bands(band, part, bands) for part in (row.R_RE, row.R_IM)))
    wanted = np.where(tables.tone[WAVENUMBER] == 0.0, size, 0.0)
    large = (wanted > LEAST_WANTED * tables.numbers.sensed_limit) & (largest(row.E_RE, row.E_IM) < SETTLED * wanted)
    settled = touch[row.CONTACT] == 0.0 and touch[row.TRUST] == 1.0 and touch[row.SCALE] == 1.0
    return float((largest(row.V_RE, row.V_IM)[large] / wanted[large]).max()) if settled and large.any() else 0.0


def spacing(bands: Bands) -> float:
    """Least distance between two fixed carriers (Hz); infinite where there is one or none."""
    return float(np.diff(np.sort(bands.frequency[bands.wavenumber == 0.0])).min(initial=np.inf))


def crowd_speed(bands: Bands, pole: float) -> float:
    """Speed (m/s) from which finger-locked carriers lie a deadbeat observer's `pole` (1/s) apart; 0 for one or none."""
    apart = np.diff(np.sort(bands.wavenumber[bands.wavenumber > 0.0])).min(initial=np.inf)
    return float(pole / apart) if np.isfinite(apart) else 0.0


def design_bank(
    method: str, model: BandModel, bands: Bands, rules: BankRules, *, feedback: bool = True
) -> BankController:
    """Apply the rules of FACTS section 3 (C, F): observer <= f0/2 and spacing/2 pi, loop <= f0/4, DC band <= f0/8."""
    rules = _paced(rules, model.pace)
    prompt = model.delay <= PROMPT
    damping = choose_damping(model, bending=model.bending) if any(rules.inner) and feedback and prompt else None
    if damping is None or not damping.margins:
        rules = replace(rules, inner=(0.0, 0.0))
    elif model.held:
        rules = replace(rules, inner=(rules.inner[1], rules.inner[1]))
    if (bands.wavenumber > 0.0).any():  # what is left over at one frequency is wrong at the next
        rules = replace(rules, rest=(0.0, 0.0))
    tables = BankTables(
        numbers=_numbers(model, bands, rules, feedback),
        tone=bands.tone(),
        listen=np.ascontiguousarray(model.coordinate_from_sensed[:, : None if feedback else 0]),
        speak=np.linalg.pinv(model.force_from_drive),
        mass=model.mass,
        damping=model.damping,
        stiffness=model.stiffness,
        shape=tuple(float(each) for each in model.pattern),
        taps=damping.taps if damping else np.zeros((len(model.mass), 1)),
        grip=damping.grip if damping else np.zeros(len(model.mass)),
    )
    why = "the method has none" if prompt else f"a delay of {model.delay} samples is that of a block device"
    notes = [damping.text() if damping else f"inner loop off: {why}"]
    if feedback:
        checked = _checked(tables)
        tables = tables._replace(numbers=checked.tables.numbers)
        notes += [*checked.notes, *(f"{state}: {margins}" for state, margins in checked.margins.items())]
    return BankController(method, tables, "\n".join(notes))


def _numbers(model: BandModel, bands: Bands, rules: BankRules, feedback: bool) -> BankNumbers:
    """Numbers of the compiled step: what the rules allow on this device for these bands."""
    period, lowest, quick = 1.0 / model.rate, _lowest(model, bands), 2 * math.pi * QUICK_LEVEL / model.rate
    return BankNumbers(
        rate=float(model.rate),
        analysed=bands.envelope is None,
        error_observer=rules.error_observer,
        lead=(model.delay + 0.5) * period,
        **_paces(model, bands, rules, lowest, feedback),
        age=(model.delay + 0.5) / ADAPTATION,
        rest=rules.rest[0],
        rest_awake=rules.rest[1],
        inner=rules.inner[0],
        inner_awake=rules.inner[1],
        **_detectors(model, rules),
        ramp=period / max(RAMP_TIME / model.pace, LEAST_RAMP),
        lowest=model.lowest_frequency,
        highest=min(model.highest_frequency, 0.4 * model.rate),
        highest_edge=float(model.highest_edge),
        drive_limit=float(model.drive_limit),
        drive_step=float(model.drive_step),
        peak_decay=math.exp(-period * lowest),
        back=_back(model),
        sensed_limit=float(model.sensed_limit),
        modulated=bands.modulated,
        differentiated=bands.differentiated,
        presence=model.finger.presence,
        dc_quick=1.6 * quick,
        dc_drift_quick=quick**2,
        shows=bands.shown is None and (model.late != 0.0 or model.foresight != 0.0),
        late=model.late,
        foresight=model.foresight,
        memory=model.memory,
        typical_speed=model.typical_speed,
        lock=2 * math.pi * model.lock,
        **_finger(model.finger),
    )


def _detectors(model: BandModel, rules: BankRules) -> dict[str, float]:
    """What wakes the loop, and for how long."""
    noise = np.sqrt((model.coordinate_from_sensed**2).sum(axis=1).max()) * max(
        model.sensed_noise, LEAST_NOISE * model.sensed_limit
    )
    period, fast, slow = 1.0 / model.rate, FAST_POLE * model.pace, SLOW_POLE * model.pace
    return {
        "fast_pole": -math.expm1(-2 * math.pi * fast * period),
        "slow_pole": -math.expm1(-2 * math.pi * slow * period),
        "fast_level": _threshold(FAST_SIGMAS, noise, fast, period) if rules.detect else math.inf,
        "slow_level": _threshold(SLOW_SIGMAS, noise, slow, period) if rules.detect else math.inf,
        "fast_time": rules.awake_time * model.rate,
        "slow_time": rules.stirred_time * model.rate,
        "release": period / rules.release,
    }


def _finger(finger: FingerRange) -> dict[str, float]:
    """How contact is felt, and what may be learnt of it."""
    contact_on, contact_off = finger.contact or (ALWAYS, ALWAYS)
    ranges = {name: getattr(finger, name) for name in ("mass", "damping", "stiffness")}
    return {
        "contact_on": contact_on,
        "contact_off": contact_off,
        "least_speed": finger.least_speed,
        "least_motion": finger.least_motion,
        "typical_mass": finger.typical_mass,
        "typical_stiffness": finger.typical_stiffness,
        **{f"least_{name}": least for name, (least, _) in ranges.items()},
        **{f"most_{name}": most for name, (_, most) in ranges.items()},
    }


def _back(model: BandModel) -> float:
    """Rate (1/s) of the back-calculation; of a held mode about as fast as it loses energy, lest it chase the limit.

    However little that is, a finger takes it away within a millisecond.
    """
    fade = float((model.damping.diagonal() / model.mass.diagonal()).min()) if model.held else math.inf
    return min(model.pace / BACK_TIME, max(fade, TOUCHED_FADE))


def _paced(rules: BankRules, pace: float) -> BankRules:
    """Rules for a device that is to be followed `pace` times as fast."""
    faster: dict[str, Any] = {
        name: tuple(pace * each for each in getattr(rules, name)) for name in ("observer", "integral", "adapt", "rest")
    }
    shorter = {name: getattr(rules, name) / pace for name in ("awake_time", "stirred_time", "release")}
    return replace(rules, **faster, **shorter)


def _lowest(model: BandModel, bands: Bands) -> float:
    """Lowest carrier (Hz): of the fixed ones, and of what a moving finger makes of the others."""
    locked = bands.wavenumber > 0.0
    return float(bands.frequency[~locked].min(initial=model.lowest_frequency if locked.any() else np.inf))


def _paces(model: BandModel, bands: Bands, rules: BankRules, lowest: float, feedback: bool) -> dict[str, float]:
    """How fast observer, integral, adaptation and DC band may run, by lowest carrier (Hz), spacing and delay."""
    apart = spacing(bands)
    if apart == 0.0:
        twice = np.sort(bands.frequency[bands.wavenumber == 0.0])
        raise ValueError(
            f"texture has two carriers at {twice[:-1][np.diff(twice) == 0.0][0]:g} Hz: must differ; add them up"
        )
    period = 1.0 / model.rate
    wait = model.delay * period  # integrator, observer and delay leave at least PHASE_MARGIN
    pole = [2 * math.pi * min(width, lowest / 2, apart / (2 * math.pi)) for width in rules.observer]
    fastest = [min(2 * math.pi * lowest / 4, PHASE_MARGIN / (wait + 1 / each)) for each in pole]
    learning = min(LEARNING_SHARE * model.rate / ADAPTATION, model.finger.fastest)
    if model.finger.contact is None:  # what is always there is as large as D, and the law far from it while it learns
        learning = min(1 / (2 * wait + LEARNING_TIME / model.pace), learning, pole[0] / LEARNING_MARGIN)
    level = 2 * math.pi * min(6.0, lowest / rules.level) * period
    paces = {
        "observer": 2 * pole[0] * period,
        "observer_awake": 2 * pole[1] * period,
        "dc": 1.6 * level,
        "dc_drift": level**2,
        "integral": min(rules.integral[0], fastest[0]),
        "integral_stirred": min(rules.integral[1], fastest[0]),
        "integral_awake": min(rules.integral[2], fastest[1]),
        "adapt": min(rules.adapt[0], learning),
        "adapt_awake": min(rules.adapt[1], learning),
    }
    if not feedback:
        paces = dict.fromkeys(paces, 0.0) | {"adapt": -1.0, "adapt_awake": -1.0}
    return paces | {"reference": 2 * pole[0] * period, "crowd_speed": crowd_speed(bands, max(pole))}


@remembered
def _checked(tables: BankTables) -> Checked:
    """Check the bandwidth."""
    return checked_bandwidth(tables, LIMITS)


def _threshold(sigmas: float, noise: float, pole: float, period: float) -> float:
    """Square (m2) of so many sigmas of 2 eps e^(-j phi) behind a pole (Hz), eps white of rms `noise` (m)."""
    return (sigmas * noise * math.sqrt(2 * math.pi * pole * period)) ** 2
