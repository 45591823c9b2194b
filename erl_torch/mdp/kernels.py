"""Sums of rows, with an error that does not grow with their length.

Kernels, here and in the other rooms, take plain C-contiguous arrays and scalars, use no globals, and validate nothing:
the callers do. ``error_model="numpy"``: a division by zero gives inf or nan, which the caller checks; no check costs
time. Kernels that call each other stand in one file, because Numba's cache does not notice a changed kernel in another
file. Pair index: ``k = s * n_actions + a``. Transition matrices come as CSR arrays (indptr, indices, data).
"""

from __future__ import annotations

import numba


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _compensated(x, n):
    """Sum of the first n of x >= 0, within 2 units of the last place (Neumaier)."""
    total, lost = 0.0, 0.0
    for i in range(n):
        new = total + x[i]
        lost += (total - new) + x[i] if total >= x[i] else (x[i] - new) + total
        total = new
    return total + lost


@numba.njit(cache=True, error_model="numpy", nogil=True)
def row_sums(indptr, data, sums):
    """Sums of CSR rows with entries >= 0, each within 2 units of the last place."""
    for row in range(indptr.size - 1):
        sums[row] = _compensated(data[indptr[row] :], indptr[row + 1] - indptr[row])
