"""The paper's figures about the closed loop, run again on the simulated plate under a simulated finger.

References
----------
Grigorii et al. 2021, Figs. 4 and 5 and the sections around them.
"""

from __future__ import annotations

from functools import partial
from math import pi, sqrt
from typing import Any

import numpy as np

from hapticrender.control.stdft import StarSTDFT
from hapticrender.control.transfer import butterworth
from hapticrender.loop import render
from hapticrender.paper.claims import Claim, Item, Table
from hapticrender.paper.formulas import FILTER, FREQUENCIES, LOOP
from hapticrender.plants.vibrotactile import PLACES, PlateParameters
from hapticrender.protocols import Array
from hapticrender.recordings.recording import Recording
from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.mechanics import HEAVY
from hapticrender.touch.scene import Scene

METHODS = ("paper", "paper-common", "h2")
CARRIER = 261.0  # Hz, of Fig. 4
AMPLITUDES = (1e-6, 10e-6, 100e-6)  # m, of Fig. 4
LOAD = 0.5  # N, of Fig. 4
EXPLORING = partial(Finger.sliding, speed=0.1, span=0.09, normal_load=LOAD, touches=((1.0, 4.5),))
IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0}
THINNED = 25  # samples a row of the tables over time


def _run(frequency: float, amplitude: float, finger: Finger, method: str, seconds: float, **plant: Any) -> Recording:
    """Render one grating in closed loop."""
    texture = Grating(frequency=frequency, amplitude=amplitude)
    return render(Scene(texture=texture, finger=finger, duration=seconds, plant=plant, keep_unfelt=True), method=method)


def _amplitudes(recording: Recording, frequency: float, start: float, stop: float) -> Array:
    """Mean amplitude (m) at the centre and both ends between two times (s)."""
    time = recording.time
    chosen = (time >= start) & (time < stop)
    turn = np.exp(-2j * pi * frequency * time[chosen])
    motion = recording.motion[chosen]
    return np.abs(2 * np.mean((motion - motion.mean(axis=0)) * turn[:, None], axis=0))


def _off(recording: Recording, frequency: float, wanted: float, start: float, stop: float) -> Array:
    """How far the mean amplitudes are off (%), at the centre and both ends."""
    return 100 * (_amplitudes(recording, frequency, start, stop) / wanted - 1)


def commanded() -> Item:
    """Commanded amplitudes at 261 Hz under a sliding finger."""
    runs = {
        (finger, wanted, method): _run(CARRIER, wanted, EXPLORING(mechanics=finger), method, 5.0)
        for finger in ("light", "heavy")
        for wanted in AMPLITUDES
        for method in METHODS
    }
    off = {key: _off(recording, CARRIER, key[1], 1.5, 4.5) for key, recording in runs.items()}
    shown = [runs["heavy", wanted, "paper"] for wanted in AMPLITUDES]
    wobble, expected = _wobble()
    line = 1e6 * PlateParameters().sensor_noise * sqrt(pi / 30_000)
    claims = [
        Claim(
            what=f"amplitude under a {finger} finger that slides, {1e6 * wanted:g} µm wanted", paper=1e6 * wanted,
            ours=1e6 * wanted * (1 + off[finger, wanted, "paper"][0] / 100), within=0.05e6 * wanted, unit="µm",
            why="the printed figure can be read to 5 %",
        )
        for finger in ("light", "heavy") for wanted in AMPLITUDES
    ]  # fmt: skip
    upward = shown[1].motion[:, 1:].max() * 1e6
    return Item(
        name="commanded",
        title="Commanded amplitudes at 261 Hz under a sliding finger of 0.5 N",
        where="Fig. 4 A and B",
        claims=(
            *claims,
            Claim(
                what="highest rise of an end above rest, beyond the amplitude, finger at the far end",
                paper=0, ours=float(upward - 1e6 * AMPLITUDES[1]), within=0, unit="µm", relation=">=",
            ),
            Claim(
                what="mean line of the spectrum of the sensor's noise, 1 s at 30 kHz", paper=0.01, ours=line,
                within=0.005, unit="µm", why="1 µm rms times sqrt(pi/30000)",
            ),
            Claim(
                what="accuracy: wobble of the plate through the loop", paper=0.01, ours=wobble, within=0.005,
                unit="µm rms", check=expected, why="the printed floor is that of the record's length; what the loop "
                "makes of 1 µm of noise is the check: 1 µm sqrt(2 B/rate), B the noise bandwidth of T L",
            ),
        ),
        tables={"errors": _error_table(off), **_commanded_tables(shown)},
        note="Method “paper” controls each side apart, “paper-common” their mean, “h2” is the default here.",
    )  # fmt: skip


