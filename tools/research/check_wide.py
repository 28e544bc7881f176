"""Compare ways to show a wide stereo pair to a tracker: raw images, and three projections with epipolar rows.

    python tools/research/check_wide.py             # a flight of the rig `wide` through a rendered room, exact truth

The same surface points are tracked in each kind of image, from starts 1.5 raw pixels off: from left to right, and in
the left image over time. Errors are angles between rays. The table of docs/rectification.md is from this tool.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from vio.frontend.align import align, cut_patches, shift_warps, templates
from vio.frontend.flow import lucas_kanade
from vio.geometry.distortion import CameraModel, StereoRig, project_point, unproject_pixel
from vio.geometry.lie import FloatArray
from vio.geometry.rectify import rectify, rectifying_rotations
from vio.geometry.stereo import StereoCamera, left_rays, project
from vio.records import BoolArray, Image
from vio.sim.effects import SensorEffects, apply_effects
from vio.sim.motion import MotionSpline, evaluate, hand_held
from vio.sim.render import View, camera_rays, correspondence, inside_image, render
from vio.sim.rigs import wide_rig
from vio.sim.world import World, room

_STEPS = {"stereo": 0, "50 ms": 50_000_000, "250 ms": 250_000_000}
_MARGIN_PX, _WINDOW_PX, _RADIUS = 12.0, 21, 6
_GUESS_PX, _BACK_PX, _CORRELATION = 1.5, 0.5, 0.85
_REACH = np.radians(77.0)  # of the angles' image, both ways: what the raw images show along their middle lines


@dataclass(frozen=True, slots=True)
class _Kind:
    """One kind of images: rays to pixels and back for either camera; angles: u = f atan(x / rho), v = f atan2(y, z)."""

    name: str
    rig: StereoRig
    camera: StereoCamera | None = None  # None: raw
    angles: bool = False

    def pixels(self, side: int, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of rays (N, 3) of the raw camera, and a mask (N,) of those well inside the image."""
        raw = self._raw(side)
        if self.camera is None:
            uv, valid = project_point(raw, rays)
            return uv, valid & inside_image(raw, uv, margin_px=_MARGIN_PX)
        R_rect_cam = rectifying_rotations(self.rig)[:2][side]
        x, y, z = (rays @ R_rect_cam.T).T
        c, rho = self.camera, np.hypot(y, z)
        if self.angles:
            uv = np.stack([c.fu * np.arctan2(x, rho) + c.cu, c.fv * np.arctan2(y, z) + c.cv], axis=1)
        else:
            depth = np.where(c.is_cylinder | (z > 0.05), z, 1e-3)
            uv = project(c, np.stack([x, y, depth], axis=1))[:, :2]
        size = np.array([c.width, c.height], dtype=np.float64)
        inside = ((uv >= _MARGIN_PX) & (uv <= size - 1 - _MARGIN_PX)).all(axis=1)
        return uv, np.asarray(inside & (c.is_cylinder | self.angles | (z > 0.05)))

    def rays(self, side: int, uv: FloatArray) -> FloatArray:
        """Unit rays (N, 3) of the raw camera through pixels (N, 2)."""
        if self.camera is None:
            return unproject_pixel(self._raw(side), uv)[0]
        c = self.camera
        if self.angles:
            along, round_ = (uv[..., 0] - c.cu) / c.fu, (uv[..., 1] - c.cv) / c.fv
            ray = np.stack([np.tan(along), np.sin(round_), np.cos(round_)], axis=-1)
        else:
            ray = left_rays(c, uv)
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        return np.asarray(ray @ rectifying_rotations(self.rig)[:2][side])

    def image(self, side: int, raw: Image) -> Image:
        """Return the image of this kind from a raw one."""
        if self.camera is None:
            return raw
        c = self.camera
        assert c.width is not None
        assert c.height is not None
        grid = np.stack(np.meshgrid(np.arange(c.width), np.arange(c.height)), axis=-1).astype(np.float64)
        uv, valid = project_point(self._raw(side), self.rays(side, grid))
        u, v = np.where(valid[..., None], uv, -1e4).astype(np.float32).transpose(2, 0, 1)
        return np.asarray(cv2.remap(raw, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)

    def _raw(self, side: int) -> CameraModel:
        return self.rig.cam0 if side == 0 else self.rig.cam1


@dataclass(slots=True)
class _Tally:
    seen: int = 0  # points that lie in both images
    kept: int = 0
    common: list[FloatArray] = field(default_factory=list)  # mrad, of points kept in all kinds
    beyond: list[FloatArray] = field(default_factory=list)  # of points outside the pinhole, kept in the others


def kinds_of(rig: StereoRig) -> list[_Kind]:
    """Return the kinds that are compared; all images have the size of the raw ones."""
    width, height = rig.cam0.width, rig.cam0.height
    f = (width - 1) / (2 * _REACH)
    baseline = rectifying_rotations(rig)[2]
    angles = StereoCamera(f, f, (width - 1) / 2, (height - 1) / 2, baseline, width, height)
    return [
        _Kind("raw, points undistorted", rig),
        _Kind("pinhole", rig, rectify(rig, "pinhole").camera),
        _Kind("cylinder", rig, rectify(rig, "cylinder").camera),
        _Kind("angles", rig, angles, angles=True),
    ]


def measure(*, moments: int, points: int, seed: int = 3) -> dict[tuple[str, str], _Tally]:
    """Track the same surface points in every kind of images."""
    rig, world, motion = wide_rig(), room(seed), hand_held(seed=seed, duration_s=14.0)
    kinds, rng = kinds_of(rig), np.random.default_rng(seed)
    out = {(step, kind.name): _Tally() for step in _STEPS for kind in kinds}
    for at in np.linspace(2e9, 13e9, moments).astype(np.int64).tolist():
        views, here = _views(motion, rig, at), _raw_pair(world, motion, rig, at)
        corners = cv2.goodFeaturesToTrack(here[0], points, 0.005, 8)
        uv = corners.reshape(-1, 2).astype(np.float64) + rng.uniform(-0.5, 0.5, (len(corners), 2))
        for step, later_ns in _STEPS.items():
            side = 1 if later_ns == 0 else 0
            then = at + later_ns
            other = here if later_ns == 0 else _raw_pair(world, motion, rig, then)
            view = views[1] if later_ns == 0 else _views(motion, rig, then)[0]
            truth, visible = correspondence(world, views[0], view, uv)
            visible &= kinds[0].pixels(0, unproject_pixel(rig.cam0, uv)[0])[1]
            start, goal = unproject_pixel(rig.cam0, uv[visible])[0], truth[visible]
            true_rays, reached = unproject_pixel(view.camera, goal)
            guess = unproject_pixel(view.camera, goal + _GUESS_PX * rng.standard_normal(goal.shape))[0]
            found = [_tracked(kind, side, here[0], other[side], start, true_rays, guess) for kind in kinds]
            _add(out, step, kinds, found, reached)
    return out


def _add(
    out: dict[tuple[str, str], _Tally],
    step: str,
    kinds: Sequence[_Kind],
    found: Sequence[tuple[FloatArray, BoolArray, BoolArray]],
    reached: BoolArray,
) -> None:
    common = np.logical_and.reduce([kept for _, _, kept in found]) & reached
    outside = ~found[1][1] & np.logical_and.reduce([kept for k, (_, _, kept) in enumerate(found) if k != 1]) & reached
    for kind, (error, seen, kept) in zip(kinds, found, strict=True):
        tally = out[step, kind.name]
        tally.seen += int(seen.sum())
        tally.kept += int(kept.sum())
        tally.common.append(error[common])
        tally.beyond.append(error[outside])


def _views(motion: MotionSpline, rig: StereoRig, time_ns: int) -> tuple[View, View]:
    T = evaluate(motion, time_ns).T_world_imu[0]
    return View(rig.cam0, T @ rig.T_imu_cam0, time_ns), View(rig.cam1, T @ rig.T_imu_cam1, time_ns)


def _raw_pair(world: World, motion: MotionSpline, rig: StereoRig, time_ns: int) -> tuple[Image, Image]:
    pair = []
    for camera, view in enumerate(_views(motion, rig, time_ns)):
        radiance = render(world, camera_rays(view.camera), view.T_world_cam, time_ns)
        number = time_ns // 1_000_000
        effects = SensorEffects(read_noise=1.5)
        pair.append(apply_effects(radiance, effects, time_ns=time_ns, frame_index=number, camera=camera, seed=7))
    return pair[0], pair[1]


def _tracked(
    kind: _Kind, side: int, first: Image, second: Image, start: FloatArray, truth: FloatArray, guess: FloatArray
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Angles (N,) of the end points from the truth, mrad, and masks (N,): in the field of view, and tracked."""
    a, b = kind.image(0, first), kind.image(side, second)
    (p, inside), (_, there), (q, _) = kind.pixels(0, start), kind.pixels(side, truth), kind.pixels(side, guess)
    seen = inside & there
    error, kept = np.full(len(start), np.inf), np.zeros(len(start), dtype=np.bool_)
    rows = np.flatnonzero(seen)
    end, found = _flow(a, b, p[rows], q[rows])
    back, found_back = _flow(b, a, end, p[rows])
    good = found & found_back & (np.linalg.norm(back - p[rows], axis=1) < _BACK_PX)
    prepared = templates(cut_patches(a, p[rows], _RADIUS))
    same_row = p[rows, 1] if side == 1 and kind.camera is not None else None
    warps, score = align(prepared, np.arange(len(rows)), b, shift_warps(end), 12, same_row)
    rays = kind.rays(side, warps[:, :2, 2])
    kept[rows] = good & (score > _CORRELATION)
    error[rows] = 1e3 * np.linalg.norm(np.cross(rays, truth[rows]), axis=1)
    return error, seen, kept


def _flow(a: Image, b: Image, points: FloatArray, guess: FloatArray) -> tuple[FloatArray, BoolArray]:
    return lucas_kanade(a, b, points, guess, window_px=_WINDOW_PX, levels=2, iterations=40, epsilon_px=1e-3)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=12)
    parser.add_argument("--points", type=int, default=600)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("| images | step | in view | kept | common: median, 95 % (mrad) | outside the pinhole: median, 95 % |")
    print("|---|---|---|---|---|---|")
    for (step, name), tally in measure(moments=args.moments, points=args.points).items():
        errors = [tally.common] if name == "pinhole" else [tally.common, tally.beyond]
        parts = [", ".join(f"{x:.2f}" for x in np.percentile(np.concatenate(e), [50, 95])) for e in errors]
        share = 100 * tally.kept / max(tally.seen, 1)
        print(f"| {name} | {step} | {tally.seen} | {share:.1f} % | {' | '.join([*parts, '-'][:2])} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
