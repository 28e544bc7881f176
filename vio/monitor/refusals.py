"""Features that the filter refuses: where they are many, what their place in the image and the innovations tell."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from vio.calibration.severity import rows_grade
from vio.numerics.robust import median
from vio.records import BoolArray, Estimate, IntArray, Observations, UpdateReport

_SPAN_S, _LEAST_FRAMES = 1.0, 3
_MOST_REFUSED = 0.4  # of the features over the span; healthy recordings come to a third at most
_CELLS = 6, 4  # columns and rows that the image is divided into
_TOGETHER = 0.2  # of the features, at most, where half of those refused are: then they lie together
_CONTRADICTED = 2.0  # innovations over their standard deviation: more, and the motion sensor contradicts the images


@dataclass(frozen=True, slots=True)
class _Frame:
    time_ns: int
    used: int
    gated: int
    seen: Observations  # its features
    refused_ids: IntArray  # of those refused
    innovation_ratio: float | None

    def refused(self) -> BoolArray:
        """Which features (N,) were refused."""
        return np.isin(self.seen.ids, self.refused_ids)


class RefusalReport:
    """Reports once that many features are refused over a second, with the likeliest cause."""

    def __init__(self, *, imu: bool) -> None:
        """Begin; `imu`: whether an IMU predicts the motion."""
        self.imu, self._reported = imu, False
        self._frames: deque[_Frame] = deque()

    def frame(self, seen: Observations, report: UpdateReport, estimate: Estimate) -> list[str]:
        """Add the features of a frame and what the filter did with them; return the line to report, if any."""
        if self._reported:
            return []
        used, gated = report.used, report.gated
        self._frames.append(_Frame(seen.time_ns, used, gated, seen, report.gated_ids, report.innovation_ratio))
        full = False
        while seen.time_ns - self._frames[0].time_ns >= _SPAN_S * 1e9:
            self._frames.popleft()
            full = True
        kept, gone = sum(f.used for f in self._frames), sum(f.gated for f in self._frames)
        if not full or len(self._frames) < _LEAST_FRAMES or gone <= _MOST_REFUSED * (kept + gone):
            return []
        self._reported = True
        return [
            f"frame {seen.frame_index}: {100 * gone / (kept + gone):.0f} % of the features of the last second were "
            f"refused, as they contradict the others: {self._cause(estimate)}"
        ]

    def _cause(self, estimate: Estimate) -> str:
        """The likeliest cause by the evidence."""
        ratios = [f.innovation_ratio for f in self._frames if f.innovation_ratio is not None]
        ratio = median(ratios) if ratios else 0.0
        if self.imu and ratio > _CONTRADICTED:
            return (
                f"the images show features {ratio:.1f} standard deviations beside where the IMU predicts them; "
                "check the IMU, its clock and its place on the camera (vio check)"
            )
        place = self._place()
        if place is not None:
            return f"most lie together {place}; something moves there, or a lens is dirty"
        where = "they are spread over the image; " if any(f.refused().any() for f in self._frames) else ""
        field = estimate.stereo_field
        if field is not None and rows_grade(field.rows_rms_px) != "negligible":
            return (
                f"{where}rows differ by {field.rows_rms_px:.2f} px (rms) in a smooth pattern; "
                "calibrate the cameras (vio calibrate)"
            )
        return f"{where}blurred images, repeated texture, or many things that move"

    def _place(self) -> str | None:
        """Where in the image half of the refused features lie with few others; None: they are spread."""
        pixels = np.concatenate([f.seen.z[:, :2] for f in self._frames])
        refused = np.concatenate([f.refused() for f in self._frames])
        if not refused.any():
            return None
        low, size = pixels.min(axis=0), np.maximum(np.ptp(pixels, axis=0), 1.0)
        cells = np.minimum(((pixels - low) / size * _CELLS).astype(np.int64), np.array(_CELLS) - 1) @ [_CELLS[1], 1]
        total = np.bincount(cells, minlength=_CELLS[0] * _CELLS[1])
        count = np.bincount(cells[refused], minlength=len(total))
        order = np.argsort(-count / np.maximum(total, 1), kind="stable")
        half = 1 + np.searchsorted(np.cumsum(count[order]), count.sum() / 2)
        if total[order[:half]].sum() > _TOGETHER * total.sum():
            return None
        u, v = np.median(pixels[refused & np.isin(cells, order[:half])], axis=0)
        return f"in the image, around ({u:.0f}, {v:.0f})"
