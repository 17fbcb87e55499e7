"""The plate: modes, exact discretisation, electronics, and the paper's misprints beside the right forms."""

from dataclasses import replace

import numpy as np
import pytest
from naive_plate import continuous, simulate, simulate_moving
from scipy.linalg import expm

import hapticrender as hr
from hapticrender.plants.kernels import plate_matrix, plate_system, series_at
from hapticrender.plants.propagator import GRIP, NARROWEST, WIDEST, WIDTH, shifts
from hapticrender.plants.vibrotactile import Plate, PlateParameters, plate_state, plate_tables
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, LIGHT_SECOND, NONE

IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0}


def modes_of(mass, stiffness):
    """Undamped frequencies (Hz), ascending."""
    return np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)) / (2 * np.pi)


def loaded_gain(plate, frequency, mechanics, position=0.0):
    """Heave per common current (m/A) with a finger on the plate."""
    stiffness = plate.dynamic_stiffness(frequency, mechanics.impedance(frequency), position)
    return np.linalg.solve(stiffness, np.array([2 * plate.force_constant, 0.0]))[..., 0]


def test_modes_are_those_of_the_facts():
    frequency, damping = PlateParameters().modes()
    np.testing.assert_allclose(frequency, [147.27, 189.38], atol=0.005)
    np.testing.assert_allclose(damping, [0.01737, 0.02232], atol=5e-6)


@pytest.mark.parametrize(
    ("finger", "expected"), [(LIGHT, (147.6, 189.2)), (HEAVY, (142.5, 180.0))], ids=["light", "heavy"]
)
def test_finger_at_the_coil_moves_the_modes(finger, expected):
    """FACTS 1: with a 4th-order finger at 27.5 mm, from the poles of the 6-state system."""
    a, _ = continuous(
        position=27.5e-3,
        skin=(finger.mass, finger.damping, finger.stiffness),
        phalanx=(finger.phalanx_mass, finger.phalanx_damping, finger.phalanx_stiffness),
    )
    poles = np.linalg.eigvals(a)
    modes = np.sort(abs(poles[(poles.imag > 0) & (abs(poles) > 2 * np.pi * 120)])) / (2 * np.pi)
    np.testing.assert_allclose(modes[:2], expected, atol=0.05)


@pytest.mark.parametrize("finger", [NONE, HEAVY_SECOND, HEAVY], ids=["none", "2nd order", "4th order"])
@pytest.mark.parametrize("position", [0.0, 15e-3, -55e-3])
def test_the_plate_is_integrated_exactly(rng, finger, position):
    """Zero-order hold against scipy's matrix exponential: equal to the rounding of 3000 steps."""
    touch = hr.Finger.still(position=position, normal_load=0.5, mechanics=finger)
    plate = Plate(PlateParameters(**IDEAL), touch)
    drive = rng.standard_normal((3000, 2))
    skin = (finger.mass, finger.damping, finger.stiffness)
    phalanx = (finger.phalanx_mass, finger.phalanx_damping, finger.phalanx_stiffness) if finger.order == 4 else None
    expected = simulate(
        np.clip(drive, -3, 3), 0.5, 5000.0, position=position, skin=skin if finger.order else (0, 0, 0), phalanx=phalanx
    )
    motion = plate.run(drive).motion
    assert abs(motion).max() > 1e-5
    np.testing.assert_allclose(motion, expected, rtol=0, atol=3000 * 2**-52 * abs(expected).max())


@pytest.mark.parametrize("scaled", [False, True])
def test_a_finger_that_moves_presses_and_lifts_is_integrated_sample_by_sample(rng, scaled):
    """By scipy's exponential of the plate frozen at each sample's place and grip; a new touch starts at rest."""
    load = ((0.0, 0.05, 0.1), (0.2, 1.4, 0.5))
    finger = hr.Finger(
        hr.Sliding(0.5, 0.1), normal_load=load, touches=((0.0, 0.03), (0.05, 1.0)), mechanics=HEAVY, load_scaling=scaled
    )
    drive = rng.uniform(-2, 2, (500, 2))
    time = np.arange(500) / 5000.0
    expected = simulate_moving(drive, finger.position(time), finger.load(time), finger.strength(time), HEAVY, 5000.0)
    motion = Plate(PlateParameters(**IDEAL), finger).run(drive).motion
    np.testing.assert_allclose(motion, expected, rtol=0, atol=500 * 2**-50 * abs(expected).max())
    assert len(set(finger.strength(time))) > (100 if scaled else 1)


