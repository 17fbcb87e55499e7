"""Scenes on plates of every kind, each with a lesser model, drawn at random."""

import math

import numpy as np

import hapticrender as hr
from hapticrender.plants.levels import REDUCTIONS

DURATION = 4.0  # s
FREQUENCIES = (20.0, 500.0)  # Hz


def random_case(seed):
    """Draw a scene, a lesser one and what is left out of it, by name."""
    rng = np.random.default_rng(seed)
    scene = None
    while scene is None:
        try:
            scene = _scene(rng)
        except ValueError:  # numbers that no scene may have together
            continue
        lesser, names = _lesser(rng, scene)
        scene = scene if names else None
    return scene, lesser, ", ".join(names)


def _lesser(rng, scene):
    """Leave out one thing, or two or three one after another."""
    lesser, names = scene, []
    options = list(REDUCTIONS["vt-plate"].items())
    for i in sorted(rng.permutation(len(options))[: rng.choice([1, 1, 2, 3])]):
        found = options[i][1](lesser)
        if isinstance(found, hr.Scene):
            lesser = found
            names.append(options[i][0])
    return lesser, names


def _scene(rng):
    spatial = rng.random() < 0.35
    motion = _motion(rng, spatial)
    amplitude = 10 ** rng.uniform(-6.3, -4.7)  # m
    if spatial:
        shape = {"wavelength": 10 ** rng.uniform(-3.4, -2.2)}
    else:
        shape = {"frequency": FREQUENCIES[0] * (FREQUENCIES[1] / FREQUENCIES[0]) ** rng.random()}
    many = rng.choice([1, 1, 2, 3])
    order = np.sort(rng.uniform(1.0, 6.0, many)) if many > 1 else np.ones(1)
    partials = tuple((o / order[0], 10 ** rng.uniform(-1.0, 0.0), rng.uniform(0.0, 2 * math.pi)) for o in order)
    return hr.Scene(
        texture=hr.Grating(amplitude=amplitude, partials=partials, **shape),
        finger=_finger(rng, motion),
        duration=DURATION,
        profile=_plant(rng),
        gradient=rng.uniform(-14.0, 14.0) if rng.random() < 0.1 else 0.0,
    )


def _motion(rng, spatial):
    """A finger's motion, as its maker, its place and further arguments."""
    kind = rng.choice(["swiping", "curved"] if spatial else ["still", "sliding", "swiping", "sampled", "none"])
    if kind == "none":
        return hr.Finger.absent, {}
    if kind == "still":
        return hr.Finger.still, {"position": rng.uniform(-0.045, 0.045)}
    stroke, centre = rng.uniform(0.005, 0.07), rng.uniform(-0.015, 0.015)
    if kind == "sliding":
        return hr.Finger.sliding, {"speed": 10 ** rng.uniform(-2.0, -0.5), "span": stroke, "centre": centre}
    if kind == "swiping":
        return hr.Finger.swiping, {"frequency": 10 ** rng.uniform(-0.5, 0.5), "stroke": stroke, "centre": centre}
    if kind == "sampled":  # straight from turn to turn
        times = np.sort(rng.uniform(0.0, DURATION, 8))
        return hr.Finger.sampled, {"positions": tuple(rng.uniform(-0.04, 0.04, 8)), "times": tuple(times)}
    rate, many = 500.0, int(DURATION * 500) + 2
    turns = np.sin(2 * np.pi * np.outer(np.arange(many) / rate, rng.uniform(0.2, 1.5, 2)) + rng.uniform(0, 6, 2))
    return hr.Finger.sampled, {"positions": tuple(centre + turns @ rng.uniform(0.002, 0.02, 2)), "rate": rate}


def _finger(rng, motion):
    maker, where = motion
    if not where:
        return maker()
    load = rng.uniform(0.1, 1.5)
    if rng.random() < 0.4:
        times = np.sort(rng.uniform(0.0, DURATION, 4))
        load = (tuple(times), tuple(rng.uniform(0.1, 1.5, 4)))
    touches = [(rng.uniform(0.0, 0.7), 9.0)] if rng.random() < 0.2 else None
    mechanics = rng.choice(["light", "heavy", "light-2nd-order", "heavy-2nd-order"])
    scaled = bool(rng.random() < 0.4)
    return maker(**where, normal_load=load, touches=touches, mechanics=str(mechanics), load_scaling=scaled)


def _plant(rng):
    """Plates about the paper's size and others, of one coil or two, rigid or not."""
    plant = {}
    if rng.random() < 0.6:
        spread = {"mass": 32e-3, "inertia": 4e-5, "stiffness_1": 22.4e3, "stiffness_2": 22.9e3}
        plant |= {name: value * 2 ** rng.uniform(-1.0, 1.0) for name, value in spread.items()}
        plant |= {name: 0.85 * 2 ** rng.uniform(-0.5, 2.5) for name in ("damping_1", "damping_2")}
        plant["stiffness_2"] = plant["stiffness_1"] * rng.uniform(0.8, 1.25)
    if rng.random() < 0.3:
        plant |= {"bending_frequency": rng.uniform(700.0, 1800.0), "bending_damping": rng.uniform(0.005, 0.05)}
        plant |= {"bending_mass": rng.uniform(5e-3, 20e-3), "bending_coil": rng.uniform(-0.3, 0.3)}
    if rng.random() < 0.15:
        plant["coils"] = 1
    if rng.random() < 0.2:
        plant["rate"] = rng.choice([2500.0, 8000.0, 10000.0])
    return plant
