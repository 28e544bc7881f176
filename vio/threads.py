"""Single-threaded linear algebra: the filter's matrices are too small for a second thread to help."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Pin BLAS to one thread inside the block (a QR of 1640 x 96 was measured a hundred times slower with two)."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield


class BlasLimit:
    """As `one_blas_thread`, for blocks that are entered often: it looks for the BLAS libraries once."""

    def __init__(self) -> None:
        from threadpoolctl import ThreadpoolController

        self._controller = ThreadpoolController()

    def __call__(self) -> AbstractContextManager[Any]:
        """Return the context."""
        limit: AbstractContextManager[Any] = self._controller.limit(limits=1, user_api="blas")
        return limit
