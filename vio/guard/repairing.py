"""A recording whose images are wrong in the same way from its start, and put right when it is read
or used: right ones belong to the left images of other frames, or are those of a turned camera; all
show the dots of a projector, or were exposed row after row.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finding
from vio.geometry.stereo import StereoCamera
from vio.records import Event, Image, StereoFrame


@dataclass(frozen=True, slots=True)
class Repair:
    """What is put right of a recording's images."""

    delay: int = 0  # frames by which they are late; negative for early ones
    # (3,) rad, by which their camera shows points p of its rectified frame as `exp(turn) p`
    turn: tuple[float, ...] | None = None
    dots: bool = False  # projected dots are taken out of all images
    readout_s: float = 0.0  # of a rolling shutter, as `StereoCamera` has it

    def __bool__(self) -> bool:
        return self != AS_READ

    def adding(self, finding: Finding) -> Repair:
        """Return the repair of what a run found beside this one; itself where that is nothing new.

        What was put right once is not put right again.
        """
        figures = finding.figures
        if finding.code == "projected-dots" and finding.since == 0:
            return replace(self, dots=True)
        if finding.code == "rolling-shutter" and not self.readout_s:
            return replace(self, readout_s=1e-3 * figures["readout_ms"])
        if finding.code == "pairs-shifted" and self.delay == 0:
            return replace(self, delay=round(figures["delay_frames"]))
        if finding.code == "right-camera-turned" and self.turn is None and finding.since == 0:
            angles = [figures[key] for axis in "xyz" if (key := f"turned_{axis}_deg") in figures]
            if len(angles) == 3:
                return replace(self, turn=tuple(np.radians(angles).tolist()))
        return self

    def to_json(self) -> dict[str, object] | None:
        """Return it as plain values for `metrics.json`; None: nothing is put right."""
        turn = None if self.turn is None else list(self.turn)
        if not self:
            return None
        return {
            "late_frames": self.delay,
            "turned_rad": turn,
            "dots_taken_out": self.dots,
            "readout_s": self.readout_s,
        }

    @classmethod
    def of_json(cls, stated: Mapping[str, Any] | None) -> Repair:
        """Return what `to_json` states."""
        if stated is None:
            return cls()
        turn = stated.get("turned_rad")
        return cls(
            stated.get("late_frames", 0),
            None if turn is None else tuple(turn),
            stated.get("dots_taken_out", False),
            stated.get("readout_s", 0.0),
        )

    def lines(self) -> tuple[tuple[str, str], ...]:
        """Return codes, and a line for each, on what a run that began again has put right."""
        out = []
        if self.turn is not None:
            angles = ", ".join(f"{angle:+.2f}" for angle in np.degrees(self.turn))
            line = (
                f"the right camera is turned against its calibration, by {angles} degrees about "
                "x, y and z; the run began again with its images turned back; calibrate anew (vio "
                "calibrate)"
            )
            out.append(("right-turn-put-right", line))
        if self.delay:
            line = (
                f"{late_text(self.delay)}; the run began again with the right pairs; pair the "
                "images by their times of exposure"
            )
            out.append(("pairs-put-right", line))
        if self.dots:
            line = (
                "the images show the dots of an infrared projector, which move with the cameras; "
                "the run began again without the dots; switch the projector off"
            )
            out.append(("projected-dots", line))
        if self.readout_s:
            ms = 1e3 * self.readout_s
            line = (
                f"the shutter rolls: rows are exposed one after the other within {abs(ms):.1f} ms, by "
                "how features move where the velocity changes; the run began again with features "
                f"moved to the time of the middle row; set frontend.readout_ms to {ms:.1f}"
            )
            out.append(("shutter-put-right", line))
        return tuple(out)


AS_READ = Repair()  # nothing is put right


def repaired(events: Iterable[Event], repair: Repair, camera: StereoCamera) -> Iterator[Event]:
    """Yield events with the images of each pair those of one time, as calibrated.

    No image comes before its exposure: where right images are early, the left ones are late, and
    take the stamps of the frames that the right ones came with. The image that is late is taken from
    a later frame; the last frames are left out.

    Args:
        events: as the recording gives them, in time order.
        repair: what to put right.
        camera: of the rectified images.
    """
    if repair.dots:
        events = _without_dots(events)
    if repair.turn is not None:
        events = _turned_back(events, repair.turn, camera)
    if repair.delay:
        events = _paired(events, abs(repair.delay), right_is_late=repair.delay > 0)
    return iter(events)


def _without_dots(events: Iterable[Event]) -> Iterator[Event]:
    from vio.guard.projected_dots import without_dots  # loads OpenCV

    for event in events:
        if isinstance(event, StereoFrame):
            left, right = (x if x is None else without_dots(x) for x in (event.left, event.right))
            event = replace(event, left=left, right=right)
        yield event


def _turned_back(
    events: Iterable[Event], turn: tuple[float, ...], camera: StereoCamera
) -> Iterator[Event]:
    from vio.guard.turned_pair import turned_back  # loads OpenCV

    rotation = np.array(turn)
    for event in events:
        if isinstance(event, StereoFrame) and event.right is not None:
            event = replace(event, right=turned_back(event.right, camera, rotation))
        yield event


def late_text(delay: int) -> str:
    """Say which images of a recording are late and by how many frames, `delay` as of `repaired`."""
    late, other = ("right", "left") if delay > 0 else ("left", "right")
    frames = "a frame" if abs(delay) == 1 else f"{abs(delay)} frames"
    return (
        f"each {late} image comes {frames} later than the {other} one of its time, by the rows that "
        "match"
    )


def _paired(events: Iterable[Event], frames: int, *, right_is_late: bool) -> Iterator[Event]:
    held = deque[Event]()  # from the frame on that waits
    waiting = 0  # frames among them
    for event in events:
        if not isinstance(event, StereoFrame):
            held.append(event)
            continue
        if waiting == frames:
            first = held.popleft()
            while not isinstance(first, StereoFrame):
                yield first
                first = held.popleft()
            yield (
                replace(first, right=event.right)
                if right_is_late
                else replace(first, left=event.left)
            )
            waiting -= 1
        held.append(replace(event, left=_copied(event.left), right=_copied(event.right)))
        waiting += 1
    yield from (event for event in held if not isinstance(event, StereoFrame))


def _copied(image: Image | None) -> Image | None:
    """A copy, as a reader may reuse its buffer."""
    return None if image is None else image.copy()
