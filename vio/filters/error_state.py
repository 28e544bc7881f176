"""The error vector of the sliding-window filter: its blocks, their order, and the rows of each.

| block | errors |
|---|---|
| `nav` | navigation state (15): pose, velocity, biases |
| those of `vio.filters.online_calibration.BLOCKS` | constants of the calibration that are estimated |
| `clones` | camera poses (6 each), oldest first |
| `landmarks` | points (3 each) |

Covariances, Jacobians and information matrices find their rows and columns here, by the name of the
block.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vio.filters import track_loops as loops
from vio.filters.navigation import DIM
from vio.filters.online_calibration import BLOCKS
from vio.filters.track_records import Information
from vio.geometry.lie import FloatArray


class ErrorState:
    """Where each block is in an error vector of length D; a window with other blocks has another
    one.
    """

    def __init__(self, calibration: Mapping[str, int], clones: int, landmarks: int) -> None:
        """Lay out the blocks.

        Args:
            calibration: name and size of each block of the calibration that is estimated, in their
                order.
            clones: how many.
            landmarks: how many.
        """
        # rows of the blocks of navigation state and calibration that are estimated, by name
        self.blocks = {"nav": slice(0, DIM)}
        first = DIM
        for name, size in calibration.items():
            self.blocks[name] = slice(first, first + size)
            first += size
        self.nav = self.blocks["nav"]
        self.own = slice(0, first)  # navigation state and calibration
        self.own_identity = np.eye(first)
        self.calibration = slice(DIM, first)
        of_motion, of_pixels = (
            sum(size for name, size in calibration.items() if BLOCKS[name].enters == where)
            for where in ("motion", "pixels")
        )
        self.motion = slice(0, DIM + of_motion)  # what the motion model predicts and corrects
        # coefficients that pixels depend on
        self.stereo = slice(self.motion.stop, self.motion.stop + of_pixels)
        # pixels depend on no error before it
        self.first_of_pixels = self.stereo.start if of_pixels else first
        self.clones = slice(first, first + 6 * clones)
        self.landmarks = slice(self.clones.stop, self.clones.stop + 3 * landmarks)
        self.size = self.landmarks.stop

    def clone(self, index: int) -> slice:
        """Rows of a clone, -1 being the newest."""
        if index >= 0:
            bounds = self.clones.start
        else:
            bounds = self.clones.stop
        return slice(bounds + 6 * index, bounds + 6 * index + 6)

    def jacobian(
        self, out_D_clones: FloatArray, out_D_stereo: FloatArray | None = None
    ) -> FloatArray:
        """Turn Jacobians into Jacobians (..., D) by the error vector.

        Args:
            out_D_clones: by the clones (..., 6N).
            out_D_stereo: by the stereo calibration (..., S), where it is estimated.
        """
        out = np.zeros((*out_D_clones.shape[:-1], self.size))
        out[..., self.clones] = out_D_clones
        if out_D_stereo is not None:
            out[..., self.stereo] = out_D_stereo
        return out

    def information(
        self, A: FloatArray, b: FloatArray, variance: float = 1.0, considered: int = 0
    ) -> Information:
        """Turn information about clones and stereo coefficients into that about the error vector.

        Args:
            A: information matrix (6N + S, 6N + S); of the clones alone, S is zero.
            b: information vector (6N + S,).
            variance: of a pixel, by which both are divided.
            considered: how many of the coefficients, the last ones, have no errors here.

        Returns:
            Matrix (D, D), vector (D,), and the information of all errors with the coefficients
            considered (D, C).
        """
        out = Information(
            np.empty((self.size, self.size)),
            np.empty(self.size),
            np.empty((self.size, considered)),
        )
        clones = self.clones
        loops.place_information(
            A, b, variance, clones.stop - clones.start, clones.start, self.stereo.start, out
        )
        return out
