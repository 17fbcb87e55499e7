"""Two fingers on a plate: told from one at a stated rate of false alarms, flagged, held stable, refused in a scene."""

import warnings

import numpy as np
import pytest
from strangers_plate import HEAVY_SLIDE as _  # noqa: F401
