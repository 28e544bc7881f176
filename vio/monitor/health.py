"""Monitor a run for divergence by the estimator's outputs, and for features that it refuses;
each event is one line.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from vio.calibration.severity import rows_grade
from vio.dataclass import dataclass
from vio.findings import Finding, begun, ended
from vio.geometry.lie import FloatArray, length
from vio.numerics.robust import median
from vio.numerics.statistics import chi_square_quantile, squared_distance
from vio.records import (
    MAX_GYRO_BIAS_RADPS,
    NS_PER_S,
    ROW_TERMS,
    BoolArray,
    Estimate,
    IntArray,
    Observations,
    StereoFieldEstimate,
    UpdateReport,
)


class _GapRules(NamedTuple):
    """When frames or features are missing."""

    unseen_s: float = 1.0  # without a usable feature for longer, the pose is a prediction only
    min_s: float = 0.5  # between frames: a gap if longer, and so many times the usual time
    steps: float = 5.0
    min_steps: int = 5  # between frames, for the usual time to be known; and that it is taken from
    recent_steps: int = 50


_GAPS = _GapRules()


class _RigRules(NamedTuple):
    """When the estimated calibration is that of no rig."""

    # No rig comes to this by a camera that turns in its mount (docs/notes/design_decisions.md,
    # swapped cameras).
    other_pair_px: float = 10.0
    # of a baseline, which images in reverse order nearly take away: KITTI 06, 0039: -83, -81
    backwards_percent: float = -60.0
    scale_off_percent: float = 1.0  # of baseline or focal length, both to be exceeded
    scale_sigmas: float = 3.0
    # chi-square probability of the rows' field: fewer are called off by noise. 60 matches with a
    # noise of 0.3 px fit 0.15 px.
    rows_probability: float = 0.9999


_RIG = _RigRules()


class _PossibleRules(NamedTuple):
    """When an estimate is impossible."""

    restart_event_s: float = 1.0  # restarts that follow each other within this time are one event
    max_speed_mps: float = 100.0
    max_accel_bias_mps2: float = 3.0
    # of the clocks' offset beside that of the rates of gyro and images, beyond its sigmas
    max_offset_error_s: float = 0.02
    offset_sigmas: float = 3.0
    # after which an estimate is possible again: none that is not, and features within so many
    # standard deviations of where they were predicted
    settled_s: float = 5.0
    settled_sigmas: float = 2.0


_POSSIBLE = _PossibleRules()
_STATE = ("speed", "gyro bias", "accelerometer bias", "clock")  # what is implausible of a state
_SCALES = ("baseline", "focal length")


def is_corrected(finding: Finding) -> bool:
    """Whether a run corrects what was found, so that it is information, not a warning: a stereo
    calibration that is off by no more than other rigs' are.
    """
    if finding.code != "stereo-calibration-off":
        return False
    return rows_grade(finding.figures["rows_rms_px"]) == "worth calibrating"


def _rows_are_off(field: StereoFieldEstimate) -> bool:
    """Whether rows of left and right differ by more than is negligible, and than the noise of the
    matches that they are fitted to explains.
    """
    if rows_grade(field.rows_rms_px) == "negligible":
        return False
    if field.rows is None or field.rows_covariance is None:
        return True
    limit = float(chi_square_quantile(_RIG.rows_probability, ROW_TERMS))
    return not squared_distance(field.rows, field.rows_covariance, 0.0) <= limit


class RunHealth:
    """Monitor each frame's report and estimate; return a finding when an event begins or ends."""

    def __init__(self) -> None:
        self._last: tuple[int, FloatArray] | None = None  # time and position of the frame before
        # index and time of the last frame with used features
        self._last_used: tuple[int, int] | None = None
        self._without_features = False
        self._steps_s: deque[float] = deque(maxlen=_GAPS.recent_steps)
        self._last_index = 0
        self._reported: set[str] = set()
        self._restarted_ns: int | None = None  # time of the last restart
        self._impossible = False  # the present state
        # time of the last frame with such a state, or that the images contradict
        self._off_ns: int | None = None

    def restarted(self, index: int, why: str, estimate: Estimate) -> tuple[Finding, ...]:
        """Return the finding on a restart from an estimate, with the reason; none within a second
        of the last one.
        """
        last_ns = self._restarted_ns
        self._restarted_ns = estimate.time_ns
        self._last = estimate.time_ns, estimate.T_world_imu[:3, 3].copy()
        if last_ns is not None and (estimate.time_ns - last_ns) * 1e-9 < _POSSIBLE.restart_event_s:
            return ()
        sigma = _position_sigma(estimate)
        message = (
            f"frame {index}: {why}; started again from the last good pose, the standard deviation "
            f"of its position is {sigma:.2f} m"
        )
        return (Finding("estimate-restarted", message, index, figures={"sigma_m": sigma}),)

    def begin_again(self, before: RunHealth) -> None:
        """Take what was found before, but for a state that another one has replaced from the first
        frame on.
        """
        self._reported = before._reported - {*_SCALES, *_STATE}

    def begun_anew(self, index: int, good_ns: int, estimate: Estimate) -> Finding:
        """Return the finding on a new start from the sensors, with an estimate after it; what was
        found of the state before is forgotten.
        """
        self._last = estimate.time_ns, estimate.T_world_imu[:3, 3].copy()
        sigma = _position_sigma(estimate)
        ago_s = (estimate.time_ns - good_ns) / NS_PER_S
        message = (
            f"frame {index}: the filter was begun anew by the sensors, as its state was impossible; "
            f"position and heading go on from {ago_s:.1f} s ago, the standard deviation of the "
            f"position is {sigma:.2g} m"
        )
        self._reported -= {*_SCALES, *_STATE}
        return Finding("estimate-restarted", message, index, figures={"sigma_m": sigma})

    def frame(self, index: int, report: UpdateReport, estimate: Estimate) -> tuple[Finding, ...]:
        """Return the findings of a frame, by what its update did and the estimate after it."""
        found = [*self._gap(index, estimate), *self._features(index, report, estimate)]
        found += self._stereo(index, estimate)
        found += self._jump(index, report)
        found += self._implausible(index, estimate)
        found += self._settled(index, report, estimate)
        return tuple(found)

    def _jump(self, index: int, report: UpdateReport) -> list[Finding]:
        """Report the first time that the gyro's bias has jumped."""
        jump_radps = report.gyro_jump_radps
        if jump_radps is None or "gyro jump" in self._reported:
            return []
        self._reported.add("gyro jump")
        message = (
            f"frame {index}: the gyro's bias has jumped by {jump_radps:.2g} rad/s, as all images "
            "show: the sensor was shocked or restarted; the bias was estimated anew, by the images"
        )
        return [Finding("gyro-jumped", message, index, figures={"jump_radps": jump_radps})]

    def _gap(self, index: int, estimate: Estimate) -> list[Finding]:
        """Report a time without frames, with what is known of the pose after it."""
        last = self._last
        last_index = self._last_index
        self._last_index = index
        if last is None:
            return []
        step_s = (estimate.time_ns - last[0]) * 1e-9
        usual_s = np.inf
        # a shorter one is no gap, whatever is usual
        if step_s > _GAPS.min_s and len(self._steps_s) >= _GAPS.min_steps:
            usual_s = median(self._steps_s)
        self._steps_s.append(step_s)
        if step_s <= max(_GAPS.min_s, _GAPS.steps * usual_s):
            return []
        sigma = _position_sigma(estimate)
        message = (
            f"frame {index}: no frame for {step_s:.2f} s since frame {last_index}; the motion in "
            f"between is a prediction, the standard deviation of the position is {sigma:.2g} m "
            "after it"
        )
        figures = {"gap_s": step_s, "sigma_m": sigma}
        return [Finding("frames-missing", message, index, figures=figures)]

    def _stereo(self, index: int, estimate: Estimate) -> list[Finding]:
        """Report once that the filter estimates the stereo calibration, as the rows show that it
        is off.
        """
        field = estimate.stereo_field
        if field is None or not _rows_are_off(field):
            return []
        other_pair = field.rows_rms_px > _RIG.other_pair_px
        # what begins as a small error may come out as that of another pair
        said = "other pair" if other_pair else "stereo"
        if said in self._reported:
            return []
        self._reported |= {"stereo", said}
        seen = "the rows of left and right images differ"
        figures = {"rows_rms_px": field.rows_rms_px}
        if other_pair:
            text = (
                f"{seen} by {field.rows_rms_px:.2f} px (rms): left and right are exchanged, the "
                "calibration is not that of these images (as of rectified ones, where they are "
                "raw), or a camera was moved; `vio calibrate` "
                "finds which; what the calibration is off by is estimated while running, which may "
                "not suffice (msckf.calibrate_stereo)"
            )
            return [begun("other-calibration", index, text, figures=figures)]
        # What is corrected needs no figure here: the run ends with one.
        grade = rows_grade(field.rows_rms_px)
        if grade == "worth calibrating":
            size = ""
        else:
            size = f" by {field.rows_rms_px:.2f} px (rms)"
        verdict = "" if grade == "worth calibrating" else f", {grade}"
        message = (
            f"frame {index}: {seen}{size} in a smooth pattern: the stereo calibration is off{verdict}; "
            "by how much is estimated while running, and stated at the end (msckf.calibrate_stereo)"
        )
        return [Finding("stereo-calibration-off", message, index, figures=figures)]

    def scale(self, index: int, estimate: Estimate) -> list[Finding]:
        """Return once that baseline or focal length differ from the calibration significantly
        and harmfully.
        """
        lines: list[Finding] = []
        found = {} if estimate.stereo_scale is None else estimate.stereo_scale.percent()
        for name, (percent, sigma) in found.items():
            if (
                abs(percent) <= max(_RIG.scale_off_percent, _RIG.scale_sigmas * sigma)
                or name in self._reported
            ):
                continue
            self._reported.add(name)
            # One scale does not tell them apart.
            named = (
                f"{name}, or the focal length," if len(found) == 1 and name == "baseline" else name
            )
            order = ""
            if name == "baseline" and percent < _RIG.backwards_percent:
                order = "the order of the images (against a sensor they run backwards), "
            text = (
                f"the {named} is {abs(percent):.1f} % "
                f"{'longer' if percent > 0 else 'shorter'} than "
                f"calibrated (standard deviation {sigma:.1g} %), by the motion that the sensor "
                f"measures; check {order}the sensor (unit, axes, clock) and that images and "
                "calibration have one size (of depth images, dataset.depth_factor); then calibrate "
                "the cameras anew, or run with what --save-calibration keeps"
            )
            figures = {"off_percent": percent, "sigma_percent": sigma}
            lines.append(begun("scale-off", index, text, figures=figures))
        return lines

    def _features(self, index: int, report: UpdateReport, estimate: Estimate) -> list[Finding]:
        """Report when features have been missing for long, and when they are back."""
        time_ns = estimate.time_ns
        starts = report.initialised > 0 and not self._without_features
        if report.used > 0 or starts or self._last_used is None:
            was_without = self._without_features
            if self._last_used is None:
                away_s = 0.0
            else:
                away_s = (time_ns - self._last_used[1]) * 1e-9
            self._last_used = (index, time_ns)
            self._without_features = False
            if not was_without:
                return []
            return [ended("no-features", index, f"features again, after {away_s:.1f} s without")]
        seconds = (time_ns - self._last_used[1]) * 1e-9
        if self._without_features or seconds < _GAPS.unseen_s:
            return []
        self._without_features = True
        sigma = _position_sigma(estimate)
        text = (
            f"no usable feature since frame {self._last_used[0]} ({seconds:.1f} s); "
            f"the pose is a prediction, the standard deviation of its position is {sigma:.2f} m"
        )
        since = self._last_used[0] + 1
        return [begun("no-features", index, text, since)]

    def _implausible(self, index: int, estimate: Estimate) -> list[Finding]:
        """Report once when the state is implausible for a vehicle."""
        lines: list[Finding] = []
        self._impossible = False
        position = estimate.T_world_imu[:3, 3].copy()
        if self._last is not None and estimate.time_ns > self._last[0]:
            elapsed_s = (estimate.time_ns - self._last[0]) * 1e-9
            speed = length(position - self._last[1]) / elapsed_s
            line = f"the estimate moves at {speed:.0f} m/s: the filter has diverged"
            lines += self._once(index, "speed", speed, _POSSIBLE.max_speed_mps, line)
        self._last = estimate.time_ns, position
        for name, bias, limit, unit in (
            ("gyro bias", estimate.gyro_bias, MAX_GYRO_BIAS_RADPS, "rad/s"),
            ("accelerometer bias", estimate.accel_bias, _POSSIBLE.max_accel_bias_mps2, "m/s^2"),
        ):
            if bias is not None:
                size = length(bias)
                line = f"the {name} is estimated as {size:.2g} {unit}, which no working sensor has"
                lines += self._once(index, name, size, limit, line)
        return lines

    def clock(
        self, index: int, estimate: Estimate, offset_s: float | None, since: int
    ) -> list[Finding]:
        """Report once that the clocks' offset is not what the rates of gyro and images show.

        Args:
            index: frame number.
            estimate: of the frame.
            offset_s: by the rates, see `InertialCheck.clock_offset_s`.
            since: the first frame that they are of.
        """
        known = estimate.time_offset_s
        if offset_s is None or known is None or "clock" in self._reported:
            return []
        sigma = estimate.time_offset_sigma_s or 0.0
        off = abs(known - offset_s)
        if off <= _POSSIBLE.max_offset_error_s + _POSSIBLE.offset_sigmas * sigma:
            return []
        self._reported.add("clock")
        text = (
            f"the estimate has frames exposed {1e3 * known:+.1f} ms after their stamps "
            f"on the IMU's clock, the rates of gyro and images show {1e3 * offset_s:+.0f} ms: a clock "
            "has jumped"
        )
        return [begun("estimate-implausible", index, text, since)]

    def _settled(self, index: int, report: UpdateReport, estimate: Estimate) -> list[Finding]:
        """Report that the state has been possible for long, as of a filter that has found its start
        and that nothing replaces.
        """
        time_ns = estimate.time_ns
        ratio = report.innovation_ratio
        off = self._impossible or ratio is None or ratio > _POSSIBLE.settled_sigmas
        if self._off_ns is None or off:
            self._off_ns = time_ns
        waits = time_ns - self._off_ns < _POSSIBLE.settled_s * NS_PER_S
        # a clock that has jumped is not seen in the state
        if waits or "clock" in self._reported or not self._reported.intersection(_STATE):
            return []
        self._reported -= {*_STATE}
        text = "the estimate is one that a working rig can have again, and the images agree with it"
        return [ended("estimate-implausible", index, text)]

    def _once(self, index: int, what: str, value: float, limit: float, line: str) -> list[Finding]:
        self._impossible |= value > limit
        if value <= limit or what in self._reported:
            return []
        self._reported.add(what)
        text = f"{line}; check the order of the images, calibration, units and clocks"
        return [begun("estimate-implausible", index, text)]