def _wobble() -> tuple[float, float]:
    """Motion of the centre (um rms) that the sensors' noise makes through the loop: simulated, and in closed form.

    Each side follows the noise of its amplitude and phase, of density 4 s^2/rate each, through T L; half of both is
    the motion's, and the centre is the mean of two sides.
    """
    exact = {key: value for key, value in IDEAL.items() if key != "sensor_noise"}
    noisy, quiet = (
        _run(CARRIER, 10e-6, Finger.absent(), "paper", 62.0, **plant).motion[10_000:, 0] for plant in (exact, IDEAL)
    )
    parameters = PlateParameters()
    frequency = np.arange(0.0, 500.0, 0.01)
    through = butterworth(LOOP).frequency_response(frequency) * butterworth(FILTER).frequency_response(frequency)
    bandwidth = float(np.sum(np.abs(through) ** 2) * 0.01)
    return float(1e6 * (noisy - quiet).std()), 1e6 * parameters.sensor_noise * sqrt(2 * bandwidth / parameters.rate)


def _error_table(off: dict[tuple[str, float, str], Array]) -> Table:
    """Errors of every run, a row each."""
    return {
        "finger": np.array([finger for finger, _, _ in off]),
        "wanted (um)": np.array([1e6 * wanted for _, wanted, _ in off]),
        "method": np.array([method for _, _, method in off]),
        **{f"{place}, off by (%)": np.array([each[i] for each in off.values()]) for i, place in enumerate(PLACES)},
    }


def _commanded_tables(shown: list[Recording]) -> dict[str, Table]:
    """Motion over time and its spectrum, of three amplitudes."""
    time = shown[0].time
    close = (time >= 2.0) & (time < 2.02)
    whole = (time >= 2.0) & (time < 4.0)
    size = int(whole.sum())
    frequency = np.fft.rfftfreq(size, 1 / shown[0].rate)
    spectra = [2 / size * np.abs(np.fft.rfft(each.motion[whole, 0])) for each in shown]
    middle = shown[1]
    slow = StarSTDFT(bandwidth=FILTER, rate=middle.rate).start(channels=1, bands=1)
    sag = slow.run(middle.motion[:, 2:], np.zeros((len(middle), 1)))[:, 0, 0].real / 2
    names = [f"{1e6 * wanted:g} um wanted (um)" for wanted in AMPLITUDES]
    return {
        "centre": {"time (s)": time[close]}
        | {name: 1e6 * each.motion[close, 0] for name, each in zip(names, shown, strict=True)},
        "spectrum": {"frequency (Hz)": frequency[1:]}
        | {name: 1e6 * each[1:] for name, each in zip(names, spectra, strict=True)},
        "end 2": {
            "time (s)": time[::3],
            "displacement (um)": 1e6 * middle.motion[::3, 2],
            "without what is slow (um)": 1e6 * (middle.motion[:, 2] - sag)[::3],
            "finger (mm)": 1e3 * middle.position[::3],
        },
    }


