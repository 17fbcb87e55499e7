"""Threads of live play: what runs until a player stops, and a device without a clock of its own, held to the clock."""

import threading
import time
from collections.abc import Callable

from hapticrender.errors import DriverError, HapticError
from hapticrender.live_loop import LiveLoop

NAP, LATE = 2e-3, 0.1  # s: shorter waits are not slept; so late the clock starts anew
DRIFT = 0.01  # of the clock
FORESEE = 5e-3  # s between two looks at where the finger was set, for textures in time and place


class LiveThreads:
    """Threads that run until `stopping` is set; `hanging` is set where one does not end then."""

    def __init__(self) -> None:
        self.stopping, self.hanging = threading.Event(), threading.Event()

    def start(self, target: Callable[[], None], failed: Callable[[BaseException], None]) -> threading.Thread:
        """Run `target` in a thread; what it raises goes to `failed`."""

        def run() -> None:
            try:
                target()
            except BaseException as error:
                failed(error)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread

    def end(self, thread: threading.Thread, device: object, timeout: float, busy: Callable[[], str]) -> None:
        """Stop all threads and wait for one, which may be in `play` of the device.

        Raises
        ------
        HapticError
            It has not ended within `timeout` (s), and is `busy` with what that says.
        DriverError
            It has not ended within `timeout` (s).
        """
        self.stopping.set()
        thread.join(timeout)
        if thread.is_alive():
            if trouble := busy():
                raise HapticError(trouble)
            self.hanging.set()
            trouble = f"its driver has not returned for {timeout:.3g} s: zero drive could not be played"
            raise DriverError(f"{device}: {trouble}: switch the device off")


def hold_to_clock(loop: LiveLoop, play: Callable[[bool], object], stopping: threading.Event) -> None:
    """Play block after block, no faster than the clock; one that was left behind by `LATE` starts anew.

    `play` is then called with True: a real device has lost samples, and a simulation is slower than the clock.  A real
    device's own clock may be off by `DRIFT`.
    """
    rate, late = loop.driver.rate, False
    drift, real = DRIFT * loop.driver.block / rate, loop.rendering.plant is None
    play(False)  # the first one may open a stream
    start = time.monotonic() - loop.samples / rate
    while not stopping.is_set():
        play(late)
        ahead = loop.samples / rate - (time.monotonic() - start)
        late = ahead < -LATE
        start -= ahead if late else min(max(ahead, -drift), drift if real else 0.0)
        if ahead - drift > NAP:
            time.sleep(ahead - drift)


def foresee(loop: LiveLoop, stopping: threading.Event) -> None:
    """Evaluate textures in time and place ahead of a callback, in at most a quarter of the time."""
    took = 0.0
    while not stopping.wait(max(FORESEE, 3.0 * took)):
        began = time.monotonic()
        loop.foresee()
        took = time.monotonic() - began
