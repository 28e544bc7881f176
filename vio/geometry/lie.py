"""SO(3) and SE(3): exponential, logarithm, adjoint and the operators of the paper's filter.

Convention: a twist is `xi = [rho; phi]`, translation first; every function takes leading batch
dimensions. Single rotations and transforms, of which a filter takes many, go through plain numbers:
NumPy's calls cost far more.
Reference: Barfoot, State Estimation for Robotics (2017), chapter 7.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from vio.errors import CalibrationError
from vio.numerics.arrays import FloatArray as FloatArray
from vio.numerics.kinds import Tolerance

_EXACT: Tolerance[float] = 1e-12  # rotations this close to orthonormal keep their bits
# Below this angle the closed forms suffer from cancellation and the Taylor series is exact to
# rounding.
_SMALL_ANGLE_RAD: Tolerance[float] = 1e-2


def so3_hat(phi: npt.ArrayLike) -> FloatArray:
    """Map vectors (..., 3) to skew-symmetric matrices (..., 3, 3), so that
    `so3_hat(a) @ b = a x b`.
    """
    phi = np.asarray(phi, dtype=np.float64)
    out = np.zeros((*phi.shape[:-1], 3, 3))
    out[..., 0, 1] = -phi[..., 2]
    out[..., 0, 2] = phi[..., 1]
    out[..., 1, 0] = phi[..., 2]
    out[..., 1, 2] = -phi[..., 0]
    out[..., 2, 0] = -phi[..., 1]
    out[..., 2, 1] = phi[..., 0]
    return out


def _sinc_terms(angle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3, accurate down to a = 0."""
    small = angle < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    a2 = angle * angle
    first = np.where(small, 1 - a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42)), np.sin(safe) / safe)
    half = np.sin(safe / 2) / (safe / 2)
    second = np.where(small, 0.5 - a2 / 24 * (1 - a2 / 30 * (1 - a2 / 56)), 0.5 * half * half)
    third = np.where(
        small, 1 / 6 - a2 / 120 * (1 - a2 / 42 * (1 - a2 / 72)), (safe - np.sin(safe)) / safe**3
    )
    return first, second, third


def _sinc_terms_of_one(angle: float) -> tuple[float, float, float]:
    """As `_sinc_terms`, for one finite angle."""
    a2 = angle * angle
    if angle < _SMALL_ANGLE_RAD:
        first = 1 - a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42))
        second = 0.5 - a2 / 24 * (1 - a2 / 30 * (1 - a2 / 56))
        return first, second, 1 / 6 - a2 / 120 * (1 - a2 / 42 * (1 - a2 / 72))
    half = math.sin(angle / 2) / (angle / 2)
    sine = math.sin(angle)
    return sine / angle, 0.5 * half * half, (angle - sine) / (angle * a2)


def _one(phi: FloatArray) -> tuple[float, float, float, float] | None:
    """Entries and length of a single finite vector (3,); None: it is another array."""
    if phi.ndim != 1:
        return None
    x, y, z = phi.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if not math.isfinite(angle):
        return None
    return (x, y, z, angle)


def length(vector: FloatArray) -> float:
    """Length of a single vector (n,): `np.linalg.norm`, to the bit, in a few calls."""
    return math.sqrt(vector.dot(vector))


def lengths(vectors: FloatArray) -> FloatArray:
    """Lengths (N,) of vectors of the plane (N, 2)."""
    x = vectors[:, 0]
    y = vectors[:, 1]
    return np.sqrt(x * x + y * y)


def _series(x: float, y: float, z: float, b: float, c: float) -> FloatArray:
    """`I + b W + c W W` (3, 3) with W the skew-symmetric matrix of a vector."""
    xx = c * x * x
    yy = c * y * y
    zz = c * z * z
    xy = c * x * y
    xz = c * x * z
    yz = c * y * z
    return np.array(
        [
            [1.0 - (yy + zz), xy - b * z, xz + b * y],
            [xy + b * z, 1.0 - (xx + zz), yz - b * x],
            [xz - b * y, yz + b * x, 1.0 - (xx + yy)],
        ]
    )


