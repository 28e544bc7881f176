"""The report on a recording, before anything is run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vio.calibration.severity import StereoError
from vio.datasets.samples import motion_samples
from vio.errors import DataError
from vio.files.epochs import epoch_hint
from vio.filters.stereo_calibration import VerticalDisparityModel
from vio.findings import Finding
from vio.geometry.rectify import field_of_view
from vio.geometry.stereo import StereoCamera
from vio.guard.pairing import find_delay
from vio.guard.repairing import late_text
from vio.imu.clocks import judge_clocks
from vio.imu.findings import InertialFinding
from vio.imu.sampling import sampled_hz
from vio.inspection.finding import Inspection, Part
from vio.inspection.inertial import extrinsics_part, noise_part, rest_part
from vio.inspection.pictures import calibration_part, depths_part, images_part, rows_part
from vio.monitor.inertial import InertialCheck
from vio.monitor.lens_distortion import lens_check
from vio.monitor.reading import pair_as_read
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import robust_sigma
from vio.protocols import Dataset, Frontend
from vio.records import (
    NS_PER_S,
    ImuRecord,
    ImuSample,
    IntArray,
    Recording,
    StereoFrame,
    VelocitySample,
    doubts_among,
)

PAIRS = 12  # or single images looked at, spread over the recording
TRACKED = 60  # frames tracked to compare the IMU with the images' motion
_SETTLED_NS = 5 * NS_PER_S  # of frames that an accelerometer is compared with


class _LookedAt(NamedTuple):
    """How much of a recording is looked at."""

    max_tracked: int = 200
    video_frames: int = 300  # of a video, which can only be decoded in order
    windows: int = 6  # spread over the recording, whose pairs may be of different times
    window_frames: int = 8


_LOOKED_AT = _LookedAt()


def inspect_recording(
    dataset: Dataset,
    build_frontend: Callable[[Dataset], Frontend],
    *,
    pairs: int = PAIRS,
    tracked: int = TRACKED,
    span: tuple[int, int | None] = (0, None),
    begin: Callable[[str], None] = lambda part: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Inspection:
    """Examine a recording, or its frames from the first of `span` to before the second.

    `begin` is called with the part that comes next, `progress` with how far it is.

    Raises:
        DataError: an image has a wrong size, or too many cannot be read.
    """
    recording = dataset.recording
    frames_seen = range(len(recording.frame_times_ns))[slice(*span)]
    times_ns = recording.frame_times_ns[slice(*span)]
    parts = [frames_part(times_ns), camera_part(recording)]
    off: StereoError | None = None  # the calibration
    if recording.has_images and frames_seen:
        begin("read images")
        frames = _spread(dataset, frames_seen, pairs, progress)
        parts.append(images_part(frames))
        if recording.camera.kind == "rgbd":
            parts.append(depths_part(frames))
        elif recording.camera.kind == "stereo":
            begin("match left and right")
            stereo, off = rows_part(frames, pair_as_read(dataset), progress)
            begin("look at the pairing")
            parts += [stereo, *_pairs_parts(dataset, frames_seen)]
    parts += _motion_parts(dataset, span, times_ns)
    if recording.has_images and tracked > 1 and frames_seen:
        begin("track features")
        tracked = _frames_to_track(recording, times_ns, tracked)
        seen = _track(dataset, build_frontend(dataset), frames_seen[:tracked], progress)
        parts += _tracking_parts(recording, seen)
        off = _as_in_a_run(off, seen.rows)
    if off is not None:
        parts.append(calibration_part(off))
    parts += [_reference_part(recording, times_ns), _missing_part(recording)]
    return Inspection(tuple(parts), recording.notes)


def _frames_to_track(recording: Recording, times_ns: IntArray, tracked: int) -> int:
    """Return the number of frames to track: more where the calibration is doubted and an IMU can
    settle it, whose comparison of accelerations takes seconds.
    """
    if "imu" not in recording.motion or not doubts_among(recording.notes):
        return tracked
    within = int(np.searchsorted(times_ns, times_ns[0] + _SETTLED_NS))
    return max(tracked, min(within, _LOOKED_AT.max_tracked))


def camera_part(recording: Recording) -> Part:
    """Describe the rectified pair, or the undistorted camera."""
    c = recording.camera
    facts: dict[str, object] = {"kind": c.kind, "fu": c.fu, "fv": c.fv, "cu": c.cu, "cv": c.cv}
    if c.kind == "stereo":
        facts["baseline_m"] = c.baseline_m
    facts |= {"width": c.width or 0, "height": c.height or 0}
    wide = ""
    if c.baseline_fault is None:
        faults = []
    else:
        faults = [c.baseline_fault]
    if c.width is not None and c.height is not None:
        angles = " x ".join(f"{angle:.0f}" for angle in np.degrees(field_of_view(c)))
        wide = f", {angles} deg"
        if not (0 < c.cu < c.width and 0 < c.cv < c.height):
            faults.append(
                f"the principal point {c.cu:.0f}, {c.cv:.0f} is outside the image; check its size"
            )
    return Part("camera", _camera_text(c, wide), facts, faults)


def _camera_text(c: StereoCamera, wide: str) -> str:
    """Return kind, focal length, field of view as given, and baseline of a camera in words."""
    if c.kind != "stereo":
        beside = "with depth images" if c.kind == "rgbd" else "alone"
        return f"one camera {beside}, undistorted: focal {c.fu:.1f} px{wide}"
    form = " to a cylinder" if c.is_cylinder else ""
    far = f"disparity 1 px at a depth of {c.fu * c.baseline_m:.0f} m"
    return f"rectified{form}: focal {c.fu:.1f} px{wide}, baseline {c.baseline_m:.4f} m, {far}"


def _spread(
    dataset: Dataset, of: range, pairs: int, progress: Callable[[int, int], None]
) -> list[StereoFrame]:
    """Read some frames, spread over a range."""
    last = _last_looked_at(dataset, of)
    chosen = np.unique(np.linspace(of[0], last, pairs).astype(int)).tolist()
    frames: list[StereoFrame] = []
    unusable: DataError | None = None
    for done, k in enumerate(chosen):
        try:
            events = dataset.events(k, k + 1)
            frames += [event for event in events if isinstance(event, StereoFrame)]
        except DataError as error:  # as of one damaged image, which a run skips
            unusable = unusable or error
        progress(done + 1, len(chosen))
    if unusable is not None and not frames:
        raise unusable
    return frames


def _pairs_parts(dataset: Dataset, of: range) -> list[Part]:
    """Name pairs of different times that do not begin with the first frame, as where a camera lost
    images and numbered on.
    """
    if len(of) <= _LOOKED_AT.window_frames:
        return []
    last = _last_looked_at(dataset, of) + 1 - _LOOKED_AT.window_frames
    apart: dict[int, int] = {}
    frames: list[StereoFrame] = []  # of a window; what the one before has of it is not read again
    end = of[0]
    for first in np.linspace(of[0], last, _LOOKED_AT.windows).astype(int).tolist():
        frames = [frame for frame in frames if frame.index >= first]
        begin = max(first, end)
        end = first + _LOOKED_AT.window_frames
        with contextlib.suppress(DataError):
            events = dataset.events(begin, end)
            frames += [event for event in events if isinstance(event, StereoFrame)]
        delay = find_delay(frames, dataset.recording.camera)
        if delay is not None:
            apart[first] = delay
    if len(set(apart.values())) < 2:  # of one delay throughout, tracking says more
        return []
    first, delay = next((first, delay) for first, delay in apart.items() if delay)
    fault = (
        f"about frame {first} {late_text(delay)}, and elsewhere not: a camera has lost images; pair "
        "the images by their times of exposure"
    )
    return [Part("pairs", "of different times in a part", {"shifted_from": first}, [fault])]


def _last_looked_at(dataset: Dataset, of: range) -> int:
    """Return the last frame of a range that is read, as a video can only be decoded in order."""
    if dataset.recording.kind == "video":
        return min(of[-1], of[0] + _LOOKED_AT.video_frames - 1)
    return of[-1]


def _motion_parts(dataset: Dataset, span: tuple[int, int | None], times_ns: IntArray) -> list[Part]:
    """Describe the samples of velocity sensor and IMU beside frames at some times."""
    recording = dataset.recording
    events = list(dataset.events(*span, images=False))
    parts = list[Part]()
    velocities = [event.time_ns for event in events if isinstance(event, VelocitySample)]
    if velocities:
        parts.append(clock_part("velocity", times_ns, np.array(velocities, dtype=np.int64)))
    samples = [event for event in events if isinstance(event, ImuSample)]
    if not samples:
        return parts
    arrays = motion_samples(samples)
    record = ImuRecord(arrays.times_ns, arrays.values[:, :3], arrays.values[:, 3:])
    rate_hz = sampled_hz(record) if len(samples) > 1 else None
    parts.append(clock_part("IMU", times_ns, record.times_ns, rate_hz))
    if len(samples) > 1:
        noise = noise_part(record, getattr(dataset, "imu_noise", None))
        parts += filter(None, (rest_part(record, recording.T_cam0_imu), noise))
    if recording.T_cam0_imu is not None:
        parts.append(extrinsics_part(recording.T_cam0_imu))
    return parts


def _as_in_a_run(by_pairs: StereoError | None, rows: VerticalDisparityModel) -> StereoError | None:
    """Return what the calibration is off by with the rows as a run learns and states them; where
    they are too far off for its front end, or nothing was learned, those of single pairs.
    """
    learned = rows.offset_px is not None
    if not learned or (by_pairs is not None and by_pairs.grade == "unusable"):
        return by_pairs
    return StereoError(rows.stated_px, 0.0 if by_pairs is None else by_pairs.seen_px)


def _tracking_parts(recording: Recording, seen: _Tracked) -> list[Part]:
    """Describe tracked frames, and how the IMU fits the images' motion as a run compares them."""
    mono = recording.camera.kind == "mono"
    parts = [_tracked_part(seen, mono=mono)]
    if seen.shifted:
        parts.append(Part("pairs", "of different times", {"shifted": True}, seen.shifted))
    if seen.lenses is not None:
        fault = seen.lenses.message.partition(": ")[2]
        parts.append(Part("lenses", "pixels are distorted", seen.lenses.figures, [fault]))
    if "imu" in recording.motion and recording.T_cam0_imu is not None:
        parts.append(_imu_part(seen.imu_findings, mono=mono))
    return parts


