"""Types of values that every layer hands on: arrays of numbers, and JSON objects as they were read."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
JsonObject = dict[str, Any]
"""A JSON object whose members are looked at where they are used."""
