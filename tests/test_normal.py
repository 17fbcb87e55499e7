"""Normal numbers in bulk are numpy's own, to the last bit."""

import numpy as np

from hapticrender.compiled.normal import FEW, Normals, normal_run


def test_they_are_those_of_numpy():
    """A million in pieces of every size: 12 000 of them need more than a word, 260 of these lie beyond the layers."""
    ours, numpys, sizes = Normals(7), np.random.default_rng(7), np.random.default_rng(1)
    beyond = total = 0
    while total < 1_000_000:
        size = int(sizes.integers(0, sizes.choice([10, FEW, 20 * FEW])))
        found, expected = ours.fill(np.empty(size)), numpys.standard_normal(size)
        np.testing.assert_array_equal(found, expected)
        beyond, total = beyond + int((abs(expected) > 3.6541528853610088).sum()), total + size
    assert beyond > 200


def test_few_are_left_to_numpy_and_counted():
    """A first few, then many, then few again: one stream, whichever way each takes."""
    ours, expected = Normals(3), np.random.default_rng(3).standard_normal(2 * FEW + 20)
    found = np.concatenate([ours.fill(np.empty(size)) for size in (10, 2 * FEW, 0, 10)])
    np.testing.assert_array_equal(found, expected)


def test_a_number_waits_for_its_words():
    """Handed over one by one, words are kept until those of a whole number are there."""
    ours, numpys = Normals(5), np.random.default_rng(5)
    words, room, found = np.empty(0, np.uint64), np.empty(1), []
    for word in np.random.default_rng(5).bit_generator.random_raw(20_000):
        words = np.append(words, word)
        made, used = normal_run(words, *ours._layers, room)
        found += [*room[:made]]
        words = words[used:]
    np.testing.assert_array_equal(found, numpys.standard_normal(len(found)))
    assert len(found) < 20_000


def test_arrays_keep_their_shape():
    out = np.empty((FEW, 2))
    assert Normals(1).fill(out) is out
    np.testing.assert_array_equal(out, np.random.default_rng(1).standard_normal((FEW, 2)))
