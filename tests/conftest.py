"""What every test may lean on: seeded randomness, loud arithmetic, the recorded finger where it is at hand."""

from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent

hypothesis.settings.register_profile("house", derandomize=True, deadline=None, max_examples=25, database=None)
hypothesis.settings.load_profile("house")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20210617)


@pytest.fixture(autouse=True)
def loud_arithmetic() -> Iterator[None]:
    with np.errstate(all="raise"):
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with the recorded finger, which is no part of this repository."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the recorded finger is not here: no ../shared/data beside the checkout")
    return folder
