"""How a filter's errors depend on a constant that it takes for known.

The filter runs with the constant at zero. Beside it one vector is carried: how the mean of its errors would move with
the constant, as all motion and all measurements have it; Friedland's separate-bias filter, equation (S2) of
docs/math.md. The filter itself does not change, until the constant becomes a state, with all that was seen before.
Reference: Friedland, Treatment of bias in recursive filtering, IEEE TAC (1969).
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray


class SeparateBias:
    """The dependence of a filter's D errors on a constant beside them."""

    def __init__(self, size: int) -> None:
        """Start with errors (D,) that do not depend on the constant."""
        self.error_D_bias: FloatArray = np.zeros(size)

    def follow(self, A: FloatArray, P: FloatArray, cross: FloatArray | None = None) -> None:
        """Follow measurements `r = H error + h s` of variance R that the filter has absorbed: V <- V - P (A V + c).

        Args:
            A: their information about the errors, `H' R^-1 H` (D, D).
            P: covariance of the errors (D, D) after them.
            cross: `c = H' R^-1 h` (D,); None: they do not depend on the constant.
        """
        W = A @ self.error_D_bias
        if cross is not None:
            W = W + cross
        self.error_D_bias = self.error_D_bias - P @ W
