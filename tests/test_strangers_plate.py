"""The third party's plate against two other integrations, and through the library."""

import numpy as np
import pytest
from strangers_plate import WRONG, StrangersPlate

import hapticrender as hr


def test_the_library_holds_a_tone_on_it_although_everything_is_wrong():
    """k +5, m -5, b -20 %, gains +-2 %, a sample late: the wave's mean amplitude within 3 % at every place."""
    plate = StrangersPlate(**WRONG, told=2, bending=(1250.0, 30, 0.1))
    scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=50e-6), duration=2.0)
    with pytest.warns(hr.PlateMismatch):
        hr.render(scene, driver=plate)
    turn = np.exp(-2j * np.pi * 72.0 * np.arange(5000, 10000) / 5000)
    assert abs(2 * turn @ plate.truth[5000:10000] / 5000) == pytest.approx([50e-6] * 4, rel=0.03)