@dataclass(slots=True)
class _Tracked:
    """What tracking some frames has shown."""

    rows: VerticalDisparityModel  # of left and right images
    tracked: list[int] = field(default_factory=list)  # features from the frame before, per frame
    matched: list[int] = field(default_factory=list)  # features with depth, per frame
    shifted: list[str] = field(default_factory=list)  # findings about the pairs
    lenses: Finding | None = None  # that pixels are distorted
    imu_findings: list[str] = field(default_factory=list)


def _track(
    dataset: Dataset, frontend: Frontend, frames: range, progress: Callable[[int, int], None]
) -> _Tracked:
    """Track some frames, and give their motion and the samples between them to a check."""
    recording = dataset.recording
    mono = recording.camera.kind == "mono"
    check: InertialCheck | None = None
    if "imu" in recording.motion and recording.T_cam0_imu is not None:
        check = InertialCheck(recording.camera, recording.T_cam0_imu)
    seen = _Tracked(VerticalDisparityModel(recording.camera))
    lenses = lens_check(recording.camera)
    for event in dataset.events(frames.start, frames.stop):
        if isinstance(event, StereoFrame):
            output = frontend.process(event)
            seen.tracked.append(output.tracked)
            seen.matched.append(output.matched)
            seen.shifted += [_shifted_text(f) for f in output.findings if f.code == "pairs-shifted"]
            progress(len(seen.tracked), len(frames))
            if recording.camera.kind == "stereo":
                seen.rows.update(output.observations)
            if lenses is not None:
                seen.lenses = seen.lenses or lenses.frame(output.observations)
            if check is not None:
                seen.imu_findings += _messages(check.frame(output.observations), mono=mono)
        elif check is not None and isinstance(event, ImuSample):
            check.imu([event])
    if check is not None:
        seen.imu_findings += _messages(check.finish(), mono=mono)
    return seen


