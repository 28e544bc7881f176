"""Between odometry and map: chooses keyframes, hands them to the map's thread, and takes back what
it finds.

What a keyframe brings is taken over a fixed number of frames after it, by waiting if need be. So
the result does not depend on how fast the thread was, and repeats to the bit. In live use no frame
waits: a map that is behind gets its next keyframe later.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.builder import Keyframe, MapBuilder, MapUpdate, check_camera
from vio.mapping.features import KeyframeFeatures, extract
from vio.mapping.map_store import MapStore
from vio.records import (
    Estimate,
    IntArray,
    LoopEvent,
    MapKeyframes,
    Observations,
    StereoFrame,
    no_map_keyframes,
)

_T = TypeVar("_T")
Relative: TypeAlias = Callable[[int, int], "RelativePose | None"]


class _KeyframeRules(NamedTuple):
    """When a frame becomes a keyframe."""

    # of the last keyframe's features that are still seen: below it, a new keyframe
    max_shared_share: float = 0.6
    # keyframes without a result, where the odometry waits for none: beyond, the next one comes
    # later
    max_waiting: int = 3


_KEYFRAMES = _KeyframeRules()


@dataclass(frozen=True, slots=True)
class _Choice:
    """What becomes a keyframe, and what its motion is worth."""

    # with a right pixel; or half of the most that a frame had, where features are set to be few
    min_features: int = 30
    min_tracked: int = 6  # likewise, by which the odometry can still follow
    # frames between keyframes of a session that is localised, where nothing is stored
    localise_step: int = 5
    lost_step: int = 3  # likewise while it has no place
    lost_m: float = 1.0  # standard deviation of the position, likewise
    # On the standard deviations of a motion: errors of a track last longer than a frame, which
    # the window does not count. Measured over a keyframe's step: 1.6 to 3.1 times the standard
    # deviation (street), 1.2 to 3.1 (room).
    motion_inflation: float = 2.0
    # Added to them, as shares of a motion's length and angle: what stays the same from motion to
    # motion, such as errors of the calibration. Rendered street and room come out 0.05 % off in
    # length and 0.02 % in angle, in each motion, which is many times the standard deviation that
    # the tracks leave.
    motion_shares: tuple[float, float] = (5e-4, 2e-4)
    # Where images show nothing, a filter without a motion sensor holds its velocity; a hand or a
    # car in a curve does not.
    dark_s: float = 0.5


_CHOICE = _Choice()
HANDOVER_FRAMES = 10  # from a keyframe to the frame at which its result is taken over
# from a keyframe to the frame after which its motion is no longer corrected by the window
SETTLED_FRAMES = 3
# errors of the vertical last longer than from keyframe to keyframe
_MIN_UP_SIGMA_RAD = float(np.radians(0.1))
# variance of the motion where the filter began anew, m^2 and rad^2
_BROKEN = np.repeat([30.0**2, 1.0**2], 3)


@dataclass(slots=True)
class _Held:
    """A keyframe whose motion the filter's window still corrects."""

    keyframe: Keyframe  # without its motion
    due: int  # when its motion is taken
    anchor: int | None  # a frame from which the window knows it; None: the first keyframe
    base: RelativePose | None  # from the keyframe before to the anchor, where that is another frame
    motions: list[RelativePose]  # since the keyframe before, as known at each frame from it on


