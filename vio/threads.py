"""Single-threaded linear algebra: the filter's matrices are too small for a second thread to help."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any

_limited: ContextVar[bool] = ContextVar("one_blas_thread", default=False)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Pin BLAS to one thread inside the block (a QR of 1640 x 96 was measured a hundred times slower with two)."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        token = _limited.set(True)
        try:
            yield
        finally:
            _limited.reset(token)


class BlasLimit:
    """As `one_blas_thread`, for blocks that are entered often: it looks for the BLAS libraries once."""

    def __init__(self) -> None:
        from threadpoolctl import ThreadpoolController

        self._controller = ThreadpoolController()

    def __call__(self) -> AbstractContextManager[Any]:
        """Return the context; it does nothing inside `one_blas_thread`, as asking the libraries takes its time."""
        if _limited.get():
            return nullcontext()
        limit: AbstractContextManager[Any] = self._controller.limit(limits=1, user_api="blas")
        return limit
