"""What is said of objects that cover much of the image, and whether they hide the scene."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import NamedTuple

from vio.findings import Finder, Finding
from vio.frontend.columns import share_of
from vio.frontend.expected_motion import AGREEMENT_LIMIT, ExpectedMotion
from vio.frontend.moving_object import CLEARLY_NEARER, MIN_POINTS, STATIC_FRAMES, TwoMotions
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, MotionPrior


class _EventRules(NamedTuple):
    """When an object is an event that is reported, and when it hides the scene."""

    frames: int = 5  # in a row before an object is reported …
    # … or so many of the last ones, where a decision was made: a slow one is seen in some of them
    # only
    recent_frames: int = 15
    known_frames: int = 2  # in a row before an object is known, and may hide the scene
    # of the points that the scene has, during an event, below which the object hides it …
    hidden_share: float = 0.1
    hidden_frames: int = 3  # … in so many frames in a row
    clear_frames: int = 20  # without one before the next is another event
    # in a row whose motion no older points prove, before what is seen may be the object alone
    unproven_frames: int = 3


_EVENT = _EventRules()


class ObjectReport(Finder):
    """Reports once per event that an object covers much of the image, and what decided which
    motion is the camera's.
    """

    def __init__(self) -> None:
        super().__init__()
        # squared distances from the prediction of motions that older points support
        self._usual = deque[float](maxlen=_EVENT.clear_frames)
        self._frames = 0  # with an object, in a row
        self._since = 0  # the first of them
        # points that are older than this frame are of the scene
        self._event_since = 0
        self._decided = deque[int]()  # recent frames in which it was told from the scene
        self._clear = 0  # without one, in a row
        self._proven = 0  # without one, and with a motion that is proven, in a row
        self._unproven = 0  # whose motion is not, in a row
        self._hidden = 0  # that an object hides, in a row
        self._reported: str | None = None  # code of the event that goes on
        self._hidden_reported = False
        self._active = False

    @property
    def active(self) -> bool:
        """Whether the prediction has distinguished an object from the scene in some of the last
        frames.
        """
        return self._active

    @property
    def since(self) -> int | None:
        """The frame than which points of the scene are older, of the event that goes on; None:
        there is none.
        """
        return self._event_since if self._reported is not None else None

    def prove(self, index: int) -> None:
        """Take that points which are older than a frame are of the scene."""
        self._event_since = max(self._event_since, index)

    def questioned(
        self,
        motions: TwoMotions,
        camera: StereoCamera,
        p_prev: FloatArray,
        predicted: MotionPrior,
        voting: BoolArray,
        disparity_error_px: float,
    ) -> TwoMotions:
        """Return the motions of a frame, as unsupported ones where the camera's is far off an
        extrapolated prediction, and no older point supports it.

        Arguments as of `choose_motion`; the camera's motion is the only one.
        """
        motion = motions.motion
        expected = ExpectedMotion(camera, predicted, disparity_error_px)
        supported = int((motion.inliers & voting).sum()) >= MIN_POINTS
        limit = (
            AGREEMENT_LIMIT if supported else CLEARLY_NEARER * max([AGREEMENT_LIMIT, *self._usual])
        )
        distance = 0.0
        if expected.is_beyond(motion.T_curr_prev, limit):
            distance = expected.distance(motion.T_curr_prev, p_prev[motion.inliers])
        if supported:
            self._usual.append(distance)
        if supported or not self._usual or distance <= limit:
            return motions
        return replace(motions, object_share=share_of(motion.inliers), decision="unsupported")

    def hides_scene(self, index: int, motions: TwoMotions) -> bool:
        """Return whether a known object has left too few points of the scene for some frames, so
        that none is used.
        """
        hidden = self._active and float(motions.motion.inliers.mean()) < _EVENT.hidden_share
        self._hidden = self._hidden + 1 if hidden else 0
        if self._hidden >= _EVENT.hidden_frames and not self._hidden_reported:
            self._hidden_reported = True
            message = (
                f"frame {index}: fewer than {100 * _EVENT.hidden_share:.0f} % of the points are left of "
                "the scene: the object hides it, and no feature is used"
            )
            self._found.append(Finding("object-hides-scene", message, index, lasts=True))
        return self._hidden >= _EVENT.hidden_frames

    def lost(self, index: int, last: int) -> None:
        """Report that the points of the scene are gone since a frame `last`, though the motion so
        far would still show them.
        """
        self._event_since = last + 1
        message = (
            f"frame {index}: the points of frame {last} are gone, and its motion would still show "
            "them: something hides the scene, or the rig was turned or pushed; what is seen is "
            "taken for the scene"
        )
        self._begin_doubt(index, last + 1, message, {})

    def frame(self, index: int, motions: TwoMotions, *, proven: bool = True) -> None:
        """Take the motions of a frame; `proven`: a sensor, or points that are older than the event
        that goes on, show that the chosen one is the camera's.
        """
        self._question(index, proven=proven)
        if motions.object_share == 0.0:
            self._no_object(index, proven=proven)
            return
        self._proven = 0
        if self._frames == 0:
            self._since = index
        self._frames = self._frames + 1
        self._clear = 0
        if motions.decision == "unsupported":
            self._report_unsupported(index, motions)
            return
        undecided = motions.decision == "undecided"
        self._active = self._active or (self._frames >= _EVENT.known_frames and not undecided)
        if not undecided:
            self._decided.append(index)
        while self._decided and self._decided[0] <= index - _EVENT.recent_frames:
            self._decided.popleft()
        often = not undecided and len(self._decided) >= _EVENT.frames
        if often:
            self._since = min(self._since, self._decided[0])
        if (often or self._frames >= _EVENT.frames) and self._reported is None:
            self._report(index, motions)

    def _question(self, index: int, *, proven: bool) -> None:
        """Report that what is seen may be the object alone, where it has hidden the scene."""
        self._unproven = 0 if proven or self._reported is None else self._unproven + 1
        if self._unproven < _EVENT.unproven_frames or self._reported == "object-or-scene":
            return
        message = (
            f"frame {index}: hardly a point is left that is older than the object: the scene was "
            "hidden, and what is seen may be the object alone; it is taken for the scene"
        )
        self._begin_doubt(index, index - self._unproven + 1, message, {})

    def _no_object(self, index: int, *, proven: bool) -> None:
        self._frames = 0
        self._clear = self._clear + 1
        self._proven = self._proven + 1 if proven else 0
        self._active = self._active and self._clear < _EVENT.frames
        if self._reported is None or self._proven < _EVENT.clear_frames:
            return
        message = f"frame {index}: no object covers much of the image any more"
        self._found.append(Finding(self._reported, message, index, ended=True))
        if self._hidden_reported:
            self._found.append(Finding("object-hides-scene", message, index, ended=True))
        self._reported = None
        self._hidden_reported = False

    def _report_unsupported(self, index: int, motions: TwoMotions) -> None:
        self._event_since = index - STATIC_FRAMES
        if self._reported == "object-or-scene":
            return
        share = round(100 * motions.object_share)
        message = (
            f"frame {index}: {share} % of the points move as the rig did not before, and hardly "
            "one of them was seen before: the rig was pushed, or an object hides the scene; they "
            "are taken for the scene"
        )
        self._begin_doubt(index, index, message, {"object_share": motions.object_share})

    def _begin_doubt(self, index: int, since: int, message: str, figures: dict[str, float]) -> None:
        """Report that nothing tells whether what is seen is the scene, in place of what was
        reported before.
        """
        if self._reported is not None:
            self._found.append(
                Finding(self._reported, f"frame {index}: see below", index, ended=True)
            )
        self._reported = "object-or-scene"
        self._found.append(
            Finding(self._reported, message, index, since, lasts=True, figures=figures)
        )

    def _report(self, index: int, motions: TwoMotions) -> None:
        share = round(100 * motions.object_share)
        self._event_since = self._since
        self._reported = "object-covers-image"
        by = "the points seen before" if motions.decision == "voted" else "its predicted motion"
        message = (
            f"frame {index}: {share} % of the points move together, but not as the camera does by "
            f"{by}: an object that moves on its own covers much of the image; its points are left "
            "out"
        )
        if motions.decision == "undecided":
            self._reported = "object-or-scene"
            rest = round(100 * float(motions.motion.inliers.mean()))
            message = (
                f"frame {index}: two groups of points move differently, {rest} % and {share} % of "
                "all: an object that moves on its own covers much of the image, and the predicted "
                "motion does not tell which group it is; the larger one is taken for the scene"
            )
        figures = {"object_share": motions.object_share}
        self._found.append(
            Finding(self._reported, message, index, self._since, lasts=True, figures=figures)
        )
