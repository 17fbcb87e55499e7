"""Plates other than the paper's: one coil, amplitudes that grow along the plate, and numbers that were identified."""

import numpy as np
import pytest
from held import amplitude
from tables import tables

import hapticrender as hr
from hapticrender.plants.plate import PlateParameters

SLIDE = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
A = 50e-6  # m: that of the accuracy suite, 50 times the noise of a sensor


def rendered(frequency=72.0, gradient=0.0, finger=SLIDE, **plant):
    texture = hr.Grating(frequency=frequency, amplitude=A)
    return hr.render(hr.Scene(texture=texture, finger=finger, duration=2.5, gradient=gradient, **tables(plant)))


CENTRE, ENDS = 0.004, 0.015  # of A, rms: what the accuracy suite asks of a slide


@pytest.mark.parametrize(("frequency", "gradient"), [(40.0, 5.0), (150.0, -12.0)])
def test_an_amplitude_grows_along_the_plate(frequency, gradient):
    """1 + gradient x at the middle and at the ends, 55 mm away, near the rocking mode of 147 Hz as well.

    Noise leaves as many m whatever is wanted, so bounds are of A and not of what little is wanted at the weak end.
    """
    recording = rendered(frequency, gradient)
    wanted = A * (1.0 + gradient * np.array([0.0, -55e-3, 55e-3]))
    (band,) = recording.summary()["bands"]
    left = wanted * [band[f"rms_error_{place}"] for place in ("centre", "end_1", "end_2")]
    assert (left < A * np.array([CENTRE, ENDS, ENDS])).all()
    assert (abs(amplitude(recording.motion, frequency, 1.0) - wanted) < A * np.array([CENTRE, ENDS, ENDS])).all()
    assert recording.header.profile == pytest.approx((wanted / A).tolist())


def test_one_coil_holds_the_middle_and_leaves_the_ends_to_the_finger():
    """Heave alone is controlled; a finger off the middle tilts the plate, most near its rocking mode of 147 Hz.

    The second row of D q = F [1, 0] has no force: q_1 = -D_10/D_11 q_0.
    """
    frequency = 143.0
    place, plate = 15e-3, PlateParameters()
    finger = hr.Finger.still(position=place, normal_load=0.4, mechanics="light")
    stiffness = plate.dynamic_stiffness(frequency, finger.mechanics.impedance(frequency), place)
    heave_and_rocking = np.array([1.0, -stiffness[1, 0] / stiffness[1, 1]])
    expected = abs(plate.device_model(plate.rate, plate.delay).place_from_coordinate @ heave_and_rocking)
    recording = rendered(frequency, finger=finger, coils=1)
    assert recording.drive.shape[1] == 1
    np.testing.assert_allclose(amplitude(recording.motion, frequency, 1.0) / A, expected, rtol=0, atol=CENTRE)
