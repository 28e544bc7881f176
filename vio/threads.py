"""Single-threaded linear algebra: the filter's matrices are too small for a second thread to help."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Pin BLAS to one thread inside the block (a QR of 1640 x 96 was measured a hundred times slower with two)."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
