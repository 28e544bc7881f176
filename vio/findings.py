"""What checks report: one record for every fault of images, sensors, calibration and estimate.

A finding has a code that stays the same from version to version, so that programs and tests compare
codes and not sentences. `CODES` lists them all, with their effect on the integrity of the estimates
of the frames that they hold for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Literal, TypeAlias

from vio.dataclass import dataclass
from vio.errors import ConfigError

# of the estimates: use them; they are less certain than usual; do not use them
Integrity: TypeAlias = Literal["nominal", "degraded", "unusable"]
INTEGRITIES: tuple[Integrity, ...] = ("nominal", "degraded", "unusable")


@dataclass(frozen=True, slots=True)
class Code:
    """What a code means."""

    effect: Integrity  # on the estimates of the frames that it holds for
    meaning: str  # one line
    remedy: str  # one line


@dataclass(frozen=True, slots=True)
class Finding:
    """One event: something is wrong from a frame on, or no longer."""

    code: str  # a key of `CODES`
    message: str  # one line: what was seen, its likely cause, what to do
    frame: int | None = None  # frame that it was found at; None: of the whole recording
    since: int | None = None  # first frame that it holds for; None: `frame`
    ended: bool = False  # it no longer holds from `frame` on
    lasts: bool = False  # it holds until a finding of the same code says that it has ended
    certain: bool = True  # False: suspected, correct data can look like this
    figures: Mapping[str, float] = field(default_factory=dict)  # with units in their names

    def __post_init__(self) -> None:
        """Refuse a code that is not documented."""
        if self.code not in CODES:
            raise ConfigError(f"there is no finding {self.code!r}; add it to vio.findings.CODES")

    def __str__(self) -> str:
        return self.message

    @property
    def effect(self) -> Integrity:
        """Effect on the estimates of the frames that it holds for."""
        return "nominal" if self.ended else CODES[self.code].effect

    @property
    def first_frame(self) -> int | None:
        """First frame that it holds for."""
        return self.frame if self.since is None else self.since

    def to_json(self) -> dict[str, object]:
        """Return the finding as plain values for `metrics.json`."""
        return {
            "code": self.code,
            "frame": self.frame,
            "since": self.first_frame,
            "ended": self.ended,
            "certain": self.certain,
            "effect": self.effect,
            "figures": dict(self.figures),
            "message": self.message,
        }


def begun(
    code: str,
    frame: int,
    text: str,
    since: int | None = None,
    *,
    figures: Mapping[str, float] | None = None,
) -> Finding:
    """Return that something has begun, and lasts until it has `ended`.

    Args:
        code: a key of `CODES`.
        frame: that it was found at.
        text: what was seen, its likely cause, what to do.
        since: first frame that it holds for; None: `frame`.
        figures: with units in their names.
    """
    message = f"frame {frame}: {text}"
    return Finding(code, message, frame, since, lasts=True, figures=figures or {})


def ended(code: str, frame: int, text: str) -> Finding:
    """Return that what had `begun` no longer holds from a frame on."""
    return Finding(code, f"frame {frame}: {text}", frame, ended=True)


class Finder:
    """Base of what finds something: keeps findings until they are taken."""

    def __init__(self) -> None:
        self._found: list[Finding] = []

    def take_findings(self) -> tuple[Finding, ...]:
        """Return the findings since the last call."""
        found = tuple(self._found)
        self._found = []
        return found


def worst(effects: list[Integrity]) -> Integrity:
    """Return the worst of some effects; nominal for none."""
    return max(effects, key=INTEGRITIES.index, default="nominal")


_EXPOSURES = "pair images by exposure times, or synchronise the cameras"
_CAMERA = "check camera, cable and driver"

CODES: dict[str, Code] = {
    "bands": Code(
        "nominal",
        "bands of brightness move through the images; they are taken out",
        "use steady light",
    ),
    "exposures-mixed": Code(
        "degraded",
        "images show the frame before, too",
        "switch off temporal filters",
    ),
    "projected-dots": Code(
        "degraded",
        "dots of a projector are taken out",
        "switch the projector off",
    ),
    "rolling-shutter": Code(
        "unusable",
        "rows are exposed one after the other; features are moved to one time",
        "set frontend.readout_ms",
    ),
    "readout-contradicted": Code(
        "unusable",
        "features move as by another readout time than is stated",
        "correct frontend.readout_ms, or leave it out",
    ),
    "shutter-put-right": Code(
        "nominal",
        "rows are exposed in turn; the run began again, corrected",
        "set frontend.readout_ms",
    ),
    "images-exchanged": Code(
        "degraded",
        "left and right images are exchanged; put back, or left out",
        "check how the two streams are told apart",
    ),
    "right-image-frozen": Code(
        "degraded", "the right image does not change; the left one alone is used", _CAMERA
    ),
    "right-image-dark": Code(
        "degraded", "the right image has no contrast; the left one alone is used", _CAMERA
    ),
    "left-image-frozen": Code(
        "degraded", "the left image does not change; the right one alone is used", _CAMERA
    ),
    "right-contradicts-left": Code(
        "degraded",
        "points of known depth are elsewhere in the right image",
        "check the right camera's mount, and that both expose together",
    ),
    "right-matches-lost": Code(
        "degraded",
        "hardly any feature has a right match any more; the left pixels are used",
        _CAMERA,
    ),
    "right-matches-missing": Code(
        "unusable",
        "right matches have not agreed with the left images yet, so lengths are unknown",
        "vio inspect says why",
    ),
    "right-camera-turned": Code(
        "degraded",
        "the right camera is turned in its mount; that is taken out",
        "fix the mount of the right camera, and calibrate anew",
    ),
    "right-camera-shakes": Code(
        "degraded",
        "all disparities of a frame are off together, differently in each; they count less",
        "fix the mount of the right camera, or synchronise the cameras",
    ),
    "right-image-late": Code(
        "degraded", "the right camera exposes later than the left one", _EXPOSURES
    ),
    "right-image-early": Code(
        "degraded", "the right camera exposes earlier than the left one", _EXPOSURES
    ),
    "pairs-shifted": Code(
        "unusable",
        "each left image was paired with the right image of another frame",
        _EXPOSURES,
    ),
    "pairs-put-right": Code(
        "nominal",
        "right images were of another frame, and the run began again with the right ones",
        _EXPOSURES,
    ),
    "right-turn-put-right": Code(
        "nominal",
        "the right camera is turned, and the run began again with its images turned back",
        "calibrate anew",
    ),
    "gyro-jumped": Code(
        "degraded",
        "the gyro's bias has jumped; the images estimate it anew",
        "check the IMU's mount and supply",
    ),
    "object-covers-image": Code(
        "degraded",
        "points that move otherwise than the scene cover much of the image",
        "mask what moves with the rig (frontend.klt.mask)",
    ),
    "object-or-scene": Code(
        "unusable",
        "points move apart, or an object hid the scene",
        "add an IMU, or mask what moves with the rig",
    ),
    "object-hides-scene": Code(
        "degraded", "an object hides nearly all of the scene; no feature is used", ""
    ),
    "frame-refused": Code("degraded", "the front end refused a frame", "see the message"),
    "frames-missing": Code("degraded", "no frame came for some time", _CAMERA),
    "frames-out-of-order": Code(
        "unusable", "images are not ordered by exposure", "order them by stamps"
    ),
    "frames-repeated": Code("degraded", "frames or rows show an earlier exposure again", _CAMERA),
    "images-held": Code(
        "unusable",
        "equal images were an earlier exposure again, not a rig at standstill",
        _CAMERA,
    ),
    "depths-repeated": Code("nominal", "depth images repeat an earlier one", _CAMERA),
    "frames-unread": Code("degraded", "frames of the recording could not be read", "see the files"),
    "view-changed": Code(
        "unusable",
        "a frame shows another view than the one before",
        "add an IMU; keep recordings apart",
    ),
    "image-geometry-changed": Code(
        "unusable",
        "images are scaled or cropped otherwise than at first",
        "keep size, crop and zoom",
    ),
    "rig-in-view": Code(
        "unusable",
        "parts of the rig, or what moves before the scene, may be taken for it",
        "mask the rig (frontend.klt.mask)",
    ),
    "tracks-disagree": Code(
        "degraded", "tracks fit no common motion", "mask what moves with the rig"
    ),
    "no-features": Code(
        "degraded",
        "no feature is used; the pose is a prediction",
        "more light or texture, or a shorter exposure",
    ),
    "few-features": Code(
        "degraded",
        "too few features tell the scene from passers-by",
        "more light or texture",
    ),
    "features-refused": Code(
        "degraded",
        "many features contradict the others, and are refused",
        "see the message",
    ),
    "estimate-restarted": Code(
        "degraded", "the estimate diverged, and began again from a good pose", ""
    ),
    "estimate-lost": Code("unusable", "the estimate diverged, and there is no pose", ""),
    "estimate-implausible": Code(
        "unusable",
        "the estimate is impossible for a rig",
        "check the order of the images, calibration, units and clocks",
    ),
    "stereo-calibration-off": Code(
        "nominal",
        "rows of left and right images differ smoothly; corrected while running",
        "vio calibrate",
    ),
    "other-calibration": Code(
        "degraded",
        "rows of left and right images differ beyond any calibration error, or by distortion",
        "check that calibration and images belong together",
    ),
    "calibration-misread": Code(
        "unusable",
        "rows agree only by another reading of the calibration or the images",
        "correct what the message names",
    ),
    "scale-off": Code(
        "degraded",
        "baseline or focal length differ from the calibration, by the motion sensor",
        "check the sensor and the image size, then calibrate anew",
    ),
    "baseline-implausible": Code(
        "degraded", "the baseline is not that of a stereo camera", "check its unit"
    ),
    "one-camera-start": Code("nominal", "the trajectory of one camera begins here", ""),
    "no-pose": Code("nominal", "frames have no pose: the state was not observable yet", ""),
    "imu-gap": Code("degraded", "no IMU sample came for some time", "check the IMU's driver"),
    "imu-readings": Code(
        "degraded",
        "IMU samples are spikes or stuck, or an axis is dead",
        "check the IMU's driver",
    ),
    "imu-not-used": Code(
        "degraded",
        "frames were estimated again without the IMU, or corrected",
        "correct the fault named before",
    ),
    "imu-in-doubt": Code(
        "degraded",
        "the IMU looks useless so far, and is left out",
        "see the message",
    ),
    "imu-clock": Code(
        "degraded", "clocks of camera and IMU are apart", "use one clock, or calibrate"
    ),
    "imu-units": Code("degraded", "readings of the IMU have another unit", "see the message"),
    "imu-axes": Code(
        "degraded", "axes of the IMU, or its extrinsics, are wrong", "see the message"
    ),
    "imu-disagrees": Code("degraded", "IMU and images measure different motions", "vio check"),
    "imu-saturated": Code(
        "degraded", "readings of the IMU are at the end of their range", "use a larger range"
    ),
    "imu-suspected": Code("nominal", "something about the IMU may be wrong", "vio check"),
    "front-end": Code("nominal", "a remark of a front end of the caller's own", ""),
    "run": Code("nominal", "a remark on the run", ""),
}
