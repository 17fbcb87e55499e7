"""A misspelt name in a scene's [plant] table is refused, and every name that would do is listed."""

import re

import pytest

import hapticrender as hr
from hapticrender.loop import prepare

TEXTURE = hr.Grating(velocity=5e-3, frequency=100.0)
FINGER = hr.Finger.sliding(speed=0.08, normal_load=0.4)
ONE_EACH = {  # of every class of parameters that a kind of device reads from the table
    "vt-plate": {"mass", "bending_frequency"},
    "electroadhesion": {"velocity_per_force", "square_root", "headroom", "floor", "output", "current_limit", "rate"},
    "ultrasonic": {"velocity_per_force", "square_root", "bias", "memory_length", "quality", "rate", "law"},
    "hybrid": {"crossover", "velocity_per_force", "square_root", "mass", "screen_current_limit", "gap_thickness"},
}


def known_of(device):
    """Names that the refusal of a misspelt one lists."""
    with pytest.raises(ValueError, match=r"^plant.mispelt: no such parameter; known: ") as refused:
        prepare(hr.Scene(texture=TEXTURE, finger=FINGER, device=device, duration=2.0, plant={"mispelt": 1.0}))
    return re.sub(r".*known: ", "", str(refused.value)).split(", ")


@pytest.mark.parametrize("device", ONE_EACH)
def test_every_name_that_would_do_is_listed_once_and_in_order(device):
    known = known_of(device)
    assert set(known) >= ONE_EACH[device]
    assert known == sorted(set(known))


@pytest.mark.parametrize("device", ONE_EACH)
def test_every_name_listed_is_accepted(device):
    """A word is refused for what it is, never for its name: all parameters are numbers or words of a few."""
    for name in known_of(device):
        with pytest.raises((TypeError, ValueError), match="must be") as refused:
            prepare(hr.Scene(texture=TEXTURE, finger=FINGER, device=device, duration=2.0, plant={name: "no such word"}))
        assert re.search(rf"\b{re.sub('^(plate|screen)_', '', name)} = 'no such word'", str(refused.value))


def test_the_numbers_of_the_law_are_those_of_the_one_that_is_chosen():
    def known(law):
        with pytest.raises(ValueError, match="no such parameter") as refused:
            hr.plants.surface.SurfaceParameters.with_overrides({"law": law, "mispelt": 1.0})
        return str(refused.value)

    assert known("fit") != known("load-sharing")
