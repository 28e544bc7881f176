"""The compiled loops over tracks and their views behind `multiview` and `stereo_calibration`.

Shapes: F tracks, N clones, S coefficients of the rectification error. `camera` is that of
`camera_args`. Each loop writes into the arrays that come last. `tests/numpy_twins.py` holds the
same in NumPy.
"""

from __future__ import annotations

import numpy as np

from vio.cameras.projection import CameraArgs, point_at, turn_to
from vio.cameras.rectification_error import write_view
from vio.filters.track_records import (
    Cameras,
    Damping,
    DepthLimits,
    Eliminated,
    ErrorRows,
    Information,
    InverseDepth,
    LandmarkResiduals,
    Residuals,
    RowEquations,
    TermColumns,
    TrackColumns,
    Views,
)
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, index_of, solve_positive
from vio.records import BoolArray, IntArray, SigmaArray


@compiled
def _turned_rows(T: FloatArray, s: float, c: float, row1: FloatArray, row2: FloatArray) -> None:
    """Write the y and z axes (3,) of a camera (4, 4) turned about its baseline by an angle of
    this sine and cosine.
    """
    for j in range(3):
        row1[j] = c * T[1, j] - s * T[2, j]
        row2[j] = s * T[1, j] + c * T[2, j]


@compiled
def compare_views(cameras: Cameras, p: FloatArray, views: Views, at: Residuals) -> None:
    """Write residuals (F, N, 4), Jacobians (F, N, 4, 3) by the points (F, 3), and which points
    are ahead (F,): (M1).
    """
    camera = cameras.lens
    least_depth = cameras.min_depth
    T = cameras.T_cam0_world
    z = views.z
    weight = views.weight
    r = at.r
    J = at.z_D_p
    ahead = at.ahead
    fu, fv, cu, cv, baseline, _ = camera
    centre = (cu, cv, cu, cv)
    along = np.empty((2, 3))  # pixels by the camera's axes along them
    row1 = np.empty(3)
    row2 = np.empty(3)
    for f in range(len(p)):
        ahead[f] = True
        for n in range(len(T)):
            x = T[n, 0, 0] * p[f, 0] + T[n, 0, 1] * p[f, 1] + T[n, 0, 2] * p[f, 2] + T[n, 0, 3]
            y = T[n, 1, 0] * p[f, 0] + T[n, 1, 1] * p[f, 1] + T[n, 1, 2] * p[f, 2] + T[n, 1, 3]
            depth = T[n, 2, 0] * p[f, 0] + T[n, 2, 1] * p[f, 1] + T[n, 2, 2] * p[f, 2] + T[n, 2, 3]
            azimuth, s, c, y, depth = turn_to(camera, y, depth)
            seen = weight[f, n, 0] > 0.0
            if not (seen and depth > least_depth):
                ahead[f] = ahead[f] and not seen
                _clear_view(r[f, n], J[f, n])
                continue
            _turned_rows(T[n], s, c, row1, row2)
            u = fu * x / depth
            v = fv * y / depth
            right_u = u - fu * baseline / depth
            seen_v = v + fv * azimuth
            pixels = (u, v, right_u, v)
            seen_at = (u, seen_v, right_u, seen_v)
            for j in range(3):
                along[0, j] = fu * T[n, 0, j]
                along[1, j] = fv * row1[j]
            for a in range(4):
                w = weight[f, n, a]
                off = z[f, n, a] - seen_at[a] - centre[a]
                r[f, n, a] = off * w if w > 0.0 else 0.0
                for j in range(3):
                    J[f, n, a, j] = w * (along[a % 2, j] - pixels[a] * row2[j]) / depth


@compiled
def _clear_view(r: FloatArray, J: FloatArray) -> None:
    """Write zeros as residuals (4,) and Jacobians (4, 3) of a view that was not measured."""
    for a in range(4):
        r[a] = 0.0
        for j in range(3):
            J[a, j] = 0.0


@compiled
def _is_measured(J: FloatArray, f: int, n: int) -> bool:
    """Whether a clone saw a track: the row of vl is measured in every view."""
    return J[f, n, 1, 0] != 0.0 or J[f, n, 1, 1] != 0.0 or J[f, n, 1, 2] != 0.0


@compiled
def _mark_views(J: FloatArray, out: BoolArray) -> None:
    """Write which views (F, N) of tracks were measured."""
    for f in range(J.shape[0]):
        for n in range(J.shape[1]):
            out[f, n] = _is_measured(J, f, n)


@compiled
def _square_view(r: FloatArray, J: FloatArray) -> tuple[float, int]:
    """Squared residual of a view, of (4,) and (4, 3), and how many of its pixel coordinates were
    measured.
    """
    squares = 0.0
    count = 0
    for a in range(4):
        squares += r[a] ** 2
        count += J[a, 0] != 0.0 or J[a, 1] != 0.0 or J[a, 2] != 0.0
    return squares, count


@compiled
def square_views(r: FloatArray, J: FloatArray, squares: FloatArray, count: IntArray) -> None:
    """Write squared residuals (F, N) of views, and how many of their pixel coordinates were
    measured.
    """
    for f in range(J.shape[0]):
        for n in range(J.shape[1]):
            squares[f, n], count[f, n] = _square_view(r[f, n], J[f, n])


@compiled
def mark_wrong_views(
    r: FloatArray,
    J: FloatArray,
    variance: float,
    limits: FloatArray,
    wrong: BoolArray,
    enough: BoolArray,
) -> bool:
    """Write which views (F, N) exceed the limit of their number of pixels, and which tracks (F,)
    have two others.

    Returns:
        Whether there is any such view.
    """
    found = False
    for f in range(J.shape[0]):
        others = 0
        for n in range(J.shape[1]):
            squares, count = _square_view(r[f, n], J[f, n])
            wrong[f, n] = squares > variance * limits[count]
            others += count > 0 and not wrong[f, n]
            found = found or wrong[f, n]
        enough[f] = others >= 2
    return found


@compiled
def square_tracks(
    r: FloatArray, J: FloatArray, variance: float, most: int, squares: FloatArray, dof: IntArray
) -> None:
    """Write squared residuals (F,) of tracks over the variance, and their degrees of freedom
    (F,), 1 to `most`.
    """
    for f in range(J.shape[0]):
        squares[f] = 0.0
        count = -3
        for n in range(J.shape[1]):
            of_view, measured = _square_view(r[f, n], J[f, n])
            squares[f] = squares[f] + of_view
            count = count + measured
        squares[f] /= variance
        dof[f] = min(max(count, 1), most)


