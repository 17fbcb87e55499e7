"""Sensors of a finger's position, engineering estimates; docs/devices.md has their table."""

from dataclasses import replace

from hapticrender.touch.touch_panel import TouchPanel

PANELS = {
    "encoder, 1 kHz, 0.5 um": TouchPanel(
        rate=1000.0, noise=0.0, resolution=0.5e-6, latency=1e-3, jitter=0.0, dropouts=0.0
    ),
    "panel, 240 Hz, 8 ms": TouchPanel(rate=240.0, latency=8e-3),
    "panel, 120 Hz, 15 ms": TouchPanel(),
    "panel, 60 Hz, 25 ms": replace(TouchPanel(), rate=60.0, latency=25e-3),
}
