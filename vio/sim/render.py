"""Ray-cast images of a world, and the exact correspondence of any pixel in any other view.

A ray `d` from the camera centre c meets a surface with corner p0, axes e_s, e_t and normal n (h = n
. (c - p0) > 0 in front of it) where `w = -(n . d) / h`, the inverse distance in units of d. Texture
coordinates times w and w itself are linear in d, so every surface is one 3x3 matrix `G` with
`G d = (w U, w V, w)`: in a pinhole image, a homography. All tests (inside the rectangle, nearest)
are linear inequalities in d; where they hold at the corners of a tile they hold all over it. Tiles
that show one surface are shaded at once; along outlines each pixel has eight samples, each with its
own visibility test.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.errors import SimulationError
from vio.geometry.distortion import CameraModel, project_point, unproject_pixel
from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import BoolArray, IntArray
from vio.sim.textures import LEVELS_PER_OCTAVE, MipTexture
from vio.sim.world import Surfaces, World, surfaces_at

Radiance: TypeAlias = npt.NDArray[np.float32]


class _RenderRules(NamedTuple):
    """Accuracy and memory of the rays."""

    tile_px: Capacity[int] = 64  # pixels
    coarse_tiles: Capacity[int] = 2  # tiles along a coarse tile
    detail_step_px: int = 4  # pixels between evaluations of the level of detail
    min_front_m: Tolerance[float] = 1e-6
    same_point_share: Tolerance[float] = (
        1e-6  # relative distance within which two hits are the same point
    )
    max_pairs: Capacity[int] = 400_000  # rays times surfaces held in memory at once
    # ratio of footprint sides from which the longer one gets twice the samples
    stretched_ratio: float = 2.0


_RENDER = _RenderRules()
_EDGE_MARK = np.int16(-1)
_NONE = np.int16(-2)
_EMPTY = np.float32(90.0)  # gray level where no surface is hit


@dataclass(frozen=True, slots=True)
class View:
    """One camera with its pose and time."""

    camera: CameraModel
    T_world_cam: FloatArray  # (4, 4)
    time_ns: int = 0


@dataclass(frozen=True, slots=True)
class CameraRays:
    """The rays of a camera's pixels, computed once."""

    camera: CameraModel
    # Rays in the camera frame, of unit depth for planar lens models, unit length for others.
    centre: npt.NDArray[np.float32]  # (3, H, W) through pixel centres
    # (3, H + 1, W + 1) through pixel corners; [.., 0, 0] is pixel (-0.5, -0.5)
    corner: npt.NDArray[np.float32]
    fine: FloatArray  # (R, C, 4, 3) rays whose cone contains each tile
    coarse: FloatArray  # (R', C', 4, 3) the same for blocks of tiles


@dataclass(frozen=True, slots=True)
class Hits:
    """Intersections of rays with the scene."""

    surface: IntArray  # (N,) index of the surface; arbitrary where nothing is hit
    distance: FloatArray  # (N,) along the unit ray, m
    coordinates: FloatArray  # (N, 2) s, t on the surface, m
    found: BoolArray  # (N,)


def camera_rays(camera: CameraModel) -> CameraRays:
    """Tabulate the rays of a camera.

    Raises:
        SimulationError: the distortion model does not reach every pixel.
    """
    centre, found = unproject_pixel(camera, _grid(camera.width, camera.height, 0.0))
    corner, found_corner = unproject_pixel(camera, _grid(camera.width + 1, camera.height + 1, -0.5))
    if not (found.all() and found_corner.all()):
        raise SimulationError(
            "the distortion model does not reach every pixel of the image (it ends "
            f"{np.degrees(camera.lens.max_angle(camera.coefficients)):.0f} deg off the axis); "
            "check its coefficients"
        )
    if camera.lens.planar:
        centre = centre / centre[..., 2:]
        corner = corner / corner[..., 2:]
    return CameraRays(
        camera,
        np.ascontiguousarray(np.moveaxis(centre, -1, 0), dtype=np.float32),
        np.ascontiguousarray(np.moveaxis(corner, -1, 0), dtype=np.float32),
        _cones(corner, _RENDER.tile_px),
        _cones(corner, _RENDER.tile_px * _RENDER.coarse_tiles),
    )


