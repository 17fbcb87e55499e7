"""Names of what the band bank's compiled step reads and writes: rows of its state and entries of a scenario's numbers.

Symbols: R wanted, V commanded and E error envelope of a coordinate, v = V - R the integral part, D dynamic stiffness
(N/m), z the finger's, h = [1, g] with g = p/a its place, eps the deviation y - sum Re V e^{j phi} at sample rate.
"""

# rows of BankState.band: what the bank was asked for; carrier; target (R and its slope), and what the finger adds to it
# beyond its three numbers
LIVE, FREQUENCY, WAVENUMBER, PHASE, WANTED_RE, WANTED_IM = range(6)
TURNS, RAMP, WEIGHT, COS, SIN, OMEGA, SWEEP = range(6, 13)
R_RE, R_IM, DR_RE, DR_IM, RAW_RE, RAW_IM, REST_RE, REST_IM = range(13, 21)
# the target as the observer sees it: R itself (error observer), or R behind the observer's pole
SEEN_RE, SEEN_IM = range(21, 23)
BAND_ROWS = 23
# rows of BankState.loop, LOOP_ROWS a coordinate: error; integral part, its slope; low-passed like the error; error and
# low-passed integral part at the last adaptation; fast and slow detector of the deviation
E_RE, E_IM, V_RE, V_IM, DV_RE, DV_IM, L_RE, L_IM, LAST_RE, LAST_IM, FAST_RE, FAST_IM, SLOW_RE, SLOW_IM = range(14)
LOOP_ROWS = 14
# rows of BankState.law: ahead, the turn by delay and hold; then, LAW_ROWS for each pair of coordinates, ahead D and
# ahead D'
AHEAD_RE, AHEAD_IM = range(2)
FIRST_LAW = 2
LAW_RE, LAW_IM, SLOPE_RE, SLOPE_IM = range(4)
LAW_ROWS = 4
# entries of BankState.track: the finger's motion (position as given, smoothed, velocity, acceleration, seen before)
HELD, SMOOTH, VELOCITY, ACCELERATION, SEEN = range(5)
TRACK_ROWS = 5
# entries of BankState.touch: the finger's load (N), place g, contact, its three numbers; timers and openings of the two
# detectors; limiter (peak of the drive over its limit, squared, and the scale that answers it); trust in the sensors
LOAD, PLACE, CONTACT, MASS, DAMPING, STIFFNESS, FAST_TIME, SLOW_TIME, FAST_OPEN, SLOW_OPEN, PEAK, SCALE, TRUST = range(
    13
)
TOUCH_ROWS = 13
# rows of BankState.residual: residual of the observer, deviation, force, force a quarter turn ahead
ERROR, DEVIATION, FORCE, QUADRATURE = range(4)
