"""What a recording of a board still lacks, while it is made.

No calibration is known yet: the tilt of the board is that of its foreshortening around its middle,
by square pixels, and its direction that in which the board's scale falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.robust import median
from vio.records import NS_PER_S, Image, ImuSample
from vio.targets.corners import CornerDetector, Corners
from vio.targets.description import Target
from vio.targets.homography import derivative, homographies, mapped
from vio.targets.verdict import CELLS, MIN_CORNERS, MIN_TILT_DEG, corners_by_part, part_name

ENOUGH_VIEWS = 30


class _ViewRules(NamedTuple):
    """What the views of a board must show."""

    min_cell_corners: int = 12  # in a part of an image
    min_tilted_views: int = 3  # views, in each direction
    min_scale_ratio: float = 1.6  # of the nearest view over the farthest
    min_moved_share: float = 0.04  # of the image's width, from each earlier view


_VIEWS = _ViewRules()


class _ImuRules(NamedTuple):
    """What the IMU must feel."""

    min_turn_radps: float = 0.4  # standard deviation of each of the gyro's axes
    min_s: float = 30.0


_IMU = _ImuRules()
_GYRO_NS = NS_PER_S // 20  # between samples that are kept
_SIDES = ("right", "lower", "left", "upper")  # of the board as it appears, that recede


@dataclass(frozen=True, slots=True)
class Lacks:
    """What a recording lacks."""

    views: int  # that were counted
    together: int  # of these, seen by both cameras
    wanted: tuple[str, ...]  # what to do, the most important first; empty: it is enough

    def __str__(self) -> str:
        if not self.wanted:
            return f"enough: {self.views} views, nothing is missing"
        return f"{self.views} of {ENOUGH_VIEWS} views: {'; '.join(self.wanted)}"


class Guidance:
    """Counts the views of a board, and what they show."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._detector = CornerDetector(target)
        self._views: list[tuple[Corners, ...]] = []
        self._sizes: list[tuple[int, int]] = []  # width and height of each camera's images
        self._cells: list[FloatArray] = []  # corners in each part of each camera's image
        self._tilts_deg: list[FloatArray] = []  # of the right and the lower side away
        self._scales: list[float] = []  # pixels per metre
        self._gyro: list[FloatArray] = []  # rad/s, of one sample in `_GYRO_NS`
        self._gyro_ns: list[int] = []

    def add_sample(self, sample: ImuSample) -> None:
        """Take a sample of the IMU."""
        if not self._gyro_ns or sample.time_ns - self._gyro_ns[-1] >= _GYRO_NS:
            self._gyro.append(sample.gyro)
            self._gyro_ns.append(sample.time_ns)

    def add_images(self, images: Sequence[Image]) -> bool:
        """Look at the images (H, W) of one moment; return whether they are a new view."""
        if not self._sizes:
            self._sizes = [(image.shape[1], image.shape[0]) for image in images]
            self._cells = [np.zeros(CELLS**2) for _ in images]
        found = tuple(self._detector.detect(image) for image in images)
        if max(map(len, found)) < MIN_CORNERS or not self._is_new(found):
            return False
        self._views.append(found)
        for cells, corners, size in zip(self._cells, found, self._sizes, strict=True):
            cells += corners_by_part(corners.uv, *size)
        best = max(found, key=len)
        tilt, scale = self._tilt_and_scale(best)
        self._tilts_deg.append(tilt)
        self._scales.append(scale)
        return True

    def lacks(self) -> Lacks:
        """Return what is missing now."""
        together = sum(min(map(len, view)) >= MIN_CORNERS for view in self._views)
        count = len(self._views)
        wanted: list[str] = []
        if not count:
            wanted.append("show the board to the cameras, larger and well lit")
            return Lacks(0, 0, tuple(wanted))
        if len(self._sizes) > 1 and together < count // 2:
            wanted.append("show the board to both cameras at once")
        wanted += [*self._empty_parts(), *self._missing_tilts(), *self._missing_distances()]
        if count < ENOUGH_VIEWS and not wanted:
            wanted.append("go on, slowly, at other places and tilts")
        wanted += self._missing_motion()
        return Lacks(count, together, tuple(wanted))

    def _is_new(self, found: tuple[Corners, ...]) -> bool:
        for view in self._views:
            moved: list[float] = []
            for new, old, (width, _) in zip(found, view, self._sizes, strict=True):
                _, mine, its = np.intersect1d(new.ids, old.ids, return_indices=True)
                if len(mine) >= MIN_CORNERS // 2:
                    apart = np.linalg.norm(new.uv[mine] - old.uv[its], axis=1)
                    moved.append(median(apart) / width)
            if moved and max(moved) < _VIEWS.min_moved_share:
                return False
        return True

    def _tilt_and_scale(self, corners: Corners) -> tuple[FloatArray, float]:
        """Tilt (2,) in degrees, of the right and the lower side away, and pixels per metre."""
        board = self._target.points_m[corners.ids]
        H = homographies(board[None], corners.uv[None])
        middle = board.mean(axis=0)[None]
        uv = mapped(H, middle[None])[0]
        U, s, _ = np.linalg.svd(derivative(H, middle, uv)[0])
        direction = U[:, 1]
        # The board recedes to where it is drawn smaller: the horizon lies there.
        step = 0.25 * float(np.ptp(board, axis=0).max())
        back = np.linalg.inv(H[0])
        toward = np.array([*(uv[0] + direction), 1.0]) @ back.T
        along = toward[:2] / toward[2] - middle[0]
        along *= step / max(float(np.linalg.norm(along)), 1e-12)
        ends = np.stack([middle[0] + along, middle[0] - along])
        areas = np.linalg.det(derivative(np.repeat(H, 2, axis=0), ends, mapped(H, ends[None])[0]))
        sign = 1.0 if areas[0] < areas[1] else -1.0
        tilt_deg = float(np.degrees(np.arccos(np.clip(s[1] / s[0], 0.0, 1.0))))
        return np.asarray(sign * tilt_deg * direction), float(s[0])

    def _empty_parts(self) -> list[str]:
        out: list[str] = []
        names: tuple[str, ...] = ("image",)
        if len(self._sizes) > 1:
            names = ("left image", "right image")
        for name, cells in zip(names, self._cells, strict=True):
            empty = [part_name(k) for k in np.flatnonzero(cells < _VIEWS.min_cell_corners).tolist()]
            if empty:
                out.append(f"the {name} is empty at {', '.join(empty)}")
        return out

    def _missing_tilts(self) -> list[str]:
        tilts = np.array(self._tilts_deg)
        tilted = np.concatenate([tilts, -tilts], axis=1)
        few = np.sum(tilted > MIN_TILT_DEG, axis=0) < _VIEWS.min_tilted_views
        missing = [side for side, lacks in zip(_SIDES, few.tolist(), strict=True) if lacks]
        return (
            [f"tilt the board, its {' and then its '.join(missing)} side away"] if missing else []
        )

    def _missing_distances(self) -> list[str]:
        scales = np.array(self._scales)
        if scales.max() > _VIEWS.min_scale_ratio * scales.min():
            return []
        return ["show it from nearer and from farther away"]

    def _missing_motion(self) -> list[str]:
        if not self._gyro:
            return []
        out: list[str] = []
        seconds = (self._gyro_ns[-1] - self._gyro_ns[0]) / NS_PER_S
        turning = np.array(self._gyro).std(axis=0)
        slow = [
            axis
            for axis, rate in zip("xyz", turning.tolist(), strict=True)
            if rate < _IMU.min_turn_radps
        ]
        if slow:
            out.append(f"turn the rig to and fro about the IMU's {', '.join(slow)}")
        if seconds < _IMU.min_s:
            out.append(f"record {_IMU.min_s - seconds:.0f} s more for the IMU")
        return out
