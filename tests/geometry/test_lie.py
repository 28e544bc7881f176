"""SO(3) and SE(3): group axioms, exp and log near 0 and near pi, and independent twins of every
operator.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from tests.jacobians import numeric_jacobian
from vio.geometry import lie
from vio.geometry.lie import FloatArray

properties = settings(max_examples=60, deadline=None)


@st.composite
def directions(draw: st.DrawFn) -> FloatArray:
    v = np.array(draw(st.tuples(*[st.floats(-1, 1, allow_subnormal=False)] * 3)))
    norm = np.linalg.norm(v)
    return np.array([1.0, 0.0, 0.0]) if norm < 1e-3 else v / norm


# Zero, tiny, across the switch from series to closed form (1e-2), ordinary, and up to pi.
angles = st.one_of(
    st.just(0.0),
    st.floats(1e-300, 1e-6),
    st.floats(9.9e-3, 1.01e-2),
    st.floats(0, np.pi - 1e-6),
    st.floats(np.pi - 1e-6, np.pi),
)
rotation_vectors = st.builds(lambda a, d: a * d, angles, directions())
translations = st.tuples(*[st.floats(-1e3, 1e3)] * 3).map(np.array)
twists = st.builds(lambda rho, phi: np.concatenate([rho, phi]), translations, rotation_vectors)
poses = twists.map(lie.se3_exp)


def se3_hat(xi: FloatArray) -> FloatArray:
    """The algebra's matrix (4, 4) of a twist (6,)."""
    return np.block([[lie.so3_hat(xi[3:]), xi[:3, None]], [np.zeros((1, 4))]])


def close(actual: Any, expected: Any, atol: float = 1e-12, rtol: float = 1e-12) -> None:
    np.testing.assert_allclose(actual, expected, atol=atol, rtol=rtol)


@properties
@given(rotation_vectors)
def test_so3_exp_is_a_rotation_and_equals_scipy_and_expm(phi: FloatArray) -> None:
    R = lie.so3_exp(phi)
    close(R @ R.T, np.eye(3), atol=2e-14)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-14)
    close(R, Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)
    close(R, expm(lie.so3_hat(phi)), atol=1e-13)


@properties
@given(rotation_vectors)
def test_so3_log_undoes_exp(phi: FloatArray) -> None:
    angle = np.linalg.norm(phi)
    back = lie.so3_log(lie.so3_exp(phi))
    if angle > np.pi - 1e-7:  # both signs of the axis give the same rotation, to rounding
        close(min(back, -back, key=lambda v: float(np.linalg.norm(v - phi))), phi, atol=1e-7)
    else:
        close(back, phi, atol=1e-14, rtol=1e-9)
    assert np.linalg.norm(back) <= np.pi + 1e-15


