"""A front end between the checks: the same checks for every front end."""

from __future__ import annotations

from vio.findings import Finding
from vio.frontend.given import checked_output
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.bands import BandRemoval
from vio.guard.contrast import LostContrast
from vio.guard.exchange import ExchangeDetector
from vio.guard.frozen_image import FrozenCamera
from vio.guard.image_check import FrameImages, ImageCheck, images_of
from vio.guard.match_check import without_right
from vio.guard.matches import RightMatches
from vio.guard.never_matched import NeverMatched
from vio.guard.object_matches import ObjectMatches
from vio.guard.pairing import PairingCheck
from vio.guard.probe import RowProbe
from vio.guard.projected_dots import ProjectedDots
from vio.guard.repeated_features import RepeatedFeatures
from vio.guard.swap import SwapDetector
from vio.guard.torn import TornImages
from vio.guard.turned_pair import TurnedPair
from vio.protocols import ChecksMatches, ChecksObjects, ChecksRepeats, FollowsRight, Frontend
from vio.records import (
    FrontendOutput,
    Observations,
    StereoFrame,
    TrackPrior,
    no_features,
)

# Features and share of them with a right match, below which left and right may be exchanged.
_MIN_FEATURES = 20
_FEW_MATCHES = 0.2


def image_checks(camera: StereoCamera) -> tuple[ImageCheck, ...]:
    """Return the checks of the images of a camera, in their order.

    A frozen image looks as if it were the other camera's, so that is asked first. So do images of two
    times, and are paired anew before they could be exchanged. All of these search along rows, which
    a turned camera does not have.
    """
    if camera.kind != "stereo":
        return (TornImages(), ProjectedDots(), LostContrast())
    probe = RowProbe()
    return (
        TornImages(),
        BandRemoval(),
        ProjectedDots(),
        LostContrast(),
        FrozenCamera(),
        TurnedPair(camera, probe),
        SwapDetector(probe),
        PairingCheck(probe),
        ExchangeDetector(probe),
    )


class GuardedFrontend:
    """Checks the images of each frame before a front end sees them, and its right matches after it;
    see `vio.protocols.Frontend`.

    Images that no front end takes are handed on as they are. The features of a front end that checks
    them itself (`vio.protocols.ChecksMatches`, `ChecksObjects`, `ChecksRepeats`) are not checked again.
    """

    def __init__(self, frontend: Frontend, camera: StereoCamera) -> None:
        self.frontend = frontend
        self._pair = camera.kind == "stereo"
        # the front end, where it may check matches and objects itself; slow to ask in every frame
        self._may_check = frontend if isinstance(frontend, ChecksMatches) else None
        self._may_check_objects = frontend if isinstance(frontend, ChecksObjects) else None
        checks_repeats = isinstance(frontend, ChecksRepeats) and frontend.checks_repeats
        self._repeats = None if checks_repeats else RepeatedFeatures()
        self._checks = image_checks(camera)
        self._matches = RightMatches(camera)
        self._objects = ObjectMatches(camera)
        self._never = NeverMatched() if self._pair else None
        self._swap = next((c for c in self._checks if isinstance(c, SwapDetector)), None)
        self._exchange = next((c for c in self._checks if isinstance(c, ExchangeDetector)), None)
        self._turned = next((c for c in self._checks if isinstance(c, TurnedPair)), None)

    @property
    def turned_back(self) -> FloatArray | None:
        """The rotation (3,) rad of the right camera that is taken back in its images; None: none
        is.
        """
        return None if self._turned is None else self._turned.rotation

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Check, and process what is left of a frame.

        Raises:
            DataError: the recording cannot be used, or the front end refuses the frame.
        """
        images = images_of(frame, pair=self._pair)
        if images is None:
            output = checked_output(self.frontend, self.frontend.process(frame, prior), frame)
            return self._checked(output, (), prior, right_usable=True)
        images = self._inspect(images)
        output = self._output(images, prior)
        if self._exchange is not None and images.right_usable:
            # before, few matches are a matter of the whole recording
            known = self._swap is not None and self._swap.decided
            self._exchange.suspicious = known and _few_matches(output.observations)
        if self._turned is not None and images.right_usable:
            self._turned.see(output.observations)
        found = tuple(f for check in self._checks for f in check.take_findings())
        output = self._checked(output, found, prior, right_usable=images.right_usable)
        if self._turned is not None and output.findings:
            self._turned.take(output.findings)
        return output

    def _checked(
        self,
        output: FrontendOutput,
        found: tuple[Finding, ...],
        prior: TrackPrior | None,
        *,
        right_usable: bool,
    ) -> FrontendOutput:
        """Return an output after the checks of its columns, with findings `found` before them.

        Without a usable right image there is nothing of it to check.
        """
        seen = output.observations
        is_checked = self._may_check is not None and self._may_check.checks_matches
        if not is_checked and self._repeats is not None:
            seen = self._repeats.inspect(seen)
            found = (*found, *self._repeats.take_findings())
        if not right_usable:
            seen = without_right(seen)
        elif not is_checked:
            seen = self._matches.inspect(seen)
            found = (*found, *self._matches.take_findings())
        if self._may_check_objects is None or not self._may_check_objects.checks_objects:
            seen = self._objects.inspect(seen, prior)
            found = (*found, *self._objects.take_findings())
        if right_usable and self._never is not None:
            self._never.see(seen)
            found = (*found, *self._never.take_findings())
        return _with_findings(output, seen, found)

    def _inspect(self, images: FrameImages) -> FrameImages:
        """Return the images after all checks, up to the first that leaves the frame out."""
        for check in self._checks:
            images = check.inspect(images)
            if images.skipped or not images.left_usable:
                break
        return images

    def _output(self, images: FrameImages, prior: TrackPrior | None) -> FrontendOutput:
        if images.skipped:
            return no_features(images.frame)
        if images.left_usable:
            checked = images.checked()
            output = self.frontend.process(checked, prior)
            return checked_output(self.frontend, output, images.frame)
        if isinstance(self.frontend, FollowsRight):
            return self.frontend.follow_right(images.checked(), prior)
        return no_features(images.frame)


def guarded(frontend: Frontend, camera: StereoCamera, *, checks: bool = True) -> Frontend:
    """Return a front end between the checks; itself where it is already, or where none are wanted
    (`frontend.checks`).
    """
    if isinstance(frontend, GuardedFrontend) or not checks:
        return frontend
    return GuardedFrontend(frontend, camera)


def _few_matches(seen: Observations) -> bool:
    """Whether hardly any feature has a right match."""
    if len(seen) < _MIN_FEATURES:
        return False
    return bool(seen.has_right.mean() < _FEW_MATCHES)


def _with_findings(
    output: FrontendOutput, seen: Observations, found: tuple[Finding, ...]
) -> FrontendOutput:
    """Return an output with other observations and with findings; itself where neither changes."""
    if seen is output.observations and not found:
        return output
    return FrontendOutput(
        seen,
        output.tracked,
        int(seen.has_right.sum()),
        output.detected,
        output.stages_ms,
        output.warnings,
        (*found, *output.findings),
    )
