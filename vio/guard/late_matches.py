"""Right pixels of another frame, by how their rows move; see `vio.frontend.right_delay`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.findings import Finding
from vio.frontend.right_delay import RightDelay
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.match_check import MatchCheck, SharedMatches, without_right
from vio.records import Observations

# frames from the start: a delay of whole frames that is found so early was there all the time
_FROM_THE_START = 40


class LateMatches(MatchCheck):
    """Takes the delay of the right camera out of its pixels, at first order.

    A recording of features whose right pixels are a whole frame late or early from the start is
    paired anew instead, by the finding `pairs-shifted`. The rows of late ones differ by the motion
    in the last frame, those of early ones by that in the next: the two are learned apart, as points
    that come near move more from frame to frame.
    """

    def __init__(self, camera: StereoCamera) -> None:
        super().__init__()
        self._delay = RightDelay(camera, keeps_images=False)
        self._early = RightDelay(camera, keeps_images=False)  # by the motion in the next frame
        self._frames = 0
        self._named_pairs = False  # another pairing was named: one that is another again is not
        self._is_early = False  # right pixels were a whole frame early from the start

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Learn from the rows of a frame, and return its right pixels as they are now."""
        self._frames += 1
        left = shared.now[:, :2]
        flow = left - shared.before[:, :2]
        rows = shared.now[:, 3] - shared.now[:, 1]
        if not self._is_early:
            self._delay.update(seen.frame_index, left, flow, rows, shared.seconds)
            found = self._delay.take_findings()
            early = self._found_early(seen.frame_index, shared, flow)
            if early and self._early.explained > self._delay.explained:
                self._is_early = True
                self._delay.know(-1)
                found = early
            self._found += [self._paired_anew(f) for f in found]
        delay = self._delay.frames
        if delay == 0.0:
            return seen
        dropped = np.ones(len(seen), dtype=np.bool_)
        dropped[shared.rows] = False
        z = seen.z.copy()
        # those that are a whole frame early came with the frame before
        right = shared.now[:, 2:] + delay * (shared.now - shared.before)[:, 2:]
        z[shared.rows, 2:] = shared.before[:, 2:] if delay == -1.0 else right
        return without_right(replace(seen, z=z), dropped)

    def _found_early(
        self, index: int, shared: SharedMatches, flow: FloatArray
    ) -> tuple[Finding, ...]:
        """Learn from the rows of the frame before; return what is found where its right pixels, as
        those before, were a whole frame early.

        Args:
            index: frame number.
            shared: features of this frame and the one before.
            flow: motion (N, 2) of their left pixels from the one to the other.
        """
        if self._frames > _FROM_THE_START or self._named_pairs:
            return ()
        before = shared.before
        rows = before[:, 3] - before[:, 1]
        self._early.update(index, before[:, :2], flow, rows, shared.seconds)
        found = self._early.take_findings()
        return found if self._early.frames == -1.0 else ()

    def _paired_anew(self, found: Finding) -> Finding:
        """Return a finding as one of wrong pairs, where it is one."""
        delay = found.figures.get("delay_frames", 0.0)
        whole = abs(self._delay.frames) == 1.0
        if found.ended or not whole or self._frames > _FROM_THE_START:
            return found
        self._named_pairs = True
        which = "before" if delay > 0 else "after"
        message = (
            f"frame {found.frame}: the right pixels belong to the left ones of the frame {which}, "
            "by how their rows move; the poses so far are wrong; pair the images by their times of "
            "exposure"
        )
        figures = {"delay_frames": self._delay.frames}
        return Finding("pairs-shifted", message, found.frame, 0, figures=figures)
