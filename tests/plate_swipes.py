"""A finger that swipes at random, followed by the plate alone."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from test_analysis_plate import FREQUENCIES, open_loop

import hapticrender as hr
from hapticrender.analysis.course import Course
from hapticrender.plants.plate import Plate, PlateParameters

RATE, SWIPES, SPEED = 5000, 3.0, 0.05  # Hz, Hz and m/s
BLOCK = 50  # samples, 10 ms: white noise of this spacing has the tracker's noise at low frequencies (8.8 ms)
TOUCH, FROM = 0.5, 1.0  # s


def random_swipes(n, rng):
    """Positions (m, (n,)) of swipes whose amplitude and phase wander within about 1 s."""
    wander = gaussian_filter1d(rng.standard_normal((2, n)), 0.2 * RATE, axis=1)
    wander *= SPEED / (2 * np.pi * SWIPES) / np.sqrt(2 * np.mean(wander**2))
    turn = 2 * np.pi * SWIPES * np.arange(n) / RATE
    return wander[0] * np.cos(turn) - wander[1] * np.sin(turn)


def followed_on_a_plate(load, seconds, rng):
    """Errors of position and velocity now (m, m/s; (n, 2)), and what the estimator states of them."""
    time = np.arange(round(seconds * RATE)) / RATE
    place = random_swipes(len(time), rng)
    finger = hr.Finger.sampled(place, times=time, normal_load=load, touches=[(TOUCH, seconds + 1)])
    drive, plate = open_loop(time, FREQUENCIES), Plate(PlateParameters(), finger, seed=int(rng.integers(1000)))
    sensed = plate.run(drive).sensed
    identified = Course.of(PlateParameters(), {"stiffness_1": 5.0, "stiffness_2": 5.0, "mass": 1e-5})
    tracker = hr.FingerTracker(identified, lookahead=0.0)
    estimator = hr.MotionEstimator(1e-3, frequency=SWIPES, speed=SPEED)
    found = []
    for first in range(0, len(time), BLOCK):
        touch = tracker.update(drive[first : first + BLOCK], sensed[first : first + BLOCK])
        now = (first + BLOCK - 1) / RATE
        if len(touch.time):
            estimator.update(touch.time[-1], touch.position.value[-1], touch.position.standard_error[-1])
        found.append(estimator.at(now))
    at = slice(round(FROM * RATE) // BLOCK, None)
    truth = np.stack([place, np.gradient(place) * RATE], axis=1)[BLOCK - 1 :: BLOCK][at]
    found = np.array(found)[at]
    return found[:, :2] - truth, found[:, 2:]
