"""What the compiled loops over tracks take together: named tuples, which numba knows.

Shapes: F tracks, N clones, S coefficients of the rectification error, D errors of the filter, C
coefficients considered.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.projection import CameraArgs
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray


class Cameras(NamedTuple):
    """The left cameras that tracks were seen by."""

    lens: CameraArgs
    min_depth: float  # m; nearer points are mismatches
    T_cam0_world: FloatArray  # (N, 4, 4)


class Views(NamedTuple):
    """What F tracks showed in N clones."""

    z: FloatArray  # (F, N, 4) pixels [ul vl ur vr]; arbitrary where unseen
    # (F, N, 4) one over a coordinate's relative standard deviation; 0: not measured
    weight: FloatArray

    def take(self, index: BoolArray) -> Views:
        """Return the tracks of a mask (F,)."""
        if index.all():
            return self
        return Views(self.z[index], self.weight[index])


class Residuals(NamedTuple):
    """Residuals of tracks at given poses and points, and their Jacobians, times the weights of
    the views.
    """

    r: FloatArray  # (F, N, 4) pixels, zero where unseen
    # (F, N, 4, 3) with respect to the point in the world frame, zero where unseen
    z_D_p: FloatArray
    ahead: BoolArray  # (F,) the point lies in front of every camera that saw it
    weight: FloatArray  # (F, N, 4) as in `Views`

    def take(self, index: BoolArray | IntArray) -> Residuals:
        """Return the tracks of a mask (F,) or of rows (K,)."""
        if index.dtype == np.bool_ and index.all():
            return self
        return Residuals(self.r[index], self.z_D_p[index], self.ahead[index], self.weight[index])


class InverseDepth(NamedTuple):
    """Coordinates of F points as one of their cameras sees them, equation (M5).

    `q = fu [x/z, y/z, b/z]`, pixels: the place in the left image, and the disparity, measured or
    not.
    """

    anchor: IntArray  # (F,) the clone whose camera it is: the first that saw the point
    centre: FloatArray  # (F, 3) of that camera, world
    disparity: FloatArray  # (F,) the third coordinate
    # (F, 3, 3) metres in the world per pixel; the third column points from the point to the camera
    p_D_q: FloatArray
    q_D_p: FloatArray  # (F, 3, 3) its inverse

    @classmethod
    def empty(cls, count: int) -> InverseDepth:
        """Return room for the coordinates of F points."""
        return cls(
            np.empty(count, np.int64),
            np.empty((count, 3)),
            np.empty(count),
            np.empty((count, 3, 3)),
            np.empty((count, 3, 3)),
        )

    def take(self, rows: IntArray) -> InverseDepth:
        """Return the points of rows (K,)."""
        q = self
        return InverseDepth(
            q.anchor[rows], q.centre[rows], q.disparity[rows], q.p_D_q[rows], q.q_D_p[rows]
        )


class Damping(NamedTuple):
    """How Gauss-Newton steps on points are held back, in the coordinates (M5)."""

    scale2: float  # px^2, of the Cauchy weights
    tiny: float  # information on the first two coordinates, per px^2
    prior: float  # likewise on the third one, the disparity
    min_disparity: float  # px, after a step


class DepthLimits(NamedTuple):
    """When parallax fixes the depth of a point without a right view.

    The variance of its disparity, for one pixel of noise, is below the first limit plus the second
    one times the squared disparity.
    """

    variance: float  # px^2
    relative_variance: float
    tiny: float  # as in `Damping`
    prior: float


class TrackColumns(NamedTuple):
    """Normal equations of tracks; pixel noise is one pixel here."""

    q: InverseDepth  # the points' coordinates, pixels
    G: FloatArray  # (F, 6N, 3) cross information of clones and point
    C: FloatArray  # (F, 3, 3) information of the point
    # (F, 3, 6) how a clone's error moves a point as that clone sees it: S^-1 B
    q_D_clone: FloatArray
    gradient: FloatArray  # (F, 6N) before the point is eliminated
    point_gradient: FloatArray  # (F, 3)


class TermColumns(NamedTuple):
    """The part of tracks' normal equations that concerns the coefficients of the rectification
    error.
    """

    lens: CameraArgs
    chosen: IntArray  # (S,) of the columns that `write_view` writes
    rows_D_common: FloatArray  # (7, 4) or (7, 0), as in `StereoCorrection`
    z: FloatArray  # (F, N, 4) pixels at which the derivatives are taken
    weight: FloatArray  # (F, N) robust weights
    G: FloatArray  # (F, S, 3) cross information of coefficients and point


class Eliminated(NamedTuple):
    """Information about clones and coefficients of tracks whose points are taken out, (M4): `A`
    less `V' V`.
    """

    V: FloatArray  # (3K, 6N + S)
    A: FloatArray  # (6N + S, 6N + S)
    b: FloatArray  # (6N + S,)


class LandmarkResiduals(NamedTuple):
    """Residuals of landmarks in one camera, their Jacobians `dz = J dp`, and the weights that
    they enter a fit with.
    """

    r: FloatArray  # (K, 4) pixels, zero where not measured, times the precision
    J: FloatArray  # (K, 4, 3) with respect to the point in the world frame, likewise
    weight: FloatArray  # (K,) robust weights
    precision: FloatArray  # (K, 4) the weight of `Views`


class ErrorRows(NamedTuple):
    """First rows of blocks of the error vector."""

    exposure: int  # the position of the camera that saw the landmarks
    landmarks: int
    stereo: int  # the coefficients of the rectification error


class Information(NamedTuple):
    """Information about all errors, and about them together with what is considered."""

    A: FloatArray  # (D, D)
    b: FloatArray  # (D,)
    considered: FloatArray  # (D, C) of all errors with the coefficients considered


class RowEquations(NamedTuple):
    """Normal equations of the learned rows, equation (R2)."""

    A: FloatArray  # (7, 7)
    b: FloatArray  # (7,)
    common: FloatArray  # (7, 4) right sides if the rows were those of k1, k2, q1, q2 alone