def _position_sigma(estimate: Estimate) -> float:
    """Standard deviation of the position, m."""
    return math.sqrt(estimate.covariance[:3, :3].trace())


class _RefusedRules(NamedTuple):
    """When the filter refuses what it is given."""

    span_s: float = 1.0
    min_frames: int = 3
    # of the features over the span; healthy recordings come to a third at most
    max_share: float = 0.4
    # of the features, at most, where half of those refused are: then they lie together
    together_share: float = 0.2
    # innovations over their standard deviation: more, and the motion sensor contradicts the images
    contradicted_sigmas: float = 2.0


_REFUSED = _RefusedRules()
_CELLS = 6, 4  # columns and rows that the image is divided into


@dataclass(frozen=True, slots=True)
class _Frame:
    time_ns: int
    used: int
    gated: int
    seen: Observations  # its features
    refused_ids: IntArray  # of those refused
    innovation_ratio: float | None

    def refused(self) -> BoolArray:
        """Which features (N,) were refused."""
        return np.isin(self.seen.ids, self.refused_ids)


class RefusalReport:
    """Reports once that many features are refused over a second, with the likeliest cause."""

    def __init__(self, *, imu: bool) -> None:
        """Begin; `imu`: whether an IMU predicts the motion."""
        self.imu = imu
        self._reported = False
        self._frames: deque[_Frame] = deque()
        self._used = 0  # features of these frames
        self._gated = 0

    def frame(self, seen: Observations, report: UpdateReport, estimate: Estimate) -> list[Finding]:
        """Add the features of a frame and what the filter did with them; return the finding to
        report, if any.
        """
        if self._reported:
            return []
        used = report.used
        gated = report.gated
        self._frames.append(
            _Frame(seen.time_ns, used, gated, seen, report.gated_ids, report.innovation_ratio)
        )
        self._used += used
        self._gated += gated
        full = False
        while seen.time_ns - self._frames[0].time_ns >= _REFUSED.span_s * 1e9:
            old = self._frames.popleft()
            self._used -= old.used
            self._gated -= old.gated
            full = True
        kept = self._used
        gone = self._gated
        if (
            not full
            or len(self._frames) < _REFUSED.min_frames
            or gone <= _REFUSED.max_share * (kept + gone)
        ):
            return []
        self._reported = True
        share = gone / (kept + gone)
        message = (
            f"frame {seen.frame_index}: {100 * share:.0f} % of the features of the last second "
            f"were refused, as they contradict the others: {self._cause(estimate)}"
        )
        figures = {"refused_share": share}
        return [Finding("features-refused", message, seen.frame_index, figures=figures)]

    def _cause(self, estimate: Estimate) -> str:
        """The likeliest cause by the evidence."""
        ratio = self._innovation_ratio()
        if self.imu and ratio > _REFUSED.contradicted_sigmas:
            return (
                f"the images show features {ratio:.1f} standard deviations beside where the IMU "
                "predicts them; "
                "check the IMU, its clock and its place on the camera (vio check)"
            )
        place = self._place()
        if place is not None:
            return f"most lie together {place}; something moves there, or a lens is dirty"
        where = (
            "they are spread over the image; "
            if any(f.refused().any() for f in self._frames)
            else ""
        )
        field = estimate.stereo_field
        if field is not None and _rows_are_off(field):
            return (
                f"{where}rows differ by {field.rows_rms_px:.2f} px (rms) in a smooth pattern; "
                "calibrate the cameras (vio calibrate)"
            )
        return f"{where}blurred images, repeated texture, or many things that move"

    def _innovation_ratio(self) -> float:
        """How many standard deviations the features lie beside where they were predicted (median)."""
        ratios = [f.innovation_ratio for f in self._frames if f.innovation_ratio is not None]
        return median(ratios) if ratios else 0.0

    def _place(self) -> str | None:
        """Where in the image half of the refused features lie with few others.

        None: they are spread.
        """
        pixels = np.concatenate([f.seen.z[:, :2] for f in self._frames])
        refused = np.concatenate([f.refused() for f in self._frames])
        if not refused.any():
            return None
        low = pixels.min(axis=0)
        size = np.maximum(np.ptp(pixels, axis=0), 1.0)
        cells = np.minimum(
            ((pixels - low) / size * _CELLS).astype(np.int64), np.array(_CELLS) - 1
        ) @ [_CELLS[1], 1]
        total = np.bincount(cells, minlength=_CELLS[0] * _CELLS[1])
        count = np.bincount(cells[refused], minlength=len(total))
        order = np.argsort(-count / np.maximum(total, 1), kind="stable")
        half = 1 + np.searchsorted(np.cumsum(count[order]), count.sum() / 2)
        if total[order[:half]].sum() > _REFUSED.together_share * total.sum():
            return None
        u, v = np.median(pixels[refused & np.isin(cells, order[:half])], axis=0)
        return f"in the image, around ({u:.0f}, {v:.0f})"