@compiled
def anchor_points(cameras: Cameras, p: FloatArray, seen: BoolArray, q: InverseDepth) -> None:
    """Write the coordinates (M5) of points (F, 3), which were seen by clones (F, N)."""
    camera = cameras.lens
    T = cameras.T_cam0_world
    centre = q.centre
    disparity = q.disparity
    p_D_q = q.p_D_q
    q_D_p = q.q_D_p
    fu = camera[0]
    baseline = camera[4]
    row1 = np.empty(3)
    row2 = np.empty(3)
    for f in range(len(p)):
        k = 0
        for n in range(len(T) - 1, -1, -1):
            if seen[f, n]:
                k = n
        q.anchor[f] = k
        for i in range(3):
            centre[f, i] = -(
                T[k, 0, i] * T[k, 0, 3] + T[k, 1, i] * T[k, 1, 3] + T[k, 2, i] * T[k, 2, 3]
            )
        x = T[k, 0, 0] * p[f, 0] + T[k, 0, 1] * p[f, 1] + T[k, 0, 2] * p[f, 2] + T[k, 0, 3]
        y = T[k, 1, 0] * p[f, 0] + T[k, 1, 1] * p[f, 1] + T[k, 1, 2] * p[f, 2] + T[k, 1, 3]
        z = T[k, 2, 0] * p[f, 0] + T[k, 2, 1] * p[f, 1] + T[k, 2, 2] * p[f, 2] + T[k, 2, 3]
        _, s, c, y, z = turn_to(camera, y, z)
        _turned_rows(T[k], s, c, row1, row2)
        z = max(z, cameras.min_depth)
        disparity[f] = fu * baseline / z
        for i in range(3):
            p_D_q[f, i, 0] = T[k, 0, i] * z / fu
            p_D_q[f, i, 1] = row1[i] * z / fu
            p_D_q[f, i, 2] = (centre[f, i] - p[f, i]) / disparity[f]
            q_D_p[f, 0, i] = (T[k, 0, i] - x / z * row2[i]) * fu / z
            q_D_p[f, 1, i] = (row1[i] - y / z * row2[i]) * fu / z
            q_D_p[f, 2, i] = -row2[i] * disparity[f] / z


@compiled
def find_rows(ids: IntArray, increasing: IntArray, ordered: IntArray, rows: IntArray) -> int:
    """Write the rows (K,) of ids (K,), -1 where unknown, and return how many are; ids (F,) are
    those of rows (F,).
    """
    unknown = 0
    for k in range(len(ids)):
        at = index_of(ids[k], increasing)
        rows[k] = ordered[at] if at >= 0 else -1
        unknown += at < 0
    return unknown


@compiled
def write_column(
    rows: IntArray,
    column: int,
    z: FloatArray,
    weight: FloatArray,
    table_z: FloatArray,
    table_weight: FloatArray,
) -> None:
    """Write pixels and weights (K, 4) into a column of the rows (K,) of tables (R, N, 4)."""
    for k in range(len(rows)):
        for a in range(4):
            table_z[rows[k], column, a] = z[k, a]
            table_weight[rows[k], column, a] = weight[k, a]


@compiled
def count_views(rows: IntArray, weight: FloatArray, seen: BoolArray, length: IntArray) -> None:
    """Write in which columns (F, N) rows of a table (R, N, 4) were seen, and in how many (F,)."""
    for f in range(len(rows)):
        length[f] = 0
        for n in range(weight.shape[1]):
            seen[f, n] = weight[rows[f], n, 0] > 0.0
            length[f] += seen[f, n]


@compiled
def shift_columns(rows: IntArray, z: FloatArray, weight: FloatArray) -> None:
    """Move rows of tables (R, N, 4) one column towards the first, which is lost; nothing was
    seen in the last one.
    """
    last = z.shape[1] - 1
    for f in rows:
        for n in range(last):
            for a in range(4):
                z[f, n, a] = z[f, n + 1, a]
                weight[f, n, a] = weight[f, n + 1, a]
        for a in range(4):
            weight[f, last, a] = 0.0


@compiled
def middle(values: FloatArray) -> float:
    """Median of one or more values (n,), which are reordered.

    Reference: Hoare, Algorithm 65: Find, CACM (1961).
    """
    k = len(values) // 2
    low = 0
    high = len(values) - 1
    while low < high:
        pivot = values[k]
        i = low
        j = high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i = i + 1
                j = j - 1
        if j < k:
            low = i
        if k < i:
            high = j
    if len(values) % 2 == 1:
        return values[k]
    below = values[0]
    for i in range(1, k):
        below = max(below, values[i])
    return 0.5 * (below + values[k])


@compiled
def _median_sigma(sigma: SigmaArray, weight: FloatArray) -> float:
    """Return the median of the standard deviations (N, 3) that are known of measured pixels; 0:
    there is none.
    """
    values = np.empty(3 * len(sigma))
    count = 0
    for n in range(len(sigma)):
        for a in range(3):
            if weight[n, a] > 0.0 and sigma[n, a] > 0.0 and np.isfinite(sigma[n, a]):
                values[count] = sigma[n, a]
                count += 1
    return middle(values[:count]) if count > 0 else 0.0


@compiled
def weigh_by_sigma(sigma: SigmaArray, least: float, most: float, weight: FloatArray) -> None:
    """Multiply weights (N, 4), where above zero, by the median standard deviation over the
    pixel's own (N, 3).
    """
    centre = _median_sigma(sigma, weight)
    if centre == 0.0:
        return
    for n in range(len(sigma)):
        for a in range(3):
            if weight[n, a] > 0.0 and sigma[n, a] > 0.0:
                # of float32, as the standard deviations are
                relative = np.float32(centre) / sigma[n, a]
                weight[n, a] *= min(max(relative, np.float32(least)), np.float32(most))


@compiled
def newest_residual(r: FloatArray, J: FloatArray) -> float | None:
    """Return the median absolute residual of the newest clone's pixels, of (F, N, 4).

    None: there are none.
    """
    values = np.empty(4 * len(r))
    count = 0
    n = r.shape[1] - 1
    for f in range(len(r)):
        for a in range(4):
            if J[f, n, a, 0] != 0.0 or J[f, n, a, 1] != 0.0 or J[f, n, a, 2] != 0.0:
                values[count] = abs(r[f, n, a])
                count += 1
    if count == 0:
        return None
    return middle(values[:count])


@compiled
def weigh_rows(residual: FloatArray, cauchy: float, weight: FloatArray) -> None:
    """Write Cauchy weights (M,) of residuals (M,) from their median, in standard deviations by
    its absolute values.
    """
    values = residual.copy()
    centre = middle(values)
    for m in range(len(residual)):
        values[m] = abs(residual[m] - centre)
    scale = cauchy * max(1.48 * middle(values), 1e-3)
    for m in range(len(residual)):
        weight[m] = 1.0 / (1.0 + ((residual[m] - centre) / scale) ** 2)