def _tracked_part(seen: _Tracked, *, mono: bool) -> Part:
    """Describe how many features were tracked."""
    count = len(seen.tracked)
    kept = 0.0
    if count > 1:
        kept = float(np.median(seen.tracked[1:]))
    matched = float(np.median(seen.matched or [0]))
    facts = {"frames": count, "tracked_median": kept, "matched_median": matched}
    depth = "" if mono else f", {matched:.0f} with depth"
    text = f"{kept:.0f} features from frame to frame{depth} (of {count} frames)"
    faults = []
    if count > 1 and kept < 8:
        faults.append(
            "hardly any feature is tracked; the frames may not be consecutive, in disorder, dark "
            "or blurred"
        )
    return Part("tracking", text, facts, faults)


def _imu_part(findings: Sequence[str], *, mono: bool) -> Part:
    """Describe how the IMU fits the motion of the images."""
    verdict = "agrees with the motion of the images, as far as they move"
    if mono:
        verdict = "not compared: the motion of one camera has no scale"
    if findings:
        verdict = "see below"
    return Part("IMU against images", verdict, {"findings": findings}, findings)


def _shifted_text(found: Finding) -> str:
    """Return what is wrong with pairs of different times."""
    return (
        f"{late_text(round(found.figures['delay_frames']))}; pair the images by their times of "
        "exposure (a run pairs them anew, and says so)"
    )


def _messages(found: tuple[InertialFinding, ...], *, mono: bool) -> list[str]:
    """Return findings of the IMU as lines; of one camera without its units, which the images
    then say nothing about.
    """
    return [f.message for f in found if not (mono and f.group == "size")]


