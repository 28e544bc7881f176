"""The compiled loops once more in NumPy, many at a time: slower and, for an eye used to arrays,
easier to check.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from vio.filters.imu_terms import ENTRIES, IMU_TERMS, accel_D_terms
from vio.filters.multiview import CAUCHY, MIN_DEPTH, MIN_DISPARITY_PX, TrackInformation
from vio.filters.track_records import InverseDepth, Residuals, Views
from vio.frontend.align import FLAT_RMS, Templates, disc, offsets, window
from vio.geometry.lie import FloatArray, circledot, se3_exp, so3_exp, so3_hat, so3_left_jacobian
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project, z_D_p_cam
from vio.records import BoolArray, IntArray, imu_matrices

PRIOR = 1e-6  # per px^2, on a disparity: that of `vio.filters.multiview`
ROW_WEIGHT = (4.0 / 0.3) ** 2  # gray levels and pixels: those of `frontend.align`


def sampled(image: FloatArray, warp: FloatArray, xy: FloatArray) -> FloatArray:
    """Gray levels (N, S) at `warp @ [x, y, 1]` (N, 2, 3), interpolated linearly; the image's
    border is repeated.
    """
    x, y = xy.astype(np.float64)
    u, v = np.moveaxis(warp @ np.stack([x, y, np.ones_like(x)]), 1, 0)
    u, v = np.clip(u, 0, image.shape[1] - 1), np.clip(v, 0, image.shape[0] - 1)
    i, j = (
        np.minimum(u.astype(int), image.shape[1] - 2),
        np.minimum(v.astype(int), image.shape[0] - 2),
    )
    a, b = u - i, v - j
    above = (1 - a) * image[j, i] + a * image[j, i + 1]
    below = (1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]
    out: FloatArray = (1 - b) * above + b * below
    return out


def prepared(wide: FloatArray) -> Templates:
    """Templates of patches (N, 2r+3, 2r+3), in double precision."""
    n, radius = len(wide), wide.shape[1] // 2 - 1
    x, y = disc(radius).astype(np.float64)
    weight, inside = (
        window(radius).astype(np.float64),
        np.isin(_names(offsets(radius)), _names(disc(radius))),
    )
    patch, gu, gv = (
        part.reshape(n, -1)[:, inside]
        for part in (
            wide[:, 1:-1, 1:-1],
            (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2,
            (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2,
        )
    )
    centred = patch - np.average(patch, axis=1, weights=weight)[:, None]
    basis = np.stack([gu, gv, centred, np.ones_like(gu), gu * x, gu * y, gv * x, gv * y], axis=1)
    normal = (basis * weight) @ basis.transpose(0, 2, 1)
    normal += (1e-6 * np.einsum("nii->ni", normal) + 1e-6)[:, :, None] * np.eye(8)
    on_row = normal[:, :6, :6].copy()
    on_row[:, 1, 1] += ROW_WEIGHT
    weighted = weight * centred, weight * np.stack([gu, gv], axis=1), centred**2 @ weight
    columns = (*weighted, np.linalg.inv(normal), np.linalg.inv(on_row), np.zeros((len(wide), 3)))
    return Templates(*columns)  # type: ignore[arg-type]  # float64


def _names(xy: FloatArray) -> FloatArray:
    """A number (S,) for each offset of (2, S)."""
    return np.asarray(1000.0 * xy[0] + xy[1])


def aligned(
    store: Templates,
    radius: int,
    image: FloatArray,
    warp: FloatArray,
    iterations: int,
    rows: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Warps (N, 2, 3) and correlations (N,) of `frontend.align.align`, all templates in step."""
    x, y = disc(radius).astype(np.float64)
    weight = window(radius).astype(np.float64)
    size = weight.sum()
    warp, score, active = warp.copy(), np.full(len(warp), -1.0), np.arange(len(warp))
    inverse = store.inverse if rows is None else store.row_inverse
    for _ in range(iterations):
        view, here = sampled(image, warp[active], disc(radius)), warp[active]
        patch, energy = store.patch[active], store.energy[active]
        gu, gv = np.moveaxis(store.gradient[active] * view[:, None], 1, 0)
        terms = [gu, gv, patch * view, weight * view, gu * x, gu * y, gv * x, gv * y]
        moments = np.stack([term.sum(axis=1) for term in terms], axis=1)
        other = (view - np.average(view, axis=1, weights=weight)[:, None]) ** 2 @ weight
        flat = (other <= FLAT_RMS**2 * size) | (energy <= FLAT_RMS**2 * size)
        score[active] = np.where(
            flat, -1.0, moments[:, 2] / np.sqrt(np.where(flat, 1.0, other * energy))
        )
        if rows is not None:
            gain = np.maximum(moments[:, 2] / np.maximum(energy, 1.0), 0.1)
            moments[:, 1] += ROW_WEIGHT * gain * (here[:, 1, 2] - rows[active])
        parameters = inverse.shape[1]
        fit = np.zeros((len(active), 8))
        fit[:, :parameters] = (inverse[active] @ moments[:, :parameters, None])[:, :, 0]
        fit /= np.maximum(fit[:, 2:3], 0.1)
        step = np.eye(3) + np.zeros((len(active), 1, 1))
        step[:, :2, 2] = np.clip(fit[:, :2], -1.0, 1.0)
        step[:, :2, :2] += np.clip(fit[:, 4:], -0.3, 0.3).reshape(-1, 2, 2)
        warp[active] = here @ np.linalg.inv(step)
        active = active[np.abs(fit[:, :2]).max(axis=1) > 0.05]
    return warp, score


