"""Parameters of a device, sorted into the tables of a scene."""

import hapticrender as hr

SETTINGS = {"velocity_per_force", "square_root", "headroom", "floor", "output", "crossover"}
LEVEL = {
    *("level", "oversampling", "envelope_oversampling", "envelope_frequency"),
    *("degrees_of_freedom", "finger_dynamics"),
}


def tables(parameters):
    """Fields of a scene: settings of the renderer, model level, and the rest in the device's profile."""
    return {
        "rendering": {name: value for name, value in parameters.items() if name in SETTINGS},
        "simulation": {name: value for name, value in parameters.items() if name in LEVEL},
        "profile": {name: value for name, value in parameters.items() if name not in SETTINGS | LEVEL},
    }


def scene_on(device, texture, finger, duration, *, settle=1.0, keep_unfelt=False, **parameters):
    """A scene whose tables hold the parameters."""
    fields = {"texture": texture, "finger": finger, "device": device, "duration": duration, "settle": settle}
    return hr.Scene(**fields, keep_unfelt=keep_unfelt, **tables(parameters))
