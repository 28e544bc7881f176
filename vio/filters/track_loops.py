"""The compiled loops over tracks and their views behind `multiview` and `stereo_calibration`.

Shapes: F tracks, N clones, S coefficients of the stereo field. `lens` is that of `lens_of`. Each loop writes into the
arrays that come last. `tests/numpy_twins.py` holds the same in NumPy.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from vio.compiled import compiled, solve_positive
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, IntArray

Lens: TypeAlias = tuple[float, float, float, float, float, bool]


def lens_of(camera: StereoCamera) -> Lens:
    """Return `(fu, fv, cu, cv, baseline, whether it is a cylinder)`."""
    fu, fv, cu, cv = float(camera.fu), float(camera.fv), float(camera.cu), float(camera.cv)
    return fu, fv, cu, cv, float(camera.baseline_m), camera.is_cylinder


@compiled
def compare_views(
    lens: Lens,
    least_depth: float,
    T: FloatArray,
    p: FloatArray,
    z: FloatArray,
    weight: FloatArray,
    r: FloatArray,
    J: FloatArray,
    ahead: BoolArray,
) -> None:
    """Write residuals (F, N, 4), Jacobians (F, N, 4, 3) by the points (F, 3), and which points are ahead (F,): (M1)."""
    fu, fv, cu, cv, baseline, cylinder = lens
    azimuth, s, c = 0.0, 0.0, 1.0  # of the point, about the baseline: a cylinder is a pinhole turned to it
    for f in range(len(p)):
        ahead[f] = True
        for n in range(len(T)):
            x = T[n, 0, 0] * p[f, 0] + T[n, 0, 1] * p[f, 1] + T[n, 0, 2] * p[f, 2] + T[n, 0, 3]
            y = T[n, 1, 0] * p[f, 0] + T[n, 1, 1] * p[f, 1] + T[n, 1, 2] * p[f, 2] + T[n, 1, 3]
            depth = T[n, 2, 0] * p[f, 0] + T[n, 2, 1] * p[f, 1] + T[n, 2, 2] * p[f, 2] + T[n, 2, 3]
            if cylinder:
                azimuth, depth = np.arctan2(y, depth), np.sqrt(y * y + depth * depth)
                s, c = np.sin(azimuth), np.cos(azimuth)
            seen = weight[f, n, 0] > 0.0
            usable = depth > least_depth
            if seen and not usable:
                ahead[f] = False
            if not (seen and usable):
                for a in range(4):
                    r[f, n, a] = 0.0
                    for j in range(3):
                        J[f, n, a, j] = 0.0
                continue
            u, v, d = fu * x / depth, fv * y / depth, fu * baseline / depth
            for a in range(4):
                w = weight[f, n, a]
                axis, focal, pixel, centre = 0, fu, u, cu
                if a == 1 or a == 3:
                    axis, focal, pixel, centre = 1, fv, v, cv
                elif a == 2:
                    pixel = u - d
                if cylinder and axis == 1:
                    pixel = fv * azimuth
                r[f, n, a] = (z[f, n, a] - pixel - centre) * w if w > 0.0 else 0.0
                if cylinder:
                    for j in range(3):
                        along = pixel * (s * T[n, 1, j] + c * T[n, 2, j]) if axis == 0 else 0.0
                        across = T[n, 0, j] if axis == 0 else c * T[n, 1, j] - s * T[n, 2, j]
                        J[f, n, a, j] = w * (focal * across - along) / depth
                    continue
                for j in range(3):
                    J[f, n, a, j] = w * (focal * T[n, axis, j] - pixel * T[n, 2, j]) / depth


@compiled
def mark_measured(J: FloatArray, out: BoolArray) -> None:
    """Write which pixel coordinates (F, N, 4) have a Jacobian (F, N, 4, 3) other than zero."""
    for f in range(J.shape[0]):
        for n in range(J.shape[1]):
            for a in range(4):
                out[f, n, a] = J[f, n, a, 0] != 0.0 or J[f, n, a, 1] != 0.0 or J[f, n, a, 2] != 0.0


@compiled
def anchor_points(
    lens: Lens,
    least_depth: float,
    T: FloatArray,
    p: FloatArray,
    seen: BoolArray,
    anchor: IntArray,
    centre: FloatArray,
    disparity: FloatArray,
    p_D_q: FloatArray,
    q_D_p: FloatArray,
) -> None:
    """Write the coordinates (M5) of points (F, 3): the columns of `InverseDepth`."""
    fu, baseline, cylinder = lens[0], lens[4], lens[5]
    row1, row2 = np.empty(3), np.empty(3)  # y and z axes of the camera, for a cylinder turned to the point
    for f in range(len(p)):
        k = 0
        for n in range(len(T) - 1, -1, -1):
            if seen[f, n]:
                k = n
        anchor[f] = k
        for i in range(3):
            centre[f, i] = -(T[k, 0, i] * T[k, 0, 3] + T[k, 1, i] * T[k, 1, 3] + T[k, 2, i] * T[k, 2, 3])
        x = T[k, 0, 0] * p[f, 0] + T[k, 0, 1] * p[f, 1] + T[k, 0, 2] * p[f, 2] + T[k, 0, 3]
        y = T[k, 1, 0] * p[f, 0] + T[k, 1, 1] * p[f, 1] + T[k, 1, 2] * p[f, 2] + T[k, 1, 3]
        z = T[k, 2, 0] * p[f, 0] + T[k, 2, 1] * p[f, 1] + T[k, 2, 2] * p[f, 2] + T[k, 2, 3]
        for i in range(3):
            row1[i], row2[i] = T[k, 1, i], T[k, 2, i]
        if cylinder:
            azimuth = np.arctan2(y, z)
            s, c = np.sin(azimuth), np.cos(azimuth)
            y, z = 0.0, np.sqrt(y * y + z * z)
            for i in range(3):
                row1[i], row2[i] = c * T[k, 1, i] - s * T[k, 2, i], s * T[k, 1, i] + c * T[k, 2, i]
        z = max(z, least_depth)
        disparity[f] = fu * baseline / z
        for i in range(3):
            p_D_q[f, i, 0] = T[k, 0, i] * z / fu
            p_D_q[f, i, 1] = row1[i] * z / fu
            p_D_q[f, i, 2] = (centre[f, i] - p[f, i]) / disparity[f]
            q_D_p[f, 0, i] = (T[k, 0, i] - x / z * row2[i]) * fu / z
            q_D_p[f, 1, i] = (row1[i] - y / z * row2[i]) * fu / z
            q_D_p[f, 2, i] = -row2[i] * disparity[f] / z


@compiled
def step_points(
    r: FloatArray, J: FloatArray, p_D_q: FloatArray, scale2: float, tiny: float, prior: float, dq: FloatArray
) -> None:
    """Write a Gauss-Newton step (F, 3) of each point in the coordinates (M5), with Cauchy weights of a scale."""
    C, row = np.empty((3, 3)), np.empty(3)
    for f in range(len(r)):
        for i in range(3):
            dq[f, i] = 0.0
            for j in range(3):
                C[i, j] = 0.0
        C[0, 0], C[1, 1], C[2, 2] = tiny, tiny, prior
        for n in range(r.shape[1]):
            squares = r[f, n, 0] ** 2 + r[f, n, 1] ** 2 + r[f, n, 2] ** 2 + r[f, n, 3] ** 2
            w = 1.0 / (1.0 + squares / (4.0 * scale2))
            for a in range(4):
                for i in range(3):
                    row[i] = (
                        J[f, n, a, 0] * p_D_q[f, 0, i] + J[f, n, a, 1] * p_D_q[f, 1, i] + J[f, n, a, 2] * p_D_q[f, 2, i]
                    )
                for i in range(3):
                    dq[f, i] += w * row[i] * r[f, n, a]
                    for j in range(i + 1):
                        C[i, j] += w * row[i] * row[j]
        solve_positive(C, dq[f])


@compiled
def collect_tracks(
    r: FloatArray,
    J: FloatArray,
    weight: FloatArray,
    p_D_q: FloatArray,
    B: FloatArray,
    anchor: IntArray,
    prior: float,
    G: FloatArray,
    C: FloatArray,
    gradient: FloatArray,
    point_gradient: FloatArray,
) -> None:
    """Write the normal equations of tracks, (M2), (M3), (M5), (M6): the columns of `TrackInformation`."""
    C_i, g_i, row = np.empty((3, 3)), np.empty(3), np.empty(3)
    for f in range(len(r)):
        for i in range(3):
            point_gradient[f, i] = 0.0
            for j in range(3):
                C[f, i, j] = 0.0
        for n in range(r.shape[1]):
            for i in range(3):
                g_i[i] = 0.0
                for j in range(3):
                    C_i[i, j] = 0.0
            for a in range(4):
                for i in range(3):
                    row[i] = (
                        J[f, n, a, 0] * p_D_q[f, 0, i] + J[f, n, a, 1] * p_D_q[f, 1, i] + J[f, n, a, 2] * p_D_q[f, 2, i]
                    )
                for i in range(3):
                    g_i[i] += weight[f, n] * row[i] * r[f, n, a]
                    for j in range(3):
                        C_i[i, j] += weight[f, n] * row[i] * row[j]
            if n == anchor[f]:
                C_i[2, 2] += prior
            for i in range(3):
                point_gradient[f, i] += g_i[i]
                for j in range(3):
                    C[f, i, j] += C_i[i, j]
            for k in range(6):
                b0, b1, b2 = B[f, 0, k], B[f, 1, k], B[f, 2, k]
                gradient[f, 6 * n + k] = b0 * g_i[0] + b1 * g_i[1] + b2 * g_i[2]
                for j in range(3):
                    G[f, 6 * n + k, j] = b0 * C_i[0, j] + b1 * C_i[1, j] + b2 * C_i[2, j]


@compiled
def eliminate_tracks(
    chosen: IntArray,
    G: FloatArray,
    C: FloatArray,
    B: FloatArray,
    gradient: FloatArray,
    point_gradient: FloatArray,
    V: FloatArray,
    A: FloatArray,
    b: FloatArray,
) -> None:
    """Write `V` (3F, 6N), whose `V' V` is what the points of the chosen tracks take away, equation (M4).

    The blocks of the clones on the diagonal are added to A (6N, 6N), and the vector to b (6N,).
    """
    L, y = np.empty((3, 3)), np.empty(3)
    size = G.shape[1]
    for c, f in enumerate(chosen):
        for i in range(3):
            for j in range(i + 1):
                total = C[f, i, j]
                for k in range(j):
                    total -= L[i, k] * L[j, k]
                L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
        y[0] = point_gradient[f, 0] / L[0, 0]
        y[1] = (point_gradient[f, 1] - L[1, 0] * y[0]) / L[1, 1]
        y[2] = (point_gradient[f, 2] - L[2, 0] * y[0] - L[2, 1] * y[1]) / L[2, 2]
        for k in range(size):
            v0 = G[f, k, 0] / L[0, 0]
            v1 = (G[f, k, 1] - L[1, 0] * v0) / L[1, 1]
            v2 = (G[f, k, 2] - L[2, 0] * v0 - L[2, 1] * v1) / L[2, 2]
            V[3 * c, k], V[3 * c + 1, k], V[3 * c + 2, k] = v0, v1, v2
            b[k] += gradient[f, k] - v0 * y[0] - v1 * y[1] - v2 * y[2]
            first = k - k % 6
            for j in range(6):
                A[k, first + j] += G[f, k, 0] * B[f, 0, j] + G[f, k, 1] * B[f, 1, j] + G[f, k, 2] * B[f, 2, j]


@compiled
def stereo_field_jacobian(lens: Lens, z: FloatArray, out: FloatArray) -> None:
    """Write the derivatives (M, 4, 8) of pixels (M, 4) by the coefficients of (R3) and (R4)."""
    fu, fv, cu, cv, _, _ = lens
    for m in range(len(z)):
        x, y, xr = (z[m, 0] - cu) / fu, (z[m, 1] - cv) / fv, (z[m, 2] - cu) / fu
        r2, rr2 = x * x + y * y, xr * xr + y * y
        for a in range(4):
            for s in range(8):
                out[m, a, s] = 0.0
        out[m, 0, 3], out[m, 0, 4], out[m, 0, 5] = fu * x * r2, fu * 2.0 * x * y, fu * (r2 + 2.0 * x * x)
        out[m, 1, 3], out[m, 1, 4], out[m, 1, 5] = fv * y * r2, fv * (r2 + 2.0 * y * y), fv * 2.0 * x * y
        out[m, 2, 0], out[m, 2, 1], out[m, 2, 2] = fu, fu * xr, fu * rr2
        out[m, 2, 3], out[m, 2, 4], out[m, 2, 5] = fu * xr * rr2, fu * 2.0 * xr * y, fu * (rr2 + 2.0 * xr * xr)
        out[m, 2, 6] = z[m, 2] - z[m, 0]
        out[m, 0, 7], out[m, 1, 7], out[m, 2, 7] = fu * x, fv * y, fu * xr


@compiled
def correct_pixels(
    lens: Lens, coefficients: FloatArray, rows: FloatArray, z: FloatArray, weight: FloatArray, out: FloatArray
) -> None:
    """Write pixels (M, 4) without the field of (R3) and (R4), (8,), and what follows from the rows (6,) of (R2)."""
    fu, fv, cu, cv, _, _ = lens
    a0, a1, a2, k, q1, q2, baseline, focal = coefficients
    by_focal, by_both = np.exp(-focal), np.exp(-focal - baseline)
    metric = baseline != 0.0 or focal != 0.0
    for m in range(len(z)):
        x, y, xr = (z[m, 0] - cu) / fu, (z[m, 1] - cv) / fv, (z[m, 2] - cu) / fu
        r2, rr2 = x * x + y * y, xr * xr + y * y
        left = x * r2 * k + 2.0 * x * y * q1 + (r2 + 2.0 * x * x) * q2
        row = y * r2 * k + (r2 + 2.0 * y * y) * q1 + 2.0 * x * y * q2
        right = a0 + a1 * xr + a2 * rr2 + xr * rr2 * k + 2.0 * xr * y * q1 + (rr2 + 2.0 * xr * xr) * q2
        right += -rows[1] * y + (rows[5] - rows[4]) * xr * y - rows[3] * y * y
        out[m, 0] = z[m, 0] - fu * left if weight[m, 0] > 0.0 else z[m, 0]
        out[m, 1] = z[m, 1] - fv * row if weight[m, 1] > 0.0 else z[m, 1]
        out[m, 2] = z[m, 2] - fu * right if weight[m, 2] > 0.0 else z[m, 2]
        out[m, 3] = z[m, 3]
        if metric and weight[m, 0] > 0.0:
            disparity = (out[m, 0] - out[m, 2]) * by_both
            out[m, 0] = cu + (out[m, 0] - cu) * by_focal
            out[m, 1] = cv + (out[m, 1] - cv) * by_focal
            out[m, 2] = out[m, 0] - disparity if weight[m, 2] > 0.0 else z[m, 2]


@compiled
def _lens_plane(x: float, azimuth: float) -> tuple[float, float, float, float, float, float]:
    """Angles off the axis (along u, along v) of a cylinder's coordinates, and how the coordinates move with them (2x2).

    Errors of a wide lens are low polynomials in these angles, as those of a narrow one are on the plane z = 1.
    """
    rho = 1.0 / np.sqrt(1.0 + x * x)
    a, y, z = x * rho, np.sin(azimuth) * rho, np.cos(azimuth) * rho
    sine = np.sqrt(a * a + y * y)
    if sine < 1e-6:
        return a, y, 1.0, 0.0, 0.0, 1.0
    ratio = np.arctan2(sine, z) / sine
    ca, sa = a / sine, y / sine
    xx, xy = (z * ca * ca + sa * sa / ratio) / rho**3, ca * sa * (z - 1.0 / ratio) / rho**3
    yx, yy = ca * sa * (1.0 - z / ratio) / rho**2, (sa * sa + ca * ca * z / ratio) / rho**2
    return ratio * a, ratio * y, xx, xy, yx, yy


@compiled
def cylinder_terms(x: float, azimuth: float, out: FloatArray) -> None:
    """Write by how much (2, 12) a right camera's coordinates on a cylinder move, for one unit of each coefficient.

    Columns: a0, a1, a2, k, q1, q2 of the states, then the six of the rows, equation (R6).
    """
    u, v, xx, xy, yx, yy = _lens_plane(x, azimuth)
    s, c, r2 = np.sin(azimuth), np.cos(azimuth), u * u + v * v
    # What moves in the lens, in angles off the axis; then on the cylinder.
    lens_u = 4.0, u, r2, r2 * u, 2.0 * u * v, r2 + 2.0 * u * u, 0.0, 0.0, 0.0, 0.0, 0.0, r2 * u
    lens_v = 0.0, 0.0, 0.0, r2 * v, r2 + 2.0 * v * v, 2.0 * u * v, 0.0, 0.0, v, 0.0, 3.0, r2 * v
    for j in range(12):
        out[0, j] = xx * lens_u[j] + xy * lens_v[j]
        out[1, j] = yx * lens_u[j] + yy * lens_v[j]
    # The turns about y, z and x.
    out[0, 0] -= 3.0 * (1.0 + x * x) * c
    out[1, 0] -= 3.0 * x * s
    out[0, 9] += (1.0 + x * x) * c
    out[1, 9] += x * s
    out[0, 7] -= (1.0 + x * x) * s
    out[1, 7] += x * c
    out[1, 6] += 1.0
    out[1, 10] -= 3.0


@compiled
def cylinder_field_jacobian(lens: Lens, z: FloatArray, out: FloatArray) -> None:
    """Write the derivatives (M, 4, 8) of a cylinder's pixels (M, 4) by the coefficients of (R3); by (R4)'s, zero."""
    fu, fv, cu, cv, _, _ = lens
    left, right = np.empty((2, 12)), np.empty((2, 12))
    for m in range(len(z)):
        y = (z[m, 1] - cv) / fv
        cylinder_terms((z[m, 0] - cu) / fu, y, left)
        cylinder_terms((z[m, 2] - cu) / fu, y, right)
        for j in range(8):
            for a in range(4):
                out[m, a, j] = 0.0
        for j in range(6):
            out[m, 2, j] = fu * right[0, j]
        for j in range(3, 6):
            out[m, 0, j], out[m, 1, j] = fu * left[0, j], fv * left[1, j]


@compiled
def correct_cylinder_pixels(
    lens: Lens, coefficients: FloatArray, rows: FloatArray, z: FloatArray, weight: FloatArray, out: FloatArray
) -> None:
    """Write a cylinder's pixels (M, 4) without the field of (R3), (8,), and what follows from the rows (6,) of (R2)."""
    fu, fv, cu, cv, _, _ = lens
    left, right = np.empty((2, 12)), np.empty((2, 12))
    for m in range(len(z)):
        y = (z[m, 1] - cv) / fv
        for a in range(4):
            out[m, a] = z[m, a]
        if weight[m, 0] > 0.0:
            cylinder_terms((z[m, 0] - cu) / fu, y, left)
            for j in range(3, 6):
                out[m, 0] -= fu * left[0, j] * coefficients[j]
                out[m, 1] -= fv * left[1, j] * coefficients[j]
        if weight[m, 2] > 0.0:
            cylinder_terms((z[m, 2] - cu) / fu, y, right)
            for j in range(6):
                out[m, 2] -= fu * (right[0, j] * coefficients[j] + right[0, 6 + j] * rows[j])


