"""How long a camera takes from the exposure of its first row to that of its last, by its changes of
velocity.

Where all rows are exposed at once, the features of three frames fit a constant acceleration. A
rolling shutter shows a feature, by the share s of its row, after the middle one, of the readout
time r, at the velocity of another moment: beside the middle frame's pixels, those of a frame that is
a time t away are off by `r s` times the change of velocity since then, equation (F3). What a steady
velocity shows of r is left out, as errors of lenses, rows and depths show alike.
Reference: Oth, Furgale, Kneip & Siegwart, Rolling shutter camera calibration, CVPR (2013).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vio.cameras.rig import MAX_READOUT_S, Rectifier
from vio.findings import Finder, Finding
from vio.geometry.lie import FloatArray, circledot
from vio.geometry.stereo import DEPTH_DISPARITY_PX, StereoCamera, project, triangulate, z_D_p_cam
from vio.numerics.compiled import move_poses
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import NormalEquations, cauchy_equations, median
from vio.records import NS_PER_S, IntArray, Observations, shared_rows


class _ReadoutRules(NamedTuple):
    """When the shutter is taken for a rolling one."""

    # Frames that are looked at together, at first and once a rolling shutter shows: three take a
    # velocity for steady that changes fast, and the readout time for a tenth shorter.
    coarse: int = 3
    fine: int = 5
    min_features: int = 30  # that they share, with depth
    max_features: int = 80  # of them that are used, before a rolling shutter shows
    steps: int = 2  # of Gauss-Newton, from what three frames before have shown
    longest_s: float = 0.3  # from the middle frame
    least_motion_px: float = 0.5  # of the features, median; fewer show nothing
    least_px: float = 0.02  # error of a pixel, at least
    triples: int = 8  # of frames, before anything is decided
    passes: int = 2  # of as many, each linearised at what the last one has shown
    precise: float = 0.03  # of the readout time, as a standard deviation
    certain: float = 6.0  # standard deviations
    # of the readout time, by what it is off on six rendered rigs with usual errors
    usual: float = 0.1
    least_s: float = 2e-3  # shorter readout times count as none, and smaller differences from one
    # share by which a stated one may be off, which is three times what one that is found is off
    stated: float = 0.3
    # as precise as that, it is known, and a shorter one is none from then on
    sigma_s: float = 0.5e-3
    # after so many looks at every other frame, and at every fifth, every tenth is enough
    often: tuple[int, int] = (20, 40)


_RULES = _ReadoutRules()
MIN_DEPTH_M: Tolerance[float] = 0.05  # of points moved by a velocity that is not fitted yet


class RowShares:
    """When pixels are exposed: their raw row's share of the image, after the middle one."""

    def __init__(self, camera: StereoCamera, rectifier: Rectifier | None) -> None:
        """Prepare for a rectified camera; `rectifier`: of its raw images, None: there are none."""
        self._rows: tuple[IntArray | None, ...] = (None, None)
        heights = (camera.height, camera.height)
        if rectifier is not None:
            last = len(rectifier.cameras) - 1  # virtual right pixels are of the only camera
            self._rows = (rectifier.rows(0), rectifier.rows(last))
            heights = (rectifier.cameras[0].height, rectifier.cameras[last].height)
        self._heights = tuple(int(height or 0) for height in heights)

    @property
    def known(self) -> bool:
        """Whether the height of the images is."""
        return 0 not in self._heights

    def of(self, z: FloatArray) -> FloatArray:
        """Shares (N, 2) of the left and the right pixels (N, 4), -0.5 to 0.5; arbitrary where a
        pixel is.
        """
        shares = np.empty((len(z), 2))
        for camera, (raw, height) in enumerate(zip(self._rows, self._heights, strict=True)):
            rows = z[:, 2 * camera + 1]
            if raw is not None:
                pixels = np.nan_to_num(z[:, 2 * camera : 2 * camera + 2])
                u, v = np.rint(pixels).astype(np.int64).T
                rows = raw[np.clip(v, 0, len(raw) - 1), np.clip(u, 0, raw.shape[1] - 1)]
            shares[:, camera] = (rows - 0.5 * (height - 1)) / height
        return shares


class _Shown(NamedTuple):
    """What frames show: N features of the middle one, and where the M others show them."""

    points: FloatArray  # (M N, 3) in the middle frame, as often as there are others
    share: FloatArray  # (M N,) of their rows there
    z: FloatArray  # (M N, 3) pixels [ul vl ur] in the others, one after the other
    there: FloatArray  # (M N,) shares of their rows
    time_s: FloatArray  # (M N,) of those frames, after the middle one
    others: int


