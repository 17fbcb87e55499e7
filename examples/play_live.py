"""A texture that an application plays live: it changes, and the finger moves, while the device goes on.

Here the device is a simulated plate that plays as fast as it can; with ``hr.Player(driver="audio:0")`` it is a sound
card, and `sleep` the application's own loop.  The figure is the amplitude (m) of the ridges at half the gain.
"""

import hapticrender as hr

FRAME = 1 / 60  # s: an application reports the finger once a frame of its screen


def main() -> float:
    position, velocity = -0.02, 0.05  # m, m/s
    with hr.Player("vt-plate", paced=False) as player:
        player.play(hr.Grating(frequency=120.0, amplitude=5e-6))
        player.sleep(0.5)
        player.play(hr.Grating(wavelength=1e-3, amplitude=10e-6))  # fades into it within 40 ms
        for _ in range(60):
            player.finger(position, velocity, load=0.4)
            player.sleep(FRAME)
            position += velocity * FRAME
            player.gain = 1.0 if position < 0.0 else 0.5
        print(player.state())
        [ridges] = player.state().bands
    return ridges.achieved


if __name__ == "__main__":
    print(main())