@pytest.mark.parametrize("bending", [0.0, 1200.0], ids=["rigid", "bending"])
@pytest.mark.parametrize("mechanics", [LIGHT, HEAVY, HEAVY_SECOND], ids=["light", "heavy", "2nd order"])
def test_sliding_in_windows_is_as_exact_as_the_series(rng, mechanics, bending):
    """The same run, once with its windows shut: each sample's propagator differs by 2e-15, over 2000 samples."""
    parameters = PlateParameters(bending_frequency=bending, **IDEAL)
    finger = hr.Finger.sliding(speed=0.1, span=0.09, normal_load=0.8, mechanics=mechanics)
    drive = rng.uniform(-2, 2, (2000, 2))
    windowed, summed = Plate(parameters, finger), Plate(parameters, finger)
    summed._state.window[WIDTH] = 0.0
    motion, expected = windowed.run(drive).motion, summed.run(drive).motion
    assert windowed._state.window[GRIP] == 1.0  # one is open
    assert summed._state.window[GRIP] < 0.0
    assert not np.array_equal(motion, expected)
    np.testing.assert_allclose(motion, expected, rtol=0, atol=2000 * 2e-15 * abs(expected).max())


def test_a_window_that_is_too_wide_shrinks_until_its_polynomial_is_exact():
    """A light finger on rigid glass needs none of it; bending glass follows the finger's place more closely."""
    finger = hr.Finger.sliding(speed=0.1, span=0.09, normal_load=0.3, mechanics=LIGHT)
    widths = []
    for bending in (0.0, 1200.0):
        plate = Plate(PlateParameters(bending_frequency=bending), finger)
        plate.run(np.zeros((100, 2)))
        widths.append(plate._state.window[WIDTH])
    assert widths[0] == WIDEST
    assert NARROWEST < widths[1] < WIDEST


def test_a_plate_of_another_kind_need_not_be_told_from_others():
    """Numbers of plates are remembered by what they are equal by; one that is not goes without."""

    class Odd(PlateParameters):
        __hash__ = None

    assert plate_tables(Odd(), hr.Finger.absent()) == plate_tables(PlateParameters(), hr.Finger.absent())
    with pytest.raises(TypeError):
        Plate(PlateParameters(sensor_noise=0.0), hr.Finger.absent(), "x")


def propagator(parameters, mechanics, place, strength):
    """Phi and Gamma (n, n + 3) that the plate uses for a finger, and by scipy's exponential of the same A and B."""
    state = plate_state(0)
    tables = plate_tables(parameters, hr.Finger.still(mechanics=mechanics, normal_load=0.4, load_scaling=True))
    series_at(tables, state, place / parameters.half_spacing, strength, state.step, 0)
    n, rates = (8, [3, 4, 7]) if tables.flexible else (6, [3, 4])
    block = np.zeros((n + 3, n + 3))
    block[:n, :n] = state.system[:n, :n].T
    block[rates, n:] = state.push.T[: len(rates)]
    kept = np.concatenate([state.step[0, :n], state.step[0, 8:]])
    return kept[:, :n].T, expm(block)[:n]


@pytest.mark.parametrize("levels", [{}, {"degrees_of_freedom": 1}, {"bending_frequency": 1200.0}, {"rate": 48000.0}])
@pytest.mark.parametrize("mechanics", [NONE, LIGHT, HEAVY, HEAVY_SECOND], ids=["none", "light", "heavy", "2nd order"])
def test_the_series_is_the_exponential_to_rounding(levels, mechanics):
    """Column by column, to 8 roundings of its largest entry: 15 to 22 terms, summed from the smallest."""
    for place in (0.0, 20e-3, -55e-3):
        for strength in (0.0, 1.0, 3.0):
            mine, expected = propagator(PlateParameters(**levels), mechanics, place, strength)
            assert (abs(mine - expected).max(axis=0) <= 8 * 2**-53 * abs(expected).max(axis=0)).all()


def stop_and_go(time):
    """A finger (m) that slides, rests, turns and jumps."""
    return 0.01 * np.sin(2 * np.pi * 2 * np.clip(time, 0.0, 0.1)) + np.where((0.15 < time) & (time < 0.2), 0.02, 0.0)


