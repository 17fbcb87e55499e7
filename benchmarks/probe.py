"""Start-up probe of plates: how many healthy ones it refuses, and how many wrong set-ups it refuses.

Run: python -m benchmarks.probe [healthy plates]

Healthy: mass, inertia and springs off by 5 %, dampers by 20 %, sensors' gains by 2 %, delay as stated or a sample more;
7 of 10 under a finger of 0-10 g, 0-12 N s/m, 0-12 kN/m, 0.1-1.5 N within `REACH` of the middle.  Wrong: the same, with
something of `WRONG` besides.  A plate is refused after three tries.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

import hapticrender as hr
from hapticrender.protocols import Array
from tests.other_plate import TRUTH, OtherPlate

REACH = 0.05  # m: within which a finger may rest; the glass ends at 55 mm
SWAP = np.eye(2)[::-1]


def one(value: float, which: int) -> Array:
    """Identity with `value` for channel `which`."""
    return np.diag([value if i == which else 1.0 for i in range(2)])


WRONG: dict[str, dict[str, Any]] = {
    **{f"{part[:-1]} {i + 1} inverted": {part: one(-1.0, i)} for part in ("sensors", "coils") for i in range(2)},
    **{f"{part[:-1]} {i + 1} dead": {part: one(0.0, i)} for part in ("sensors", "coils") for i in range(2)},
    **{f"{part} inverted": {part: -np.eye(2)} for part in ("sensors", "coils")},
    **{f"{part} swapped": {part: SWAP} for part in ("sensors", "coils")},
    **{f"{part} swapped and inverted": {part: -SWAP} for part in ("sensors", "coils")},
    **{f"{part} dead": {part: np.zeros((2, 2))} for part in ("sensors", "coils")},
    **{f"sensors' gain {gain:g}": {"sensors": gain * np.eye(2)} for gain in (0.1, 0.3, 3.0, 10.0, 1e3)},
    **{f"coils' gain {gain:g}": {"coils": gain * np.eye(2)} for gain in (0.1, 0.3, 3.0, 10.0)},
    **{f"delay {late} samples off": {"delay": 1 + late} for late in (3, 4, 6, 10)},
}


def plates(seed: int, wrong: dict[str, Any] | None = None) -> Iterator[OtherPlate]:
    """Draw plates, healthy but for what is `wrong`."""
    rng = np.random.default_rng(seed)
    while True:
        off = {
            name: TRUTH[name] * rng.uniform(0.95, 1.05) for name in ("mass", "inertia", "stiffness_1", "stiffness_2")
        }
        off |= {name: TRUTH[name] * rng.uniform(0.8, 1.2) for name in ("damping_1", "damping_2")}
        touched, finger = rng.uniform() < 0.7, tuple(rng.uniform(0.0, (10e-3, 12.0, 12e3)))
        rest = {"finger": finger, "load": rng.uniform(0.1, 1.5), "position": rng.uniform(-REACH, REACH)}
        late = {"gains": rng.uniform(0.98, 1.02, 2), "delay": int(rng.integers(1, 3)), "seed": int(rng.integers(2**31))}
        yield OtherPlate(**off, **late | (wrong or {}), **rest if touched else {})


def refusal(plate: OtherPlate) -> str:
    """What the probe says of a plate; "" where it passes."""
    scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=1e-6), duration=0.002, keep_unfelt=True)
    try:
        hr.render(scene, driver=plate)
    except hr.DeviceFault as fault:
        return str(fault).partition("start-up probe: ")[2] or str(fault)
    return ""


def main(count: int) -> None:
    """Print how many healthy plates of `count` are refused, and why; then how many wrong ones pass, by kind."""
    found = [refusal(plate) for _, plate in zip(range(count), plates(11), strict=False)]
    refused = [each for each in found if each]
    print(f"healthy: {len(refused)} of {count} refused", *refused, sep="\n  ", flush=True)
    passed, each = {}, max(count // len(WRONG), 1)
    for seed, (name, wrong) in enumerate(WRONG.items()):
        passed[name] = sum(not refusal(plate) for _, plate in zip(range(each), plates(100 + seed, wrong), strict=False))
    total, left = each * len(WRONG), sum(passed.values())
    share = 1.0 - left / total
    kinds = [f"{count} of {each}: {name}" for name, count in passed.items() if count]
    print(f"wrong: {share:.1%} of {total} refused; not", *kinds, sep="\n  ")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