@compiled
def add_rows(
    basis: FloatArray,
    common: FloatArray,
    rows: FloatArray,
    weight: FloatArray,
    memory: float,
    out: RowEquations,
) -> None:
    """Add normal equations of rows (M,) in terms (M, 7), and what others (M, 4) do to them, to
    those remembered.
    """
    A = out.A
    b = out.b
    C = out.common
    for i in range(len(b)):
        b[i] *= memory
        for j in range(len(b)):
            A[i, j] *= memory
        for j in range(C.shape[1]):
            C[i, j] *= memory
    for m in range(len(rows)):
        for i in range(len(b)):
            w = basis[m, i] * weight[m]
            b[i] += w * rows[m]
            for j in range(len(b)):
                A[i, j] += w * basis[m, j]
            for j in range(C.shape[1]):
                C[i, j] += w * common[m, j]


@compiled
def fitted_rows(
    basis: FloatArray, rows: FloatArray, weight: FloatArray, solution: FloatArray
) -> tuple[float, float, float]:
    """Return the weighted squares of what a solution (7,) leaves of rows (M,), the sum of
    weights, and its squares.
    """
    misfits = 0.0
    weights = 0.0
    squares = 0.0
    for m in range(len(rows)):
        fitted = 0.0
        for i in range(len(solution)):
            fitted += basis[m, i] * solution[i]
        misfits += weight[m] * (rows[m] - fitted) ** 2
        weights += weight[m]
        squares += fitted * fitted
    return misfits, weights, squares


@compiled
def _first_view(weight: FloatArray, f: int) -> int:
    """The first clone that saw a track; 0 where none did."""
    for n in range(weight.shape[1]):
        if weight[f, n, 0] > 0.0:
            return n
    return 0


@compiled
def _put_on_ray(
    camera: CameraArgs, T: FloatArray, u: float, v: float, disparity: float, p: FloatArray
) -> None:
    """Write the point (3,) in the world that a camera (4, 4) sees at a left pixel, at a
    disparity.
    """
    x, y, z = point_at(camera, u, v, camera[0] * camera[4] / disparity)
    x = x - T[0, 3]
    y = y - T[1, 3]
    z = z - T[2, 3]
    for i in range(3):
        p[i] = T[0, i] * x + T[1, i] * y + T[2, i] * z


@compiled
def start_by_stereo(
    camera: CameraArgs,
    disparities: tuple[float, float],
    T: FloatArray,
    z: FloatArray,
    weight: FloatArray,
    p: FloatArray,
    known: BoolArray,
) -> None:
    """Write points (F, 3) at the stereo view of largest disparity, and which tracks (F,) have one.

    The newest clone's view counts only where it is the only one. Disparities are kept between two
    values.
    """
    last = len(T) - 1
    for f in range(len(p)):
        best = -1
        largest = -np.inf
        for n in range(last):
            disparity = z[f, n, 0] - z[f, n, 2]
            if weight[f, n, 2] > 0.0 and disparity > largest:
                best = n
                largest = disparity
        if best < 0 and weight[f, last, 2] > 0.0:
            best = last
            largest = z[f, last, 0] - z[f, last, 2]
        known[f] = best >= 0
        if best >= 0:
            disparity = min(max(largest, disparities[0]), disparities[1])
            _put_on_ray(camera, T[best], z[f, best, 0], z[f, best, 1], disparity, p[f])


@compiled
def start_by_parallax(
    camera: CameraArgs,
    disparities: tuple[float, float],
    tiny: float,
    T: FloatArray,
    z: FloatArray,
    weight: FloatArray,
    p: FloatArray,
) -> None:
    """Write points (F, 3) on the ray of each track's first left view, at the inverse depth that
    fits its others best.

    With m that ray, and c its camera seen from camera i, view i shows `(m_i + rho c_i)`, up to
    scale; times its third component this is linear in the inverse depth rho. A cylinder's rays may
    have no third component: there their cross product with it is zero, which is linear as well.
    Disparities are kept between two values.
    """
    m = np.empty(3)
    c = np.empty(3)
    m_i = np.empty(3)
    c_i = np.empty(3)
    for f in range(len(p)):
        k = _first_view(weight, f)
        x, y, w = point_at(camera, z[f, k, 0], z[f, k, 1], 1.0)
        for i in range(3):
            m[i] = T[k, 0, i] * x + T[k, 1, i] * y + T[k, 2, i] * w
            c[i] = -(T[k, 0, i] * T[k, 0, 3] + T[k, 1, i] * T[k, 1, 3] + T[k, 2, i] * T[k, 2, 3])
        along = 0.0
        squared = tiny
        for n in range(len(T)):
            if not weight[f, n, 0] > 0.0:
                continue
            for i in range(3):
                m_i[i] = T[n, i, 0] * m[0] + T[n, i, 1] * m[1] + T[n, i, 2] * m[2]
                c_i[i] = T[n, i, 0] * c[0] + T[n, i, 1] * c[1] + T[n, i, 2] * c[2] + T[n, i, 3]
            x, y, w = point_at(camera, z[f, n, 0], z[f, n, 1], 1.0)
            a0 = w * c_i[0] - x * c_i[2]
            a1 = w * c_i[1] - y * c_i[2]
            a2 = x * c_i[1] - y * c_i[0]
            b0 = w * m_i[0] - x * m_i[2]
            b1 = w * m_i[1] - y * m_i[2]
            b2 = x * m_i[1] - y * m_i[0]
            if not camera[5]:
                a2 = b2 = 0.0
            along -= a0 * b0 + a1 * b1 + a2 * b2
            squared += a0 * a0 + a1 * a1 + a2 * a2
        disparity = min(
            max(along / squared * camera[0] * camera[4], disparities[0]), disparities[1]
        )
        _put_on_ray(camera, T[k], z[f, k, 0], z[f, k, 1], disparity, p[f])


@compiled
def put_ahead(cameras: Cameras, min_disparity: float, views: Views, p: FloatArray) -> None:
    """Put points (F, 3) that are behind the first camera that saw them far away on its ray, in
    place.
    """
    camera = cameras.lens
    T = cameras.T_cam0_world
    z = views.z
    for f in range(len(p)):
        k = _first_view(views.weight, f)
        y = T[k, 1, 0] * p[f, 0] + T[k, 1, 1] * p[f, 1] + T[k, 1, 2] * p[f, 2] + T[k, 1, 3]
        z_cam = T[k, 2, 0] * p[f, 0] + T[k, 2, 1] * p[f, 1] + T[k, 2, 2] * p[f, 2] + T[k, 2, 3]
        if turn_to(camera, y, z_cam)[4] > cameras.min_depth:
            continue
        _put_on_ray(camera, T[k], z[f, k, 0], z[f, k, 1], min_disparity, p[f])


@compiled
def _begin_information(tiny: float, prior: float, C: FloatArray) -> None:
    """Write the information (3, 3) that there is of any point in the coordinates (M5)."""
    _clear(C)
    C[0, 0] = tiny
    C[1, 1] = tiny
    C[2, 2] = prior