def test_a_finger_that_stops_turns_and_jumps_is_as_exact_and_splits_alike(rng):
    """Windows, series and rest in one run; the series alone differs by 2e-15 a sample."""
    positions = tuple(stop_and_go(np.arange(1500) / 5000.0))
    finger = hr.Finger.sampled(positions, rate=5000.0, normal_load=0.8, mechanics=HEAVY)
    drive = rng.uniform(-2, 2, (1500, 2))
    parameters = PlateParameters(**IDEAL)
    summed, pieces = Plate(parameters, finger), Plate(parameters, finger)
    whole = Plate(parameters, finger).run(drive).motion
    summed._state.window[WIDTH] = 0.0
    np.testing.assert_allclose(whole, summed.run(drive).motion, rtol=0, atol=1500 * 2e-15 * abs(whole).max())
    parts = [pieces.run(part).motion for part in np.split(drive, [1, 499, 500, 501, 502, 760, 1001])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_a_run_equals_its_pieces(rng):
    finger = hr.Finger.sliding(speed=0.1, normal_load=0.8, mechanics=HEAVY)
    drive = rng.standard_normal((1000, 2))
    whole = Plate(PlateParameters(), finger, seed=3).run(drive)
    pieces = Plate(PlateParameters(), finger, seed=3)
    parts = [pieces.run(part) for part in np.split(drive, [1, 7, 500, 501])]
    for name in ("sensed", "motion", "flags"):
        assert np.array_equal(getattr(whole, name), np.concatenate([getattr(part, name) for part in parts]))


@pytest.mark.parametrize("frequency", [20.0, 147.0, 189.0, 400.0])
def test_measured_response_is_the_predicted_one(frequency):
    """Hold, its half-sample delay and its images k rate + f included.

    The transient has decayed by exp(-2 pi 2.56 * 6); images past the 50th hold less than (f/rate)^3/(2 50^2) < 1e-6.
    """
    parameters = PlateParameters(**IDEAL)
    model = parameters.band_model(5000.0, 1)
    n = np.arange(40_000)
    carrier = np.exp(2j * np.pi * frequency * n / 5000.0)
    plate = Plate(parameters, hr.Finger.absent())
    motion = plate.run(0.01 * np.stack([carrier.real, 0.5 * carrier.real], axis=1)).motion
    late = slice(30_000, 40_000)
    measured = 2 * (motion[late] * carrier[late, None].conj()).mean(axis=0) / 0.01
    images = frequency + 5000.0 * np.arange(-50, 51)
    hold = np.sinc(images / 5000.0) * np.exp(-1j * np.pi * images / 5000.0)
    predicted = model.place_from_coordinate @ (hold[:, None] * (model.response(images) @ [1.0, 0.5])).sum(axis=0)
    np.testing.assert_allclose(measured, predicted, rtol=1e-6)


def test_a_locked_rocking_mode_leaves_heave_alone():
    drive = np.zeros((2000, 2))
    drive[:, 0] = np.sin(np.arange(2000) * 0.1)
    motion = Plate(PlateParameters(degrees_of_freedom=1, **IDEAL), hr.Finger.absent()).run(drive).motion
    assert abs(motion[:, 0]).max() > 1e-6
    np.testing.assert_array_equal(motion[:, 1], motion[:, 0])
    two = Plate(PlateParameters(**IDEAL), hr.Finger.absent()).run(drive).motion
    assert abs(two[:, 1] - two[:, 0]).max() > 1e-6


def test_electronics_quantise_clip_and_flag():
    """FACTS 1, swapped in the paper: 12 bits command the current, 14 bits sense the motion."""
    parameters = PlateParameters(sensor_noise=0.0)
    assert parameters.current_step == pytest.approx(1.46e-3, abs=5e-6)
    assert parameters.sensor_step == pytest.approx(2e-3 / 2**14)
    slow = np.repeat(np.linspace(0, 4 * parameters.current_step, 9), 2000)[:, None] * np.ones(2)
    plate = Plate(parameters, hr.Finger.absent())
    sensed = plate.run(slow)
    settled = sensed.motion[1999::2000, 0]  # to exp(-2 pi 2.56 * 0.4)
    steps = np.unique(np.round(settled / settled[-1], 2))
    assert len(steps) == 5  # nine commands, five currents
    counts = sensed.sensed / parameters.sensor_step
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    loud = Plate(parameters, hr.Finger.absent()).run(np.full((4000, 2), 300.0))
    limit = Plate(parameters, hr.Finger.absent()).run(np.full((4000, 2), 3.0))
    np.testing.assert_array_equal(loud.motion, limit.motion)
    small = PlateParameters(sensor_noise=0.0, sensor_range=2e-4)
    pressed = Plate(small, hr.Finger.still(normal_load=10.0)).run(np.zeros((4000, 2)))  # sags 220 um
    assert abs(pressed.sensed).max() <= 1e-4
    assert pressed.flags.max() == hr.Flag.SENSOR_CLIPPED


def test_sensor_noise_is_white_and_as_strong_as_stated():
    """1 um rms; the standard error of an rms over N samples is 1/sqrt(2N)."""
    sensed = Plate(PlateParameters(sensor_bits=0), hr.Finger.absent(), seed=1).run(np.zeros((50_000, 2))).sensed
    np.testing.assert_allclose(sensed.std(axis=0), 1e-6, rtol=4 / np.sqrt(2 * 50_000))
    correlation = (sensed[1:] * sensed[:-1]).mean(axis=0) / 1e-12
    assert np.all(abs(correlation) < 4 / np.sqrt(50_000))


def test_loop_delay_is_the_stated_number_of_samples():
    for delay, block in ((1, 1), (5, 1), (5, 5), (8, 4)):
        plate = Plate(PlateParameters(delay=delay, **IDEAL), hr.Finger.absent(), block=block)
        drive = np.zeros((40, 2))
        drive[10] = 1.0
        first = int(np.flatnonzero(plate.run(drive).motion[:, 0])[0])
        assert first == 10 + (delay - block) + 1  # held during its interval, seen at the end of it
    with pytest.raises(ValueError, match=r"block = 3: must be between 1 and the loop's delay of 2"):
        Plate(PlateParameters(delay=2), hr.Finger.absent(), block=3)


def test_static_load_and_position_from_the_sag():
    """FACTS 1: the printed P divides by zero where side 1 does not sag; the right form gives the position."""
    parameters = PlateParameters(**IDEAL)
    for position in (0.0, 10e-3, -20e-3):
        finger = hr.Finger.still(position=position, normal_load=0.5, mechanics=NONE)
        centre, end_1, end_2 = Plate(parameters, finger).run(np.zeros((50_000, 2))).motion[-1]
        tilt = (end_2 - end_1) / 4  # a theta
        load, found = parameters.static_load(centre - tilt, centre + tilt)
        assert load == pytest.approx(0.5, rel=1e-6)
        assert found == pytest.approx(position, abs=1e-8)
    assert centre == pytest.approx(-11e-6, rel=0.05)  # FACTS 1: 0.5 N sags 11 um

    def printed(x1, x2):  # distance from transducer 2 towards 1, as in the paper
        with np.errstate(divide="raise"):
            return np.float64(55e-3) * (22.9e3 * np.float64(x2) / (22.4e3 * np.float64(x1)) + 1) ** -1

    load, found = parameters.static_load(-4e-6, -1e-5)
    assert printed(-4e-6, -1e-5) == pytest.approx(parameters.half_spacing - found, rel=1e-12)  # the same number
    with pytest.raises(FloatingPointError):
        printed(0.0, -1e-5)
    load, found = parameters.static_load(0.0, -1e-5)
    assert found == pytest.approx(parameters.half_spacing)
    with pytest.raises(ValueError, match="no net load"):
        parameters.static_load(0.0, 0.0)


def test_printed_force_equations_put_the_rocking_mode_at_185_hz():
    """As printed, (m/2) x_i'' -+ (I/2) theta''; with I/d but x_i'' kept; and right, (m/2) x_c'' -+ (I/d) theta''."""
    p = PlateParameters()
    d, stiffness = p.coil_spacing, np.diag([p.stiffness_1, p.stiffness_2])
    twist = np.array([[1.0, -1.0], [-1.0, 1.0]]) / d  # -+ theta'' from x_i''
    own = p.mass / 2 * np.eye(2)
    mean = p.mass / 4 * np.ones((2, 2))
    assert modes_of(own + p.inertia / 2 * twist, stiffness).min() == pytest.approx(185.0, abs=0.05)
    assert modes_of(own + p.inertia / d * twist, stiffness).min() == pytest.approx(116.2, abs=0.05)
    right = modes_of(mean + p.inertia / d * twist, stiffness)
    np.testing.assert_allclose(right, modes_of(p.mass_matrix, p.stiffness_matrix), rtol=1e-12)
    assert right.min() == pytest.approx(147.27, abs=0.005)
    same = own + (p.inertia / d - p.mass * d / 4) * twist  # the other way to write it
    np.testing.assert_allclose(same, mean + p.inertia / d * twist, atol=1e-15)
    coefficient = p.inertia / d - p.mass * d / 4  # N s2/rad
    assert coefficient == pytest.approx(2.873e-4, abs=5e-8)
    for wrong in (own + p.inertia / 2 * twist, mean + p.inertia / d * twist):
        np.testing.assert_allclose(wrong.sum(axis=0), p.mass / 2, rtol=1e-12)  # F1 + F2 is unaffected


def test_a_finger_does_not_always_lower_the_gain():
    """FACTS 1, against the paper's "the finger always adds impedance"."""
    plate = PlateParameters()
    frequency = np.arange(20.0, 401.0)
    free = abs(loaded_gain(plate, frequency, NONE))
    light = abs(loaded_gain(plate, frequency, LIGHT_SECOND)) / free
    raised = frequency[light > 1.0]
    assert (raised.min(), raised.max()) == (pytest.approx(36, abs=1), pytest.approx(182, abs=1))
    assert light.max() == pytest.approx(1.94, abs=0.01)
    assert frequency[light.argmax()] == pytest.approx(176, abs=1)
    heavy = abs(loaded_gain(plate, np.array([189.0]), HEAVY))
    assert heavy[0] / free[frequency == 189][0] == pytest.approx(0.26, abs=0.01)


def test_amplifier_inverts_and_the_phase_cut_needs_the_sign_taken_out():
    """-V/5: voltage to displacement lies in 0..+180 deg, current to displacement in -180..0."""
    plate = PlateParameters()
    assert plate.amplifier_gain == pytest.approx(-0.1999, abs=5e-5)
    drive = np.full((100, 2), 0.5)
    nominal, doubled = (
        Plate(PlateParameters(amplifier_r1=r1, **IDEAL), hr.Finger.absent()).run(drive).motion for r1 in (10e3, 5e3)
    )
    np.testing.assert_allclose(doubled, 2 * nominal, rtol=1e-12)  # half of R1 gives twice the current
    current = np.angle(loaded_gain(plate, np.linspace(20, 400, 500), NONE), deg=True)
    voltage = np.angle(-np.exp(1j * np.radians(current)), deg=True)
    assert current.max() < 0.0
    assert current.min() > -180.0
    assert voltage.min() > 0.0
    assert voltage.max() < 180.0


def test_noise_floor_of_the_paper_is_a_record_length_artefact(rng):
    """0.0102 um is the mean line of a 1 s, 30 kHz spectrum of 1 um white noise: sqrt(pi/N) sigma."""
    noise = 1e-6 * rng.standard_normal(30_000)
    lines = 2 * abs(np.fft.rfft(noise))[1:-1] / noise.size
    assert lines.mean() == pytest.approx(0.0102e-6, abs=0.0002e-6)
    assert np.sqrt(np.pi / 30_000) == pytest.approx(0.01023, abs=5e-6)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"mass": 0.0}, r"mass = 0.0: must be > 0 kg"),
        ({"mass": True}, r"mass = True: must be a number"),
        ({"delay": 0}, r"delay = 0: must be >= 1 samples"),
        ({"delay": 1.5}, r"delay = 1.5: must be an integer"),
        ({"sensor_noise": -1e-6}, r"sensor_noise = -1e-06: must be >= 0 m"),
        ({"rate": 10.0}, r"rate = 10.0: must be >= 500 Hz"),
        ({"degrees_of_freedom": 3}, r"degrees_of_freedom = 3: must be <= 2"),
        ({"masss": 1.0}, r"plant.masss: no such parameter; known: .*mass"),
        ({"stiffness_1": float("nan")}, r"stiffness_1 = nan: must be > 0 N/m"),
    ],
)
def test_bad_parameters_are_refused_with_value_bound_and_unit(overrides, message):
    with pytest.raises((ValueError, TypeError), match=message):
        PlateParameters.with_overrides(overrides)


@pytest.mark.parametrize("overrides", [{}, {"bending_frequency": 1250.0}, {"degrees_of_freedom": 1}])
@pytest.mark.parametrize("strength", [0.0, 1.0, 7.0])
def test_the_matrix_that_counts_the_terms_is_that_of_the_kernel(overrides, strength):
    """Two ways to A, of which only one is compiled: their entries differ by rounding, some 1e2 operations of 1e-16."""
    finger = hr.Finger.still(normal_load=0.5, mechanics=HEAVY)
    tables = plate_tables(replace(PlateParameters(), **overrides), finger)
    kept = [0, 1, 6, 2, 3, 4, 7, 5] if tables.flexible else [0, 1, 2, 3, 4, 5]
    rows = slice(None) if tables.flexible else [0, 1, 3, 4, 5, 7]
    for lever in (0.0, 0.3, tables.reach):
        system = shifts()
        plate_system(tables, lever, strength, system, np.zeros((3, 3)))
        found = plate_matrix(tables, lever, strength)[rows][:, rows]
        np.testing.assert_allclose(found, system.T[np.ix_(kept, kept)], rtol=1e-12, atol=1e-14 * abs(system).max())
