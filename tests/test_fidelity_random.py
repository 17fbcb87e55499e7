"""The bound on plates of every kind, drawn at random: never below the plate played twice, never far above."""

import pytest
from random_plates import random_case
from test_fidelity import true_error

from hapticrender.fidelity.plate import NoBound, bound

QUICK, ALL = 24, 264


def ratios(seeds):
    """What is found over what is true, for all scenes that are bounded; checked one by one."""
    found = []
    for seed in seeds:
        scene, lesser, left_out = random_case(seed)
        try:
            most = bound(scene, lesser)
        except NoBound:
            continue
        true = true_error(scene, lesser)
        assert true <= most, (seed, left_out)
        if true > 2e-4:  # four times what nothing is told below
            assert most <= 1.5 * true, (seed, left_out)
            found.append(most / true)
    return found


def test_random_plates_are_bounded_tightly():
    assert len(ratios(range(QUICK))) > QUICK / 2


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_many_random_plates_are_bounded_tightly():
    assert len(ratios(range(QUICK, ALL))) > (ALL - QUICK) / 2