def _grid(width: int, height: int, start: float) -> FloatArray:
    u, v = np.meshgrid(np.arange(width) + start, np.arange(height) + start)
    return np.stack([u, v], axis=-1)


def _cones(corner: FloatArray, tile: int) -> FloatArray:
    """Four rays per tile that span a cone containing all its rays, found on a plane normal to
    its central ray.
    """
    height = corner.shape[0] - 1
    width = corner.shape[1] - 1
    rows = -(-height // tile)
    columns = -(-width // tile)
    out = np.empty((rows, columns, 4, 3))
    for r in range(rows):
        for c in range(columns):
            block = corner[r * tile : (r + 1) * tile + 1, c * tile : (c + 1) * tile + 1].reshape(
                -1, 3
            )
            z = block.mean(axis=0) / np.linalg.norm(block.mean(axis=0))
            # Align with image rows, so that the cone is tight.
            x = block[-1] - block[0] + 1e-9 * np.array([1.0, 0, 0])
            if abs(z[0]) < 0.9:
                x = np.array([1.0, 0, 0]) - z[0] * z
            else:
                x = x - (x @ z) * z
            x /= np.linalg.norm(x)
            y = np.cross(z, x)
            a = block @ x
            b = block @ y
            depth = block @ z
            (a0, a1), (b0, b1) = (
                (float((q / depth).min()), float((q / depth).max())) for q in (a, b)
            )
            slack = 1e-6
            across = (a0 - slack, a1 + slack)
            down = (b0 - slack, b1 + slack)
            spans = [(p, q) for q in down for p in across]
            out[r, c] = [p * x + q * y + z for p, q in spans]
    return out


# --- exact geometry
# -------------------------------------------------------------------------------------------------


def _surface_matrices(surfaces: Surfaces, T_world_cam: FloatArray) -> tuple[FloatArray, IntArray]:
    """Matrices G (K, 3, 3) with `G d = (w s, w t, w)` for camera-frame rays d, of the K surfaces
    facing it.
    """
    c = T_world_cam[:3, 3]
    R = T_world_cam[:3, :3]
    from_corner = c - surfaces.origin
    normal = surfaces.normal
    h = np.einsum("si,si->s", normal, from_corner)
    front = np.flatnonzero(h > _RENDER.min_front_m)
    w = -normal[front] / h[front, None]
    rows = []
    for axis in (surfaces.axis_s[front], surfaces.axis_t[front]):
        at_camera = np.einsum("si,si->s", axis, from_corner[front])
        rows.append(axis + at_camera[:, None] * w)
    G = np.stack([*rows, w], axis=1) @ R
    return G, front


def cast(surfaces: Surfaces, T_world_cam: npt.ArrayLike, rays: npt.ArrayLike) -> Hits:
    """Intersect unit rays (N, 3) of the camera frame with the nearest surface, exactly.

    Args:
        surfaces: the scene at one time.
        T_world_cam: pose (4, 4) of the camera.
        rays: unit rays (N, 3), camera frame.
    """
    d = np.asarray(rays, dtype=np.float64).reshape(-1, 3)
    G, index = _surface_matrices(surfaces, np.asarray(T_world_cam, dtype=np.float64))
    size = surfaces.size[index]
    rows = max(1, _RENDER.max_pairs // max(1, len(index)))
    begins = range(0, max(len(d), 1), rows)
    parts = [_cast_block(G, index, size, d[i : i + rows]) for i in begins]
    return Hits(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _cast_block(
    G: FloatArray, index: IntArray, size: FloatArray, d: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    if len(index) == 0:
        nothing = np.zeros(len(d), dtype=np.int64)
        return nothing, np.ones(len(d)), np.zeros((len(d), 2)), nothing.astype(np.bool_)
    forms = G @ d.T  # (K, 3, N)
    a = forms[:, 0]
    b = forms[:, 1]
    w = forms[:, 2]
    inside_a = (a >= 0) & (a <= size[:, :1] * w)
    inside_b = (b >= 0) & (b <= size[:, 1:] * w)
    inside = (w > 0) & inside_a & inside_b
    nearness = np.where(inside, w, 0.0)
    best = nearness.argmax(axis=0)
    each = np.arange(len(d))
    nearest = nearness[best, each]
    found = nearest > 0
    scale = 1 / np.where(found, nearest, 1.0)
    at_best = (best, each)
    coordinates = np.stack([a[at_best], b[at_best]], axis=1) * scale[:, None]
    return index[best], scale, coordinates, found


def surface_points(surfaces: Surfaces, surface: IntArray, coordinates: FloatArray) -> FloatArray:
    """World points (N, 3) at surface coordinates (N, 2) of surfaces (N,)."""
    return (
        surfaces.origin[surface]
        + coordinates[:, :1] * surfaces.axis_s[surface]
        + coordinates[:, 1:] * surfaces.axis_t[surface]
    )


def correspondence(
    world: World, frame_a: View, frame_b: View, uv: npt.ArrayLike
) -> tuple[FloatArray, BoolArray]:
    """Map pixels (N, 2) of one view to another view (of the same or another camera, at the same or
    another time).

    Exact at sub-pixel positions: the ray is intersected, nothing is interpolated. Points on moving
    boxes move along.

    Returns:
        Pixels (N, 2) in `frame_b`, and a mask (N,): True where the point is inside the other image
        and nothing is in front of it. Where False the pixel is finite but may be arbitrary.
    """
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    rays, has_ray = unproject_pixel(frame_a.camera, uv)
    hits = cast(surfaces_at(world, frame_a.time_ns), frame_a.T_world_cam, rays)
    later = surfaces_at(world, frame_b.time_ns)
    p_world = surface_points(later, hits.surface, hits.coordinates)
    uv_b, visible = observe(later, frame_b, p_world)
    return uv_b, visible & hits.found & has_ray


def observe(surfaces: Surfaces, view: View, p_world: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
    """Pixels (N, 2) of world points (N, 3) on surfaces, and a mask (N,) of those inside the
    image and not occluded.
    """
    p_cam = transform_points(
        se3_inverse(view.T_world_cam), np.asarray(p_world, dtype=np.float64).reshape(-1, 3)
    )
    uv, valid = project_point(view.camera, p_cam)
    visible = valid & inside_image(view.camera, uv)
    distance = np.linalg.norm(p_cam, axis=1)
    rays = p_cam[visible] / distance[visible, None]
    hits = cast(surfaces, view.T_world_cam, rays)
    # For a point seen from behind its surface, the ray hits nothing at its distance, or another
    # surface in front.
    reached = hits.found & (
        np.abs(hits.distance - distance[visible])
        < _RENDER.same_point_share * (1 + distance[visible])
    )
    visible[visible] = reached
    return uv, visible


def inside_image(camera: CameraModel, uv: npt.ArrayLike, *, margin_px: float = 0.0) -> BoolArray:
    """Mask (N,) of pixels (N, 2) between the centres of the outermost pixels, `margin_px`
    further in.
    """
    uv = np.asarray(uv, dtype=np.float64)
    high = np.array([camera.width - 1, camera.height - 1]) - margin_px
    u = uv[..., 0]
    v = uv[..., 1]
    return (u >= margin_px) & (v >= margin_px) & (u <= high[0]) & (v <= high[1])


def depth_map(
    world: World, rays: CameraRays, T_world_cam: npt.ArrayLike, time_ns: int = 0
) -> tuple[FloatArray, IntArray]:
    """Exact depth along the optical axis (H, W) in metres at pixel centres, and the visible surface
    (H, W).

    Depth is infinite where no surface is hit.
    """
    T = np.asarray(T_world_cam, dtype=np.float64)
    surfaces = surfaces_at(world, time_ns)
    height = rays.camera.height
    width = rays.camera.width
    depth = np.full((height, width), np.inf)
    surface = np.zeros((height, width), dtype=np.int64)
    G, index = _surface_matrices(surfaces, T)
    candidates = _candidates(G, surfaces.size[index], rays)
    uv = _grid(width, height, 0.0)
    for r, c in np.ndindex(candidates.shape[:2]):
        rows = slice(r * _RENDER.tile_px, (r + 1) * _RENDER.tile_px)
        columns = slice(c * _RENDER.tile_px, (c + 1) * _RENDER.tile_px)
        d, _ = unproject_pixel(rays.camera, uv[rows, columns].reshape(-1, 2))
        chosen = candidates[r, c]
        which, distance, _, found = _cast_block(
            G[chosen], index[chosen], surfaces.size[index[chosen]], d
        )
        shape = depth[rows, columns].shape
        depth[rows, columns] = np.where(found, distance * d[:, 2], np.inf).reshape(shape)
        surface[rows, columns] = which.reshape(shape)
    return depth, surface


# --- images
# --------------------------------------------------------------------------------------------------


def _candidates(G: FloatArray, size: FloatArray, rays: CameraRays) -> BoolArray:
    """Surfaces (R, C, K) that may be visible in each tile; exactly one where that is certain."""
    rows, columns = rays.fine.shape[:2]
    blocks = rays.coarse.shape[:2]
    coarse = _cull(G, size, rays.coarse.reshape(-1, 4, 3)).reshape(*blocks, len(G))
    out = np.zeros((rows, columns, len(G)), dtype=np.bool_)
    for r, c in np.ndindex(coarse.shape[:2]):
        chosen = np.flatnonzero(coarse[r, c])
        block = rays.fine[
            r * _RENDER.coarse_tiles : (r + 1) * _RENDER.coarse_tiles,
            c * _RENDER.coarse_tiles : (c + 1) * _RENDER.coarse_tiles,
        ]
        kept = _cull(G[chosen], size[chosen], block.reshape(-1, 4, 3)).reshape(
            *block.shape[:2], len(chosen)
        )
        out[
            r * _RENDER.coarse_tiles : (r + 1) * _RENDER.coarse_tiles,
            c * _RENDER.coarse_tiles : (c + 1) * _RENDER.coarse_tiles,
            chosen,
        ] = kept
    return out


def _cull(G: FloatArray, size: FloatArray, cones: FloatArray) -> BoolArray:
    """Surfaces (B, K) that may be visible in cones (B, 4, 3) of rays: five linear inequalities
    at the four edges.
    """
    forms = np.einsum("kij,bqj->ibqk", G, cones, optimize=True)
    w = forms[2]
    from_right = size[:, 0] * w - forms[0]
    from_top = size[:, 1] * w - forms[1]
    limits = (w, forms[0], forms[1], from_right, from_top)
    possible = np.ones((len(cones), len(G)), dtype=np.bool_)
    covers = possible.copy()
    for limit in limits:
        possible &= (limit >= 0).any(axis=1)
        covers &= (limit > 0).all(axis=1)
    nearness = np.where(covers, w.min(axis=1), -np.inf)
    front = nearness.argmax(axis=1)
    block = np.arange(len(cones))
    if len(G):
        has_cover = covers[block, front]
    else:
        has_cover = np.zeros(len(cones), dtype=np.bool_)
    behind = (w <= w[block, :, front][:, :, None]).all(axis=1)
    behind[block, front] = False
    return possible & ~(behind & has_cover[:, None])


@dataclass(frozen=True, slots=True)
class _Scene:
    """The surfaces in front of one camera, ready to be sampled."""

    G: npt.NDArray[np.float32]  # (K, 3, 3) rays to (w U, w V, w), U and V in texels
    limit: npt.NDArray[np.float32]  # (K, 2) texels
    textures: list[MipTexture]  # (K,)


def render(
    world: World, rays: CameraRays, T_world_cam: npt.ArrayLike, time_ns: int = 0
) -> Radiance:
    """Render one image (H, W) in gray levels, linear and without any camera effect.

    Every pixel is the mean of at least four filtered samples placed symmetrically about its centre.
    """
    surfaces = surfaces_at(world, time_ns)
    G, index = _surface_matrices(surfaces, np.asarray(T_world_cam, dtype=np.float64))
    candidates = _candidates(G, surfaces.size[index], rays)
    used = np.flatnonzero(candidates.any(axis=(0, 1)))
    textures = [world.textures[int(index[k])] for k in used]
    texels = np.array([t.size for t in textures], dtype=np.float64).reshape(-1, 2)
    scaled = G[used].copy()
    scaled[:, :2] *= (texels / surfaces.size[index[used]])[:, :, None]
    candidates = candidates[:, :, used]
    scene = _Scene(scaled.astype(np.float32), texels.astype(np.float32), textures)
    image = np.full((rays.camera.height, rays.camera.width), _EMPTY, dtype=np.float32)
    edges = []
    for r in range(candidates.shape[0]):
        shown = _shown(scene, candidates[r], rays, r)
        _shade_row(scene, shown, candidates[r], rays, r, image)
        edges.append(np.argwhere(shown == _EDGE_MARK) + np.array([r * _RENDER.tile_px, 0]))
    _shade_edges(scene, candidates, rays, np.concatenate(edges), image)
    return image


def _shown(scene: _Scene, candidates: BoolArray, rays: CameraRays, r: int) -> npt.NDArray[np.int16]:
    """The one surface visible in each pixel (h, W) of a row of tiles, _EDGE_MARK on outlines, or
    _NONE.
    """
    rows = slice(r * _RENDER.tile_px, min((r + 1) * _RENDER.tile_px, rays.camera.height))
    out = np.full((rows.stop - rows.start, rays.camera.width), _NONE, dtype=np.int16)
    for c, allowed in enumerate(candidates):
        chosen = np.flatnonzero(allowed)
        columns = slice(c * _RENDER.tile_px, min((c + 1) * _RENDER.tile_px, rays.camera.width))
        if len(chosen) == 1:
            out[:, columns] = chosen[0]
        elif len(chosen) > 1:
            corner = rays.corner[:, rows.start : rows.stop + 1, columns.start : columns.stop + 1]
            ids = _nearest(scene, chosen, corner.reshape(3, -1)).reshape(corner.shape[1:])
            first = ids[:-1, :-1]
            below = ids[1:, :-1]
            beside = ids[:-1, 1:]
            across = ids[1:, 1:]
            uniform = (first == below) & (first == beside) & (first == across)
            out[:, columns] = np.where(uniform, first, _EDGE_MARK)
    return out


def _nearest(scene: _Scene, chosen: IntArray, d: npt.NDArray[np.float32]) -> npt.NDArray[np.int16]:
    """The nearest (n,) of some surfaces along each ray d (3, n), or _NONE."""
    forms = scene.G[chosen] @ d  # (m, 3, n)
    limit = scene.limit[chosen]
    a = forms[:, 0]
    b = forms[:, 1]
    w = forms[:, 2]
    inside_a = (a >= 0) & (a <= limit[:, :1] * w)
    inside_b = (b >= 0) & (b <= limit[:, 1:] * w)
    inside = inside_a & inside_b
    nearness = np.where(inside, w, np.float32(0))
    best = nearness.argmax(axis=0)
    return np.where(nearness.max(axis=0) > 0, chosen[best], _NONE).astype(np.int16)


def _shade_row(
    scene: _Scene,
    shown: npt.NDArray[np.int16],
    candidates: BoolArray,
    rays: CameraRays,
    r: int,
    image: Radiance,
) -> None:
    """Shade the pixels of a row of tiles that show one surface only, surface by surface in runs
    of columns.
    """
    top = r * _RENDER.tile_px
    # Sample positions within a pixel follow the ray derivative at the middle of a run of tiles.
    longest = rays.camera.lens.linear_tiles * _RENDER.tile_px
    for k in np.flatnonzero(np.bincount(shown[shown >= 0], minlength=1)):
        tiles = np.flatnonzero(candidates[:, k])
        left = int(tiles[0]) * _RENDER.tile_px
        right = (int(tiles[-1]) + 1) * _RENDER.tile_px
        mask = shown[:, left:right] == k
        for first, last in _runs(np.flatnonzero(mask.any(axis=0)), longest):
            columns = slice(left + first, left + last)
            part = mask[:, first:last]
            within = np.flatnonzero(part.any(axis=1))
            if len(within) == 0:
                continue
            low = int(within[0])
            high = int(within[-1]) + 1
            rows = slice(top + low, top + high)
            np.copyto(
                image[rows, columns],
                _shade(scene, int(k), rays, rows, columns),
                where=part[low:high],
            )


def _runs(seen: npt.NDArray[np.intp], longest: int) -> Iterator[tuple[int, int]]:
    """Intervals [first, last) that cover all given columns, without wide gaps and at most
    `longest` long.
    """
    cuts = np.flatnonzero(np.diff(seen) > _RENDER.tile_px) + 1
    for part in np.split(seen, cuts):
        first = int(part[0])
        end = int(part[-1]) + 1
        pieces = -(-(end - first) // longest)
        for piece in range(pieces):
            yield (
                first + piece * (end - first) // pieces,
                first + (piece + 1) * (end - first) // pieces,
            )


def _samples(across: int, down: int) -> npt.NDArray[np.float32]:
    """Sample positions (N, 2) within a pixel, one colour of a chessboard after the other.

    The halves take their texture from neighbouring mip levels where the level of detail is between
    two; each half is symmetric about the pixel's centre, so the blend shifts nothing.
    """
    i, j = np.meshgrid(np.arange(down), np.arange(across), indexing="ij")
    order = np.argsort((i + j).ravel() % 2, kind="stable")
    u = (j.ravel()[order] + 0.5) / across - 0.5
    v = (i.ravel()[order] + 0.5) / down - 0.5
    return np.stack([u, v], axis=1).astype(np.float32)


_SQUARE = _samples(2, 2)
_WIDE = _samples(4, 2)
_TALL = _samples(2, 4)
# A symmetric eight-queens pattern: eight different rows and columns, symmetric about the centre.
_QUEENS = (2, 4, 1, 7, 0, 6, 3, 5)
_FINE = np.array(
    [((i + 0.5) / 8 - 0.5, (j + 0.5) / 8 - 0.5) for i, j in enumerate(_QUEENS)], dtype=np.float32
)


def _footprint(
    forms: npt.NDArray[np.float32], g_u: npt.NDArray[np.float32], g_v: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Squared length in texels of one pixel step along u and along v; forms and derivatives are
    (3, ...).
    """
    inverse = 1 / forms[2]
    U = forms[0] * inverse
    V = forms[1] * inverse
    U_D_u = (g_u[0] - U * g_u[2]) * inverse
    V_D_u = (g_u[1] - V * g_u[2]) * inverse
    U_D_v = (g_v[0] - U * g_v[2]) * inverse
    V_D_v = (g_v[1] - V * g_v[2]) * inverse
    along_u = U_D_u**2 + V_D_u**2
    along_v = U_D_v**2 + V_D_v**2
    return along_u, along_v


def _levels(
    square: npt.NDArray[np.float32], texture: MipTexture, phase: float
) -> npt.NDArray[np.intp]:
    """Mip level for a squared distance between samples, in texels."""
    detail = np.log2(np.maximum(square, 1e-12)) * np.float32(LEVELS_PER_OCTAVE / 2)
    return np.clip(np.floor(detail + phase), 0, len(texture.levels) - 1).astype(np.intp)


def _shade(scene: _Scene, k: int, rays: CameraRays, rows: slice, columns: slice) -> Radiance:
    """Texture of surface k over a block of pixels (h, w), whether or not it is visible there."""
    d = rays.centre[:, rows, columns]
    h, w = d.shape[1:]
    texture = scene.textures[k]
    G = scene.G[k]
    corner = rays.corner[
        :,
        rows.start + h // 2 : rows.start + h // 2 + 2,
        columns.start + w // 2 : columns.start + w // 2 + 2,
    ]
    g_u = G @ (corner[:, 0, 1] - corner[:, 0, 0])
    g_v = G @ (corner[:, 1, 0] - corner[:, 0, 0])
    forms = G @ d.reshape(3, -1)
    along_u, along_v = _footprint(
        forms.reshape(3, h, w)[:, :: _RENDER.detail_step_px, :: _RENDER.detail_step_px], g_u, g_v
    )
    middle = along_u.shape[0] // 2, along_u.shape[1] // 2
    ratio = along_u[middle] / max(along_v[middle], 1e-30)
    if ratio > _RENDER.stretched_ratio**2:
        offsets = _WIDE
        square = np.maximum(along_u / 16, along_v / 4)
    elif ratio < 1 / _RENDER.stretched_ratio**2:
        offsets = _TALL
        square = np.maximum(along_u / 4, along_v / 16)
    else:
        offsets = _SQUARE
        square = np.maximum(along_u, along_v) / 4
    n = len(offsets)
    moved = offsets[:, :1] * g_u + offsets[:, 1:] * g_v  # (n, 3)
    inverse = forms[2] + moved[:, 2:]
    np.divide(np.float32(1), inverse, out=inverse)
    x = forms[0] + moved[:, :1]
    y = forms[1] + moved[:, 1:2]
    x *= inverse
    y *= inverse
    for half, phase in ((slice(0, n // 2), 0.25), (slice(n // 2, n), 0.75)):
        level = _levels(square, texture, phase)
        if level.min() == level.max():
            scale_x, scale_y, shift_x, shift_y = texture.levels[level.flat[0]]
        else:
            table = np.moveaxis(texture.levels[level], -1, 0)
            grown = (
                table.repeat(_RENDER.detail_step_px, axis=1)
                .repeat(_RENDER.detail_step_px, axis=2)[:, :h, :w]
                .reshape(4, -1)
            )
            scale_x, scale_y, shift_x, shift_y = grown
        x[half] *= scale_x
        x[half] += shift_x
        y[half] *= scale_y
        y[half] += shift_y
    values = cv2.remap(
        texture.page,
        x.reshape(n * h, w),
        y.reshape(n * h, w),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    total = np.add.reduce(values.reshape(n, h * w), axis=0, dtype=np.float32)
    total *= np.float32(texture.gain / n)
    return total.reshape(h, w)


def _shade_edges(
    scene: _Scene, candidates: BoolArray, rays: CameraRays, pixels: IntArray, image: Radiance
) -> None:
    """Sample the pixels (E, 2: row, column) on outlines finely, each sample from the surface
    that it hits.
    """
    v, u = pixels.T
    if len(v) == 0:
        return
    n = len(_FINE)
    allowed = candidates[v // _RENDER.tile_px, u // _RENDER.tile_px]
    first = rays.corner[:, v, u]
    du = rays.corner[:, v, u + 1] - first  # (3, E)
    dv = rays.corner[:, v + 1, u] - first
    step_u = _FINE[:, 0, None]
    step_v = _FINE[:, 1, None]
    d = rays.centre[:, None, v, u] + step_u * du[:, None] + step_v * dv[:, None]  # (3, n, E)
    best = np.zeros((n, len(v)), dtype=np.float32)
    winner = np.full((n, len(v)), _NONE, dtype=np.int16)
    columns = {int(k): np.flatnonzero(allowed[:, k]) for k in np.flatnonzero(allowed.any(axis=0))}
    for k, mine in columns.items():
        own_rays = d[:, :, mine].reshape(3, -1)
        a, b, w = (scene.G[k] @ own_rays).reshape(3, n, -1)
        limit = scene.limit[k]
        before = best[:, mine]
        inside_a = (a >= 0) & (a <= limit[0] * w)
        inside_b = (b >= 0) & (b <= limit[1] * w)
        hit = (w > before) & inside_a & inside_b
        best[:, mine] = np.where(hit, w, before)
        winner[:, mine] = np.where(hit, np.int16(k), winner[:, mine])
    values = np.full((n, len(v)), _EMPTY, dtype=np.float32)
    for k, mine in columns.items():
        sample, column = np.nonzero(winner[:, mine] == k)
        if len(sample):
            pixel = mine[column]
            values[sample, pixel] = _sample_points(
                scene, k, d[:, sample, pixel], du[:, pixel], dv[:, pixel]
            )
    image[v, u] = values.mean(axis=0)


def _sample_points(
    scene: _Scene,
    k: int,
    d: npt.NDArray[np.float32],
    du: npt.NDArray[np.float32],
    dv: npt.NDArray[np.float32],
) -> Radiance:
    """Texture (n,) of surface k along rays d (3, n) with pixel steps du and dv (3, n)."""
    texture = scene.textures[k]
    G = scene.G[k]
    forms = G @ d
    along_u, along_v = _footprint(forms, G @ du, G @ dv)
    square = np.asarray(np.maximum(along_u, along_v) / 4, dtype=np.float32)
    level = texture.levels[_levels(square, texture, 0.5)]
    x = forms[0] / forms[2] * level[:, 0] + level[:, 2]
    y = forms[1] / forms[2] * level[:, 1] + level[:, 3]
    width = 1024  # cv2.remap needs an image
    padded = np.zeros((2, -(-len(x) // width) * width), dtype=np.float32)
    padded[0, : len(x)] = x
    padded[1, : len(x)] = y
    maps = padded.reshape(2, -1, width)
    values = cv2.remap(
        texture.page, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return values.reshape(-1)[: len(x)].astype(np.float32) * np.float32(texture.gain)
