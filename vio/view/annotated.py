"""One annotated image of a run: its features, coloured by their disparity, each with a stroke as
long as that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.numerics.robust import quantile
from vio.records import FrameResult, Observations, StereoFrame


class _PictureRules(NamedTuple):
    """How the picture is drawn."""

    width_px: int = 1240  # of the picture; larger images are made smaller
    quality: int = 85  # of the JPEG
    bar_px: int = 26  # height of the legend
    legend_px: int = 480  # least width of an image with one


_PICTURE = _PictureRules()


class AnnotatedImage:
    """A viewer that keeps the image half-way through a run with the features seen in it."""

    def __init__(self, frames: int) -> None:
        """Take the frame in the middle of so many, or the first one with images after it."""
        self._left = frames // 2
        self._kept: tuple[StereoFrame, Observations] | None = None

    def frame(self, result: FrameResult) -> None:
        """Keep the image of a frame until that of the middle is there."""
        if result.frame.left is not None and (self._kept is None or self._left >= 0):
            self._kept = (result.frame, result.output.observations)
        self._left -= 1

    def skip(self, frames: int) -> None:
        """Count frames that an earlier process has done."""
        self._left -= frames

    def close(self) -> None:
        """Do nothing; the image is kept."""

    def jpeg(self) -> bytes | None:
        """Return the picture as JPEG; None: the run had no images."""
        if self._kept is None:
            return None
        import cv2

        frame, seen = self._kept
        assert frame.left is not None
        zoom = min(1.0, _PICTURE.width_px / frame.left.shape[1])
        image = cv2.cvtColor(frame.left, cv2.COLOR_GRAY2BGR)
        image = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
        disparity = np.where(seen.has_right, seen.z[:, 0] - seen.z[:, 2], 0.0)
        known = disparity[seen.has_right & (disparity > 0)]
        low = quantile(known, 0.02) if len(known) else 1.0
        high = quantile(known, 0.98) if len(known) else 2.0
        share = np.log(np.maximum(disparity, 1e-3) / low) / max(np.log(high / low), 1e-6)
        colours = _coloured(np.clip(share, 0, 1))
        for (u, v), long, colour, has_right in zip(
            zoom * seen.z[:, :2], zoom * disparity, colours.tolist(), seen.has_right, strict=True
        ):
            at = (round(16 * u), round(16 * v))
            colour = colour if has_right else (160, 160, 160)
            cv2.line(image, at, (round(16 * (u - long)), at[1]), colour, 1, cv2.LINE_AA, shift=4)
            cv2.circle(image, at, 16 * 3, colour, -1 if has_right else 1, cv2.LINE_AA, shift=4)
        if image.shape[1] >= _PICTURE.legend_px:
            image = np.vstack([image, _legend(image.shape[1], float(low), float(high))])
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _PICTURE.quality])
        return data.tobytes() if done else None


def _coloured(share: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) BGR from far (blue) to near (red) of shares (N,) within 0 and 1."""
    import cv2

    if not len(share):
        return np.zeros((0, 3), np.uint8)
    return cv2.applyColorMap((255 * share).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO).reshape(
        -1, 3
    )


def _legend(width: int, low: float, high: float) -> np.ndarray:
    """Return a bar (H, width, 3) with the colours and their disparities."""
    import cv2

    bar = np.full((_PICTURE.bar_px, width, 3), 255, np.uint8)
    scale = slice(width // 2, width - 90)
    bar[6:-6, scale] = _coloured(np.linspace(0, 1, scale.stop - scale.start))
    texts = ((8, "disparity (strokes: to scale)"), (scale.start - 60, f"{low:.1f} px"))
    for x, text in (*texts, (scale.stop + 8, f"{high:.0f} px")):
        cv2.putText(
            bar, text, (x, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA
        )
    return bar
