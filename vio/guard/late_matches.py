"""Right pixels of another frame, by how their rows move; see `vio.frontend.right_delay`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.findings import Finding
from vio.frontend.right_delay import RightDelay
from vio.geometry.stereo import StereoCamera
from vio.guard.match_check import MatchCheck, SharedMatches, without_right
from vio.records import Observations

# frames from the start: a delay of whole frames that is found so early was there all the time
_FROM_THE_START = 40


class LateMatches(MatchCheck):
    """Takes the delay of the right camera out of its pixels, at first order.

    A recording of features whose right pixels are a whole frame late or early from the start is
    paired anew instead, by the finding `pairs-shifted`.
    """

    def __init__(self, camera: StereoCamera) -> None:
        super().__init__()
        self._delay = RightDelay(camera, keeps_images=False)
        self._frames = 0

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Learn from the rows of a frame, and return its right pixels as they are now."""
        self._frames += 1
        left = shared.now[:, :2]
        flow = left - shared.before[:, :2]
        rows = shared.now[:, 3] - shared.now[:, 1]
        self._delay.update(seen.frame_index, left, flow, rows, shared.seconds)
        self._found += [self._paired_anew(f) for f in self._delay.take_findings()]
        delay = self._delay.frames
        if delay == 0.0:
            return seen
        dropped = np.ones(len(seen), dtype=np.bool_)
        dropped[shared.rows] = False
        z = seen.z.copy()
        z[shared.rows, 2:] += delay * (shared.now - shared.before)[:, 2:]
        return without_right(replace(seen, z=z), dropped)

    def _paired_anew(self, found: Finding) -> Finding:
        """Return a finding as one of wrong pairs, where it is one."""
        delay = found.figures.get("delay_frames", 0.0)
        whole = abs(self._delay.frames) == 1.0
        if found.ended or not whole or self._frames > _FROM_THE_START:
            return found
        which = "before" if delay > 0 else "after"
        message = (
            f"frame {found.frame}: the right pixels belong to the left ones of the frame {which}, "
            "by how their rows move; the poses so far are wrong; pair the images by their times of "
            "exposure"
        )
        figures = {"delay_frames": self._delay.frames}
        return Finding("pairs-shifted", message, found.frame, 0, figures=figures)