@compiled
def step_points(at: Residuals, p_D_q: FloatArray, damping: Damping, dq: FloatArray) -> None:
    """Write a Gauss-Newton step (F, 3) of each point in the coordinates (M5), with Cauchy
    weights of a scale.
    """
    r = at.r
    J = at.z_D_p
    C = np.empty((3, 3))
    row = np.empty(3)
    for f in range(len(r)):
        for i in range(3):
            dq[f, i] = 0.0
        _begin_information(damping.tiny, damping.prior, C)
        for n in range(r.shape[1]):
            if not _is_measured(J, f, n):
                continue
            squares = r[f, n, 0] ** 2 + r[f, n, 1] ** 2 + r[f, n, 2] ** 2 + r[f, n, 3] ** 2
            w = 1.0 / (1.0 + squares / (4.0 * damping.scale2))
            for a in range(4):
                if _is_zero(J[f, n, a]):
                    continue
                _by_point(J[f, n, a], p_D_q[f], row)
                for i in range(3):
                    dq[f, i] += w * row[i] * r[f, n, a]
                    for j in range(i + 1):
                        C[i, j] += w * row[i] * row[j]
        solve_positive(C, dq[f])


@compiled
def _most_disparity(
    cameras: Cameras, least: float, weight: FloatArray, f: int, q: InverseDepth, p: FloatArray
) -> float:
    """Disparity beyond which a point (3,) would come nearer to one of its cameras than the least
    depth.
    """
    camera = cameras.lens
    T = cameras.T_cam0_world
    centre = q.centre[f]
    # of a cylinder, a point that comes too near to another camera than its anchor is dropped
    # afterwards
    if camera[5]:
        return camera[0] * camera[4] / least
    most = np.inf
    for n in range(len(T)):
        if weight[f, n, 0] > 0.0:
            a = T[n, 2, 0]
            b = T[n, 2, 1]
            c = T[n, 2, 2]
            ray = (
                a * (p[0] - centre[0]) + b * (p[1] - centre[1]) + c * (p[2] - centre[2])
            ) * q.disparity[f]
            room = least - (a * centre[0] + b * centre[1] + c * centre[2] + T[n, 2, 3])
            if room > 0.0 and ray > 0.0:
                most = min(most, ray / room)
    return most


@compiled
def _move(
    centre: FloatArray,
    p_D_q: FloatArray,
    disparity: float,
    dq: FloatArray,
    least: float,
    most: float,
    p: FloatArray,
) -> None:
    """Write the point (3,) after a step (3,) in the coordinates (M5); its disparity stays
    between two values.
    """
    moved = max(min(disparity + dq[2], most), least)
    for i in range(3):
        ray = p_D_q[i, 0] * dq[0] + p_D_q[i, 1] * dq[1] - p_D_q[i, 2] * disparity
        p[i] = centre[i] + ray * (disparity / moved)


@compiled
def step_inverse_depths(
    cameras: Cameras,
    min_disparity: float,
    weight: FloatArray,
    q: InverseDepth,
    dq: FloatArray,
    p: FloatArray,
) -> None:
    """Move points (F, 3) by steps (F, 3) in the coordinates (M5), to what is ahead of all
    cameras that saw them.
    """
    for f in range(len(p)):
        most = _most_disparity(cameras, 1.01 * cameras.min_depth, weight, f, q, p[f])
        _move(q.centre[f], q.p_D_q[f], q.disparity[f], dq[f], min_disparity, most, p[f])


@compiled
def refine(
    cameras: Cameras,
    views: Views,
    steps: int,
    damping: Damping,
    p: FloatArray,
) -> None:
    """Move points (F, 3) by Gauss-Newton steps in the coordinates (M5), each after what is
    behind was put ahead.
    """
    F, N = views.weight.shape[:2]
    seen = np.empty((F, N), np.bool_)
    dq = np.empty(p.shape)
    ahead = np.empty(F, np.bool_)
    at = Residuals(np.empty((F, N, 4)), np.empty((F, N, 4, 3)), ahead, views.weight)
    q = _room_for_points(F)
    _mark_seen(views.weight, seen)
    for _ in range(steps):
        put_ahead(cameras, damping.min_disparity, views, p)
        compare_views(cameras, p, views, at)
        anchor_points(cameras, p, seen, q)
        step_points(at, q.p_D_q, damping, dq)
        step_inverse_depths(cameras, damping.min_disparity, views.weight, q, dq, p)


@compiled
def _room_for_points(count: int) -> InverseDepth:
    """Room for the coordinates of some points: `InverseDepth.empty`."""
    p_D_q = np.empty((count, 3, 3))
    q_D_p = np.empty((count, 3, 3))
    return InverseDepth(
        np.empty(count, np.int64), np.empty((count, 3)), np.empty(count), p_D_q, q_D_p
    )


@compiled
def _mark_seen(weight: FloatArray, out: BoolArray) -> None:
    """Write which clones (F, N) showed a track."""
    for f in range(out.shape[0]):
        for n in range(out.shape[1]):
            out[f, n] = weight[f, n, 0] > 0.0


@compiled
def _is_finite(p: FloatArray) -> bool:
    """Whether a point (3,) is made of numbers."""
    return np.isfinite(p[0]) and np.isfinite(p[1]) and np.isfinite(p[2])


@compiled
def _has_right_view(weight: FloatArray) -> bool:
    """Whether some right camera saw a track, of weights (N, 4)."""
    seen = False
    for n in range(len(weight)):
        seen = seen or weight[n, 2] > 0.0
    return seen


@compiled
def mark_usable(
    cameras: Cameras,
    p: FloatArray,
    at: Residuals,
    limits: DepthLimits,
    keep: BoolArray,
) -> None:
    """Write which points (F, 3) are finite, ahead of their cameras and, without a right view, fixed
    by parallax.
    """
    weight = at.weight
    J = at.z_D_p
    F, N = weight.shape[:2]
    seen = np.empty((1, N), np.bool_)
    q = _room_for_points(1)
    C = np.empty((3, 3))
    L = np.empty((3, 3))
    row = np.empty(3)
    for f in range(F):
        keep[f] = at.ahead[f] and _is_finite(p[f])
        if not keep[f] or _has_right_view(weight[f]):
            continue
        _mark_seen(weight[f : f + 1], seen)
        anchor_points(cameras, p[f : f + 1], seen, q)
        _begin_information(limits.tiny, limits.prior, C)
        for n in range(N):
            for a in range(4):
                _by_point(J[f, n, a], q.p_D_q[0], row)
                for i in range(3):
                    for j in range(i + 1):
                        C[i, j] += row[i] * row[j]
        _factor(C, L)
        keep[f] = 1.0 / L[2, 2] ** 2 < (
            limits.variance + limits.relative_variance * q.disparity[0] ** 2
        )


@compiled
def linearise(
    cameras: Cameras,
    views: Views,
    steps: int,
    damping: Damping,
    limits: DepthLimits,
    out: tuple[FloatArray, Residuals, BoolArray],
) -> None:
    """Move points (F, 3) as `refine` does, compare their views there, and mark (F,) those to
    use.
    """
    p, at, keep = out
    refine(cameras, views, steps, damping, p)
    compare_views(cameras, p, views, at)
    mark_usable(cameras, p, at, limits, keep)


