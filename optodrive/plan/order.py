"""The order in which one beam visits the pixels of a frame."""

import numpy as np

from optodrive.flow import IntArray


def serpentine(active: IntArray, row: IntArray, column: IntArray) -> IntArray:
    """Pixels row by row, every other row backwards, so that most moves are one pitch. active: [k]; row, column: [p]."""
    rows, columns = row[active], column[active]
    rank = np.unique(rows, return_inverse=True)[1]
    direction = np.where(rank % 2 == 0, columns, -columns)
    return active[np.lexsort((direction, rows))]
