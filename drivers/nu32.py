"""The boards of Grigorii et al. 2021: a PIC32 (NU32) that plays one of eight tones by its own loop, commanded in ASCII.

A command is a letter on a line, and a line for each number; the board echoes the letter, then replies.  The adapter has
the vocabulary of `hapticrender.drivers.serial.BoardClient`: `set_bands`, `start`, `stop`, `telemetry`.  The wire format
is that of the authors' published firmware, of which only the facts below are used; no such board was tried.

====== ======================================= =====================================================
sent   then                                    reply behind the echo
====== ======================================= =====================================================
``a``  amplitude (mm), number of the frequency ``amp <amplitude> frequency <Hz>``
``z``                                          none; amplitude 0, and the sensors' offsets anew
``f``                                          ``closed loop turned on`` or ``off``: it toggles
``t``                                          displacements at sensors 1 and 2 (mm)
``p``                                          amplitudes (mm), then phases and commanded phases (rad)
====== ======================================= =====================================================
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import serial

from hapticrender.bands import Bands
from hapticrender.checks import number
from hapticrender.drivers.base import OpenedInWith
from hapticrender.errors import DeviceLost, DeviceNotFound, DeviceTimeout, DriverError, ProtocolError

BAUD = 230_400
FREQUENCIES = (20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0)  # Hz, by the board's clock
MOST = (119e-6, 77e-6, 50.1e-6, 33.2e-6, 21.5e-6, 14e-6, 9.1e-6, 6e-6)  # m, amplitude that the board cuts to
FAST_CLOCK = 80e6 / 19_951 / 4000.0  # a loop of 4009.8 Hz that counts 4000 Hz: true frequencies are 0.24 % higher
NEAR = 0.005  # relative, of a frequency that counts as one of these
MILLIMETRE = 1e-3


class ToneTelemetry(NamedTuple):
    """Amplitude (m) and phase (rad, against the board's sine) at both sensors, and the commanded phases (rad)."""

    amplitude: tuple[float, float]
    phase: tuple[float, float]
    command: tuple[float, float]


def open_port(port: str, timeout: float) -> Any:
    """Open the port of a board, which uses hardware flow control."""
    return serial.Serial(port, BAUD, timeout=timeout, write_timeout=timeout, rtscts=True)


class NU32Board(OpenedInWith):
    """A plate whose own controller holds one tone at both of its sensors.

    Parameters
    ----------
    port : str
        Name of the serial port.
    timeout : float, s, > 0
        Longest time to a reply.
    connect : callable
        Opens the line, ``connect(port, timeout)``: an object with `readline`, `write` and `close`.
    """

    def __init__(self, port: str, *, timeout: float = 1.0, connect: Callable[[str, float], Any] = open_port) -> None:
        self.port, self.timeout, self._connect = port, number("timeout", timeout, "s", above=0.0), connect
        self._line: Any = None
        self._tone: tuple[int, float] | None = None

    def open(self) -> Self:
        """Open the port and set the board to rest; a `DeviceNotFound` or `DeviceTimeout` where that fails."""
        try:
            self._line = self._connect(self.port, self.timeout)
        except (OSError, ValueError) as error:
            raise DeviceNotFound(f"{self.port}: open: {error}") from error
        self._send("z")
        reply = self._reply("z")  # CONNECTED is the reply to any line after a reset
        if reply not in ("z", "CONNECTED"):
            raise self._unexpected("z", reply, "z or CONNECTED")
        if reply == "CONNECTED":
            self._command("z")
        return self

    def close(self) -> None:
        """Set the board to rest and close the port."""
        line = self._line
        if line is not None:
            try:
                self._command("z")
            finally:
                self._line = None
                line.close()

    def set_bands(self, bands: Bands) -> None:
        """Choose the tone that `start` plays: one band at one of `FREQUENCIES`, up to its amplitude in `MOST` (m)."""
        if len(bands) != 1 or bands.envelope is None or bands.wavenumber.any():
            raise ValueError(f"{len(bands)} bands: must be one fixed tone of constant amplitude, as the board plays")
        hertz, amplitude = float(bands.frequency[0]), float(np.abs(bands.envelope[0]))
        near = [index for index, each in enumerate(FREQUENCIES) if abs(hertz - each) <= NEAR * each]
        if not near:
            known = ", ".join(f"{each:g}" for each in FREQUENCIES)
            raise ValueError(f"frequency = {hertz:g} Hz: must be one of {known} (within {100 * NEAR:g} %)")
        if amplitude > MOST[near[0]]:
            raise ValueError(f"amplitude = {amplitude:g} m: must be <= {MOST[near[0]]:g} m at {hertz:g} Hz")
        self._tone = near[0], amplitude

    def start(self) -> None:
        """Play the tone in closed loop."""
        if self._tone is None:
            raise DriverError(f"{self.port}: start: nothing is set; call set_bands before")
        index, amplitude = self._tone
        self._set_closed_loop()
        sent = f"{amplitude / MILLIMETRE:.6f}"
        self._command("a", sent, str(index))
        reply = self._reply("a")
        found = reply.split("\t")
        if len(found) != 4 or found[::2] != ["amp", "frequency"]:
            raise self._unexpected("a", reply, "amp, frequency")
        played, hertz = self._numbers("a", "\t".join(found[1::2]), 2)
        if abs(hertz - FREQUENCIES[index]) > NEAR * hertz or abs(played - max(float(sent), 1e-4)) > 1e-6:
            raise self._unexpected("a", reply, f"{sent} mm at {FREQUENCIES[index]:g} Hz")

    def stop(self) -> None:
        """Set the board to rest; it measures the offsets of its sensors anew."""
        self._command("z")

    def sensed(self) -> tuple[float, float]:
        """Return the displacements at both sensors now (m)."""
        self._command("t")
        first, second = self._numbers("t", self._reply("t"), 2)
        return first * MILLIMETRE, second * MILLIMETRE

    def telemetry(self) -> ToneTelemetry:
        """Return what the board's own estimator finds."""
        self._command("p")
        first, second = self._numbers("p", self._reply("p"), 2)
        phases = self._numbers("p", self._reply("p"), 4)
        return ToneTelemetry((first * MILLIMETRE, second * MILLIMETRE), (phases[0], phases[1]), (phases[2], phases[3]))

    def _set_closed_loop(self) -> None:
        """Toggle until the board replies that its loop is closed."""
        for _ in range(2):
            self._command("f")
            reply = self._reply("f")
            if reply == "closed loop turned on":
                return
            if reply != "closed loop turned off":
                break
        raise self._unexpected("f", reply, "closed loop turned on")

    def _command(self, letter: str, *numbers: str) -> None:
        self._send(letter, *numbers)
        if (reply := self._reply(letter)) != letter:  # the echo
            raise self._unexpected(letter, reply, letter)

    def _send(self, *lines: str) -> None:
        if self._line is None:
            raise DriverError(f"{self.port}: {lines[0]}: it is not open; use it in a with statement")
        try:
            for line in lines:
                self._line.write(f"{line}\n".encode("ascii"))
        except OSError as error:
            raise DeviceLost(f"{self.port}: {lines[0]}: {error}") from error

    def _reply(self, letter: str) -> str:
        """Return a line of the board, whose ends are CR LF or LF CR."""
        try:
            data: bytes = self._line.readline()
        except OSError as error:
            raise DeviceLost(f"{self.port}: {letter}: {error}") from error
        if not data.endswith(b"\n"):
            raise DeviceTimeout(f"{self.port}: {letter}: no whole line in {self.timeout:g} s, only {data!r}")
        return data.decode("ascii", "replace").strip("\r\n")

    def _numbers(self, letter: str, reply: str, count: int) -> list[float]:
        try:
            found = [float(each) for each in reply.split("\t")]
        except ValueError:
            found = []
        if len(found) != count:
            raise self._unexpected(letter, reply, f"{count} numbers")
        return found

    def _unexpected(self, letter: str, reply: str, expected: str) -> ProtocolError:
        return ProtocolError(f"{self.port}: {letter}: received {reply!r}, must be {expected}")
