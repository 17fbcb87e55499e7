"""Models of devices, exact in discrete time."""