def _reference_part(recording: Recording, times: IntArray) -> Part:
    truth = recording.reference
    if truth is None:
        return Part("ground truth", "none", {"poses": 0})
    text = f"{len(truth)} poses ({truth.body})"
    if truth.times_ns is None:
        return Part("ground truth", text, {"poses": len(truth)})
    covered = float(np.mean((times >= truth.times_ns[0]) & (times <= truth.times_ns[-1])))
    text += f", over {100 * covered:.0f} % of the frames"
    if covered == 0.0:
        own = int(times[0]), int(times[-1])
        other = int(truth.times_ns[0]), int(truth.times_ns[-1])
        text += (
            f": of another clock or recording; it begins {(other[0] - own[0]) / NS_PER_S:+.3f} s from the "
            f"frames{epoch_hint(own, other, 'the ground truth')}"
        )
    return Part("ground truth", text, {"poses": len(truth)})


def _missing_part(recording: Recording) -> Part:
    """Say what the recording lacks, and what is lost with it."""
    missing = []
    faults = []
    if recording.camera.kind == "mono" and (
        "imu" not in recording.motion or recording.T_cam0_imu is None
    ):
        missing.append("no IMU with T_cam0_imu")
        faults.append(
            "one camera alone knows no scale: add an IMU (imu.csv and T_cam0_imu), depth images or "
            "a second camera"
        )
    elif not recording.motion:
        missing.append(
            "no IMU, no velocity (images alone: no gravity, nothing carries the pose over blind "
            "frames)"
        )
    elif recording.T_cam0_imu is None:
        missing.append("no T_cam0_imu")
    if recording.reference is None:
        missing.append("no ground truth (no ATE)")
    return Part("missing", "; ".join(missing) or "nothing is missing", {"missing": missing}, faults)


class _StampRules(NamedTuple):
    """What is said of the stamps."""

    gap_steps: float = 1.5  # intervals longer than this multiple of the median are gaps
    even_ms: Tolerance[float] = 1e-3  # a jitter below it is rounding of the stamps
    min_imu_hz: float = 50.0  # as the readers say it


_STAMPS = _StampRules()


def frames_part(times: IntArray) -> Part:
    """Describe the frames' stamps (N,)."""
    facts = clock_facts(times)
    text = f"{len(times)} frames{_text(facts)}"
    faults = ["a run needs at least two frames; give a longer recording"] if len(times) < 2 else []
    return Part("frames", text, facts, faults)


def clock_part(
    name: str, frame_times_ns: IntArray, times_ns: IntArray, rate_hz: float | None = None
) -> Part:
    """Describe the stamps of a motion sensor, and how they cover the frames.

    Args:
        name: of the sensor.
        frame_times_ns: stamps (M,) of the frames.
        times_ns: stamps (N,).
        rate_hz: of its readings; None: that of the stamps.
    """
    facts = clock_facts(times_ns)
    facts |= {} if rate_hz is None else {"rate_hz": rate_hz}
    faults = []
    if name == "IMU":
        if facts["rate_hz"] is not None and facts["rate_hz"] < _STAMPS.min_imu_hz:
            faults.append(
                f"{facts['rate_hz']:.3g} Hz are too few to integrate the motion between images; "
                "record at least "
                f"{_STAMPS.min_imu_hz:g} Hz, or use --motion none"
            )
        faults += [finding.message for finding in judge_clocks(frame_times_ns, times_ns)]
    inside = (frame_times_ns >= times_ns[0]) & (frame_times_ns <= times_ns[-1])
    text = f"{len(times_ns)} samples{_text(facts)}; they cover {100 * float(inside.mean()):.0f} % of the frames"
    return Part(name, text, {**facts, "covered": float(inside.mean())}, faults)


def clock_facts(times_ns: IntArray) -> dict[str, float | int | None]:
    """Return duration, median rate, jitter (robust standard deviation of the intervals), and
    gaps of stamps (N,).
    """
    if len(times_ns) < 2:
        return {"count": len(times_ns), "duration_s": 0.0, "rate_hz": None}
    steps = np.diff(times_ns).astype(np.float64) / NS_PER_S
    median = float(np.median(steps))
    gaps = steps > _STAMPS.gap_steps * median
    return {
        "count": len(times_ns),
        "duration_s": float(times_ns[-1] - times_ns[0]) / NS_PER_S,
        "rate_hz": 1 / median,
        "jitter_ms": 1e3 * robust_sigma(steps - median),
        "gaps": int(gaps.sum()),
        "longest_gap_s": float(steps.max()) if gaps.any() else 0.0,
    }


def _text(facts: dict[str, float | int | None]) -> str:
    if facts["rate_hz"] is None:
        return ""
    gaps = (
        f", {facts['gaps']} gaps, the longest {facts['longest_gap_s']:.3g} s"
        if facts["gaps"]
        else ", no gap"
    )
    jitter_ms = facts["jitter_ms"] or 0.0
    if jitter_ms < _STAMPS.even_ms:
        jitter = "even"
    else:
        jitter = f"jitter {jitter_ms:.3g} ms"
    return f" in {facts['duration_s']:.2f} s, {facts['rate_hz']:.4g} Hz, {jitter}{gaps}"