@compiled
def cylinder_rows(lens: Lens, z: FloatArray, rows: FloatArray, common: FloatArray) -> None:
    """Write the derivatives of right minus left rows, in focal lengths, of a cylinder's pixels (M, 4).

    By the coefficients of (R2), (M, 6), and by k, q1 and q2 of (R3), (M, 3).
    """
    fu, fv, cu, cv, _, _ = lens
    left, right = np.empty((2, 12)), np.empty((2, 12))
    for m in range(len(z)):
        y = (z[m, 1] - cv) / fv
        cylinder_terms((z[m, 0] - cu) / fu, y, left)
        cylinder_terms((z[m, 2] - cu) / fu, y, right)
        for j in range(6):
            rows[m, j] = right[1, 6 + j]
        for j in range(3):
            common[m, j] = right[1, 3 + j] - left[1, 3 + j]


@compiled
def collect_columns(
    J: FloatArray, H: FloatArray, weight: FloatArray, p_D_q: FloatArray, by_point: FloatArray, WH: FloatArray
) -> None:
    """Write `J' W H` (F, N, 3, S) and `W H` (F, N, 4, S); H (F, N, 4, S) becomes zero where nothing was measured."""
    row = np.empty(3)
    terms = H.shape[3]
    for f in range(len(J)):
        for n in range(J.shape[1]):
            for i in range(3):
                for s in range(terms):
                    by_point[f, n, i, s] = 0.0
            for a in range(4):
                measured = J[f, n, a, 0] != 0.0 or J[f, n, a, 1] != 0.0 or J[f, n, a, 2] != 0.0
                for i in range(3):
                    row[i] = (
                        J[f, n, a, 0] * p_D_q[f, 0, i] + J[f, n, a, 1] * p_D_q[f, 1, i] + J[f, n, a, 2] * p_D_q[f, 2, i]
                    )
                for s in range(terms):
                    if not measured:
                        H[f, n, a, s] = 0.0
                    WH[f, n, a, s] = weight[f, n] * H[f, n, a, s]
                    for i in range(3):
                        by_point[f, n, i, s] += row[i] * WH[f, n, a, s]


