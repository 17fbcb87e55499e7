"""Drivers: carry samples to a device, a file or a plant model, and back."""
