"""Parameters of a device, sorted into the tables of a scene."""

import hapticrender as hr

SETTINGS = {"velocity_per_force", "square_root", "headroom", "floor", "output", "crossover"}
SIMULATED = {
    *("level", "oversampling", "envelope_oversampling", "envelope_frequency"),
    *("degrees_of_freedom", "finger_dynamics", "area_scale", "gap_thickness", "gap_resistance"),
}


def tables(parameters):
    """Fields of a scene: settings of the renderer, model level and unknown finger, and the rest in the profile."""
    return {
        "rendering": {name: value for name, value in parameters.items() if name in SETTINGS},
        "simulation": {name: value for name, value in parameters.items() if name in SIMULATED},
        "profile": {name: value for name, value in parameters.items() if name not in SETTINGS | SIMULATED},
    }


def scene_on(device, texture, finger, duration, *, settle=1.0, keep_unfelt=False, **parameters):
    """A scene whose tables hold the parameters."""
    fields = {"texture": texture, "finger": finger, "device": device, "duration": duration, "settle": settle}
    return hr.Scene(**fields, keep_unfelt=keep_unfelt, **tables(parameters))
