"""The third party's plate against two other integrations, and through the library."""

import numpy as np
import pytest
from naive_plate import bar as naive_bar
from other_plate import OtherPlate
from scipy.integrate import solve_ivp
from strangers_plate import TRUTH, StrangersPlate, bar

IDEAL = {"noise": 0.0, "sensor_bits": 0}
HEAVY_2, HEAVY_4 = (4e-3, 1.5, 300.0), (0.2e-3, 8.0, 8e3, 4e-3, 1.5, 300.0)


def played(plate, drive):
    """Play drive (A, (n, 2)) in the plate's blocks, and return what it sensed."""
    return np.concatenate([plate.play(part).sensed for part in np.split(drive, len(drive) // plate.block)])


@pytest.mark.parametrize("finger", [{}, {"finger": HEAVY_2, "load": 0.8, "position": 15e-3}], ids=["free", "touched"])
def test_it_moves_like_the_exact_discretisation(rng, finger):
    """Six substeps of fourth order at 189 Hz: (2 pi 189/30000)^4/120 = 2e-8 of a period's phase per step."""
    drive = 0.1 * rng.standard_normal((2000, 2))
    delay = {"delay": 3}
    theirs = played(StrangersPlate(**finger, **({"contact": 1.0} if finger else {}), **delay, **IDEAL), drive)
    exact = played(OtherPlate(**finger, **delay, noise=0.0), drive)
    assert abs(theirs - exact).max() < 1e-6 * abs(exact).max()


def test_a_sliding_finger_on_bending_glass_is_what_scipy_integrates(rng):
    """Skin on a phalanx that touches, slides and lifts: scipy's own rule on the equations in matrix form."""
    rate, m, currents = 5000.0, np.array([TRUTH["mass"], TRUTH["inertia"], 9.5e-3]), 0.2 * rng.standard_normal((150, 2))
    contact, position = np.interp(np.arange(151), [20, 25, 120, 121], [0, 1, 1, 0]), np.linspace(-0.03, 0.02, 151)
    mf, bf, kf, mp, bp, kp = HEAVY_4
    omega, zeta = 2 * np.pi * 1250.0, 0.5 / 30
    sides = np.array([[1, -27.5e-3, 0], [1, 27.5e-3, 0]])
    push = 7.4 * np.hstack([sides[:, :2], [[0.1], [0.1]]]).T
    stiff = sides.T @ np.diag([22.4e3, 22.9e3]) @ sides + np.diag([0, 0, omega**2 * m[2]])
    damp = sides.T @ np.diag([0.85, 0.85]) @ sides + np.diag([0, 0, 2 * zeta * omega * m[2]])

    def rule(n):
        def slope(t, z):
            s, p = (np.interp(t * rate, np.arange(151), each) for each in (contact, position))
            q, v, h = z[:3], z[4:7], np.array([1.0, p, naive_bar(p)])
            tissue = s * (bf * (h @ v - z[7]) + kf * (h @ q - z[3]))
            force = push @ currents[n] - stiff @ q - damp @ v - h * (0.8 * s + tissue)
            a = np.linalg.solve(np.diag(m) + s * mf * np.outer(h, h), force)
            return [*v, z[7], *a, (tissue - bp * z[7] - kp * z[3]) / mp]

        return slope

    z, expected = np.zeros(8), []
    for n in range(150):
        h = np.array([[1, position[n], naive_bar(position[n])], [1, -0.055, 1], [1, 0.055, 1]])
        expected.append(h @ z[:3])
        with np.errstate(under="ignore"):
            z = solve_ivp(rule(n), (n / rate, (n + 1) / rate), z, rtol=1e-9, atol=1e-13).y[:, -1]
    plate = StrangersPlate(
        finger=HEAVY_4, position=position, load=0.8, contact=contact, bending=(1250.0, 30, 0.1), substeps=24, **IDEAL
    )
    played(plate, currents)
    assert abs(plate.truth[:, :3] - expected).max() < 1e-6 * abs(np.array(expected)).max()
    assert (plate.contact == contact[:-1]).all()
    assert bar(0.02) == pytest.approx(naive_bar(0.02), rel=1e-12)


def test_it_rests_under_its_load_and_says_where_the_finger_is():
    """W/(k_1 + k_2 + k_f) in the middle, reported 5 ms after the touch; blocks are the same samples."""
    lag = {"report_lag": 5e-3, "contact": lambda t: 1.0 * (t < 0.01), "load": 0.5, "finger": HEAVY_2}
    one, five = (StrangersPlate(block=block, **lag, **IDEAL) for block in (1, 5))
    assert one.play(np.zeros((1, 2))).sensed[0].mean() == pytest.approx(-0.5 / 45.6e3, rel=1e-3)
    reports = [five.play(np.zeros((5, 2))) for _ in range(20)]
    reported = np.concatenate([each.position for each in reports])
    assert np.flatnonzero(np.isfinite(reported)).tolist() == list(range(75))
    assert played(one, np.zeros((99, 2))) == pytest.approx(np.concatenate([r.sensed for r in reports])[1:], rel=1e-12)
