"""Whether so few features carry the motion that nothing tells the scene from what moves on its own.

Before a blank wall, in the dark or in fog a handful of features is left. A person that walks by
then has as many, fits a motion as well as the scene does, and no consensus, vote or gate can tell.
With a motion sensor the prediction does. By images alone the motion of such frames may be that of
the person. ORB-SLAM3 takes a frame with fewer than 30 matches of its map for lost.
"""

from __future__ import annotations

from typing import NamedTuple

from vio.findings import Finding, begun, ended
from vio.records import UpdateReport


class _FewRules(NamedTuple):
    """When features are few."""

    # In rendered and real recordings of all rigs, three frames in a row have 46 and more. Before a
    # blank wall with people 10 to 23, and a motion off by 4 degrees that is stated to 0.9.
    least: int = 25
    frames: int = 3  # in a row


_FEW = _FewRules()
_CODE = "few-features"


class FewFeatures:
    """Reports that few features carry the motion, and when they are enough again."""

    def __init__(self) -> None:
        self._begun = False  # whether there have been enough
        self._since = 0  # first frame of those in a row with few, or with enough again
        self._count = 0  # of these
        self._few = False  # as it was reported

    def frame(self, index: int, report: UpdateReport, *, measured: bool) -> list[Finding]:
        """Return what a frame shows; `measured`: whether a motion sensor carries the pose."""
        if report.used == 0:
            return []  # of a prediction, the covariance tells
        few = report.used < _FEW.least and not measured
        self._begun = self._begun or not few
        if not self._begun or few == self._few:
            self._count = 0
            return []
        if self._count == 0:
            self._since = index
        self._count += 1
        if self._count < _FEW.frames:
            return []
        self._few = few
        self._count = 0
        if not few:
            return [ended(_CODE, index, "enough features again")]
        text = (
            f"fewer than {_FEW.least} features carry the motion since frame "
            f"{self._since}, too few to tell the scene from what moves on its own: more light or "
            "texture, a wider lens, or a motion sensor would"
        )
        # the motion may be another's altogether
        figures = {"used": float(report.used), "doubted_share": 1.0}
        return [begun(_CODE, index, text, self._since, figures=figures)]
