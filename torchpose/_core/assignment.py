"""Assign columns to rows, each at most once."""

import numpy as np


def best_columns(values: np.ndarray) -> np.ndarray:
    """Return the column of each row [P], -1 if none, with the largest sum of values that are not negative.

    Shortest augmenting paths with dual prices; rows have columns of their own, of value 0.

    Reference: R. Jonker and A. Volgenant (1987), "A shortest augmenting path algorithm for dense and sparse
    linear assignment problems", https://doi.org/10.1007/BF02278710.
    """
    n_rows, n_columns = values.shape
    cost = np.hstack([-values, np.zeros((n_rows, n_rows))])
    row_price, price = np.zeros(n_rows), np.zeros(cost.shape[1])
    owner = np.full(cost.shape[1], -1)
    for first in range(n_rows):
        distance, before = np.full(cost.shape[1], np.inf), np.full(cost.shape[1], -1)
        done = np.zeros(cost.shape[1], dtype=bool)
        row, column, reached = first, -1, 0.0
        while row >= 0:
            length = reached + cost[row] - row_price[row] - price
            shorter = ~done & (length < distance)
            distance[shorter], before[shorter] = length[shorter], column
            column = int(np.where(done, np.inf, distance).argmin())
            reached, row = distance[column], owner[column]
            done[column] = True
        inside = done & (owner >= 0)
        row_price[first] += reached
        row_price[owner[inside]] += reached - distance[inside]
        price[done] -= reached - distance[done]
        while column >= 0:
            earlier = before[column]
            owner[column] = first if earlier < 0 else owner[earlier]
            column = earlier
    found = np.full(n_rows, -1)
    real = (owner >= 0) & (np.arange(len(owner)) < n_columns)
    found[owner[real]] = np.nonzero(real)[0]
    return found
