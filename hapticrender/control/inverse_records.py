"""Record of the waveform law: settings and state beside those of the controller, and the order of its parameters."""

from __future__ import annotations

import numba
import numpy as np

from hapticrender.control.records import MOST_CHANNELS

TAPS = 12  # of the derivatives' filters, 6 of them ahead
BASIS = 6  # r, r'/w_n, r''/w_n^2, r through the pair of poles and its derivative/w_p, D_00 r' T
FINGER, HEAVE, COUPLING, LOAD, INITIAL, PARAMETERS = np.array([0, 5, 9, 12, 14, 18])  # first of each set; their number
ROWS = int(PARAMETERS) + 1  # regressors psi_i, and w
RING = BASIS + 2  # of a sample: basis and deviation force, until they act

# 1/m; w_n, w_p (rad/s) and damping ratio of the finger's poles; steps of the fade
_LAW = "lever_per_metre hertz_scale pole pole_damping fade_step"
# after a contact, in samples: learning begins, begins again, has no initial motion any more, the damper closes;
# samples between two notes of the device's parameters; for so many a position may be missing
_CONTACT = "settling joining joined damper_time notice patience"
# of the damper's gate (m^2; poles a sample), of the reference's scale (samples; poles a sample), of means and levelling
_POLES = "level high_pass mean_square hold decay smoothing levelling slowly"
# fade and scale of the reference, the drive's largest need; the finger's lever arm and contact, samples since it
# changed and since a position was there; the gate's slow part, mean square and noise; r as the sensors
# show it; levelling force; mean squares on the untouched device, see `compare`; last sane sample of the waveform
_STATE = """
fade peak held scale smooth_scale lever contact since away slow power sensed_noise reference moment
nominal_power learned_power reference_power last_waveform
"""

INVERSE = np.dtype(
    [
        # settings
        *((name, np.int64) for name in ("delay", "spatial", "learns")),
        *((name, np.float64) for name in f"{_LAW} {_CONTACT} {_POLES}".split()),
        ("filters", np.float64, (4, TAPS)),
        ("sensor_filter", np.float64, (TAPS,)),
        ("sensor_rate_filter", np.float64, (TAPS,)),  # of its derivative, where the sensors are ahead of the contact
        ("pair", np.float64, (2, 4)),  # step of the pair of poles: two states, r now and next
        ("force_from_drive", np.float64, (2, MOST_CHANNELS)),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        ("noise", np.float64, (2,)),  # R of heave and rocking
        ("model_error", np.float64),  # part of `model_power` in R
        ("prior", np.float64, (ROWS - 1,)),
        ("spread", np.float64, (ROWS - 1, ROWS - 1)),  # covariance of the prior
        ("kept", np.float64, (ROWS - 1,)),  # share of a parameter's distance from its prior after a reversion
        ("start", np.float64, (4,)),  # variances of the initial motion
        # state
        *((name, np.float64) for name in _STATE.split()),
        *((name, np.int64) for name in ("sample", "ring_at", "reference_at")),
        ("window", np.float64, (TAPS,)),  # references around the moment at which this sample's drive acts, oldest first
        ("shown", np.float64, (TAPS,)),  # around now
        ("model_power", np.float64, (2,)),  # mean squares of the deviation and of what the drive explains of it
        ("poles", np.float64, (2,)),
        ("basis", np.float64, (BASIS,)),
        ("theta", np.float64, (ROWS - 1,)),
        ("covariance", np.float64, (ROWS - 1, ROWS - 1)),
        ("earlier", np.float64, (2, 8, 7)),  # the device's own parameters and covariance, 10-20 ms and 0-10 ms ago
        ("states", np.float64, (4, ROWS)),
        ("moved", np.float64, (4, ROWS)),  # states a sample later
        ("inputs", np.float64, (2, ROWS)),
        # [A, B] T, a term of its series and the next one, [Phi, Gamma]
        *((name, np.float64, (4, 6)) for name in ("flow", "power_of_flow", "following", "step")),
    ]
)
"""Settings and state of the waveform law beside those of the controller."""
INVERSE_T = numba.from_dtype(INVERSE)