def frequencies() -> Item:
    """The eight frequencies on the free plate, and under a heavy finger."""
    wanted = 10e-6
    fingers = {
        "free": Finger.absent(),
        "heavy": Finger.sliding(speed=0.1, span=0.03, normal_load=LOAD, mechanics="heavy"),
    }
    off = {
        (name, method): np.array(
            [
                _off(_run(float(each), wanted, finger, method, 6.0), float(each), wanted, 4.0, 6.0)
                for each in FREQUENCIES
            ]
        )
        for name, finger in fingers.items()
        for method in METHODS
    }
    return Item(
        name="frequencies",
        title="10 µm at the eight frequencies",
        where="“precise … 20Hz - 400Hz”, and the phase loop under “Computing filter and control dynamics”",
        claims=tuple(
            Claim(
                what=f"amplitude at {frequency:g} Hz off by, centre, free plate", paper=0, ours=float(error), within=5,
                unit="%", check=_one_sided(float(frequency)) if frequency == 170 else None,
                why="“precise” read as 5 %" if frequency != 170 else
                "a coil moves the other side more than its own here, so the two loops fight until one coil gives up; "
                "check: the table's gains with one coil at rest",
            )
            for frequency, error in zip(FREQUENCIES, off["free", "paper"][:, 0], strict=True)
        ),
        tables={
            name: {"frequency (Hz)": FREQUENCIES}
            | {
                f"{method}, {place} (%)": off[name, method][:, i]
                for method in METHODS
                for i, place in enumerate(PLACES)
            }
            for name in fingers
        },
        note="Errors of the mean amplitude over 2 s; at 20 Hz the sag under the finger disturbs the paper's estimate.",
    )  # fmt: skip


def _one_sided(frequency: float) -> float:
    """Error of the centre (%) where one coil alone holds its own side at the target, the stronger of the two."""
    parameters = PlateParameters()
    model = parameters.band_model(parameters.rate, parameters.delay)
    motion = np.linalg.solve(parameters.dynamic_stiffness(np.array(frequency)), parameters.force_from_drive)
    own = np.abs(np.diag(model.side_from_coordinate @ motion))
    return float(100 * (np.abs(motion[0]) / own - 1).max())


def press() -> Item:
    """What a still press of 0.5 N does to the amplitude that the loop holds."""
    finger = Finger.still(position=0.0, normal_load=LOAD, mechanics="none")
    off = {
        (wanted, method): np.array(
            [
                _off(_run(each, wanted, finger, method, 9.0, sensor_noise=0.0), each, wanted, 4.0, 9.0)[0]
                for each in FREQUENCIES.tolist()
            ]
        )
        for wanted in AMPLITUDES
        for method in ("paper", "h2")
    }
    claims = [
        Claim(
            what=f"{1e6 * wanted:g} µm at {frequency:g} Hz, off by", paper=0, ours=float(off[wanted, "paper"][at]),
            within=1, unit="%", check=_blinded(frequency, wanted),
            why="“ignores … displacement due to the applied normal load”; the sag of 11 µm leaks through L at the "
            "carrier; check: the mean modulus of target and leak",
        )
        for wanted, at, frequency in ((1e-6, 0, 20.0), (10e-6, 0, 20.0), (1e-6, 6, 261.0), (10e-6, 6, 261.0))
    ]  # fmt: skip
    return Item(
        name="press",
        title="A press of 0.5 N on a steady amplitude",
        where="Fig. 4 A, and the end of “Computing filter and control dynamics”",
        claims=tuple(claims),
        tables={
            "errors": {"frequency (Hz)": FREQUENCIES}
            | {f"{1e6 * wanted:g} um, {method} (%)": values for (wanted, method), values in off.items()}
        },
        note="As the paper says where the amplitude is well above the leak; not where both are small and slow.",
    )


def _blinded(frequency: float, wanted: float) -> float:
    """Error (%) of a loop that holds the mean modulus of its amplitude A and the leak s at `wanted`: A + s^2/(4 A)."""
    parameters = PlateParameters()
    sag = LOAD / (parameters.stiffness_1 + parameters.stiffness_2)
    leak = 2 * sag * abs(butterworth(FILTER).frequency_response(frequency))
    if leak > wanted:
        return -100.0
    return 100 * ((1 + sqrt(1 - (leak / wanted) ** 2)) / 2 - 1)