class ReadoutTime(Finder):
    """Learns the readout time of a camera whose calibration states none, or tests a stated one."""

    def __init__(self, camera: StereoCamera, shares: RowShares) -> None:
        """Prepare for frames of a rectified camera, whose heights are known, as it shows them."""
        super().__init__()
        self._camera = camera
        self._shares = shares
        self._frames: list[Observations] = []  # the last ones
        self._waits = 0  # frames before three are looked at again
        self._looked = 0
        self._sums: FloatArray = np.zeros(4)  # number, w, w r, w r^2
        self._motion: FloatArray = np.zeros((2, 6))  # the last velocity, acceleration, ...
        self._stated_s = camera.readout_s
        self._near_s = camera.readout_s  # that equations are linearised at
        self._passes = 1 if camera.readout_s else 0
        self._open = camera.kind != "mono" and shares.known
        self.readout_s = 0.0  # 0 until a rolling shutter is certain

    def frame(self, seen: Observations) -> None:
        """Take the features of the next frame as the camera shows them."""
        if not self._open:
            return
        span = _RULES.fine if self._passes else _RULES.coarse
        self._frames = [*self._frames[1 - _RULES.fine :], seen]
        self._waits -= 1
        if self._waits > 0 or len(self._frames) < span:
            return
        shown = self._shown(self._frames[-span:])
        if shown is None:
            return
        often, seldom = _RULES.often
        near = self._looked < often or (self._passes and not self._stated_s)
        self._waits = 2 if near else 5 if self._looked < seldom else 10
        self._looked += 1
        self._add(shown)
        self._decide(seen)

    def _shown(self, frames: list[Observations]) -> _Shown | None:
        """What frames show, an odd number of them; None: too little."""
        middle = frames.pop(len(frames) // 2)
        time_s = np.array([seen.time_ns - middle.time_ns for seen in frames]) / NS_PER_S
        if np.abs(time_s).max() > _RULES.longest_s:
            return None
        rows = np.full((len(frames), len(middle)), -1)
        use = middle.has_right & ~middle.stale
        for k, other in enumerate(frames):
            mine, theirs = shared_rows(middle.ids, other.ids)
            good = other.has_right[theirs] & ~other.stale[theirs]
            rows[k, mine[good]] = theirs[good]
            use &= rows[k] >= 0
        points, has_depth = triangulate(
            self._camera, middle.z[use], min_disparity_px=DEPTH_DISPARITY_PX
        )
        chosen = use.nonzero()[0][has_depth]
        if len(chosen) < _RULES.min_features:
            return None
        every = 1 if self._passes else -(-len(chosen) // _RULES.max_features)
        chosen = chosen[::every]
        z = np.stack([seen.z[rows[k, chosen]] for k, seen in enumerate(frames)])
        if median(np.abs(z[-1] - z[0])[:, :2].max(axis=1)) < _RULES.least_motion_px:
            return None
        z = z.reshape(-1, 4)
        return _Shown(
            np.tile(points[has_depth][::every], (len(frames), 1)),
            np.tile(self._shares.of(middle.z[chosen])[:, 0], len(frames)),
            z[:, :3],
            self._shares.of(z)[:, 0],
            time_s.repeat(len(chosen)),
            len(frames),
        )

    def _add(self, shown: _Shown) -> None:
        """Add the readout time that frames show, with their velocity and its derivatives."""
        motion = np.zeros((shown.others, 6))
        motion[:2] = self._motion[:2]
        size = motion.size
        near_s = self._near_s
        for _ in range(_RULES.steps):
            normal, gradient, variance = _equations(self._camera, shown, motion, near_s)
            try:
                solved = np.linalg.solve(
                    normal[:size, :size], np.stack((gradient[:size], normal[:size, size]), axis=1)
                )
            except np.linalg.LinAlgError:
                return
            motion = motion + solved[:, 0].reshape(-1, 6)
        if not np.isfinite(motion).all():
            self._motion = np.zeros((2, 6))
            return
        self._motion = motion
        information = normal[size, size] - normal[size, :size] @ solved[:, 1]
        if not information > 0.0:
            return
        readout_s = near_s + (gradient[size] - normal[size, :size] @ solved[:, 0]) / information
        weight = information / max(variance, _RULES.least_px**2)
        self._sums += [1.0, weight, weight * readout_s, weight * readout_s**2]

    def _decide(self, seen: Observations) -> None:
        """Tell a rolling shutter, or that there is none, where that is certain."""
        count, weight, product, squares = self._sums.tolist()
        if count < _RULES.triples:
            return
        found_s = product / weight
        scatter = max((squares - product * found_s) / (count - 1.0), 1.0)
        sigma_s = math.sqrt(scatter / weight)
        step_s = (seen.time_ns - self._frames[-2].time_ns) / NS_PER_S
        is_possible = abs(found_s) < min(1.2 * step_s, MAX_READOUT_S)
        if self._stated_s:
            if is_possible:
                self._test(seen.frame_index, found_s, sigma_s)
            return
        is_clear = abs(found_s) > max(_RULES.least_s, _RULES.certain * sigma_s)
        if not (is_possible and is_clear):
            self._open = sigma_s > _RULES.sigma_s or abs(found_s) > _RULES.least_s
            return
        if not self._is_precise(found_s, sigma_s):
            return
        self.readout_s = found_s
        self._open = False
        figures = _figures(found_s, sigma_s)
        first = "first" if found_s > 0.0 else "last"
        message = (
            f"frame {seen.frame_index}: the shutter rolls, by how features move where the velocity "
            f"changes: rows are exposed one after the other, from the {first} one on, within "
            f"{1e3 * abs(found_s):.1f} +/- {figures['sigma_ms']:.1f} ms; features are moved to the time of "
            f"the middle row from here on; set frontend.readout_ms to {1e3 * found_s:.1f}"
        )
        self._found.append(
            Finding("rolling-shutter", message, seen.frame_index, 0, figures=figures)
        )

    def _is_precise(self, found_s: float, sigma_s: float) -> bool:
        """Whether a readout time is known well enough, by equations linearised at it."""
        if self._passes < _RULES.passes:  # as the equations are not linear
            self._passes += 1
            self._near_s = found_s
            self._sums[:] = 0.0
            return False
        return sigma_s <= max(_RULES.sigma_s, _RULES.precise * abs(found_s))

    def _test(self, index: int, found_s: float, sigma_s: float) -> None:
        """Tell a stated readout time that is another one's, or that it is right."""
        if sigma_s > max(_RULES.sigma_s, _RULES.usual * abs(found_s)):
            return  # nothing to linearise at
        if not self._is_precise(found_s, sigma_s):
            return
        self._open = False
        stated_s = self._stated_s
        longer_s = max(abs(stated_s), abs(found_s))
        limit_s = max(_RULES.least_s, _RULES.certain * sigma_s, _RULES.stated * longer_s)
        if abs(found_s - stated_s) <= limit_s:
            return
        figures = _figures(found_s, sigma_s)
        message = (
            f"frame {index}: the stated readout time of {1e3 * stated_s:.1f} ms does not fit how "
            f"features move where the velocity changes, which shows {1e3 * found_s:.1f} +/- "
            f"{figures['sigma_ms']:.1f} ms (0: a global shutter); correct frontend.readout_ms, or the "
            "calibration that states it"
        )
        self._found.append(Finding("readout-contradicted", message, index, 0, figures=figures))


def _figures(found_s: float, sigma_s: float) -> dict[str, float]:
    """A readout time and its standard deviation, with what is usual on real rigs."""
    return {
        "readout_ms": 1e3 * found_s,
        "sigma_ms": 1e3 * math.hypot(sigma_s, _RULES.usual * found_s),
    }


def moved_by(p: FloatArray, twists: FloatArray) -> FloatArray:
    """Points (N, 3) after their own twists (N, 6)."""
    T = np.tile(np.eye(4), (len(p), 1, 1))
    move_poses(twists, T)
    out: FloatArray = (T[:, :3, :3] @ p[:, :, None])[:, :, 0] + T[:, :3, 3]
    return out


def _equations(
    camera: StereoCamera, shown: _Shown, motion: FloatArray, readout_s: float
) -> NormalEquations:
    """Equations of the points' velocity and its derivatives (M, 6), and of the readout time, the
    last parameter; a feature counts in all frames or in none.
    """
    from_s = readout_s * shown.share
    to_s = shown.time_s + readout_s * shown.there
    orders = np.arange(1, len(motion) + 1)
    factorials = np.cumprod(orders)
    elapsed = (to_s[:, None] ** orders - from_s[:, None] ** orders) / factorials
    there = moved_by(shown.points, elapsed @ motion)
    there[:, 2] = np.maximum(there[:, 2], MIN_DEPTH_M)
    r = shown.z - project(camera, there)[:, :3]
    by_twist = z_D_p_cam(camera, there)[:, :3] @ circledot(there)[:, :3]
    J = np.empty((len(r), 3, motion.size + 1))
    J[:, :, :-1] = (elapsed[:, None, :, None] * by_twist[:, :, None]).reshape(len(r), 3, -1)
    later = to_s[:, None] ** (orders - 1) * shown.there[:, None]
    earlier = from_s[:, None] ** (orders - 1) * shown.share[:, None]
    slope = ((later - earlier) * orders / factorials)[:, 1:] @ motion[1:]
    J[:, :, -1] = (by_twist @ slope[:, :, None])[:, :, 0]
    return cauchy_equations(
        _by_feature(r, shown.others), _by_feature(J, shown.others), _RULES.least_px
    )


def _by_feature(rows: FloatArray, others: int) -> FloatArray:
    """Rows (M N, 3, ...) of M frames, one after the other, as (N, 3 M, ...)."""
    of_frames = rows.reshape(others, -1, *rows.shape[1:])
    return of_frames.swapaxes(0, 1).reshape(of_frames.shape[1], -1, *rows.shape[2:])
