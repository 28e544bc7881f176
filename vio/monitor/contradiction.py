"""Whether the IMU contradicts the images: features are seen far from where it predicts them, frame
after frame.

Innovations over the standard deviations that the filter expects of them are about 1, whatever the
motion is. Wrong axes, extrinsics, stamps or scales of an IMU show in them from the first turn on,
long before enough motion has been seen to tell which of these it is (`vio.monitor.inertial`). A
shock or an object that moves makes single frames stand out. So frames are counted, and what they are
off by is summed, each up to a limit: the more, the fewer frames are needed.
Reference: Page, Continuous inspection schemes, Biometrika (1954), for the sum.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.findings import Finding, begun, ended
from vio.numerics.robust import median


class _ContradictionRules(NamedTuple):
    """When motion sensor and images contradict each other."""

    min_sigmas: float = 4.0  # median innovation over its standard deviation
    newest_frames: int = 24  # the newest, of which …
    # … so many are contradicted. Healthy ones come to 13 of 24 where a flight begins with
    # vibrations that the stated noise lacks and the filter learns (images rendered along MH_03, its
    # real IMU: 7 of the first 8, ATE 0.3 mm); clocks 0.1 s off and an IMU turned by 18 degrees to
    # 21 and more.
    min_frames: int = 20
    # of the sum of the logarithms of ratios over `min_sigmas`; of the healthy ones above, 4.7 at most
    min_sum: float = 8.0
    max_of_a_frame: float = 1.0  # what one frame adds to it at most
    quiet_frames: int = 20  # in a row without one, after which IMU and images agree again


_CONTRADICTION = _ContradictionRules()
_CODE = "imu-disagrees"


class ImuContradiction:
    """Reports once per event that the images contradict the motion by the IMU."""

    def __init__(self) -> None:
        self._ratios = deque[tuple[int, float]](
            maxlen=_CONTRADICTION.newest_frames
        )  # with the numbers of the frames
        self._sum = 0.0  # of what frames are off by, as long as it is positive
        self._sum_since = 0  # the frame from which on it is
        self._quiet = 0  # frames in a row
        self._reported = False

    @property
    def stands(self) -> bool:
        """Whether it was reported that they do, and not yet that they agree again."""
        return self._reported

    def frame(self, index: int, innovation_ratio: float | None) -> list[Finding]:
        """Return what a frame shows.

        Args:
            index: frame number.
            innovation_ratio: as in `UpdateReport`; None: nothing was seen.
        """
        if innovation_ratio is None:
            return []
        self._ratios.append((index, innovation_ratio))
        self._add(index, innovation_ratio)
        is_off = innovation_ratio > _CONTRADICTION.min_sigmas
        self._quiet = 0 if is_off else self._quiet + 1
        if self._reported:
            if self._quiet >= _CONTRADICTION.quiet_frames:
                return self.end(index)
            return []
        off = [(frame, ratio) for frame, ratio in self._ratios if ratio > _CONTRADICTION.min_sigmas]
        if len(off) < _CONTRADICTION.min_frames and self._sum < _CONTRADICTION.min_sum:
            return []
        self._reported = True
        ratio = median(np.array([ratio for _, ratio in off]))
        text = (
            f"in {len(off)} of {len(self._ratios)} frames the features lie "
            f"{ratio:.1f} standard deviations from where the IMU predicts them; check its clock, "
            "axes, units, range and mount (vio check)"
        )
        figures = {"innovation_ratio": ratio}
        if self._sum > 0.0:
            since = min(off[0][0], self._sum_since)
        else:
            since = off[0][0]
        return [begun(_CODE, index, text, since, figures=figures)]

    def _add(self, index: int, ratio: float) -> None:
        """Add what a frame is off by to the sum."""
        off = np.log(max(ratio, 1e-3) / _CONTRADICTION.min_sigmas)
        if self._sum == 0.0:
            self._sum_since = index
        self._sum = max(self._sum + min(float(off), _CONTRADICTION.max_of_a_frame), 0.0)

    def end(self, index: int) -> list[Finding]:
        """Return that the event has ended, if there is one: the IMU agrees again, or is not used."""
        self._ratios.clear()
        self._sum = 0.0
        if not self._reported:
            return []
        self._reported = False
        return [ended(_CODE, index, "the images agree with the predicted motion again")]
