"""Names of what the band bank's compiled step reads and writes: rows of its state and entries of a scenario's numbers.

Symbols: R wanted, V commanded and E error envelope of a coordinate, v = V - R the integral part, D dynamic stiffness
(N/m), z the finger's, h = [1, g] with g = p/a its place, eps the deviation y - sum Re V e^{j phi} at sample rate.
"""

# rows of BankState.band: what the bank was asked for; carrier; target (R and its slope), and what the finger adds to it
# beyond its three numbers
LIVE, FREQUENCY, WAVENUMBER, PHASE, WANTED_RE, WANTED_IM = range(6)
TONE_ROWS = 5
TURNS, RAMP, WEIGHT, SHARE, COS, SIN, TURN_COS, TURN_SIN, OMEGA, SWEEP = range(6, 16)
R_RE, R_IM, DR_RE, DR_IM, RAW_RE, RAW_IM, REST_RE, REST_IM = range(16, 24)
# the target as the observer sees it: R itself (error observer), or R behind the observer's pole
SEEN_RE, SEEN_IM = range(24, 26)
BAND_ROWS = 26
# what BankState.pace says of a tile: carriers follow the finger; fixed, their targets growing; fixed, and nothing grows
LOCKED, GROWING, STEADY = range(3)
# rows of BankState.loop, LOOP_ROWS a coordinate: error; integral part; command as it acted and the observer shows it;
# motion less that at the last step of learning; fast and slow detector of the deviation, the slow one sample by sample
# behind the fast one; command V and its slope
E_RE, E_IM, V_RE, V_IM, L_RE, L_IM, LAST_RE, LAST_IM, FAST_RE, FAST_IM, SLOW_RE, SLOW_IM = range(12)
COMMAND_RE, COMMAND_IM, SLOPED_RE, SLOPED_IM = range(12, 16)
LOOP_ROWS = 16
# rows of BankState.law: the turn ahead, by delay and hold; then, LAW_ROWS for each pair of coordinates, D and D' of
# device and finger, turned ahead
AHEAD_RE, AHEAD_IM = range(2)
FIRST_LAW = 2
LAW_RE, LAW_IM, SLOPE_RE, SLOPE_IM = range(4)
LAW_ROWS = 4
# rows of BankState.sent: as the observer shows them the finger's force, the target and the carrier's angular frequency,
# and how far it has forgotten what was before the carrier was all there; then, SENT_ROWS a step of the past, commands
# of the coordinates and the finger's force
SHOWN_RE, SHOWN_IM, SHOWN_R_RE, SHOWN_R_IM, SHOWN_OMEGA, SHOWN_WHOLE = range(6)
SHOWN_ROWS = 6
FORCE_RE, FORCE_IM = 4, 5
SENT_ROWS = 6
# entries of BankState.track: the finger's motion (position as given, smoothed, velocity, acceleration, seen before)
# for how many samples more its coming counts as fresh, and its speed whichever way it goes
HELD, SMOOTH, VELOCITY, ACCELERATION, SEEN, FRESH, SPEED = range(7)
TRACK_ROWS = 7
# entries of BankState.touch: the finger's load (N), place g, contact, its three numbers; timers and openings of the two
# detectors; limiter (peak of the drive over its limit, squared, and the scale that answers it); trust in the sensors;
# contact and place as the law knows them; 1 where the limiter acts
LOAD, PLACE, CONTACT, MASS, DAMPING, STIFFNESS, FAST_TIME, SLOW_TIME, FAST_OPEN, SLOW_OPEN, PEAK, SCALE, TRUST = range(
    13
)
KNOWN, KNOWN_PLACE, LIMITED = 13, 14, 15
TOUCH_ROWS = 16
# rows of BankState.residual: a coordinate as heard, residual of the observer, deviation, force, force a quarter turn
# ahead; force, and what is observed and commanded, as they are known before anything is heard
HEARD, ERROR, DEVIATION, FORCE, QUADRATURE, KNOWN_FORCE, OBSERVED, COMMANDED = range(8)
RESIDUAL_ROWS = 8