class MapSession:
    """One trajectory in a map."""

    def __init__(
        self,
        path: Path,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        *,
        source: str,
        imu: bool,
        localise: bool,
        wait: bool = True,
        alone: bool = False,
        density: int | None = None,
        rig_sigmas: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Open the map.

        Args:
            path: the map's file; made where it does not exist, unless `localise`.
            camera: rectified pair.
            T_cam0_body: (4, 4) extrinsics of the body whose poses come.
            source: names the recording.
            imu: whether the vertical is known.
            localise: leave the map as it is.
            wait: for the map's thread where it is behind; False: a result is taken over once it is
                there, and no frame becomes a keyframe while several wait.
            alone: whether the odometry has images alone, so that it is lost where they show
                nothing.
            density: keyframes a cubic metre that can be found again; None: all.
            rig_sigmas: those of `Keyframe`, by the calibration as given.

        Raises:
            ConfigError: the images are not those of a pinhole stereo pair.
            DataError: the map cannot be used.
        """
        check_camera(path, camera)
        self._localise = localise
        self._imu = imu
        self._alone = alone
        self._wait = wait
        self._camera = camera
        self._rig_sigmas = rig_sigmas
        self.scale_sigma = rig_sigmas[0]  # as the filter knows it at the newest frame
        # what the stereo calibration is off by, at the newest frame
        self._field: DisplacementField | None = None
        self._T_cam_body = T_cam0_body
        self._T_body_cam = se3_inverse(T_cam0_body)
        store = MapStore(path, create=not localise, read_only=localise)
        self._builder = MapBuilder(
            store, source, camera, upright=imu, localise=localise, density=density
        )
        self._executor = ThreadPoolExecutor(1, "map")
        # when it is due, frame, result
        self._waiting: list[tuple[int, int, Future[MapUpdate]]] = []
        self._frames = 0
        self._ids: IntArray = np.zeros(0, dtype=np.int64)  # stereo features of the last keyframe
        self._base: RelativePose | None = None  # from the last keyframe to the anchor
        self._anchor: int | None = None  # a frame in the filter's window
        # Newest frame: its number, the motion since the last keyframe, its pose by odometry.
        self._newest: tuple[int, RelativePose, FloatArray] | None = None
        self._since = 0  # frames since the last keyframe
        self._last_keyframe: int | None = None  # its frame
        self._most_features = 0  # with a right pixel, of a frame
        self._seen_ns: int | None = None  # newest frame with features
        self._seen: Estimate | None = None  # likewise
        self._dark: RelativePose | None = (
            None  # motion of the body since then, of a frame that the window does not hold
        )
        self._T_map_odom: FloatArray | None = (
            np.eye(4) if self._builder.first == 0 and not localise else None
        )
        self._T_odom_body: FloatArray = np.eye(4)  # at the newest frame
        # Of the newest keyframe with a result: (6, 6) covariance in the map, and (4, 4) pose once a
        # loop holds it
        self._known: FloatArray | None = None if self._T_map_odom is None else np.zeros((6, 6))
        self._T_map_cam: FloatArray | None = None
        self._unconfirmed = False  # whether it found a place that another keyframe may confirm
        # later keyframes, each with the motion since the one before
        self._moves: list[tuple[int, RelativePose]] = []
        self._held: list[_Held] = []  # newest keyframes, which are not yet added
        self._features: list[Future[KeyframeFeatures]] = []  # of each of them
        self.loops: list[LoopEvent] = []

    def frame(
        self, frame: StereoFrame, seen: Observations, estimate: Estimate, relative: Relative
    ) -> tuple[LoopEvent, ...]:
        """Take a processed frame; return the loops whose time has come.

        Args:
            frame: with its images.
            seen: what the front end saw.
            estimate: of the filter.
            relative: the filter's motion between two frames of its window.
        """
        self._frames += 1
        self._T_odom_body = estimate.T_world_imu
        self._take_calibration(estimate)
        self._release(relative)
        events = self._take(lambda due, done: due <= self._frames and (done or self._wait))
        fresh = seen.take(seen.has_right & ~seen.stale)
        motion = self._follow(frame, len(fresh), estimate, relative)
        self._most_features = max(self._most_features, len(fresh))
        enough = min(_CHOICE.min_features, 0.5 * self._most_features)
        if len(fresh) and len(fresh) >= enough:
            self._consider(frame, fresh.ids, estimate, motion)
        return events

    def _take_calibration(self, estimate: Estimate) -> None:
        if estimate.stereo_field is not None:
            self._field = DisplacementField.of(self._camera, estimate.stereo_field)
        scale = estimate.stereo_scale
        self.scale_sigma = (
            self._rig_sigmas[0] if scale is None else float(np.sqrt(scale.covariance.sum()))
        )

    def finish(self) -> tuple[LoopEvent, ...]:
        """Wait for everything, and write the map."""
        self._release(None)
        events = self._take(lambda due, done: True)
        if self._frames:
            ended = self._executor.submit(self._builder.finish, self._field).result()
            self._T_map_odom = ended.T_map_odom
            self._T_map_cam = None
        return events

    def close(self) -> None:
        """Write what there is, end the thread and let the file go."""
        self._executor.shutdown(wait=True)
        self._builder.commit()
        self._builder.close()

    def keyframes(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return frame numbers (K,) of this session's keyframes, optimised poses and those of the
        odometry.

        Both (K, 4, 4), of the body.
        """
        graph = self._builder.graph
        own = slice(self._builder.first, None)
        frames = np.array(
            [graph.frame(k) for k in range(self._builder.first, len(graph))], dtype=np.int64
        )
        return (
            frames,
            graph.T_map_cam[own] @ self._T_cam_body,
            graph.T_odom_cam[own] @ self._T_cam_body,
        )

    def map_keyframes(self) -> MapKeyframes:
        """Return all keyframes of the map that are in the frame of this session's poses.

        Their covariance is that of odometry, verticals and loops.
        """
        graph = self._builder.graph
        first = self._builder.first
        if len(graph) <= first:
            return no_map_keyframes()
        part = graph.part[first]
        A = se3_adjoint(self._T_body_cam)
        rows = np.flatnonzero(graph.part == part)
        frames, times = (
            np.array([of(k) for k in rows.tolist()], dtype=np.int64)
            for of in (graph.frame, graph.time_ns)
        )
        P = A @ graph.covariances(part) @ A.T
        return MapKeyframes(
            rows, frames, times, rows >= first, graph.T_map_cam[rows] @ self._T_cam_body, P
        )

    def settled_loops(self) -> tuple[LoopEvent, ...]:
        """Return the loops so far, each with what the newest optimisation said of it."""
        graph = self._builder.graph
        kept = {
            (o.first, graph.frame(o.second)): o.kept
            for o in graph.loops
            if o.second >= self._builder.first
        }
        return tuple(replace(o, kept=kept[o.keyframe, o.frame]) for o in self.loops)

    @property
    def newest_keyframe(self) -> int | None:
        """Frame number of the session's newest keyframe."""
        return self._last_keyframe

    @property
    def T_map_odom(self) -> FloatArray | None:
        """Pose (4, 4) of the odometry's world in the map, by the newest frame; None without a
        place.

        Once a loop holds the place, a frame is where the newest keyframe with a result is, moved by
        the motions of the filter's window since: a filter that learns what it was off by moves its
        newest pose, and not these.
        """
        now = self._now()
        if now is None or self._T_map_cam is None:
            return self._T_map_odom
        return now.T_i_j @ self._T_cam_body @ se3_inverse(self._T_odom_body)

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance (6, 6) of xi in T_map_body = T_hat exp(xi), [rho; phi], at the newest frame,
        in the map's frame.

        That of the newest keyframe whose place is known, grown by the odometry since; None without
        a place. Where images show nothing, it grows as the filter's own; of images alone, the place
        is soon not known.
        """
        now = self._now()
        if now is None:
            return None
        A = se3_adjoint(self._T_body_cam)
        return A @ now.covariance @ A.T

    def _now(self) -> RelativePose | None:
        """Return the camera's pose in the map at the newest frame, its keyframe's being the
        identity if not known.
        """
        if self._known is None:
            return None
        now = RelativePose(np.eye(4) if self._T_map_cam is None else self._T_map_cam, self._known)
        for motion in [
            *(move[1] for move in self._moves),
            *(m for h in self._held for m in h.motions[-1:]),
        ]:
            now = now.then(motion)
        if self._newest is not None:
            now = now.then(self._newest[1])
        if self._dark is not None:
            now = now.then(self._dark.seen_by(self._T_cam_body))
        return now

    @property
    def is_joined(self) -> bool:
        """Whether the session's poses are in the map's frame."""
        return self._builder.is_joined

    # Keyframes

    def _is_lost(self, time_ns: int) -> bool:
        """Whether the odometry cannot know the motion since the newest frame with features."""
        return (
            self._alone
            and self._seen_ns is not None
            and 1e-9 * (time_ns - self._seen_ns) > _CHOICE.dark_s
        )

    def _motion_to(self, frame: int, estimate: Estimate, relative: Relative) -> RelativePose | None:
        """Return the camera's motion since the last keyframe with its covariance; None before the
        first keyframe.

        The anchor follows where the filter's window moves on; motions from anchor to anchor are
        taken as independent.
        """
        if self._anchor is None:
            return None
        motion = relative(self._anchor, frame)
        if motion is None and self._newest is not None:
            self._anchor = self._newest[0]
            self._base = self._newest[1]
            motion = relative(self._anchor, frame)
        T_odom_cam = estimate.T_world_imu @ self._T_body_cam
        if motion is None:  # the filter began anew, or is blind
            if relative(frame, frame) is None or self._newest is None:
                return None
            last = self._newest
            jump = RelativePose(se3_inverse(last[2]) @ T_odom_cam, np.diag(_BROKEN))
            self._base = last[1].then(jump)
            self._anchor = frame
            total = self._base
        else:
            total = motion.seen_by(self._T_cam_body)
            if self._base is not None:
                total = self._base.then(total)
        self._newest = frame, total, T_odom_cam
        return total

    def _follow(
        self, frame: StereoFrame, features: int, estimate: Estimate, relative: Relative
    ) -> RelativePose | None:
        """Return the camera's motion since the last keyframe as `_motion_to` does, and keep what is
        known of a frame that shows too few features.
        """
        is_lost = self._is_lost(frame.time_ns)
        seen_now = features >= _CHOICE.min_tracked
        motion = self._motion_to(
            frame.index, estimate, _unknown if seen_now and is_lost else relative
        )
        self._dark = None
        if motion is None and self._seen is not None:
            dark = _predicted(self._seen, estimate)
            if is_lost:
                self._dark = RelativePose(dark.T_i_j, np.diag(_BROKEN))
            else:
                self._dark = dark
        if seen_now:
            self._seen_ns = frame.time_ns
            self._seen = estimate
        return motion

    def _consider(
        self, frame: StereoFrame, ids: IntArray, estimate: Estimate, motion: RelativePose | None
    ) -> None:
        """Make a frame that shows enough a keyframe, where one is due."""
        if frame.left is None or frame.right is None:
            return
        self._since += 1
        if motion is None and self._newest is not None:
            return
        busy = not self._wait and len(self._waiting) + len(self._held) >= _KEYFRAMES.max_waiting
        if not busy and self._is_due(ids, motion):
            self._hold(frame, ids, estimate, motion)

    def _is_due(self, ids: IntArray, motion: RelativePose | None) -> bool:
        """Whether a frame becomes a keyframe: it shows little of what the last one showed."""
        if motion is None:
            return True
        if self._unconfirmed and self._since >= _CHOICE.lost_step:
            return True
        if self._localise and self._since >= _CHOICE.lost_step:
            covariance = self.covariance
            lost = covariance is None or covariance[:3, :3].trace() > _CHOICE.lost_m**2
            if lost or self._since >= _CHOICE.localise_step:
                return True
        return bool(np.isin(self._ids, ids).mean() < _KEYFRAMES.max_shared_share)

    def _hold(
        self, frame: StereoFrame, ids: IntArray, estimate: Estimate, motion: RelativePose | None
    ) -> None:
        assert frame.left is not None
        assert frame.right is not None
        T_odom_cam = estimate.T_world_imu @ self._T_body_cam
        up, sigma = self._vertical(estimate)
        seen = up, sigma, self._field, (self.scale_sigma, self._rig_sigmas[1])
        keyframe = Keyframe(frame.index, frame.time_ns, T_odom_cam, None, *seen)
        motions = [] if motion is None else [_inflated(motion)]
        self._held.append(
            _Held(keyframe, self._frames + SETTLED_FRAMES, self._anchor, self._base, motions)
        )
        self._features.append(self._executor.submit(extract, frame.left, frame.right))
        self._ids = ids
        self._base = None
        self._anchor = frame.index
        self._since = 0
        self._last_keyframe = frame.index
        self._newest = frame.index, RelativePose(np.eye(4), np.zeros((6, 6))), T_odom_cam

    def _release(self, relative: Relative | None) -> None:
        """Take the newest motions as known now, and hand over the keyframes that are due; None:
        all, as they are.

        The filter may accept a single wrong image and correct the pose with the next ones.
        """
        if relative is not None:
            for held in self._held:
                self._add_motion(held, relative)
        while self._held and (relative is None or self._held[0].due <= self._frames):
            self._hand_over(self._held.pop(0))

    def _add_motion(self, held: _Held, relative: Relative) -> None:
        if held.anchor is None:
            motion = None
        else:
            motion = relative(held.anchor, held.keyframe.frame)
        if motion is None:
            return
        motion = motion.seen_by(self._T_cam_body)
        held.motions.append(_inflated(motion if held.base is None else held.base.then(motion)))

    def _hand_over(self, held: _Held) -> None:
        motion = None
        if held.motions:
            motion = _middle(held.motions)
        keyframe = replace(held.keyframe, motion=motion)
        result = self._executor.submit(_add, self._builder, keyframe, self._features.pop(0))
        due = held.due + HANDOVER_FRAMES - SETTLED_FRAMES
        self._waiting.append((due, keyframe.frame, result))
        if keyframe.motion is not None:
            self._moves.append((keyframe.frame, keyframe.motion))

    def _vertical(self, estimate: Estimate) -> tuple[FloatArray | None, float]:
        """Direction against gravity in the camera (3,) and its standard deviation.

        None where it is not known.
        """
        if not self._imu or estimate.tilt_sigma_rad is None:
            return None, 0.0
        up_body = estimate.T_world_imu[2, :3]
        if estimate.gravity_world is not None:
            up_world = -estimate.gravity_world / np.linalg.norm(estimate.gravity_world)
            up_body = estimate.T_world_imu[:3, :3].T @ up_world
        return self._T_cam_body[:3, :3] @ up_body, max(estimate.tilt_sigma_rad, _MIN_UP_SIGMA_RAD)

    # Results

    def _take(self, is_due: Callable[[int, bool], bool]) -> tuple[LoopEvent, ...]:
        """Take over what is due, by frame and whether it is done, waiting for it; the map's
        errors are raised here.
        """
        events: list[LoopEvent] = []
        while self._waiting and is_due(self._waiting[0][0], self._waiting[0][2].done()):
            _, frame, result = self._waiting.pop(0)
            update = result.result()
            self._T_map_odom = update.T_map_odom
            self._known = update.covariance
            self._T_map_cam = update.T_map_cam
            self._unconfirmed = update.unconfirmed
            self._moves = [move for move in self._moves if move[0] > frame]
            events += update.loops
        self.loops += events
        return tuple(events)

    # Checkpoints

    def __getstate__(self) -> dict[str, Any]:
        """State for a checkpoint: waits for the thread, and brings the map to the disk."""
        results = [(due, frame, future.result()) for due, frame, future in self._waiting]
        self._executor.submit(self._builder.commit).result()
        features = [future.result() for future in self._features]
        state = {
            key: value
            for key, value in self.__dict__.items()
            if key not in ("_executor", "_waiting")
        }
        return {**state, "_results": results, "_features": features}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a checkpoint; `reopen` then gives it the map's file."""
        results = state.pop("_results")
        features = state.pop("_features")
        self.__dict__.update(state)
        self._executor = ThreadPoolExecutor(1, "map")
        self._features = [_done(each) for each in features]
        self._waiting = [(due, frame, _done(update)) for due, frame, update in results]

    def reopen(self, path: Path) -> None:
        """Go on from a checkpoint with the map in a file, as it was then.

        Raises:
            DataError: the map cannot be used.
        """
        self._builder.reopen(MapStore(path, read_only=self._localise))


def _predicted(before: Estimate, after: Estimate) -> RelativePose:
    """Return the motion of the body between two estimates without a measurement in between.

    Errors in the body's frame go with it, `xi_j = Ad(T_i_j)^-1 xi_i + xi_i_j`, and so do their
    covariances.
    """
    T = se3_inverse(before.T_world_imu) @ after.T_world_imu
    A = se3_adjoint(se3_inverse(T))
    grown, V = np.linalg.eigh(after.covariance - A @ before.covariance @ A.T)
    return RelativePose(T, (V * np.maximum(grown, 0.0)) @ V.T)


def _unknown(older: int, newer: int) -> RelativePose | None:
    """Return the motion between two frames where only that of a frame to itself is known."""
    if older == newer:
        return RelativePose(np.eye(4), np.zeros((6, 6)))
    return None


def _middle(motions: list[RelativePose]) -> RelativePose:
    """Return that of several estimates of one motion which is closest to all of them; of equals,
    the newest.
    """
    T = np.array([motion.T_i_j for motion in motions[::-1]])
    apart = se3_log(se3_inverse(T)[:, None] @ T)
    P = np.linalg.inv(motions[-1].covariance)
    return motions[::-1][
        int(np.argmin(np.sqrt(np.einsum("abi,ij,abj->ab", apart, P, apart)).sum(axis=1)))
    ]


def _inflated(motion: RelativePose) -> RelativePose:
    """Return a motion by the filter with the covariance that its errors have, see the constants
    above.
    """
    xi = se3_log(motion.T_i_j)
    sigma = np.repeat(
        np.multiply(_CHOICE.motion_shares, [np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])]), 3
    )
    return RelativePose(
        motion.T_i_j, _CHOICE.motion_inflation**2 * motion.covariance + np.diag(sigma**2)
    )


def _done(result: _T) -> Future[_T]:
    """Return what has been computed as if it had been waited for."""
    done: Future[_T] = Future()
    done.set_result(result)
    return done


def _add(builder: MapBuilder, keyframe: Keyframe, features: Future[KeyframeFeatures]) -> MapUpdate:
    """What the map's thread does with a keyframe once its motion is known."""
    return builder.add(keyframe, features.result())
