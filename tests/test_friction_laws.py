"""Friction against ultrasonic amplitude: printed tables, the balance on the film, and the way back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticrender.plants.friction_laws import (
    LAWS,
    LEAST_SHARE,
    FitLaw,
    IntermittentContact,
    LoadSharing,
    friction_ratio,
    reference_amplitude,
)

AMPLITUDES = np.array([0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0]) * 1e-6
ROUNDING = 2.0**-52
PRINTED = 0.5001e-2  # half of the last digit printed

TABLES = [  # docs/theory.md
    (FitLaw(), 0.5, (0.91, 0.76, 0.61, 0.48, 0.28, 0.18, 0.11)),
    (LoadSharing(), 0.25, (0.93, 0.74, 0.51, 0.29, 0.05, 0.01, 0.0)),
    (LoadSharing(), 0.5, (0.95, 0.81, 0.63, 0.45, 0.16, 0.04, 0.0)),
    (LoadSharing(), 1.0, (0.96, 0.86, 0.72, 0.56, 0.29, 0.13, 0.02)),
]


@pytest.mark.parametrize(("law", "load", "expected"), TABLES, ids=["fit", "0.25 N", "0.5 N", "1 N"])
def test_the_printed_tables(law, load, expected):
    np.testing.assert_allclose(law.ratio(AMPLITUDES, load, 0.05), expected, rtol=0, atol=PRINTED)


@given(
    amplitude=st.floats(1e-8, 1e-5),
    load=st.floats(0.02, 10.0),
    contact_pressure=st.floats(150e3, 400e3),
    decay=st.floats(0.3e-6, 5e-6),
)
def test_asperities_and_film_carry_the_load(amplitude, load, contact_pressure, decay):
    """The balance is stiff: a gap good to 2e-15 leaves it good to 2e-15 times (gap/u0 + 2), below 60."""
    law = LoadSharing(contact_pressure=contact_pressure, decay=decay)
    ratio = float(law.ratio(amplitude, load, 0.0))
    gap = decay * np.log(contact_pressure * 1e-4 / (load * ratio))
    carried = ratio * load + 1.25 * 101e3 * 1e-4 * (amplitude / gap) ** 2
    assert abs(carried - load) <= 60 * 2e-15 * load


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("load", [0.2, 0.5, 1.5])
@pytest.mark.parametrize("speed", [-0.02, 0.05, 0.16])
def test_the_way_back_is_the_way_there(name, load, speed):
    """With share s of the friction left, ln a answers to s by at most 1.5/(s ln s); s is good to some 40 roundings."""
    law = LAWS[name]()
    amplitude = np.geomspace(2e-8, 6e-6, 40)
    ratio = law.ratio(amplitude, load, speed)
    share = (ratio - law.floor) / (1 - law.floor)
    there = (share > 1e-5) & (share < 1.0)
    assert there.sum() > 20
    tolerance = 64 * ROUNDING / (share * -np.log(share, where=share > 0, out=np.full(40, -1.0)))[there]
    error = law.amplitude(ratio[there], load, speed) / amplitude[there] - 1
    assert (abs(error) <= tolerance).all()
    assert tolerance.max() < 1e-6


def test_intermittent_contact_is_the_formula():
    law = IntermittentContact(coefficient=1.3, friction=0.6, frequency=40e3)
    expected = np.exp(-1.3 * 0.6 * AMPLITUDES * 40e3 / 0.08)
    np.testing.assert_allclose(law.ratio(AMPLITUDES, 0.5, -0.08), expected, rtol=16 * ROUNDING)


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("load", [0.0, 0.5, 50.0])
@pytest.mark.parametrize("speed", [0.0, 0.05])
def test_a_kernel_is_finite_for_any_argument(name, load, speed):
    """NaN and more than all friction ask for no amplitude; less than the law reaches asks for a finite one."""
    law = LAWS[name]()
    numbers = law.numbers
    for ratio in (np.nan, 1.0, 1.5, np.inf):
        assert reference_amplitude(numbers, ratio, load, speed) == 0.0
    least = law.floor + LEAST_SHARE * (1 - law.floor)
    for ratio in (-np.inf, 0.0, law.floor):
        answer = reference_amplitude(numbers, ratio, load, speed)
        assert 0.0 <= answer < 1e-4
        # the rounding of least, against 1e-6 of a share with a logarithm of 14
        assert abs(answer - reference_amplitude(numbers, least, load, speed)) <= 1e-10 * answer
    assert 0.0 <= friction_ratio(numbers, 1e-6, load, speed) <= 1.0
    assert friction_ratio(numbers, 0.0, load, speed) == 1.0