def extraction() -> Item:
    """Load, place and impedance of a simulated finger, found from sensors and currents as the paper does it."""
    frequency = 111.0
    finger = Finger.swiping(
        frequency=0.5, stroke=0.03, mechanics="heavy", load_scaling=True,
        normal_load=((0.0, 1.0, 5.0, 9.0), (0.2, 0.2, 1.2, 0.2)), touches=((1.0, 9.0),),
    )  # fmt: skip
    recording = _run(frequency, 50e-6, finger, "paper", 10.0)
    load, place, impedance = _extract(recording, frequency)
    time = recording.time
    judged = (time > 1.5) & (time < 8.5)
    true = HEAVY.load_factor(recording.normal_load) * abs(HEAVY.impedance(np.array([frequency]))[0])
    exponent = float(np.polyfit(np.log(recording.normal_load[judged]), np.log(abs(impedance[judged])), 1)[0])
    off = {
        "W": _rms((load - recording.normal_load)[judged]),
        "P": 1e3 * _rms((place - recording.position)[judged]),
        "Z": 100 * _rms(abs(impedance)[judged] / true[judged] - 1),
    }
    rows = slice(None, None, THINNED)
    return Item(
        name="extraction",
        title="Load, place and impedance of a finger from the plate's own signals, at 111 Hz",
        where="Fig. 5, and “Finger load, kinematics, and impedance”",
        claims=(
            Claim(
                what="W from the sag against the load, rms", paper=0, ours=off["W"],
                within=0.05, unit="N", why="5 % of 1 N",
            ),
            Claim(
                what="P against the place, rms", paper=0, ours=off["P"], within=5,
                unit="mm", why="against the 30 mm in which the paper judges; it lags by the 10 Hz filter",
            ),
            Claim(
                what="|Z_f| against the finger's, rms", paper=0, ours=off["Z"],
                within=10, unit="%", why="a tenth: below the load's own effect",
            ),
            Claim(
                what="exponent of |Z_f| over W", paper=1 / 3, ours=exponent, within=0.05,
                why="put into the finger here; what is tested is that the procedure gives it back",
            ),
        ),
        tables={
            "over time": {
                "time (s)": time[rows],
                "load (N)": recording.normal_load[rows],
                "W found (N)": load[rows],
                "place (mm)": 1e3 * recording.position[rows],
                "P found (mm)": 1e3 * np.where(np.isfinite(recording.position), place, np.nan)[rows],
                "|Z_f| (N s/m)": np.where(np.isfinite(recording.position), true, np.nan)[rows],
                "|Z_f| found (N s/m)": np.where(np.isfinite(recording.position), abs(impedance), np.nan)[rows],
            }
        },
        note="A simulated finger in place of the printed participant: swipes of 30 mm, 0.2 to 1.2 N, |Z_f| growing as "
        "W^(1/3). P counts from transducer 2 towards 1, and is shown from the middle towards 2; as printed, it divides "
        "by zero where side 1 does not sag.",
    )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _extract(recording: Recording, frequency: float) -> tuple[Array, Array, Array]:
    """W (N), place from the middle (m) and Z_f (complex, N s/m) at every sample, low-passed at 10 Hz.

    The current acts half a sample late on average, being held over the sample that follows its command.
    """
    parameters, w = PlateParameters(), 2 * pi * frequency
    model = parameters.band_model(recording.rate, parameters.delay)
    listen = StarSTDFT(bandwidth=FILTER, rate=recording.rate)
    signals = np.column_stack([recording.sensed @ model.coordinate_from_sensed.T, recording.drive])
    phase = (w * recording.time)[:, None]
    slow = listen.start(channels=4, bands=1).run(signals, 0 * phase)[:, :2, 0].real / 2
    fast = listen.start(channels=4, bands=1).run(signals, phase)[:, :, 0]
    sides, moving = slow @ model.side_from_coordinate.T, fast[:, :2] @ model.side_from_coordinate.T
    carried = sides * [parameters.stiffness_1, parameters.stiffness_2]
    load = -carried.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = parameters.half_spacing + parameters.coil_spacing * carried[:, 0] / load
    stiffness = np.array([parameters.stiffness_1, parameters.stiffness_2])
    damping = np.array([parameters.damping_1, parameters.damping_2])
    taken = moving @ (stiffness + 1j * w * damping - parameters.mass / 2 * w**2)
    force = parameters.force_constant * fast[:, 2:].sum(axis=1) * np.exp(-0.5j * w / recording.rate) - taken
    at = np.nan_to_num(recording.position)
    velocity = 1j * w * (fast[:, 0] + at / parameters.half_spacing * fast[:, 1])
    return load, place, np.divide(force, velocity, out=np.zeros_like(force), where=velocity != 0)
