"""Single-threaded linear algebra: the filter's matrices are too small for a second thread to
help.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

# how many blocks of `one_blas_thread` are open in this process: the limit is one for all threads
_pinned = 0


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Pin BLAS to one thread inside the block (a QR of 1640 x 96 was measured a hundred times
    slower with two).
    """
    from threadpoolctl import threadpool_limits

    global _pinned
    with threadpool_limits(limits=1, user_api="blas"):
        _pinned += 1
        try:
            yield
        finally:
            _pinned -= 1


class BlasLimit:
    """As `one_blas_thread`, for blocks that are entered often: it looks for the BLAS libraries
    once.
    """

    def __init__(self) -> None:
        from threadpoolctl import ThreadpoolController

        self._controller = ThreadpoolController()

    def __call__(self) -> AbstractContextManager[Any]:
        """Return the context; inside `one_blas_thread` it does nothing: asking every library
        takes 0.3 ms.
        """
        if _pinned:
            return nullcontext()
        limit: AbstractContextManager[Any] = self._controller.limit(limits=1, user_api="blas")
        return limit


def start_worker() -> None:
    """Limit a worker process to one thread; the main process alone handles a user's interrupt."""
    import signal

    import cv2
    from threadpoolctl import threadpool_limits

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(limits=1, user_api="blas")
    cv2.setNumThreads(1)
