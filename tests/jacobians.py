"""Tools that tests share: central differences, on manifolds too, and the list of Jacobians held
against them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log

# Every public function `*_D_*` of vio and frontend, as 'module.name'. Add a name here together with
# the test that compares it with `numeric_jacobian`; tests/project/test_jacobian_registry.py holds
# this set complete and honest.
TESTED_JACOBIANS = {
    "vio.filters.imu_terms.accel_D_terms",
    "vio.filters.multiview.point_D_clones",
    "vio.filters.navigation.rate_D_error",
    "vio.filters.navigation.tilt_D_terms",
    "vio.filters.window.body_D_error",
    "vio.filters.online_calibration.camera_D_error",
    "vio.filters.window.camera_D_own",
    "vio.filters.stereo_calibration.point_D_stereo",
    "vio.filters.stereo_calibration.rows_D_common",
    "vio.filters.vislam.z_D_landmark",
    "vio.filters.vislam.z_D_xi",
    "vio.frontend.expected_motion.pixel_D_motion",
    "vio.geometry.distortion.uv_D_camera",
    "vio.geometry.distortion.uv_D_point",
    "vio.geometry.stereo.depth_D_yz",
    "vio.geometry.stereo.p_cam_D_z",
    "vio.geometry.stereo.ray_D_row",
    "vio.geometry.stereo.row_D_yz",
    "vio.geometry.stereo.z_D_p_cam",
    "vio.mapping.pose_graph.r_D_poses",
}


def numeric_jacobian(
    f: Callable[[Any], npt.ArrayLike],
    x: npt.ArrayLike,
    retract: Callable[[FloatArray, FloatArray], npt.ArrayLike] | None = None,
    local: Callable[[FloatArray, FloatArray], npt.ArrayLike] | None = None,
    eps: float = 1e-6,
    dim: int | None = None,
) -> FloatArray:
    """Jacobian (m, n) of `f` at `x` by central differences.

    Args:
        f: takes what `retract` gives; its value is flattened unless `local` is given.
        x: the point, of any shape.
        retract: moves `x` along a tangent vector (n,); None: adds it element by element.
        local: tangent vector (m,) from its first argument, `f(x)`, to its second; None: the
            flattened difference.
        eps: half the step, in units of the tangent vector.
        dim: n; None: 6 for a 4x4 pose with `retract`, 3 for a 3x3 rotation with `retract`, else the
            size of `x`.
    """
    x0 = np.asarray(x, dtype=np.float64)
    if dim is None:
        dim = {(4, 4): 6, (3, 3): 3}.get(x0.shape, x0.size) if retract is not None else x0.size
    y0 = np.asarray(f(x0), dtype=np.float64)

    def tangent(step: FloatArray) -> FloatArray:
        moved = x0 + step.reshape(x0.shape) if retract is None else retract(x0, step)
        y = np.asarray(f(moved), dtype=np.float64)
        return np.ravel(y - y0 if local is None else np.asarray(local(y0, y), dtype=np.float64))

    columns = [(tangent(step) - tangent(-step)) / (2 * eps) for step in eps * np.eye(dim)]
    return np.stack(columns, axis=1)


def left_retract(T: FloatArray, xi: FloatArray) -> FloatArray:
    """`exp(xi) T`: an error on the world side of `T_world_body`."""
    return se3_exp(xi) @ T


def left_local(T: FloatArray, other: FloatArray) -> FloatArray:
    """The `xi` with `other = exp(xi) T`."""
    return se3_log(other @ se3_inverse(T))


def right_retract(T: FloatArray, xi: FloatArray) -> FloatArray:
    """`T exp(xi)`: an error on the body side of `T_world_body`."""
    return T @ se3_exp(xi)


def right_local(T: FloatArray, other: FloatArray) -> FloatArray:
    """The `xi` with `other = T exp(xi)`."""
    return se3_log(se3_inverse(T) @ other)
