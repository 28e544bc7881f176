"""Whether what stays in its place since the first frame is a part of the rig, in front of a scene that
moves.

An arm, a bonnet or the cabin around a camera may show more features than the scene. Then they win
the consensus of each frame, the scene's are left out as outliers, and the rig seems to stand still.
At standstill objects move, too, but those are nearer than the scene behind them.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.findings import Finder, Finding
from vio.frontend.outliers import Consensus, RansacProblem, best_motion, pixel_errors
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import depth_of
from vio.numerics.robust import median
from vio.records import BoolArray


class _RigRules(NamedTuple):
    """When points that stay at their pixels are of the rig."""

    still_px: float = 0.5  # median, by which they move in a frame at most
    moved_frames: int = (
        5  # in which the consensus moves by more, before it is known to be the scene
    )
    min_points: int = 12  # of the outliers, that follow another motion
    min_share: float = 0.05  # of all points
    rigid_share: float = 0.6  # of the outliers
    nearer: float = 0.8  # depth of the points that stay, over that of the others, at most
    recent_frames: int = 10
    frames: int = 5  # of them, in which this holds


_RIG = _RigRules()
_CODE = "rig-in-view"
_STILL = np.eye(4)


class RigInView(Finder):
    """Reports that the consensus may be that of parts of the rig, until it moves."""

    def __init__(self) -> None:
        super().__init__()
        self._moved = 0  # frames in which the consensus moves
        self._recent = deque[bool](maxlen=_RIG.recent_frames)
        self._reported = False

    def see(
        self,
        index: int,
        problem: RansacProblem,
        p_prev: FloatArray,
        pixels: FloatArray,
        found: Consensus,
        measured: FloatArray | None,
    ) -> None:
        """Take the consensus over points (N, 3) of the frame before and pixels (N, 2), and the motion
        (4, 4) that a sensor measures; None: none does.
        """
        if self._moved >= _RIG.moved_frames:
            return
        flow_px = pixel_errors(problem.camera, _STILL, p_prev, pixels)
        stays = found.inliers
        if not stays.any() or median(flow_px[stays]) > _RIG.still_px:
            self._moves(index)
            return
        scene = ~stays & (flow_px > problem.limit_px)
        behind = self._is_behind(problem, p_prev, pixels, stays, scene)
        if behind and measured is not None:
            off_px = pixel_errors(problem.camera, measured, p_prev[stays], pixels[stays])
            behind = median(off_px) > problem.limit_px  # else it stands still, by the sensor
        self._recent.append(behind)
        if not self._reported and sum(self._recent) >= _RIG.frames:
            self._report(index, float(scene.mean()))

    def _is_behind(
        self,
        problem: RansacProblem,
        p_prev: FloatArray,
        pixels: FloatArray,
        stays: BoolArray,
        scene: BoolArray,
    ) -> bool:
        """Whether points (N,) that move follow one motion, behind those that stay."""
        count = int(scene.sum())
        if count < max(_RIG.min_points, _RIG.min_share * len(scene)):
            return False
        depth = depth_of(problem.camera, p_prev)
        if median(depth[stays]) > _RIG.nearer * median(depth[scene]):
            return False
        _, follows = best_motion(problem, p_prev[scene], pixels[scene], _STILL[None])
        return int(follows.sum()) >= max(_RIG.min_points, _RIG.rigid_share * count)

    def _moves(self, index: int) -> None:
        self._moved += 1
        if self._reported and self._moved >= _RIG.moved_frames:
            message = (
                f"frame {index}: the points that stayed at the same pixels are not used any more"
            )
            self._found.append(Finding(_CODE, message, index, ended=True))

    def _report(self, index: int, share: float) -> None:
        self._reported = True
        message = (
            f"frame {index}: {100 * share:.0f} % of the points move together, behind others that have "
            "stayed at the same pixels since the first frame: parts of the rig are taken for the "
            "scene, or a rig that stands still looks at something that moves behind it"
        )
        figures = {"scene_share": share}
        self._found.append(Finding(_CODE, message, index, 0, lasts=True, figures=figures))
