"""Measure a finger with the plate that it touches, fit a model to it, and put that finger into a scene.

The figure is the fitted stiffness of the finger's phalanx in N/m; the simulated subject has 200.
"""

import math

import hapticrender as hr

FREQUENCIES = (20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0)  # Hz, of Grigorii et al. 2021
SPEED = 10e-3  # m/s: amplitude of each


def record_a_subject() -> hr.Recording:
    """A light touch from 1 to 5 s that slides, on a plate of which the profile is 2 % off."""
    gratings = [hr.Grating(frequency=f, amplitude=max(SPEED / (2 * math.pi * f), 6e-6)) for f in FREQUENCIES]
    finger = hr.Finger.swiping(frequency=0.5, stroke=0.03, normal_load=0.3, touches=[(1.0, 5.0)], mechanics="light")
    scene = hr.Scene(
        texture=sum(gratings[1:], gratings[0]),
        finger=finger,
        simulation={"stiffness_1": 22.0e3, "stiffness_2": 22.6e3, "mass": 32.4e-3},
        keep_unfelt=True,
        duration=6.0,
    )
    return hr.render(scene)


def main() -> float:
    record = hr.analyse_finger(record_a_subject())  # from the drive and the sensors alone
    fit = hr.fit_finger(record)
    print(f"order {fit.order}, as likely as {fit.p_value:.2f}; at {fit.mechanics.reference_load:.2f} N:")
    for name in fit.names:
        low, high = fit.interval(name)
        print(f"  {name:18} {fit.values[name]:9.3g}, 95 %: {low:.3g} to {high:.3g}")

    finger = hr.Finger.sliding(speed=0.05, normal_load=0.3, mechanics=fit.mechanics)
    scene = hr.Scene(texture=hr.Grating(frequency=170.0, amplitude=10e-6), finger=finger, duration=2.0)
    print(hr.render(scene).text().splitlines()[-1])
    return fit.mechanics.phalanx_stiffness


if __name__ == "__main__":
    print(main())
