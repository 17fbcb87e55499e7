"""The band bank for devices that take blocks."""
