"""Defaults that several modules share."""

METHOD = "h2"  # the most accurate of `METHODS`; where the delay is long its inner loop switches itself off
METHODS = ("paper", "paper-common", "boxcar", "static", "stiffness", "resonant", "h", "h2")  # of `control.methods`
LOWEST_FREQUENCY = 20.0  # Hz: slower carriers are not judged; a window does not separate them from an offset
