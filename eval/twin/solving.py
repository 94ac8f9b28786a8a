"""Small symmetric positive systems, one for each pixel, as src/filters/solve.rs solves them."""

import torch

_MIN_PIVOT = 1e-5  # share of its diagonal; below it the unknown hardly differs from a sum of others
_TINY = 1.18e-38


def cholesky(matrix):
    """The Cholesky factors of matrices, which are given as lower triangles with a tensor for each
    `matrix[row][column]`. Their diagonals hold the inverse of the pivot's root. A zero matrix gives zero
    solutions."""
    factor = []
    for i, row in enumerate(matrix):
        factor.append([])
        for j, value in enumerate(row):
            total = value
            for k in range(j):
                total = total - factor[i][k] * factor[j][k]
            if i == j:
                pivot = torch.maximum(total, value * _MIN_PIVOT)
                total = torch.where(pivot > _TINY, pivot.clamp(min=_TINY).rsqrt(), 0)
            else:
                total = total * factor[j][j]
            factor[i].append(total)
    return factor


def solve(factor, right):
    """The solutions of the systems, for right-hand sides that are given as a list of rows."""
    size, values = len(factor), list(right)
    for i in range(size):
        for k in range(i):
            values[i] = values[i] - factor[i][k] * values[k]
        values[i] = values[i] * factor[i][i]
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            values[i] = values[i] - factor[k][i] * values[k]
        values[i] = values[i] * factor[i][i]
    return values
