"""The figures of ``python -m benchmarks.bounds``, against equations solved by another way and closed forms."""

import numpy as np
import pytest

from benchmarks.bounds import DampedPlate, bent, touch_errors
from hapticrender.accuracy.plate import BENT
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, NONE


@pytest.mark.parametrize("share", [1.0, 0.0], ids=["ends", "heave"])
@pytest.mark.parametrize("finger", [NONE, HEAVY], ids=["free", "heavy"])
def test_what_a_bending_mode_leaves_solves_the_equations_of_motion(finger, share):
    """In x_c, e and F, solved as they stand, the ends or heave at 1."""
    frequency, place = 261.0, 12e-3
    omega, mode, coil = 2 * np.pi * frequency, 2 * np.pi * BENT.bending_frequency, BENT.bending_coil
    phi, tissue = BENT.displacement(place)[2], 1j * omega * finger.impedance(np.array(frequency))
    heave = BENT.stiffness_1 + BENT.stiffness_2 - BENT.mass * omega**2
    heave += 1j * omega * (BENT.damping_1 + BENT.damping_2)
    bend = BENT.bending_mass * (mode**2 - omega**2 + 2j * BENT.bending_damping * mode * omega)
    equations = [[1.0, share, 0.0], [heave + tissue, phi * tissue, -1.0], [phi * tissue, bend + phi**2 * tissue, -coil]]
    x, e, _ = np.linalg.solve(np.array(equations), [1.0, 0.0, 0.0])
    found = bent(np.array([frequency]), finger, np.array([place]), share)
    np.testing.assert_allclose(np.ravel(found), [x + phi * e - 1, x + e - 1], rtol=1e-9, atol=1e-15)


def test_a_sag_is_the_load_over_the_stiffness():
    """After 0.5 s, where the slower mode (rocking, 147 Hz, Q 1.3 and less) is down by exp(-170)."""
    plate = DampedPlate(NONE, 20e-3)
    moved = plate.under @ plate.play(np.zeros(6), 2500, 0.0, np.zeros(3), 0.0, 0.8)[-1, :3]
    lever = 20e-3 / BENT.half_spacing
    sides = (1 - lever) ** 2 / BENT.stiffness_1 + (1 + lever) ** 2 / BENT.stiffness_2
    assert moved == pytest.approx(-0.8 * sides / 4, rel=1e-9)


def test_a_known_finger_without_load_leaves_nothing_and_one_that_is_reported_late_its_own_force():
    """One mass of 4 g starts in the exact state.  Until the report |Z|/|D_0| of its force shakes heave, no more than Q.

    |Z| is 4 g w^2 at 400 Hz at the most (25 kN/m), D_0 157 kN/m: 16 % with a Q of 2.4, that is 39 %.
    """
    case = 400.0, HEAVY_SECOND, 0.0, 0.0
    assert touch_errors(*case, 0.0).max() < 1e-6  # RIDGE of the fit
    assert 0.01 < touch_errors(*case, 5e-3).max() < 0.39