@compiled
def _is_zero(row: FloatArray) -> bool:
    """Whether a pixel's Jacobian (3,) is zero: it was not measured."""
    return row[0] == 0.0 and row[1] == 0.0 and row[2] == 0.0


@compiled
def _clear(A: FloatArray) -> None:
    """Write zeros into a matrix."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            A[i, j] = 0.0


@compiled
def _by_point(J: FloatArray, p_D_q: FloatArray, row: FloatArray) -> None:
    """Write a pixel's Jacobian (3,) by the coordinates (M5), from that by the point (3,)."""
    for i in range(3):
        row[i] = J[0] * p_D_q[0, i] + J[1] * p_D_q[1, i] + J[2] * p_D_q[2, i]


@compiled
def expected_pixels(z: FloatArray, r: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Write the pixels (F, N, 4) that are expected where z was seen, of residuals times weights."""
    for f in range(z.shape[0]):
        for n in range(z.shape[1]):
            for a in range(4):
                out[f, n, a] = z[f, n, a]
                if weight[f, n, a] > 0.0:
                    out[f, n, a] -= r[f, n, a] / weight[f, n, a]


@compiled
def weigh_views(
    r: FloatArray, J: FloatArray, sigma2: float, median: float, cauchy: float, weights: FloatArray
) -> None:
    """Write Cauchy weights (F, N) of views, zero where not measured; the scale is each clone's own.

    It is the median of its squared residuals over `median`, and `sigma2` at least.
    """
    F, N = weights.shape
    squares = np.empty(F)
    for n in range(N):
        count = 0
        for f in range(F):
            weights[f, n] = -1.0
            if _is_measured(J, f, n):
                weights[f, n] = (
                    r[f, n, 0] ** 2 + r[f, n, 1] ** 2 + r[f, n, 2] ** 2 + r[f, n, 3] ** 2
                )
                squares[count] = weights[f, n]
                count += 1
        scale2 = max(sigma2, middle(squares[:count]) / median) if count > 0 else sigma2
        for f in range(F):
            weights[f, n] = (
                0.0
                if weights[f, n] < 0.0
                else 1.0 / (1.0 + weights[f, n] / (4.0 * scale2 * cauchy**2))
            )


@compiled
def add_landmarks(
    seen: LandmarkResiduals, H: FloatArray, rows: ErrorRows, out: Information
) -> None:
    """Add what landmarks' pixels say of `dp = xi_f - xi_rho` and of S coefficients to information.

    Args:
        seen: residuals, and Jacobians by dp; the weights are over the pixels' variance.
        H: Jacobians by the coefficients (K, 4, S), not times the precision; S may be zero.
        rows: of xi_rho, the landmarks and the coefficients.
        out: information; the last of the coefficients are considered.
    """
    r = seen.r
    J = seen.J
    weight = seen.weight
    exposure = rows.exposure
    stereo = rows.stereo
    A = out.A
    b = out.b
    considered = out.considered
    terms = H.shape[2]
    estimated = terms - considered.shape[1]
    h = np.empty(terms)
    for k in range(len(r)):
        own = rows.landmarks + 3 * k
        for a in range(4):
            row = J[k, a]
            if _is_zero(row):
                continue
            for s in range(terms):
                h[s] = seen.precision[k, a] * H[k, a, s]
            for i in range(3):
                wJ = weight[k] * row[i]
                b[own + i] += wJ * r[k, a]
                b[exposure + i] -= wJ * r[k, a]
                for j in range(3):
                    C = wJ * row[j]
                    A[own + i, own + j] += C
                    A[exposure + i, exposure + j] += C
                    A[own + i, exposure + j] -= C
                    A[exposure + i, own + j] -= C
                for s in range(estimated):
                    C = wJ * h[s]
                    A[own + i, stereo + s] += C
                    A[stereo + s, own + i] += C
                    A[exposure + i, stereo + s] -= C
                    A[stereo + s, exposure + i] -= C
                for s in range(estimated, terms):
                    considered[own + i, s - estimated] += wJ * h[s]
                    considered[exposure + i, s - estimated] -= wJ * h[s]
            _add_coefficients(weight[k], r[k, a], h, stereo, out)


@compiled
def _add_coefficients(
    weight: float, r: float, h: FloatArray, stereo: int, out: Information
) -> None:
    """Add what a pixel says of the coefficients alone, by its Jacobian (S,)."""
    A = out.A
    b = out.b
    considered = out.considered
    terms = len(h)
    estimated = terms - considered.shape[1]
    for s in range(estimated):
        wh = weight * h[s]
        b[stereo + s] += wh * r
        for t in range(estimated):
            A[stereo + s, stereo + t] += wh * h[t]
        for t in range(estimated, terms):
            considered[stereo + s, t - estimated] += wh * h[t]


@compiled
def place_information(
    A: FloatArray,
    b: FloatArray,
    variance: float,
    size: int,
    clones: int,
    stereo: int,
    out: Information,
) -> None:
    """Place information (6N + S + C, same) and (6N + S + C,), over a variance, among D errors.

    Args:
        A: of clones, then of coefficients that are estimated and of those that are considered.
        b: its vector.
        variance: of a pixel.
        size: 6N.
        clones: row of the first clone.
        stereo: row of the first coefficient.
        out: about all errors.
    """
    considered = out.considered
    last = len(b) - considered.shape[1]
    for i in range(len(out.b)):
        out.b[i] = 0.0
        for j in range(len(out.b)):
            out.A[i, j] = 0.0
        for j in range(considered.shape[1]):
            considered[i, j] = 0.0
    for i in range(last):
        row = clones + i if i < size else stereo + i - size
        out.b[row] = b[i] / variance
        for j in range(size):
            out.A[row, clones + j] = A[i, j] / variance
        for j in range(size, last):
            out.A[row, stereo + j - size] = A[i, j] / variance
        for j in range(last, len(b)):
            considered[row, j - last] = A[i, j] / variance


@compiled
def substitute_back(
    info: TrackColumns,
    gradient: FloatArray,
    min_disparity: float,
    clone_errors: FloatArray,
    p: FloatArray,
) -> None:
    """Write points (F, 3) that solve their own equations once the clones (6N,) have moved.

    `gradient` (F, 3) is that of the points, with what else has moved.
    """
    G = info.G
    q = info.q
    dq = np.empty(3)
    factor = np.empty((3, 3))
    for f in range(len(p)):
        d0 = gradient[f, 0]
        d1 = gradient[f, 1]
        d2 = gradient[f, 2]
        for k in range(len(clone_errors)):
            d0 -= G[f, k, 0] * clone_errors[k]
            d1 -= G[f, k, 1] * clone_errors[k]
            d2 -= G[f, k, 2] * clone_errors[k]
        dq[0] = d0
        dq[1] = d1
        dq[2] = d2
        for i in range(3):
            for j in range(3):
                factor[i, j] = info.C[f, i, j]
        solve_positive(factor, dq)
        _move(q.centre[f], q.p_D_q[f], q.disparity[f], dq, min_disparity, np.inf, p[f])


@compiled
def collect_tracks(
    cameras: Cameras,
    at: Residuals,
    weight: FloatArray,
    p: FloatArray,
    prior: float,
    out: TrackColumns,
) -> None:
    """Write the normal equations of tracks, (M2), (M3), (M5), (M6), with robust weights (F, N)."""
    r = at.r
    J = at.z_D_p
    p_D_q = out.q.p_D_q
    G = out.G
    C = out.C
    B = out.q_D_clone
    gradient = out.gradient
    point_gradient = out.point_gradient
    C_i = np.empty((3, 3))
    g_i = np.empty(3)
    row = np.empty(3)
    seen = np.empty(weight.shape, np.bool_)
    _mark_views(J, seen)
    anchor_points(cameras, p, seen, out.q)
    for f in range(len(r)):
        _point_D_pose(out.q.q_D_p[f], p[f], B[f])
        _clear_point(point_gradient[f], C[f])
        for n in range(r.shape[1]):
            if weight[f, n] == 0.0 and n != out.q.anchor[f]:
                _clear_clone(n, gradient[f], G[f])
                continue
            _clear_point(g_i, C_i)
            _add_view(J[f, n], r[f, n], weight[f, n], p_D_q[f], row, g_i, C_i)
            if n == out.q.anchor[f]:
                C_i[2, 2] += prior
            for i in range(3):
                point_gradient[f, i] += g_i[i]
                for j in range(3):
                    C[f, i, j] += C_i[i, j]
            for k in range(6):
                b0 = B[f, 0, k]
                b1 = B[f, 1, k]
                b2 = B[f, 2, k]
                gradient[f, 6 * n + k] = b0 * g_i[0] + b1 * g_i[1] + b2 * g_i[2]
                for j in range(3):
                    G[f, 6 * n + k, j] = b0 * C_i[0, j] + b1 * C_i[1, j] + b2 * C_i[2, j]


@compiled
def _clear_point(g: FloatArray, C: FloatArray) -> None:
    """Write zeros as gradient (3,) and information (3, 3) of a point."""
    for i in range(3):
        g[i] = 0.0
        for j in range(3):
            C[i, j] = 0.0


@compiled
def _clear_clone(n: int, gradient: FloatArray, G: FloatArray) -> None:
    """Write zeros as a clone's part in gradient (6N,) and information (6N, 3) of a track."""
    for k in range(6 * n, 6 * n + 6):
        gradient[k] = G[k, 0] = G[k, 1] = G[k, 2] = 0.0


@compiled
def _add_view(
    J: FloatArray,
    r: FloatArray,
    weight: float,
    p_D_q: FloatArray,
    row: FloatArray,
    g: FloatArray,
    C: FloatArray,
) -> None:
    """Add what a view's Jacobians (4, 3) and residuals (4,) say of a point to gradient (3,) and
    information (3, 3); `row` (3,) is room.
    """
    for a in range(4):
        if _is_zero(J[a]):
            continue
        _by_point(J[a], p_D_q, row)
        for i in range(3):
            g[i] += weight * row[i] * r[a]
            for j in range(3):
                C[i, j] += weight * row[i] * row[j]


@compiled
def _point_D_pose(q_D_p: FloatArray, p: FloatArray, B: FloatArray) -> None:
    """Write `S^-1 [-I, p^]` (3, 6) of one point, equation (M2)."""
    for i in range(3):
        a = q_D_p[i, 0]
        b = q_D_p[i, 1]
        c = q_D_p[i, 2]
        B[i, 0] = -a
        B[i, 1] = -b
        B[i, 2] = -c
        B[i, 3] = b * p[2] - c * p[1]
        B[i, 4] = c * p[0] - a * p[2]
        B[i, 5] = a * p[1] - b * p[0]


@compiled
def _has_part(G: FloatArray, f: int, n: int) -> bool:
    """Whether a clone has a part in a track's normal equations: most clones saw most tracks not."""
    part = False
    for k in range(6 * n, 6 * n + 6):
        part = part or G[f, k, 0] != 0.0 or G[f, k, 1] != 0.0 or G[f, k, 2] != 0.0
    return part


@compiled
def _factor(C: FloatArray, L: FloatArray) -> None:
    """Write the lower triangle L (3, 3) of `C = L L'`, Cholesky's factor."""
    for i in range(3):
        for j in range(i + 1):
            total = C[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]


@compiled
def eliminate_tracks(chosen: IntArray, info: TrackColumns, out: Eliminated) -> None:
    """Write the clones' columns of `V` (3K, 6N + S): `V' V` is what points of the chosen tracks
    take away, (M4).

    What they say of the clones but for that is added to A (6N + S, 6N + S), and the vector with the
    points taken out to b (6N + S,).
    """
    G = info.G
    B = info.q_D_clone
    V = out.V
    A = out.A
    L = np.empty((3, 3))
    y = np.empty(3)
    for c, f in enumerate(chosen):
        _factor(info.C[f], L)
        _solve_lower(L, info.point_gradient[f], y)
        for n in range(G.shape[1] // 6):
            takes_part = _has_part(G, f, n)
            for k in range(6 * n, 6 * n + 6):
                if not takes_part:
                    V[3 * c, k] = V[3 * c + 1, k] = V[3 * c + 2, k] = 0.0
                    continue
                out.b[k] += info.gradient[f, k] - _whiten(L, G[f, k], y, V, c, k)
                g0 = G[f, k, 0]
                g1 = G[f, k, 1]
                g2 = G[f, k, 2]
                for j in range(6):
                    A[k, 6 * n + j] += g0 * B[f, 0, j] + g1 * B[f, 1, j] + g2 * B[f, 2, j]


@compiled
def _solve_lower(L: FloatArray, g: FloatArray, y: FloatArray) -> None:
    """Write `L^-1 g` (3,)."""
    y[0] = g[0] / L[0, 0]
    y[1] = (g[1] - L[1, 0] * y[0]) / L[1, 1]
    y[2] = (g[2] - L[2, 0] * y[0] - L[2, 1] * y[1]) / L[2, 2]


@compiled
def _whiten(L: FloatArray, g: FloatArray, y: FloatArray, V: FloatArray, c: int, k: int) -> float:
    """Write column k of `L^-1 g` into the rows of point c of V, and return its product with y
    (3,).
    """
    v0 = g[0] / L[0, 0]
    v1 = (g[1] - L[1, 0] * v0) / L[1, 1]
    v2 = (g[2] - L[2, 0] * v0 - L[2, 1] * v1) / L[2, 2]
    V[3 * c, k] = v0
    V[3 * c + 1, k] = v1
    V[3 * c + 2, k] = v2
    return v0 * y[0] + v1 * y[1] + v2 * y[2]


@compiled
def points_by_others(
    rows: IntArray, C: FloatArray, p_D_q: FloatArray, G: FloatArray, out: FloatArray
) -> None:
    """Write how the estimated points of tracks (K,) follow n other errors (K, 3, n), world:
    `-C^-1 G'`, G (F, n, 3).
    """
    L = np.empty((3, 3))
    for k, f in enumerate(rows):
        _factor(C[f], L)
        for s in range(G.shape[1]):
            y0, y1, y2 = _solved(L, -G[f, s, 0], -G[f, s, 1], -G[f, s, 2])
            for i in range(3):
                out[k, i, s] = p_D_q[f, i, 0] * y0 + p_D_q[f, i, 1] * y1 + p_D_q[f, i, 2] * y2


@compiled
def _solved(L: FloatArray, y0: float, y1: float, y2: float) -> tuple[float, float, float]:
    """Solve `L L' x = y` for three values."""
    y0 = y0 / L[0, 0]
    y1 = (y1 - L[1, 0] * y0) / L[1, 1]
    y2 = (y2 - L[2, 0] * y0 - L[2, 1] * y1) / L[2, 2] ** 2
    y1 = (y1 - L[2, 1] * y2) / L[1, 1]
    return (y0 - L[1, 0] * y1 - L[2, 0] * y2) / L[0, 0], y1, y2


@compiled
def point_covariances(rows: IntArray, C: FloatArray, p_D_q: FloatArray, out: FloatArray) -> None:
    """Write the covariance (K, 3, 3) of the points of tracks (K,) given all else, world:
    `p_D_q C^-1 p_D_q'`.
    """
    L = np.empty((3, 3))
    for k, f in enumerate(rows):
        _factor(C[f], L)
        for i in range(3):
            y0, y1, y2 = _solved(L, p_D_q[f, i, 0], p_D_q[f, i, 1], p_D_q[f, i, 2])
            for j in range(i + 1):
                out[k, i, j] = out[k, j, i] = (
                    p_D_q[f, j, 0] * y0 + p_D_q[f, j, 1] * y1 + p_D_q[f, j, 2] * y2
                )


@compiled
def depth_sigmas(C: FloatArray, disparity: FloatArray, out: FloatArray) -> None:
    """Write `relative_depth_sigma` (F,): what is left of the third diagonal entry without the
    other two coordinates.
    """
    for f in range(len(C)):
        c = C[f]
        minor = c[0, 0] * c[1, 1] - c[0, 1] ** 2
        a = (c[0, 2] * c[1, 1] - c[1, 2] * c[0, 1]) / minor
        b = (c[1, 2] * c[0, 0] - c[0, 2] * c[0, 1]) / minor
        out[f] = 1.0 / np.sqrt(c[2, 2] - a * c[0, 2] - b * c[1, 2]) / disparity[f]


@compiled
def stereo_sigmas(
    rows: IntArray, J: FloatArray, disparity: FloatArray, variance: float, out: FloatArray
) -> None:
    """Write `relative_stereo_sigma` (K,) of tracks (K,), with the variance of one view's
    disparity.
    """
    for k, f in enumerate(rows):
        views = 0
        for n in range(J.shape[1]):
            views += J[f, n, 2, 0] != 0.0 or J[f, n, 2, 1] != 0.0 or J[f, n, 2, 2] != 0.0
        out[k] = np.sqrt(variance / views) / disparity[f] if views > 0 else np.inf


@compiled
def _innovation_covariance(
    B: FloatArray, moved: FloatArray, variance: float, BM: FloatArray, S: FloatArray
) -> None:
    """Write the lower triangle of `B moved B' + variance` (4, 4), with room (4, 6) for `B moved`."""
    for a in range(4):
        for j in range(6):
            BM[a, j] = 0.0
            for i in range(6):
                BM[a, j] += B[a, i] * moved[i, j]
        for b in range(a + 1):
            S[a, b] = variance if a == b else 0.0
            for j in range(6):
                S[a, b] += BM[a, j] * B[b, j]


@compiled
def innovations(
    r: FloatArray,
    J: FloatArray,
    p: FloatArray,
    moved: FloatArray,
    variance: float,
    squared: FloatArray,
    count: IntArray,
) -> None:
    """Write `r' S^-1 r` (F,) of the newest clone's residuals, `S = B moved B' + variance`, and how
    many pixels (F,).

    `moved` is the covariance (6, 6) of its motion `[rho; phi]` on the world's side, and
    `B = J [I, -p^]`.
    """
    last = r.shape[1] - 1
    B = np.empty((4, 6))
    BM = np.empty((4, 6))
    S = np.empty((4, 4))
    y = np.empty(4)
    for f in range(len(r)):
        count[f] = 0
        for a in range(4):
            x = J[f, last, a]
            count[f] += not _is_zero(x)
            B[a, 0] = x[0]
            B[a, 1] = x[1]
            B[a, 2] = x[2]
            B[a, 3] = p[f, 1] * x[2] - p[f, 2] * x[1]
            B[a, 4] = p[f, 2] * x[0] - p[f, 0] * x[2]
            B[a, 5] = p[f, 0] * x[1] - p[f, 1] * x[0]
            y[a] = r[f, last, a]
        _innovation_covariance(B, moved, variance, BM, S)
        solve_positive(S, y)
        total = 0.0
        for a in range(4):
            total += r[f, last, a] * y[a]
        # not a number where the covariances have lost all digits
        squared[f] = total if total > 0.0 else 0.0


@compiled
def eliminate_columns(
    rows: IntArray, terms_of: TermColumns, at: Residuals, info: TrackColumns, out: Eliminated
) -> None:
    """Do what `eliminate_tracks` does for the S coefficients that `ErrorColumns` has chosen, behind
    the clones.

    Of A the rows of the clones and those of the coefficients. `terms_of.G` becomes `H' W J`, the
    sum over the views of each of these tracks (K,). H are the derivatives of the pixels, of which
    those count that were measured; residuals and Jacobians are times their precision, H not.
    """
    chosen = terms_of.chosen
    weight = terms_of.weight
    G = terms_of.G
    J = at.z_D_p
    B = info.q_D_clone
    A = out.A
    b = out.b
    terms = len(chosen)
    size = 6 * J.shape[1]
    H = np.empty((3, 12))
    by_q = np.empty(3)
    L = np.empty((3, 3))
    y = np.empty(3)
    h = np.empty(terms)
    wh = np.empty(terms)
    own_b = np.empty(terms)
    own = np.empty((terms, terms))
    of_view = np.empty((3, terms))
    sums = np.empty((3, terms))
    for c, f in enumerate(rows):
        _clear(sums)
        _clear(own)
        for s in range(terms):
            own_b[s] = 0.0
        for n in range(J.shape[1]):
            if weight[f, n] == 0.0:
                continue
            write_view(terms_of.lens, terms_of.z[f, n], terms_of.rows_D_common, H)
            _clear(of_view)
            for a in range(3):
                row = J[f, n, a]
                if _is_zero(row):
                    continue
                _by_point(row, info.q.p_D_q[f], by_q)
                for s in range(terms):
                    h[s] = at.weight[f, n, a] * H[a, chosen[s]]
                    wh[s] = weight[f, n] * h[s]
                    own_b[s] += wh[s] * at.r[f, n, a]
                _add_products(h, wh, own)
                _add_outer(by_q, wh, of_view)
                _add_outer(by_q, wh, sums)
            _add_clone_terms(n, B[f], of_view, size, A)
        _factor(info.C[f], L)
        _solve_lower(L, info.point_gradient[f], y)
        for s in range(terms):
            G[f, s, 0] = sums[0, s]
            G[f, s, 1] = sums[1, s]
            G[f, s, 2] = sums[2, s]
            b[size + s] += own_b[s] - _whiten(L, G[f, s], y, out.V, c, size + s)
        _add_own(own, size, A)


@compiled
def _add_products(h: FloatArray, wh: FloatArray, own: FloatArray) -> None:
    """Add what a pixel says of coefficients, by its Jacobian (S,), also times its weight, to (S,
    S).
    """
    for s in range(len(h)):
        if h[s] != 0.0:  # left pixels do not depend on the right camera
            for t in range(len(h)):
                own[s, t] += wh[s] * h[t]


@compiled
def _add_outer(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Add the products (3, S) of numbers (3,) and (S,)."""
    for i in range(3):
        for s in range(len(b)):
            out[i, s] += a[i] * b[s]


@compiled
def _add_clone_terms(n: int, B: FloatArray, of_view: FloatArray, size: int, A: FloatArray) -> None:
    """Add the part (3, S) of a view to the rows of its clone, behind the columns of all clones, by
    the Jacobian (3, 6) of the point by the clone's pose.
    """
    terms = of_view.shape[1]
    for k in range(6):
        b0 = B[0, k]
        b1 = B[1, k]
        b2 = B[2, k]
        for s in range(terms):
            A[6 * n + k, size + s] += b0 * of_view[0, s] + b1 * of_view[1, s] + b2 * of_view[2, s]


@compiled
def _add_own(own: FloatArray, size: int, A: FloatArray) -> None:
    """Add the lower triangle of a symmetric (S, S) to the rows and columns of the coefficients."""
    for s in range(len(own)):
        for t in range(len(own)):
            A[size + s, size + t] += own[s, t] if t <= s else own[t, s]


@compiled
def add_scores(
    clusters: IntArray, scores: FloatArray, together: FloatArray, squares: FloatArray
) -> None:
    """Add scores (K, 6) of tracks to those of their clusters (C, 6), and what the squares of
    these grow by (6,).
    """
    for k, c in enumerate(clusters):
        for i in range(6):
            before = together[c, i]
            together[c, i] = scores[k, i] + before
            squares[i] += scores[k, i] * (together[c, i] + before)


@compiled
def write_directions(rows: IntArray, T: FloatArray, p: FloatArray, out: FloatArray) -> None:
    """Write azimuth and elevation (K, 2), rad, of points (F, 3) of the world as a camera (4, 4)
    sees them.
    """
    for k, f in enumerate(rows):
        x = T[0, 0] * p[f, 0] + T[0, 1] * p[f, 1] + T[0, 2] * p[f, 2] + T[0, 3]
        y = T[1, 0] * p[f, 0] + T[1, 1] * p[f, 1] + T[1, 2] * p[f, 2] + T[1, 3]
        z = T[2, 0] * p[f, 0] + T[2, 1] * p[f, 1] + T[2, 2] * p[f, 2] + T[2, 3]
        out[k, 0] = np.arctan2(x, z)
        out[k, 1] = np.arctan2(y, np.hypot(x, z))


@compiled
def _ends(G: FloatArray) -> tuple[int, int]:
    """Return the first and the last clone with a part in the normal equations (6N, 3) of a track."""
    first = -1
    last = -1
    for n in range(len(G) // 6):
        if G[6 * n, 0] != 0.0 or G[6 * n + 1, 1] != 0.0:
            last = n
            if first < 0:
                first = n
    return first, last


@compiled
def _write_moves_about(centre: FloatArray, B: FloatArray) -> None:
    """Write how motions (6,) about a centre (3,) move a pose at the origin, into zeros (6, 6)."""
    for i in range(6):
        B[i, i] = 1.0
    B[0, 4] = -centre[2]
    B[0, 5] = centre[1]
    B[1, 3] = centre[2]
    B[1, 5] = -centre[0]
    B[2, 3] = -centre[1]
    B[2, 4] = centre[0]


@compiled
def score_drifts(
    rows: IntArray,
    info: TrackColumns,
    centre: FloatArray,
    variance: float,
    scores: FloatArray,
    information: FloatArray,
) -> None:
    """Write scores and information (K, 6) of tracks by a drift of the poses, their points
    eliminated as in (M4).

    The drift is a motion `[rho; phi]` of the clones along the world's axes, about `centre` (3,),
    that grows linearly from -1/2 in a track's first view to 1/2 in its last one.
    """
    G = info.G
    L = np.empty((3, 3))
    sums = np.empty((6, 3))
    own = np.empty((6, 6))
    g = np.empty(6)
    B = np.zeros((6, 6))
    _write_moves_about(centre, B)
    for k, f in enumerate(rows):
        first, last = _ends(G[f])
        sums[:] = 0.0
        own[:] = 0.0
        g[:] = 0.0
        for n in range(first, last + 1):
            w = (n - first) / max(last - first, 1) - 0.5
            for i in range(6):
                g[i] += w * info.gradient[f, 6 * n + i]
                for j in range(3):
                    Gij = G[f, 6 * n + i, j]
                    sums[i, j] += w * Gij
                    for m in range(6):
                        own[i, m] += w * w * Gij * info.q_D_clone[f, j, m]
        _factor(info.C[f], L)
        y = info.point_gradient[f]
        for s in range(6):
            g0 = 0.0
            g1 = 0.0
            g2 = 0.0
            score = 0.0
            A = 0.0
            for i in range(6):
                b = B[i, s]
                if b == 0.0:
                    continue
                g0 += b * sums[i, 0]
                g1 += b * sums[i, 1]
                g2 += b * sums[i, 2]
                score += b * g[i]
                for j in range(6):
                    A += b * own[i, j] * B[j, s]
            x0, x1, x2 = _solved(L, g0, g1, g2)
            scores[k, s] = (score - x0 * y[0] - x1 * y[1] - x2 * y[2]) / variance
            information[k, s] = (A - x0 * g0 - x1 * g1 - x2 * g2) / variance