def moved_errors(
    camera: StereoCamera, T: FloatArray, p_prev: FloatArray, pixels: FloatArray
) -> FloatArray:
    """Distances (..., N) between points (N, 3) moved by motions (..., 4, 4) and left pixels (N,
    2).
    """
    p = p_prev @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
    ahead = depth_of(camera, p) > 0.05
    distance = np.linalg.norm(
        project(camera, np.where(ahead[..., None], p, 1.0))[..., :2] - pixels, axis=-1
    )
    return np.where(ahead, distance, np.inf)


def gauss_newton(
    camera: StereoCamera,
    T: FloatArray,
    p_prev: FloatArray,
    pixels: FloatArray,
    weight: FloatArray,
    *,
    steps: int,
    free: slice,
) -> FloatArray:
    """Motions (H, 4, 4), each refined on its own points (H, K, 3), pixels (H, K, 2) and weights
    (H, K).
    """
    for _ in range(steps):
        p = p_prev @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        ahead = depth_of(camera, p) > 0.05
        p = np.where(ahead[..., None], p, np.array([0.0, 0.0, 1.0]))
        w = np.where(ahead, weight, 0.0)
        residual = pixels - project(camera, p)[..., :2]
        pixel_D_xi = z_D_p_cam(camera, p)[..., :2, :] @ circledot(p)[..., :3, free]
        n = pixel_D_xi.shape[-1]
        J = (pixel_D_xi * w[..., None, None]).reshape(len(T), -1, n)
        r = (residual * w[..., None]).reshape(len(T), -1, 1)
        A = np.swapaxes(J, 1, 2) @ J
        A = A + (1e-4 * np.trace(A, axis1=1, axis2=2)[:, None, None] / n + 1e-9) * np.eye(n)
        xi = np.zeros((len(T), 6))
        xi[:, free] = np.clip(np.linalg.solve(A, np.swapaxes(J, 1, 2) @ r)[..., 0], -5.0, 5.0)
        T = se3_exp(xi) @ T
    return T


def refined_motion(
    camera: StereoCamera,
    T: FloatArray,
    p_prev: FloatArray,
    pixels: FloatArray,
    scale_px: float,
    converged: float,
) -> FloatArray:
    """A motion (4, 4) refined on all points (N, 3) and pixels (N, 2), with Geman-McClure
    weights.
    """
    for _ in range(6):
        error = moved_errors(camera, T, p_prev, pixels)
        weight = np.where(
            error < 3 * scale_px, 1.0 / (1.0 + (np.minimum(error, 1e6) / scale_px) ** 2), 0.0
        )
        before = T
        one = (T[None], p_prev[None], pixels[None], weight[None])
        T = gauss_newton(camera, *one, steps=1, free=slice(0, 6))[0]
        if np.abs(T - before).max() < converged:
            break
    return T


