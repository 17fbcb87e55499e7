"""Record of the waveform law: settings and state beside those of the controller, and the order of its parameters."""

import numba
import numpy as np

from hapticrender.control.records import MOST_CHANNELS

TAPS = 12  # of the derivatives' filters, 6 of them ahead
BASIS = 6  # beta: r, r'/w_n, r''/w_n^2, r_p (r through the pair of poles), r_p'/w_p, D_00 r' T
FINGER, HEAVE, COUPLING, LOAD, INITIAL, PARAMETERS = np.array([0, 5, 9, 12, 14, 18])  # first of each set; their number
ROWS = int(PARAMETERS) + 1  # regressors psi_i, and dev_u
RING = BASIS + 2  # of a sample: basis and deviation force, until they act

# 1/m; w_n, w_p (rad/s) and damping ratio of the finger's poles; steps of the fade; 1: sensors lie behind the contact
_LAW = "lever_per_metre omega_n pole pole_damping fade_step behind"
# after a contact, in samples: learning begins, begins again, has no initial motion any more, the damper closes;
# samples within which a contact is reported; without a position, by which it is lost
_CONTACT = "learning_delay relearning_delay initial_end damper_time report_delay loss_time"
# of the damper's gate (m^2), of the reference's scale (samples; a factor a sample), and smoothing factors: alpha of
# mean += alpha (value - mean), a sample
_MEANS = """
gate_threshold hold decay high_pass_smoothing mean_square_smoothing scale_smoothing levelling_smoothing power_smoothing
"""
# the reference's fade, the drive's largest need and for how long it is held, scale and its least; lever arm, contact,
# samples since it changed and without a position (`away`; below 0: until the report of a suspected contact is due);
# the gate's slow part, mean square and noise; r as the sensors should show it; levelling force; mean squares on the
# untouched device, see `update_powers`; last sane sample of the waveform; mean squares of heave's part of psi^T theta,
# and of what the sensor's noise alone makes of it
_STATE = """
fade peak hold_left scale smooth_scale least_scale lever contact since away slow power sensed_noise reference moment
nominal_power learned_power reference_power last_waveform heave_power heave_noise
"""

LAW = np.dtype(
    [
        # settings
        *((name, np.int64) for name in ("delay", "spatial", "learns")),
        *((name, np.float64) for name in f"{_LAW} {_CONTACT} {_MEANS}".split()),
        ("filters", np.float64, (4, TAPS)),
        ("sensor_filter", np.float64, (TAPS,)),
        ("sensor_rate_filter", np.float64, (TAPS,)),  # of its derivative, where the sensors are ahead of the contact
        ("pole_step", np.float64, (2, 4)),  # step of the pair of poles: two states, r now and next
        ("force_from_drive", np.float64, (2, MOST_CHANNELS)),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        ("noise", np.float64, (2,)),  # of heave and rocking: what is constant in sigma_e^2
        *((name, np.float64) for name in ("deviations", "innovations")),  # weights of mean squares in `model_power`
        ("model_error", np.float64),  # part of `model_power` in sigma_e^2
        ("noise_share", np.float64),  # (sensor noise)^2 over `noise` on friction devices, of P: noise's; else 0
        ("prior", np.float64, (ROWS - 1,)),  # mean
        ("prior_covariance", np.float64, (ROWS - 1, ROWS - 1)),
        ("reversion_factor", np.float64, (ROWS - 1,)),  # a_i: share of the distance from the prior that stays
        ("initial_variance", np.float64, (4,)),  # variances of the initial motion
        # state
        *((name, np.float64) for name in _STATE.split()),
        *((name, np.int64) for name in ("sample", "ring_at", "reference_at")),
        ("window", np.float64, (TAPS,)),  # references around the moment at which this sample's drive acts, oldest first
        ("sensor_window", np.float64, (TAPS,)),  # around now, for what the sensors should show
        ("model_power", np.float64, (2,)),  # mean squares of what the drive explains, deviations and innovations
        ("poles", np.float64, (2,)),
        ("basis", np.float64, (BASIS,)),
        ("theta", np.float64, (ROWS - 1,)),
        ("covariance", np.float64, (ROWS - 1, ROWS - 1)),
        ("earlier", np.float64, (2, 8, 7)),  # the device's own parameters and covariance, 10-20 ms and 0-10 ms ago
        ("states", np.float64, (4, ROWS)),
        ("moved", np.float64, (4, ROWS)),  # states a sample later
        ("p_psi", np.float64, (ROWS - 1,)),  # P psi of a coordinate
        ("inputs", np.float64, (2, ROWS)),
        # [A, B] T, a term of its series and the next one, [Phi, Gamma]
        *((name, np.float64, (4, 6)) for name in ("flow", "power_of_flow", "following", "step")),
    ]
)
"""Settings and state of the waveform law beside those of the controller."""
LAW_T = numba.from_dtype(LAW)
