"""Whether another reading of the calibration explains rows that do not agree, during a run."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vio.findings import Finding, begun
from vio.geometry.distortion import StereoRig
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.protocols import RectifyingDataset
from vio.records import Observations

if TYPE_CHECKING:
    from vio.cameras.rig import Rectifier

_ROWS_OFF = ("stereo-calibration-off", "other-calibration")
_CODE = "calibration-misread"


class _FrameRules(NamedTuple):
    """Which frames are looked at."""

    looked_at: tuple[int, ...] = (10, 40)  # frames with matches after which readings are tried
    most: int = 20  # whose matches are kept


_FRAMES = _FrameRules()


def pair_as_read(dataset: object) -> tuple[StereoRig, StereoCamera] | None:
    """Return the raw pair of a recording and the camera that it is rectified to; None: its images
    are rectified already, or those of one camera.
    """
    return raw_pair(dataset.rectifier) if isinstance(dataset, RectifyingDataset) else None


def raw_pair(rectifier: Rectifier) -> tuple[StereoRig, StereoCamera] | None:
    """Return the raw pair that is rectified, and the rectified camera; None: nothing is rectified,
    or one camera.
    """
    lenses = rectifier.lenses
    if rectifier.maps is None or not isinstance(lenses, StereoRig):
        return None
    return lenses, rectifier.camera


class ReadingCheck:
    """Tries other readings once rows of left and right were found to differ."""

    def __init__(self, rig: StereoRig, rectified: StereoCamera) -> None:
        """Begin.

        Args:
            rig: as the calibration was read.
            rectified: the camera that it was rectified to.
        """
        self._rig = rig
        self._rectified = rectified
        self._matches = deque[FloatArray](maxlen=_FRAMES.most)
        self._frames = 0
        self._looked = 0

    def frame(self, seen: Observations, findings: Sequence[Finding]) -> Finding | None:
        """Return the finding after a frame, by its matches and by what was found so far."""
        self._matches.append(seen.z[seen.has_right])
        self._frames += 1
        due = _FRAMES.looked_at[self._looked :]
        if not due or self._frames < due[0]:
            return None
        codes = {finding.code for finding in findings}
        if _CODE in codes or not codes & set(_ROWS_OFF):
            return None
        self._looked += 1
        from vio.calibration.readings import other_reading  # few runs need it

        found = other_reading(self._rig, self._rectified, np.concatenate(self._matches))
        if found is None:
            return None
        figures = {"rows_rms_px": found.rms_px, "other_rms_px": found.other_px}
        index = seen.frame_index
        return begun(_CODE, index, str(found), 0, figures=figures)