@pytest.mark.parametrize(
    "axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [-1, 2, -3], [0, -1, 1e-9]]
)
@pytest.mark.parametrize("below_pi", [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
def test_so3_log_near_pi_keeps_full_precision(axis: list[float], below_pi: float) -> None:
    unit = np.array(axis, dtype=np.float64) / np.linalg.norm(axis)
    phi = (np.pi - below_pi) * unit
    back = lie.so3_log(lie.so3_exp(phi))
    if below_pi < 1e-11:
        back = back * np.sign(back @ phi)
    close(back, phi, atol=3e-14)


@pytest.mark.parametrize(
    "angle", [1e-300, 1e-20, 1e-12, 1e-8, 1e-7, 1e-6, 1e-4, 9.999e-3, 1.0001e-2]
)
def test_so3_log_near_zero_is_relatively_exact(angle: float) -> None:
    phi = angle * np.array([2.0, -1.0, 2.0]) / 3
    close(lie.so3_log(lie.so3_exp(phi)), phi, atol=0, rtol=1e-12)


def test_series_and_closed_forms_agree_at_the_switch() -> None:
    direction = np.array([2.0, -1.0, 2.0]) / 3
    below, above = (direction * (1e-2 * (1 + s)) for s in (-1e-12, 1e-12))
    for f in (lie.so3_exp, lie.so3_left_jacobian, lie.so3_left_jacobian_inverse):
        close(f(below), f(above), atol=1e-12)


@properties
@given(rotation_vectors, st.tuples(*[st.floats(-1, 1)] * 3).map(np.array))
def test_left_jacobian_of_so3_is_the_derivative_of_exp(phi: FloatArray, d: FloatArray) -> None:
    J = lie.so3_left_jacobian(phi)
    R = lie.so3_exp(phi)
    numeric = numeric_jacobian(lie.so3_exp, phi, local=lambda a, b: lie.so3_log(b @ a.T))
    close(J, numeric, atol=1e-8)
    close(lie.so3_exp(phi + 1e-9 * d), lie.so3_exp(1e-9 * (J @ d)) @ R, atol=1e-14)
    close(lie.so3_left_jacobian_inverse(phi) @ J, np.eye(3), atol=1e-12)


@properties
@given(rotation_vectors)
def test_left_jacobian_of_so3_equals_its_integral(phi: FloatArray) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(20)
    s, w = (nodes + 1) / 2, weights / 2
    integral = np.einsum("n,nij->ij", w, lie.so3_exp(s[:, None] * phi))
    close(lie.so3_left_jacobian(phi), integral, atol=1e-13)


@properties
@given(poses, poses, poses)
def test_se3_is_a_group(A: FloatArray, B: FloatArray, C: FloatArray) -> None:
    close((A @ B) @ C, A @ (B @ C), atol=1e-11)
    close(A @ lie.se3_inverse(A), np.eye(4), atol=1e-11)
    close(lie.se3_inverse(A) @ A, np.eye(4), atol=1e-11)
    close(lie.se3_inverse(A @ B), lie.se3_inverse(B) @ lie.se3_inverse(A), atol=1e-11)
    close(lie.se3_exp(np.zeros(6)), np.eye(4), atol=0)


@properties
@given(twists)
def test_se3_exp_equals_expm_and_log_undoes_it(xi: FloatArray) -> None:
    T = lie.se3_exp(xi)
    scale = 1 + float(np.abs(xi).max())
    close(T, expm(se3_hat(xi)), atol=1e-13 * scale)
    if np.linalg.norm(xi[3:]) < np.pi - 1e-7:
        close(lie.se3_log(T), xi, atol=1e-11 * scale, rtol=1e-9)
    close(lie.se3_exp(lie.se3_log(T)), T, atol=1e-11 * scale)


@properties
@given(twists)
def test_se3_exp_of_the_negative_is_the_inverse(xi: FloatArray) -> None:
    close(lie.se3_exp(-xi), lie.se3_inverse(lie.se3_exp(xi)), atol=1e-11 * (1 + np.abs(xi).max()))


@properties
@given(twists)
def test_adjoint_is_the_exponential_of_the_curly_hat(xi: FloatArray) -> None:
    xi = xi * np.array([1e-2, 1e-2, 1e-2, 1, 1, 1])  # expm of a large nilpotent part loses digits
    close(
        lie.se3_adjoint(lie.se3_exp(xi)),
        expm(lie.se3_curly_hat(xi)),
        atol=1e-12 * (1 + np.abs(xi).max()),
    )


@properties
@given(poses, twists)
def test_adjoint_moves_a_twist_through_a_pose(T: FloatArray, xi: FloatArray) -> None:
    left = T @ se3_hat(xi) @ lie.se3_inverse(T)
    close(left, se3_hat(lie.se3_adjoint(T) @ xi), atol=1e-9)


@properties
@given(poses, poses)
def test_adjoint_is_a_homomorphism(A: FloatArray, B: FloatArray) -> None:
    close(lie.se3_adjoint(A @ B), lie.se3_adjoint(A) @ lie.se3_adjoint(B), atol=1e-10)
    close(lie.se3_adjoint(lie.se3_inverse(A)) @ lie.se3_adjoint(A), np.eye(6), atol=1e-8)


@properties
@given(twists, twists)
def test_curly_hat_is_the_lie_bracket(a: FloatArray, b: FloatArray) -> None:
    A, B = se3_hat(a), se3_hat(b)
    close(se3_hat(lie.se3_curly_hat(a) @ b), A @ B - B @ A, atol=1e-9)
    close(lie.se3_curly_hat(a) @ b, -lie.se3_curly_hat(b) @ a, atol=1e-9)


@properties
@given(twists, translations)
def test_circledot_swaps_twist_and_point(xi: FloatArray, p: FloatArray) -> None:
    close(lie.circledot(p) @ xi, se3_hat(xi) @ np.append(p, 1.0), atol=1e-9)


def test_circledot_is_the_derivative_of_a_moved_point() -> None:
    p = np.array([0.3, -2.0, 5.0])
    numeric = numeric_jacobian(lambda xi: lie.se3_exp(xi) @ np.append(p, 1.0), np.zeros(6))
    close(lie.circledot(p), numeric, atol=1e-8)


@properties
@given(rotation_vectors, rotation_vectors)
def test_so3_hat_is_the_cross_product(a: FloatArray, b: FloatArray) -> None:
    close(lie.so3_hat(a) @ b, np.cross(a, b), atol=1e-14)


@properties
@given(rotation_vectors)
def test_quaternions_equal_scipy(phi: FloatArray) -> None:
    R = Rotation.from_rotvec(phi).as_matrix()
    q = lie.quat_xyzw_from_rotation(R)
    expected = Rotation.from_matrix(R).as_quat()
    assert q[3] >= 0
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-15)
    close(min(expected, -expected, key=lambda e: float(np.linalg.norm(e - q))), q, atol=1e-14)
    close(lie.rotation_from_quat_xyzw(q), R, atol=1e-14)


@properties
@given(
    st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-2),
    st.floats(0.1, 9),
)
def test_rotation_from_quaternion_normalises_and_ignores_the_sign(
    q: FloatArray, scale: float
) -> None:
    R = lie.rotation_from_quat_xyzw(q)
    close(R, Rotation.from_quat(q).as_matrix(), atol=1e-14)
    close(lie.rotation_from_quat_xyzw(-scale * q), R, atol=1e-14)


