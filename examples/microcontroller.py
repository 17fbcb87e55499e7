"""A grating played by a microcontroller: its firmware, built for this machine, behind a serial line.

It needs make and a C compiler.  The firmware is what `hapticrender export` writes; `hardware_posix.c` puts a plate
model where a board has converters.  The figure is the amplitude (m) of the grating under a sliding finger, by the
board's sensors.
"""

import subprocess
import tempfile
import time
from pathlib import Path

import hapticrender as hr
from hapticrender.drivers.serial import SerialDriver
from hapticrender.export import export

SLOWER = 4  # times


class SlowClock:
    """As slow as the board, which stops after 80 ms of silence: a busy machine may pause this process for so long."""

    def monotonic(self) -> float:
        return time.monotonic() / SLOWER

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds * SLOWER)


def build(scene: hr.Scene, folder: Path) -> Path:
    """Firmware for the device of the scene, as a program."""
    export(hr.prepare(scene), folder)
    subprocess.run(["make", "--silent", "-C", str(folder), "board"], check=True)
    return folder / "board"


def main() -> float:
    finger = hr.Finger.sliding(speed=0.04, span=0.04, normal_load=0.4, mechanics="heavy-2nd-order")
    scene = hr.Scene(texture=hr.Grating(wavelength=0.5e-3, amplitude=10e-6), finger=finger, duration=1.5)
    with tempfile.TemporaryDirectory() as name:
        program, port = build(scene, Path(name)), Path(name) / "port"
        board = subprocess.Popen([program, port, "--slow", str(SLOWER)])
        try:
            while not port.exists():
                time.sleep(0.01)
            recording = hr.render(scene, driver=SerialDriver(str(port), clock=SlowClock()))
        finally:
            board.terminate()
            board.wait()
    (band,) = recording.summary()["bands"]
    print(f"target {1e6 * band['target']:.2f} um, moved {1e6 * band['achieved']:.2f} um")
    return band["achieved"]


if __name__ == "__main__":
    print(main())
