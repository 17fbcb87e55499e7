"""A misspelt name in a scene's tables is refused, and every name that would do is listed."""

import re

import pytest
from tables import LEVEL

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


def opened(device, **fields):
    return prepare(hr.Scene(texture=TEXTURE, finger=FINGER, device=device, duration=2.0, **fields))


def known_of(device):
    """Names that the refusals of a misspelt one list."""
    known = []
    for field, table in (("simulation", "simulation"), ("rendering", "render")):
        with pytest.raises(ValueError, match=rf"^{table}.mispelt = 1.0: unknown key; known: ") as refused:
            opened(device, **{field: {"mispelt": 1.0}})
        names = re.sub(r".*known: |; in a file also .*", "", str(refused.value)).split(", ")
        assert names == sorted(set(names))
        known += [(name, table) for name in names if name]
    return {**dict(known), "rate": "device"}


@pytest.mark.parametrize("device", ONE_EACH)
def test_every_name_is_listed_once_in_order_and_accepted(device):
    """A value is refused for what it is, never for its name: all parameters are numbers or options of a few."""
    known = known_of(device)
    assert set(known) >= ONE_EACH[device]
    for name, table in known.items():
        field = "rendering" if table == "render" else "simulation" if name in LEVEL else "profile"
        with pytest.raises((TypeError, ValueError), match="must be") as refused:
            opened(device, **{field: {name: "no such option"}})
        assert re.search(rf"\b{re.sub('^(plate|screen)_', '', name)} = 'no such option'", str(refused.value))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rendering": {"mass": 0.03}}, r"render.mass: belongs in \[device\] or \[simulation\]"),
        ({"profile": {"finger_dynamics": 0}}, r"device.finger_dynamics: belongs in \[simulation\]"),
        ({"simulation": {"rate": 1e4}}, r"simulation.rate: belongs in \[device\]"),
        ({"device": "electroadhesion", "profile": {"headroom": 2.0}}, r"device.headroom: belongs in \[render\]"),
        ({"device": "hybrid", "simulation": {"crossover": 90.0}}, r"simulation.crossover: belongs in \[render\]"),
    ],
)
def test_a_parameter_in_the_wrong_table_is_sent_to_the_right_one(fields, message):
    with pytest.raises(ValueError, match=message):
        opened(**{"device": "vt-plate", **fields})