def equations(
    terms: FloatArray, values: FloatArray, model: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Cauchy-weighted normal equations (K, K) and (K,), the sum of the weights, and that of the
    squared values.
    """
    weight = 1 / (1 + ((values - terms @ model) / sigma) ** 2)
    return (
        (terms * weight[:, None]).T @ terms,
        terms.T @ (weight * values),
        weight.sum(),
        weight @ values**2,
    )


# --- tracks and their views
# --------------------------------------------------------------------------------------


def residuals(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views
) -> Residuals:
    """Compare predicted with seen pixels, equation (M1)."""
    R, t = T_cam0_world[:, :3, :3], T_cam0_world[:, :3, 3]
    F, N = len(p_world), len(T_cam0_world)
    p_cam = (p_world @ R.reshape(-1, 3).T).reshape(F, N, 3) + t
    seen = views.weight[..., 0] > 0
    ok = depth_of(camera, p_cam) > MIN_DEPTH * camera.baseline_m
    safe = np.where((ok & seen)[..., None], p_cam, [0.0, 0.0, 1.0])
    usable = views.weight * ok[..., None]
    r = (np.where(usable > 0, views.z, 0.0) - project(camera, safe)) * usable
    J = (z_D_p_cam(camera, safe) * usable[..., None]) @ R
    ahead: BoolArray = np.all(ok | ~seen, axis=1)
    return Residuals(r, J, ahead, views.weight)


def inverse_depth(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, seen: BoolArray
) -> InverseDepth:
    """Return the coordinates (M5) of points (F, 3) that lie ahead of the first camera that saw
    them.
    """
    anchor = np.argmax(seen, axis=1)
    R, t = T_cam0_world[anchor, :3, :3], T_cam0_world[anchor, :3, 3]
    centre = -np.einsum("nji,nj->ni", T_cam0_world[:, :3, :3], T_cam0_world[:, :3, 3])[anchor]
    p_cam = np.einsum("fij,fj->fi", R, p_world) + t
    # each as the pinhole that is turned about the baseline to the point sees it
    if camera.is_cylinder:
        turn = so3_exp(np.arctan2(p_cam[:, 1], p_cam[:, 2])[:, None] * [1.0, 0.0, 0.0])
        R, p_cam = turn @ R, (turn @ p_cam[..., None])[..., 0]
    z = np.maximum(p_cam[:, 2], MIN_DEPTH * camera.baseline_m)
    disparity = camera.fu * camera.baseline_m / z
    p_D_q, q_D_p = np.empty((len(z), 3, 3)), np.empty((len(z), 3, 3))
    p_D_q[:, :, :2] = np.swapaxes(R[:, :2], 1, 2) * (z / camera.fu)[:, None, None]
    p_D_q[:, :, 2] = (centre - p_world) / disparity[:, None]
    q_D_p[:, :2] = (R[:, :2] - (p_cam[:, :2] / z[:, None])[:, :, None] * R[:, 2:]) * (
        camera.fu / z
    )[:, None, None]
    q_D_p[:, 2] = R[:, 2] * (-disparity / z)[:, None]
    return InverseDepth(anchor, centre, disparity, p_D_q, q_D_p)


def moved(q: InverseDepth, dq: FloatArray, most: FloatArray | float) -> FloatArray:
    """Points (F, 3) in the world after steps (F, 3); the disparity stays between its least value
    and `most`.
    """
    disparity = np.maximum(np.minimum(q.disparity + dq[:, 2], most), MIN_DISPARITY_PX)
    across = np.squeeze(q.p_D_q[:, :, :2] @ dq[:, :2, None], axis=2)
    ray = across - q.p_D_q[:, :, 2] * q.disparity[:, None]
    out: FloatArray = q.centre + ray * (q.disparity / disparity)[:, None]
    return out


def on_rays(
    camera: StereoCamera, T: FloatArray, pixels: FloatArray, disparity: float | FloatArray
) -> FloatArray:
    """Points (F, 3) in the world that cameras (F, 4, 4) see at left pixels (F, 2), at
    disparities.
    """
    scale = camera.fu * camera.baseline_m / np.asarray(disparity) * np.ones(len(T))
    p_cam = left_rays(camera, pixels) * scale[:, None]
    out: FloatArray = np.einsum("fji,fj->fi", T[:, :3, :3], p_cam - T[:, :3, 3])
    return out


def refined(
    camera: StereoCamera, T: FloatArray, p: FloatArray, views: Views, steps: int, scale_px: float
) -> FloatArray:
    """Points (F, 3) after Gauss-Newton steps with Cauchy weights, ahead of all cameras that saw
    them.
    """
    seen, least = views.weight[..., 0] > 0, MIN_DEPTH * camera.baseline_m
    first = np.argmax(seen, axis=1)
    for _ in range(steps):
        p_first = np.einsum("fij,fj->fi", T[first, :3, :3], p) + T[first, :3, 3]
        far = on_rays(camera, T[first], views.z[np.arange(len(p)), first, :2], MIN_DISPARITY_PX)
        p = np.where((depth_of(camera, p_first) > least)[:, None], p, far)
        at, q = residuals(camera, T, p, views), inverse_depth(camera, T, p, seen)
        w = 1 / (1 + np.sum(at.r**2, axis=2) / (4 * scale_px**2))
        J = at.z_D_p @ q.p_D_q[:, None]
        C = np.einsum("fn,fnai,fnaj->fij", w, J, J) + np.diag([1e-12, 1e-12, PRIOR])
        dq = np.linalg.solve(C, np.einsum("fn,fnai,fna->fi", w, J, at.r)[..., None])[..., 0]
        most = np.full(len(p), camera.fu * camera.baseline_m / (1.01 * least))
        if not camera.is_cylinder:
            ray_z = (p - q.centre) @ T[:, 2, :3].T * q.disparity[:, None]
            room = 1.01 * least - (q.centre @ T[:, 2, :3].T + T[:, 2, 3])
            most = np.divide(
                ray_z, room, out=np.full(room.shape, np.inf), where=seen & (room > 0) & (ray_z > 0)
            ).min(1)
        p = moved(q, dq, most)
    return p


def robust_weights(at: Residuals, sigma2: float) -> FloatArray:
    """Cauchy weights (F, N) of all views; the scale is each clone's own."""
    squares, used = np.sum(at.r**2, axis=2), np.any(at.z_D_p[:, :, 1], axis=2)
    median = np.array(
        [np.median(s[u]) if u.any() else 0.0 for s, u in zip(squares.T, used.T, strict=True)]
    )
    return np.asarray(used / (1 + squares / (4 * np.maximum(sigma2, median / 2.37) * CAUCHY**2)))


def usable_points(
    camera: StereoCamera, T: FloatArray, p: FloatArray, views: Views, at: Residuals
) -> BoolArray:
    """Which tracks (F,) have a finite point ahead, and a right view or the parallax of one."""
    q = inverse_depth(camera, T, p, views.weight[..., 0] > 0)
    J = at.z_D_p.reshape(len(p), -1, 3) @ q.p_D_q
    variance = np.linalg.inv(np.swapaxes(J, 1, 2) @ J + np.diag([1e-12, 1e-12, PRIOR]))[:, 2, 2]
    limit = (0.15 * q.disparity) ** 2 if camera.kind == "mono" else 2.0
    by_stereo = np.any(views.weight[..., 2] > 0, axis=1)
    return np.asarray(at.ahead & np.isfinite(p).all(axis=1) & (by_stereo | (variance < limit)))


def track_information(
    camera: StereoCamera,
    T_cam0_world: FloatArray,
    at: Residuals,
    p_world: FloatArray,
    weight: FloatArray,
) -> TrackInformation:
    """Collect the normal equations of tracks, equations (M2), (M3), (M5) and (M6)."""
    F, N = at.r.shape[:2]
    q = inverse_depth(camera, T_cam0_world, p_world, np.any(at.z_D_p[:, :, 1, :], axis=2))
    J = (at.z_D_p.reshape(F, 4 * N, 3) @ q.p_D_q).reshape(F, N, 4, 3)
    Jt = np.swapaxes(J * weight[..., None, None], 2, 3)
    C_i = Jt @ J
    C_i[np.arange(F), q.anchor, 2, 2] += PRIOR
    g_i = (Jt @ at.r[..., None])[..., 0]
    B = q.q_D_p @ point_D_pose(p_world)
    Bt = np.swapaxes(B, 1, 2)
    G_i = Bt[:, None] @ C_i
    gradient = (Bt[:, None] @ g_i[..., None]).reshape(F, 6 * N)
    return TrackInformation(
        q, G_i.reshape(F, 6 * N, 3), C_i.sum(axis=1), B, gradient, g_i.sum(axis=1)
    )


def moved_points(info: TrackInformation, clone_errors: FloatArray, other: FloatArray) -> FloatArray:
    """Solve each point's own equations once the clones have moved."""
    right = info.point_gradient - np.einsum("fik,i->fk", info.G, clone_errors) - other
    return moved(info.q, np.linalg.solve(info.C, right[..., None])[..., 0], np.inf)


def eliminate_points(info: TrackInformation, chosen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Information matrix (6N, 6N) and vector (6N,) about the clones of the chosen tracks,
    equation (M4).
    """
    G, N = info.G[chosen], info.G.shape[1] // 6
    L = np.linalg.cholesky(np.linalg.inv(info.C[chosen]))
    V = G @ L  # (F, 6N, 3)
    flat = np.swapaxes(V, 1, 2).reshape(-1, 6 * N)
    A = -flat.T @ flat
    # sum of G_i B
    blocks = np.swapaxes(G, 0, 1).reshape(6 * N, -1) @ info.q_D_clone[chosen].reshape(-1, 6)
    for i in range(N):
        A[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += blocks[6 * i : 6 * i + 6]
    b = info.gradient[chosen].sum(axis=0)
    b -= flat.T @ (np.swapaxes(L, 1, 2) @ info.point_gradient[chosen][..., None]).reshape(-1)
    return A, b


def radial_focal(camera: StereoCamera) -> FloatArray:
    """Return the shares (2,) of (R8) by integrals over the image: the stretch that is nearest to
    the displacement by k1 and by k2.
    """
    nodes, weights = np.polynomial.legendre.leggauss(8)
    x, y = np.meshgrid(nodes * camera.cu / camera.fu, nodes * camera.cv / camera.fv)
    r2, area = x * x + y * y, np.outer(weights, weights)
    return np.array([np.sum(area * r2 * r2**n) / np.sum(area * r2) for n in (1, 2)])


def field_jacobian(camera: StereoCamera, z: FloatArray) -> FloatArray:
    """Derivatives of pixels (..., 4) by the coefficients of (R3) and (R4), (..., 4, 10)."""
    x, xr = ((z[..., c] - camera.cu) / camera.fu for c in (0, 2))
    y, one = (z[..., 1] - camera.cv) / camera.fv, np.ones(z.shape[:-1])
    out = np.zeros((*z.shape[:-1], 4, 10))
    for column, u in ((0, x), (2, xr)):
        r2 = u * u + y * y
        along = np.stack([u * r2, u * r2 * r2, 2 * u * y, r2 + 2 * u * u], axis=-1)
        across = np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * u * y], axis=-1)
        out[..., column, 4:8], out[..., column, 9] = camera.fu * along, camera.fu * u
        if column == 0:
            out[..., 1, 4:8], out[..., 1, 9] = camera.fv * across, camera.fv * y
    for axis, moved in ((0, camera.fu * x), (1, camera.fv * y), (2, camera.fu * x)):
        out[..., axis, 4:6] -= moved[..., None] * radial_focal(camera)
    r2 = xr * xr + y * y
    out[..., 2, :4] = camera.fu * np.stack([one, xr, r2, r2 * r2], axis=-1)
    out[..., 2, 8] = z[..., 2] - z[..., 0]
    return out


def corrected(
    camera: StereoCamera,
    rows: FloatArray,
    coefficients: FloatArray,
    z: FloatArray,
    weight: FloatArray,
) -> FloatArray:
    """Pixels (..., 4) without the field of (R3) and (R4), (10,), and what follows from the rows
    (7,) of (R2).
    """
    x, y = (z[..., 2] - camera.cu) / camera.fu, (z[..., 1] - camera.cv) / camera.fv
    out = z - field_jacobian(camera, z)[..., :8] @ coefficients[:8]
    out[..., 2] -= camera.fu * (-rows[1] * y + (rows[5] - rows[4]) * x * y - rows[3] * y * y)
    out = np.where(weight > 0, out, z)
    baseline, focal = np.exp(coefficients[8:])
    left = [camera.cu, camera.cv] + (out[..., :2] - [camera.cu, camera.cv]) / focal
    right = left[..., 0] - (out[..., 0] - out[..., 2]) / (focal * baseline)
    scaled = np.concatenate([left, right[..., None], out[..., 3:]], axis=-1)
    return np.where((weight > 0) & (np.arange(4) < 3), scaled, out)


@dataclass(frozen=True)
class StereoColumns:
    """The part of the tracks' normal equations that concerns the field's S coefficients; pixel
    noise is one pixel.
    """

    by_point: FloatArray  # (F, N, 3, S) `J' W H` of each view, the point in the coordinates (M5)
    # (F, S, 3) its sum over the views, transposed: the cross information of coefficients and point
    G: FloatArray
    A: FloatArray  # (F, S, S) information about the coefficients before the points are eliminated
    b: FloatArray  # (F, S) its vector


def stereo_columns(
    at: Residuals, H: FloatArray, p_D_q: FloatArray, weight: FloatArray
) -> StereoColumns:
    """Collect the normal equations of `r = J (B xi_i + dp) + H s`."""
    F, N, _, S = H.shape
    J = at.z_D_p
    H = H * (np.any(J, axis=3) * at.weight)[..., None]
    WH = H * weight[..., None, None]
    by_point = np.asarray(sum(J[:, :, a, :, None] * WH[:, :, a, None, :] for a in range(3)))
    by_q = np.swapaxes(p_D_q, 1, 2) @ np.swapaxes(by_point, 1, 2).reshape(F, 3, N * S)
    A, b = np.einsum("fnas,fnat->fst", WH, H), np.einsum("fnas,fna->fs", WH, at.r)
    by_view = np.swapaxes(by_q.reshape(F, 3, N, S), 1, 2)
    return StereoColumns(by_view, np.swapaxes(by_view.sum(axis=1), 1, 2), A, b)


def eliminate_columns(
    columns: StereoColumns, info: TrackInformation, chosen: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Take the points of the chosen tracks out of the coefficients' part of the normal equations,
    as (M4) does.

    Returns:
        Information about the coefficients (S, S), that with the clones (S, 6N), and the vector
        (S,).
    """
    by_point = columns.by_point[chosen]
    F, N, _, S = by_point.shape
    G = by_point.sum(axis=1)  # (F, 3, S)
    CG = np.linalg.solve(info.C[chosen], G)  # (F, 3, S)
    flat_G, flat_CG = G.reshape(3 * F, S), CG.reshape(3 * F, S)
    A = columns.A[chosen].sum(axis=0) - flat_G.T @ flat_CG
    B = info.q_D_clone[chosen].reshape(3 * F, 6)
    per_view = np.swapaxes(by_point, 1, 2).reshape(3 * F, N * S)
    cross = (B.T @ per_view).reshape(6, N, S).transpose(1, 0, 2).reshape(6 * N, S)
    cross = cross - np.swapaxes(info.G[chosen], 1, 2).reshape(3 * F, 6 * N).T @ flat_CG
    b = columns.b[chosen].sum(axis=0) - flat_CG.T @ info.point_gradient[chosen].reshape(-1)
    return A, cross.T, b


def whitened_correction(
    correction: FloatArray,
    expected: FloatArray,
    process: FloatArray,
    remaining: FloatArray,
    part: slice,
    informed: float,
) -> tuple[float, int, float]:
    """The fields of `WhitenedCorrection`, by LAPACK's generalised eigenvectors."""
    B = expected[part, part]
    removed, V = scipy.linalg.eigh(B - remaining[part, part], B)
    chosen = removed > informed
    whiten = V.T[chosen]
    y, dof = whiten @ correction[part], int(np.count_nonzero(chosen))
    share = float(np.vdot(whiten @ process[part, part], whiten)) / max(dof, 1)
    return float(y @ (y / removed[chosen])), dof, min(share, 1.0)


def leave_one_out_nis(
    r: FloatArray, J: FloatArray, covariance: FloatArray, weight: FloatArray, variance: float
) -> FloatArray:
    """Normalised innovations squared (K,) of landmarks' pixels, predicted without these very
    pixels.
    """
    R = (variance / np.maximum(weight, 1e-6))[:, None, None]
    values, vectors = np.linalg.eigh(R * np.eye(4) - J @ covariance @ np.swapaxes(J, 1, 2))
    values = np.maximum(values, 1e-3 * R[:, 0])
    predicted = R[:, 0] / values * (np.swapaxes(vectors, 1, 2) @ r[..., None])[..., 0]
    expected = R[:, 0] ** 2 / values - R[:, 0] + variance
    out: FloatArray = np.sum(predicted**2 / expected, axis=1)
    return out


# --- poses of the window, and the IMU's samples
# ------------------------------------------------------------------


def free_flow(s: FloatArray, gravity: FloatArray) -> FloatArray:
    """Transition (K, 9, 9) of [rho phi xi_v] over times (K,)."""
    out = np.zeros((len(s), 9, 9))
    out[:] = np.eye(9)
    G = so3_hat(gravity)
    out[:, 0:3, 6:9] = s[:, None, None] * np.eye(3)
    out[:, 0:3, 3:6] = (0.5 * s**2)[:, None, None] * G
    out[:, 6:9, 3:6] = s[:, None, None] * G
    return out


def moved_velocities(
    gravity: FloatArray,
    ages_s: FloatArray,
    R: FloatArray,
    error: FloatArray,
    velocities: FloatArray,
    entries: IntArray,
) -> FloatArray:
    """Velocities (N, 3) of the past, moved by a present error (15 + I,): (N2) back, with the
    accelerometer's bias and terms of the IMU.
    """
    xi_v = (free_flow(-ages_s, gravity) @ error[:9])[:, 6:9] + ages_s[:, None] * (R @ error[12:15])
    if len(entries):
        impulse = velocities[-1] - velocities - ages_s[:, None] * gravity
        by_terms = accel_D_terms((R.transpose(0, 2, 1) @ impulse[..., None])[..., 0]) @ error[15:]
        xi_v = xi_v - (R @ by_terms[..., None])[..., 0]
    out: FloatArray = velocities @ so3_exp(error[3:6]).T + xi_v @ so3_left_jacobian(error[3:6]).T
    return out


def integrated(
    times: FloatArray,
    readings: FloatArray,
    bias: FloatArray,
    gravity: FloatArray,
    densities: FloatArray,
    hidden: FloatArray,
    T: FloatArray,
    velocity: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rotations (K, 3, 3), positions and velocities (K, 3), Phi's biases (9, 6) and noise (2, 9,
    9), (N1) to (N4).
    """
    dt, (gyro, accel) = np.diff(times) * 1e-9, np.split(readings - bias, 2, axis=1)
    R = np.empty((len(times), 3, 3))
    R[0] = T[:3, :3]
    for k, step in enumerate(so3_exp(0.5 * (gyro[:-1] + gyro[1:]) * dt[:, None])):
        R[k + 1] = R[k] @ step
    force = (R @ accel[..., None])[..., 0] + gravity
    a = 0.5 * (force[:-1] + force[1:])
    v = velocity + np.concatenate([np.zeros((1, 3)), np.cumsum(a * dt[:, None], axis=0)])
    moves = v[:-1] * dt[:, None] + 0.5 * a * (dt**2)[:, None]
    p = T[:3, 3] + np.concatenate([np.zeros((1, 3)), np.cumsum(moves, axis=0)])
    left = (times[-1] - 0.5 * (times[:-1] + times[1:])) * 1e-9
    B = np.zeros((len(dt), 9, 6))
    B[:, 0:3, 0:3] = -so3_hat(0.5 * (p[:-1] + p[1:])) @ R[:-1]
    B[:, 3:6, 0:3] = B[:, 6:9, 3:6] = -R[:-1]
    B[:, 6:9, 0:3] = -so3_hat(0.5 * (v[:-1] + v[1:])) @ R[:-1]
    moved = free_flow(left, gravity) @ B
    variance = densities[:, None] ** 2 * dt + hidden
    Q = [
        np.einsum("k,kij,klj->il", s, M, M)
        for s, M in zip(variance, (moved[:, :, 3:], moved[:, :, :3]), strict=True)
    ]
    return R, p, v, np.einsum("kij,k->ij", moved, dt), np.array(Q)


def calibrated(readings: FloatArray, terms: FloatArray) -> FloatArray:
    """Readings (K, 6) `[gyro, accel]` with scale and misalignment taken out, (A1)."""
    M_accel, M_gyro = imu_matrices(terms)
    return np.concatenate([readings[:, :3] @ M_gyro.T, readings[:, 3:] @ M_accel.T], axis=1)


def gyro_D_terms(gyro: FloatArray) -> FloatArray:
    """Jacobian (..., 3, 15) of the calibrated gyro by the terms, at readings (..., 3), (A2)."""
    sensor, row, column = ENTRIES.T
    own = np.flatnonzero(sensor == 1)
    out = np.zeros((*gyro.shape, IMU_TERMS))
    out[..., row[own], own] = gyro[..., column[own]]
    return out


def term_columns(
    times: FloatArray,
    levers: FloatArray,
    R: FloatArray,
    p: FloatArray,
    v: FloatArray,
    gravity: FloatArray,
) -> FloatArray:
    """How errors of the IMU's terms move position, attitude and velocity (9, 15), (A3).

    Levers (K, 6) `[gyro, accel]`; rotations, positions and velocities as `integrated` returns them.
    """
    dt = np.diff(times)[:, None, None] * 1e-9
    left = (times[-1] - 0.5 * (times[:-1] + times[1:])) * 1e-9
    force = R @ accel_D_terms(levers[:, 3:])
    by_accel = 0.5 * (force[1:] + force[:-1]) * dt
    middle = 0.5 * (R[1:] + R[:-1])
    by_gyro = middle @ gyro_D_terms(0.5 * (levers[1:, :3] + levers[:-1, :3])) * dt
    enters = np.zeros((len(dt), 9, 15))
    enters[:, 0:3] = so3_hat(0.5 * (p[1:] + p[:-1])) @ by_gyro
    enters[:, 3:6] = by_gyro
    enters[:, 6:9] = so3_hat(0.5 * (v[1:] + v[:-1])) @ by_gyro + by_accel
    out: FloatArray = (free_flow(left, gravity) @ enters).sum(axis=0)
    return out


def point_D_pose(p_world: FloatArray) -> FloatArray:
    """`B = [-I, p^]` (F, 3, 6): how a clone's error `[rho; phi]` moves a point as that clone
    sees it.
    """
    B = np.zeros((len(p_world), 3, 6))
    B[:, :, :3] = -np.eye(3)
    B[:, :, 3:] = so3_hat(p_world)
    return B
