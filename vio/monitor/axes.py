"""Exchanged and inverted axes: all signed permutations, and their text form."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray


def signed_permutations() -> Iterator[FloatArray]:
    """Yield all 48 maps that exchange and invert axes; those that change least come first."""
    every = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    yield from sorted(every, key=lambda P: -float(np.trace(P)))


def axes_text(P: FloatArray) -> str:
    """Return how true readings of x y z appear in the recording, e.g. `[+y -x +z]`."""
    return "[" + " ".join(f"{'+' if row.sum() > 0 else '-'}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in P) + "]"


def matrix_text(R: FloatArray) -> str:
    """Return a matrix (3, 3) in one line."""
    return "[" + ", ".join(triple_text(row) for row in R) + "]"


def triple_text(v: npt.NDArray[np.floating]) -> str:
    """Return three numbers in one line."""
    return f"[{v[0]:.3f}, {v[1]:.3f}, {v[2]:.3f}]"
