"""Defaults that several modules share."""

METHOD = "inverse"  # the most accurate of `METHODS`
METHODS = ("paper", "paper-common", "boxcar", "static", "stiffness", "resonant", "h", "h2", "inverse")
LOWEST_FREQUENCY = 20.0  # Hz: slower carriers are not judged; a window does not separate them from an offset
FADE_IN = 0.05  # s: a target fades in this slowly, so that it does not excite the modes
FADE = 0.04  # s: of one texture into another, of what ends, and of a screen's bias
LOSS_TIME = 1e-3  # s without a position, by which a contact is lost
