"""All checks of right matches, in their order."""

from __future__ import annotations

from vio.findings import Finder
from vio.geometry.stereo import StereoCamera
from vio.guard.displaced_matches import DisplacedMatches
from vio.guard.exchanged_matches import ExchangedMatches
from vio.guard.frozen_matches import FrozenMatches
from vio.guard.late_matches import LateMatches
from vio.guard.lost_matches import LostMatches
from vio.guard.match_check import MatchCheck, shared_matches
from vio.guard.shifted_matches import ShiftedMatches
from vio.records import Observations


def match_checks(camera: StereoCamera) -> tuple[MatchCheck, ...]:
    """Return the checks of right matches for a camera, in their order; none for one camera.

    Frozen pixels contradict the rows as well, and late ones are learned from rows that fit. Late ones
    of a rig that turns shift all disparities until they are paired anew.
    """
    if camera.kind != "stereo":
        return ()
    return (
        LostMatches(),
        FrozenMatches(),
        DisplacedMatches(camera),
        LateMatches(camera),
        ShiftedMatches(camera),
    )


class RightMatches(Finder):
    """Checks the right matches of all frames by their columns."""

    def __init__(self, camera: StereoCamera) -> None:
        super().__init__()
        self._checks = match_checks(camera)
        self._exchanged = ExchangedMatches()
        self._before: Observations | None = None

    def inspect(self, seen: Observations) -> Observations:
        """Return the features of a frame with right pixels that may be used.

        Raises:
            DataError: the recording cannot be used.
        """
        if not self._checks:
            return seen
        seen = self._exchanged.inspect(seen)
        shared = shared_matches(self._before, seen)
        self._before = seen
        for check in self._checks:
            seen = check.inspect(seen, shared)
            if not seen.has_right.any():
                break
        for finder in (self._exchanged, *self._checks):
            self._found += finder.take_findings()
        return seen
