"""The finger, measured by the surface: load, place, contact, force and impedance out of a recording."""