@pytest.mark.parametrize("diagonal", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_half_turns_give_exact_quaternions(diagonal: tuple[int, int, int]) -> None:
    q = lie.quat_xyzw_from_rotation(np.diag(diagonal).astype(np.float64))
    close(np.abs(q), np.append(np.array(diagonal) == 1, 0.0), atol=0)


@properties
@given(rotation_vectors, st.integers(0, 2**32 - 1))
def test_nearest_rotation_keeps_rotations_and_beats_its_neighbours(
    phi: FloatArray, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    R = lie.so3_exp(phi)
    close(lie.nearest_rotation(R), R, atol=1e-14)
    M = R + 0.1 * rng.normal(size=(3, 3))
    N = lie.nearest_rotation(M)
    close(N @ N.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(N) > 0
    for step in lie.so3_exp(1e-2 * rng.normal(size=(8, 3))):
        assert np.linalg.norm(M - N) <= np.linalg.norm(M - step @ N)


def test_nearest_rotation_of_a_reflection_is_a_rotation() -> None:
    assert np.linalg.det(lie.nearest_rotation(np.diag([1.0, 1.0, -0.9]))) == pytest.approx(1)


def test_transform_points_equals_homogeneous_product() -> None:
    rng = np.random.default_rng(2)
    T, p = lie.se3_exp(rng.normal(size=6)), rng.normal(size=(5, 3))
    expected = (T @ np.column_stack([p, np.ones(5)]).T).T[:, :3]
    close(lie.transform_points(T, p), expected)
    close(lie.transform_points(T, p[0]), expected[0])


@pytest.mark.parametrize(
    "name",
    [
        "so3_hat",
        "so3_exp",
        "so3_left_jacobian",
        "so3_left_jacobian_inverse",
        "se3_exp",
        "se3_curly_hat",
        "circledot",
    ],
)
def test_batches_equal_single_calls(name: str) -> None:
    f = getattr(lie, name)
    size = 6 if name.startswith("se3") else 3
    x = np.random.default_rng(3).normal(size=(2, 4, size)) * np.array([1.0, 1e-4])[:, None, None]
    batch = f(x)
    for index in np.ndindex(2, 4):
        close(batch[index], f(x[index]), atol=1e-15)


@pytest.mark.parametrize("name", ["se3_log", "se3_inverse", "se3_adjoint"])
def test_batches_of_poses_equal_single_calls(name: str) -> None:
    f = getattr(lie, name)
    T = lie.se3_exp(np.random.default_rng(4).normal(size=(2, 4, 6)))
    for index in np.ndindex(2, 4):
        close(f(T)[index], f(T[index]), atol=1e-14)


@pytest.mark.parametrize("name", ["so3_log", "quat_xyzw_from_rotation", "nearest_rotation"])
def test_batches_of_rotations_equal_single_calls(name: str) -> None:
    f = getattr(lie, name)
    R = lie.so3_exp(np.random.default_rng(5).normal(size=(2, 4, 3)) * 2)
    for index in np.ndindex(2, 4):
        close(f(R)[index], f(R[index]), atol=1e-14)


@properties
@given(twists)
def test_single_arguments_and_batches_give_the_same(xi: FloatArray) -> None:
    batch, T = np.stack([xi, xi]), lie.se3_exp(xi)
    for function in (lie.so3_exp, lie.so3_left_jacobian, lie.so3_left_jacobian_inverse):
        close(function(xi[3:]), function(batch[:, 3:])[0], atol=4e-15)
    close(T, lie.se3_exp(batch)[0], rtol=1e-14)
    close(lie.se3_inverse(T), lie.se3_inverse(np.stack([T, T]))[1], rtol=1e-14)
    close(
        np.abs(lie.so3_log(T[:3, :3])),
        np.abs(lie.so3_log(np.stack([T, T])[:, :3, :3])[0]),
        rtol=1e-13,
    )


def test_what_is_not_finite_stays_so_without_an_error() -> None:
    with np.errstate(invalid="ignore"):
        for value in (np.nan, np.inf):
            assert not np.isfinite(lie.so3_exp([value, 0.0, 0.0])).all()
            assert not np.isfinite(lie.so3_log(np.full((3, 3), value))).all()


def test_lengths_are_those_of_numpy_to_the_bit() -> None:
    vectors = np.random.default_rng(0).normal(size=(500, 2))
    np.testing.assert_array_equal(lie.lengths(vectors), np.linalg.norm(vectors, axis=1))
    for vector in np.random.default_rng(1).normal(size=(100, 3)):
        assert lie.length(vector) == np.linalg.norm(vector)


def _integral_of_adjoints(xi: FloatArray) -> FloatArray:
    """The left Jacobian (6, 6) of a twist (6,) as the integral of Ad(exp(s xi)) over s from 0 to 1."""
    M = np.zeros((12, 12))
    M[:6, :6] = lie.se3_curly_hat(xi)
    M[:6, 6:] = np.eye(6)
    return np.asarray(expm(M)[:6, 6:])


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 3.1, 6.2, 6.4, 20.0, 40.0, 300.0])
def test_left_jacobian_of_se3_equals_its_integral_over_many_turns(angle: float) -> None:
    """As of a rig that has turned for a minute between two frames."""
    xi = np.concatenate([[30.0, -20.0, 10.0], angle * np.array([0.6, 0.0, -0.8])])
    close(lie.se3_left_jacobian(xi), _integral_of_adjoints(xi), atol=1e-10)
    others = np.stack([0.1 * xi, xi, np.zeros(6)])
    close(lie.se3_left_jacobian(others), [_integral_of_adjoints(x) for x in others], atol=1e-10)
