"""Aliases of array types, and read-only arrays for the shared types."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

IntArray = NDArray[np.int64]

BoolArray = NDArray[np.bool_]

StrArray = NDArray[np.str_]


def freeze_arrays(instance: object) -> None:
    """Make every array field of a dataclass instance read-only."""
    for value in vars(instance).values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)


class ReadOnlyArrays:
    """Base of dataclasses whose array fields are read-only."""

    def __post_init__(self) -> None:
        """Make every array field read-only."""
        freeze_arrays(self)
