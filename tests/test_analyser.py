"""The lock-in at fixed carriers against scipy's filters, in any split, for hours."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.signal import lfilter

from hapticrender.control.analyser import Analyser
from hapticrender.control.stdft import StarSTDFT

RATE = 5000.0
CARRIERS = np.linspace(20.0, 900.0, 21)


def expected(signal, frequency, bandwidth):
    b, a = StarSTDFT(bandwidth=bandwidth, rate=RATE).coefficients
    turned = np.exp(-2j * np.pi * np.outer(np.arange(len(signal)), frequency) / RATE)
    return lfilter(b, a, 2 * signal[:, :, None] * turned[:, None], axis=0)


@pytest.mark.parametrize(("precision", "bound"), [("double", 1e-12), ("single", 2e-5)])
def test_it_is_scipys_lock_in(rng, precision, bound):
    """Two channels of noise; single precision is the delta form's, FACTS 10: 7e-6."""
    signal = rng.standard_normal((3000, 2))
    found = Analyser(CARRIERS, 5.0, RATE, channels=2, precision=precision).run(signal)
    right = expected(signal, CARRIERS, 5.0)
    np.testing.assert_allclose(found, right, rtol=0, atol=bound * abs(right).max())


@pytest.mark.parametrize("precision", ["double", "single"])
def test_any_split_gives_the_same(rng, precision):
    signal = rng.standard_normal((1000, 1))
    whole = Analyser(CARRIERS, 20.0, RATE, precision=precision).run(signal)
    pieces = Analyser(CARRIERS, 20.0, RATE, precision=precision)
    cuts = [0, 1, 7, 64, 65, 128, 500, 999, 1000]
    found = [pieces.run(signal[a:b]) for a, b in zip(cuts, cuts[1:], strict=False)]
    np.testing.assert_array_equal(np.concatenate(found), whole)


def test_the_phase_never_drifts():
    """After 2e6 samples the phasor is where whole-number arithmetic has it, to the rounding of one turn a sample."""
    analyser = Analyser(CARRIERS, 20.0, RATE)
    samples = 64 * 31_250
    analyser.run(np.zeros((samples, 1)))
    analyser.run(np.zeros((1, 1)))
    exact = [float(Fraction(float(f)) / Fraction(RATE) * samples % 1) for f in CARRIERS]
    turns = analyser._band[:, 1].ravel()[: CARRIERS.size]
    off = np.mod(turns - exact + 0.5, 1.0) - 0.5
    assert abs(off).max() < samples * 2.0**-54


def test_it_fills_what_it_is_given(rng):
    signal, out = rng.standard_normal((100, 1)), np.empty((100, 1, 21), complex)
    assert Analyser(CARRIERS, 5.0, RATE).run(signal, out) is out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frequency": [2600.0]}, r"frequency: \[2600.0\]: must be one or more of 0 to 2500 Hz"),
        ({"frequency": []}, "frequency: none: must be one or more"),
        ({"rate": 0.0}, "rate"),
        ({"bandwidth": 2500.0}, r"bandwidth=2500.0 Hz must lie between 0"),
        ({"channels": 0}, "channels=0: must be >= 1"),
        ({"precision": "half"}, "precision='half': must be one of double, single"),
    ],
)
def test_what_it_refuses(arguments, message):
    right = {"frequency": [50.0], "bandwidth": 5.0, "rate": RATE}
    with pytest.raises(ValueError, match=message):
        Analyser(**(right | arguments))


def test_arrays_of_other_shapes_are_refused():
    analyser = Analyser([50.0], 5.0, RATE, channels=2)
    with pytest.raises(ValueError, match=r"must be \(n, 2\)"):
        analyser.run(np.zeros((10, 1)))
    with pytest.raises(ValueError, match="must be"):
        analyser.run(np.zeros((10, 2)), np.zeros((10, 2, 2), complex))
