"""NumPy columns that grow by amortised doubling."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


class Column(Generic[Scalar]):
    """Rows of one shape and dtype that can be appended to.

    `rows` is a view. A view taken before an append keeps its length, and may keep showing the old
    rows after the storage has moved.
    """

    __slots__ = ("_count", "_storage")

    def __init__(self, dtype: type[Scalar], row_shape: tuple[int, ...] = ()) -> None:
        self._storage: NDArray[Scalar] = np.zeros((16, *row_shape), dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> NDArray[Scalar]:
        """All rows, (N, *row_shape)."""
        return self._storage[: self._count]

    def append(self, row: Any) -> None:
        """Add one row."""
        if self._count == len(self._storage):
            grown = np.zeros((2 * self._count, *self._storage.shape[1:]), self._storage.dtype)
            grown[: self._count] = self._storage
            self._storage = grown
        self._storage[self._count] = row
        self._count += 1

    def extend(self, rows: NDArray[Scalar]) -> None:
        """Add (M, *row_shape) rows."""
        count = self._count + len(rows)
        if count > len(self._storage):
            room = max(count, 2 * len(self._storage))
            grown = np.zeros((room, *self._storage.shape[1:]), self._storage.dtype)
            grown[: self._count] = self.rows
            self._storage = grown
        self._storage[self._count : count] = rows
        self._count = count