@compiled
def eliminate_columns(
    chosen: IntArray,
    by_point: FloatArray,
    H: FloatArray,
    WH: FloatArray,
    r: FloatArray,
    G: FloatArray,
    C: FloatArray,
    B: FloatArray,
    point_gradient: FloatArray,
    A: FloatArray,
    cross: FloatArray,
    b: FloatArray,
) -> None:
    """Add to A (S, S), cross (S, 6N) and b (S,) what is left of the chosen tracks once their points are eliminated."""
    clones, terms = by_point.shape[1], by_point.shape[3]
    own, X, factor = np.empty((3, terms)), np.empty((terms, 3)), np.empty((3, 3))
    for f in chosen:
        for s in range(terms):
            for i in range(3):
                own[i, s] = 0.0
                for n in range(clones):
                    own[i, s] += by_point[f, n, i, s]
                X[s, i] = own[i, s]
                for j in range(3):
                    factor[i, j] = C[f, i, j]
            solve_positive(factor, X[s])
            b[s] -= X[s, 0] * point_gradient[f, 0] + X[s, 1] * point_gradient[f, 1] + X[s, 2] * point_gradient[f, 2]
        for s in range(terms):
            for t in range(terms):
                A[s, t] -= own[0, s] * X[t, 0] + own[1, s] * X[t, 1] + own[2, s] * X[t, 2]
        for m in range(H.shape[1]):
            for s in range(terms):
                b[s] += WH[f, m, s] * r[f, m]
                for t in range(terms):
                    A[s, t] += WH[f, m, s] * H[f, m, t]
        for n in range(clones):
            for k in range(6):
                row = 6 * n + k
                for s in range(terms):
                    for i in range(3):
                        cross[s, row] += B[f, i, k] * by_point[f, n, i, s] - G[f, row, i] * X[s, i]
