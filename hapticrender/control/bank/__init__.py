"""The band bank: one observer for all bands, the law of the device with its finger, inner damping, two speeds."""
