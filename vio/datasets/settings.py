"""Settings of the readers."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

from vio.dataclass import dataclass
from vio.geometry.rectify import Interpolation, ProjectionMode
from vio.setting import Section, setting

ExtrinsicsMode: TypeAlias = Literal["auto", "literal", "corrected"]
RepeatsMode: TypeAlias = Literal["auto", "split", "flag", "literal"]


@dataclass(frozen=True, slots=True)
class DatasetSettings(Section):
    """How recordings are read."""

    section: ClassVar[str] = "dataset"

    colour: bool | None = setting(
        None,
        "KITTI folders: use image_2/image_3 (true) or image_0/image_1 (false); null: gray where "
        "there is any",
    )
    extrinsics: ExtrinsicsMode = setting(
        "auto",
        "ECE276A files: the translation of cam_T_imu as stored (literal), as the camera's position "
        "in the IMU frame (corrected), or whichever the features support (auto)",
    )
    repeated_tracks: RepeatsMode = setting(
        "auto",
        "feature files, rows that repeat old pixels in motion: mark them stale and give a new id "
        "(split), mark them (flag), use them (literal); auto: split where the track went on at "
        "another point, else flag",
    )
    calibration: Path | None = setting(
        None,
        "the calibration file, in place of the recording's own",
    )
    folders: str | None = setting(
        None,
        "image folders of the left and the right camera within the recording, such as img_l,img_r",
    )
    camera: Literal["both", "left"] = setting(
        "both",
        "both cameras of a stereo recording, or the left one alone, which needs an IMU",
    )
    depth_factor: float | None = setting(
        None,
        "depth images: levels per metre; null: the calibration's, or 5000 for TUM RGB-D",
        above=0,
    )
    depth_noise: float = setting(
        1.5e-3,
        "depth images: k of a depth's standard deviation k depth^2; structured light has 0.0012 to "
        "0.0019",
        unit="1/m",
        above=0,
    )
    topics: str | None = setting(
        None,
        "bags: topics by name, such as left=/a,right=/b,imu=/c",
    )
    interpolation: Interpolation = setting(
        "linear",
        "of gray values in rectifying; cubic and lanczos4 cost 5 and 15 times as much for barely "
        "better tracks",
    )
    projection: ProjectionMode = setting(
        "auto",
        "rectify to the image of a pinhole, or to a cylinder about the baseline, which keeps what a "
        "wide lens sees above and below; auto: where a pinhole would crop, a cylinder",
    )
    max_bad_frames: int | None = setting(
        None,
        "unreadable frames that are skipped before the reader stops with an error; null: all but "
        "the last usable one",
        at_least=0,
    )
    max_frame_rate: float | None = setting(
        None,
        "frames that come sooner are left out, so that a slow computer follows a fast camera; null: "
        "all are used",
        unit="Hz",
        above=0,
    )
    prefetch_frames: int = setting(
        4,
        "image folders: stereo frames decoded ahead in a thread; 0: no thread",
        at_least=0,
        at_most=1000,
    )

    @property
    def cameras(self) -> int:
        """How many images of a stereo frame are decoded."""
        return 1 if self.camera == "left" else 2


def are_repeats_used(settings: DatasetSettings | None) -> bool:
    """Return whether features that repeat old pixels are to be used as they are."""
    return settings is not None and settings.repeated_tracks == "literal"
