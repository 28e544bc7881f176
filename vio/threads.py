"""Linear algebra on one thread: the filter's matrices are small, and a second thread only waits for the first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Pin BLAS to one thread inside the block (a QR of 1640 x 96 was measured a hundred times slower with two)."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
