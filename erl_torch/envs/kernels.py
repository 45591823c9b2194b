"""Random winds, and a model counted from samples.

Conventions as in ``erl_torch.mdp.kernels``.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy")
def smooth_wind(wind, noise):
    """Raster sweeps, in place, in which each value becomes the mean of itself and its four periodic neighbours.

    wind [n, 2, rows, cols]: the angles get one sweep for each noise [n, sweeps, rows, cols], which is added
    to the means as they are made; the strengths get one sweep.
    """
    n, _, rows, cols = wind.shape
    for m in range(n):
        for sweep in range(noise.shape[1] + 1):
            angles = sweep < noise.shape[1]
            field = wind[m, 0] if angles else wind[m, 1]
            for i in range(rows):
                for j in range(cols):
                    around = field[i - 1, j] + field[(i + 1) % rows, j] + field[i, j - 1] + field[i, (j + 1) % cols]
                    field[i, j] = (field[i, j] + around) / 5
                    if angles:
                        field[i, j] += noise[m, sweep, i, j]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def count_rows(cells, n_cells):
    """How often each cell occurs in each row of ``cells`` [R, n] (all in [0, n_cells)).

    Returns (length [R], indices, counts): occupied cells of row after row, ascending, and their counts.
    """
    seen = np.zeros(n_cells, np.int32)
    length = np.empty(cells.shape[0], np.int64)
    indices = np.empty(cells.size, np.int32)
    counts = np.empty(cells.size, np.int32)
    n = 0
    for row in range(cells.shape[0]):
        first = n
        for i in range(cells.shape[1]):
            cell = cells[row, i]
            if seen[cell] == 0:
                indices[n] = cell
                n += 1
            seen[cell] += 1
        indices[first:n].sort()
        for m in range(first, n):
            counts[m] = seen[indices[m]]
            seen[indices[m]] = 0
        length[row] = n - first
    return length, indices[:n].copy(), counts[:n].copy()