def so3_exp(phi: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues'
    formula).
    """
    phi = np.asarray(phi, dtype=np.float64)
    if (one := _one(phi)) is not None:
        return _series(*one[:3], *_sinc_terms_of_one(one[3])[:2])
    a, b, _ = _sinc_terms(np.linalg.norm(phi, axis=-1))
    W = so3_hat(phi)
    return np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)


def quat_xyzw_from_rotation(R: npt.ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4) in x y z w order, w >= 0, of rotation matrices (..., 3, 3).

    Computes the largest of the four components first, which avoids division by small numbers.
    Reference: Shepperd, Quaternion from rotation matrix, J. Guidance and Control (1978).
    """
    R = np.asarray(R, dtype=np.float64)
    trace: FloatArray = np.trace(R, axis1=-2, axis2=-1)
    # Rows of 4 q q^T, one for each candidate of the largest component.
    d0 = R[..., 0, 0]
    d1 = R[..., 1, 1]
    d2 = R[..., 2, 2]
    s01 = R[..., 0, 1] + R[..., 1, 0]
    s02 = R[..., 0, 2] + R[..., 2, 0]
    s12 = R[..., 1, 2] + R[..., 2, 1]
    a0 = R[..., 2, 1] - R[..., 1, 2]
    a1 = R[..., 0, 2] - R[..., 2, 0]
    a2 = R[..., 1, 0] - R[..., 0, 1]
    rows = np.stack(
        [
            np.stack([1 + d0 - d1 - d2, s01, s02, a0], axis=-1),
            np.stack([s01, 1 - d0 + d1 - d2, s12, a1], axis=-1),
            np.stack([s02, s12, 1 - d0 - d1 + d2, a2], axis=-1),
            np.stack([a0, a1, a2, 1 + trace], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.stack([d0, d1, d2, trace], axis=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def rotation_from_quat_xyzw(q: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in x y z w order; they are
    normalised first.
    """
    raw = np.asarray(q, dtype=np.float64)
    unit = raw / np.linalg.norm(raw, axis=-1, keepdims=True)
    vector = unit[..., :3]
    w = unit[..., 3, None, None]
    V = so3_hat(vector)
    return np.eye(3) + 2 * w * V + 2 * (V @ V)


def _quat_xyzw_of_one(R: FloatArray) -> tuple[float, float, float, float]:
    """As `quat_xyzw_from_rotation`, for one finite matrix (3, 3)."""
    (d0, m01, m02), (m10, d1, m12), (m20, m21, d2) = R.tolist()
    trace = d0 + d1 + d2
    largest = max(d0, d1, d2, trace)
    if largest == d0:
        x = 1 + d0 - d1 - d2
        y = m01 + m10
        z = m02 + m20
        w = m21 - m12
    elif largest == d1:
        x = m01 + m10
        y = 1 - d0 + d1 - d2
        z = m12 + m21
        w = m02 - m20
    elif largest == d2:
        x = m02 + m20
        y = m12 + m21
        z = 1 - d0 - d1 + d2
        w = m10 - m01
    else:
        x = m21 - m12
        y = m02 - m20
        z = m10 - m01
        w = 1 + trace
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    size = math.copysign(norm, -1.0 if w < 0 else 1.0)
    return x / size, y / size, z / size, w / size


def _rotation_vector_of_one(R: FloatArray) -> tuple[float, float, float] | None:
    """Entries of the rotation vector of a single finite matrix (3, 3); None: it is another
    array.
    """
    if R.ndim != 2:
        return None
    x, y, z, w = _quat_xyzw_of_one(R)
    if not math.isfinite(x + y + z + w):
        return None
    s = math.sqrt(x * x + y * y + z * z)
    if s < 1e-7:
        ratio = 2.0
    else:
        ratio = 2 * math.atan2(s, w) / s
    return ratio * x, ratio * y, ratio * z


def so3_log(R: npt.ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), angle in [0, pi], of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    if (one := _rotation_vector_of_one(R)) is not None:
        return np.array(one)
    q = quat_xyzw_from_rotation(R)
    vector = q[..., :3]
    w = q[..., 3]
    s = np.linalg.norm(vector, axis=-1)
    small = s < 1e-7
    angle_over_s = np.where(small, 2.0, 2 * np.arctan2(s, w) / np.where(small, 1.0, s))
    return angle_over_s[..., None] * vector


def so3_left_jacobian(phi: npt.ArrayLike) -> FloatArray:
    """Left Jacobian of SO(3), (..., 3, 3): exp(phi + d) = exp(J d) exp(phi) to first order in d."""
    phi = np.asarray(phi, dtype=np.float64)
    if (one := _one(phi)) is not None:
        return _series(*one[:3], *_sinc_terms_of_one(one[3])[1:])
    _, b, c = _sinc_terms(np.linalg.norm(phi, axis=-1))
    W = so3_hat(phi)
    return np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)


def _inverse_coefficient_of_one(angle: float) -> float:
    """Coefficient of `W W` in the inverse of the left Jacobian, for one finite angle."""
    squared = angle * angle
    if angle < _SMALL_ANGLE_RAD:
        return 1 / 12 + squared / 720 * (1 + squared / 42)
    a, b, _ = _sinc_terms_of_one(angle)
    return (1 - a / (2 * b)) / squared


def so3_left_jacobian_inverse(phi: npt.ArrayLike) -> FloatArray:
    """Inverse of the left Jacobian of SO(3), (..., 3, 3), for angles below 2 pi."""
    phi = np.asarray(phi, dtype=np.float64)
    if (one := _one(phi)) is not None:
        return _series(*one[:3], -0.5, _inverse_coefficient_of_one(one[3]))
    angle = np.linalg.norm(phi, axis=-1)
    a, b, _ = _sinc_terms(angle)
    small = angle < _SMALL_ANGLE_RAD
    a2 = np.where(small, 1.0, angle * angle)
    series = 1 / 12 + angle**2 / 720 * (1 + angle**2 / 42)
    coefficient = np.where(small, series, (1 - a / (2 * np.where(small, 1.0, b))) / a2)
    W = so3_hat(phi)
    return np.eye(3) - 0.5 * W + coefficient[..., None, None] * (W @ W)


def se3_from_parts(R: npt.ArrayLike, t: npt.ArrayLike) -> FloatArray:
    """Homogeneous transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    R = np.asarray(R, dtype=np.float64)
    t = np.asarray(t, dtype=np.float64)
    if R.ndim == 2 and t.ndim == 1:
        one = np.zeros((4, 4))
        one[:3, :3] = R
        one[:3, 3] = t
        one[3, 3] = 1.0
        return one
    out = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def se3_exp(xi: npt.ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) of twists (..., 6) `[rho; phi]` in metres and radians."""
    xi = np.asarray(xi, dtype=np.float64)
    rho = xi[..., :3]
    phi = xi[..., 3:]
    if (one := _one(phi)) is not None:
        x, y, z, angle = one
        a, b, c = _sinc_terms_of_one(angle)
        T = np.zeros((4, 4))
        T[:3, :3] = _series(x, y, z, a, b)
        T[:3, 3] = (_series(x, y, z, b, c) @ rho[:, None])[:, 0]
        T[3, 3] = 1.0
        return T
    return se3_from_parts(so3_exp(phi), (so3_left_jacobian(phi) @ rho[..., None])[..., 0])


def se3_log(T: npt.ArrayLike) -> FloatArray:
    """Twists (..., 6) `[rho; phi]` of transforms (..., 4, 4); the rotation angle is in [0, pi]."""
    T = np.asarray(T, dtype=np.float64)
    if (one := _rotation_vector_of_one(T[..., :3, :3])) is not None:
        x, y, z = one
        c = _inverse_coefficient_of_one(math.sqrt(x * x + y * y + z * z))
        xi = np.empty((6, 1))
        np.matmul(_series(x, y, z, -0.5, c), T[:3, 3, None], out=xi[:3])
        xi[3:, 0] = one
        return xi[:, 0]
    phi = so3_log(T[..., :3, :3])
    rho = (so3_left_jacobian_inverse(phi) @ T[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def se3_inverse(T: npt.ArrayLike) -> FloatArray:
    """Inverse transforms (..., 4, 4), by transposing the rotation."""
    T = np.asarray(T, dtype=np.float64)
    if T.ndim == 2:
        (a, b, c, x), (d, e, f, y), (g, h, i, z) = T[:3].tolist()
        p = -(a * x + d * y + g * z)
        q = -(b * x + e * y + h * z)
        r = -(c * x + f * y + i * z)
        return np.array(
            [
                [a, d, g, p],
                [b, e, h, q],
                [c, f, i, r],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return se3_from_parts(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def se3_curly_hat(xi: npt.ArrayLike) -> FloatArray:
    """The adjoint of the algebra: twists (..., 6) to (..., 6, 6),
    `exp(curly_hat(xi)) = Ad(exp(xi))`.
    """
    xi = np.asarray(xi, dtype=np.float64)
    W = so3_hat(xi[..., 3:])
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = W
    out[..., :3, 3:] = so3_hat(xi[..., :3])
    return out


def se3_adjoint(T: npt.ArrayLike) -> FloatArray:
    """Adjoint matrices (..., 6, 6): `T exp(xi) T^-1 = exp(Ad(T) xi)`."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    if T.ndim == 2:
        one = np.zeros((6, 6))
        one[:3, :3] = one[3:, 3:] = R
        x, y, z = T[:3, 3].tolist()
        one[:3, 3:] = (
            np.array(
                [
                    [0.0, -z, y],
                    [z, 0.0, -x],
                    [-y, x, 0.0],
                ]
            )
            @ R
        )
        return one
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = so3_hat(T[..., :3, 3]) @ R
    return out


def se3_left_jacobian(xi: npt.ArrayLike) -> FloatArray:
    """Left Jacobian of SE(3), (..., 6, 6): exp(xi + d) = exp(J d) exp(xi) to first order in d.

    Summed as a power series in the curly hat; for one step of motion a few terms suffice. Digits
    of the series cancel beyond some turns: there, that of a fraction of the twist is doubled by
    `J(2 xi) = (1 + Ad(exp(xi))) J(xi) / 2`. Reference: Barfoot (2017), equation 7.83.
    """
    xi = np.asarray(xi, dtype=np.float64)
    angle = float(np.linalg.norm(xi[..., 3:], axis=-1).max(initial=0.0))
    halvings = 0
    if 2 * np.pi < angle < np.inf:
        halvings = math.ceil(math.log2(angle / np.pi))
    curly = se3_curly_hat(xi / 2**halvings)
    term = np.broadcast_to(np.eye(6), curly.shape)
    total = term.copy()
    for n in range(2, 60):
        term = term @ curly / n
        total += term
        if np.abs(term).max(initial=0.0) < 1e-16:
            break
    for k in range(halvings, 0, -1):
        A = se3_adjoint(se3_exp(xi / 2**k))
        total = 0.5 * (np.eye(6) + A) @ total
    return total


def circledot(p: npt.ArrayLike) -> FloatArray:
    """The paper's operator on points (..., 3): (..., 4, 6) with
    `hat(xi) [p; 1] = circledot(p) xi`.
    """
    p = np.asarray(p, dtype=np.float64)
    out = np.zeros((*p.shape[:-1], 4, 6))
    out[..., :3, :3] = np.eye(3)
    out[..., :3, 3:] = -so3_hat(p)
    return out


def transform_points(T_a_b: npt.ArrayLike, p_b: npt.ArrayLike) -> FloatArray:
    """Map points (N, 3) or (3,) from frame b to frame a with one transform (4, 4)."""
    T_a_b = np.asarray(T_a_b, dtype=np.float64)
    p_b = np.asarray(p_b, dtype=np.float64)
    return p_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def nearest_rotation(R: npt.ArrayLike) -> FloatArray:
    """The rotations (..., 3, 3) closest to given matrices in the Frobenius norm (by SVD)."""
    U, _, Vt = np.linalg.svd(np.asarray(R, dtype=np.float64))
    U[..., :, -1] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return U @ Vt


_ROTATION_TOLERANCE = 1e-3  # largest entry of R^T R - I accepted as rounding


def rigid_fault(T: FloatArray) -> str | None:
    """Describe why a matrix (4, 4), or its first three rows, is no rigid transform.

    None: it is one, to rounding.
    """
    if not np.isfinite(T).all():
        return "not finite; check the calibration"
    last = [0.0, 0.0, 0.0, 1.0]
    if T.shape == (4, 4) and T[3].tolist() != last and not np.allclose(T[3], last, atol=1e-9):
        return f"the last row of the transform is {T[3].tolist()}, not 0 0 0 1"
    R = T[:3, :3]
    deviation = float(np.abs(R.T @ R - np.eye(3)).max())
    if not deviation <= _ROTATION_TOLERANCE:
        return f"not a rotation (R^T R differs from identity by {deviation:.2g}); check the calibration"
    if np.linalg.det(R) < 0:
        return "not a rotation but a reflection (determinant -1); check the axes' order"
    return None


def checked_transform(T: npt.ArrayLike, where: str) -> FloatArray:
    """Return a rigid transform (4, 4) whose rotation is orthonormal to rounding.

    Args:
        T: (4, 4) or its first three rows.
        where: names it (a file and its entry) in the message.

    Raises:
        CalibrationError: entries are not finite, or the rotation part is not a rotation.
    """
    try:
        T_ = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError) as error:  # as of a pair (R, t)
        raise CalibrationError(
            f"{where}: not a 3x4 or 4x4 transform ({error}); give one matrix [R t]"
        ) from error
    if T_.shape not in ((3, 4), (4, 4)) or not np.isfinite(T_).all():
        raise CalibrationError(
            f"{where}: not a finite 3x4 or 4x4 transform (shape {T_.shape}); check the calibration"
        )
    if fault := rigid_fault(T_):
        raise CalibrationError(f"{where}: {fault}")
    R = T_[:3, :3]
    deviation = float(np.abs(R.T @ R - np.eye(3)).max())
    return se3_from_parts(R if deviation <= _EXACT else nearest_rotation(R), T_[:3, 3])
