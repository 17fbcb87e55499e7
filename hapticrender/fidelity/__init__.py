"""The least model of a device that a scene needs."""
