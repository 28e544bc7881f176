"""A simulated recording: rendered on the fly behind the `Dataset` protocol, with exact ground
truth.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.datasets.common import blank_frames, frame_range, merge_events
from vio.datasets.samples import imu_samples, in_time_order
from vio.datasets.tables import read_imu_table, stamped_rows
from vio.errors import DataError, SimulationError
from vio.files.text import check_increasing
from vio.geometry.distortion import CameraModel, StereoRig, rectified_pair
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.records import (
    Event,
    Image,
    ImuRecord,
    IntArray,
    MotionSource,
    Observations,
    Recording,
    StereoFrame,
    Trajectory,
    VelocitySample,
)
from vio.sim.effects import (
    Exposure,
    SensorEffects,
    along_flow,
    apply_effects,
    average_exposures,
    blur_along_flow,
)
from vio.sim.exposure import ExposurePlan, plan_exposures
from vio.sim.glare import glare
from vio.sim.imu import ImuNoise, VelocityNoise, simulate_imu, simulate_velocity
from vio.sim.miscalibration import CalibrationErrors, CalibrationSigmas, drawn_rig, miscalibrated
from vio.sim.motion import MotionSpline, motion_at, recorded_motion
from vio.sim.render import (
    CameraRays,
    Radiance,
    View,
    camera_rays,
    correspondence,
    depth_map,
    render,
)
from vio.sim.world import World, check_clear, room

logger = logging.getLogger(__name__)

_CLEARANCE_STEP_NS = 20_000_000


class _BlurRules(NamedTuple):
    """How blur is approximated."""

    flow_grid_px: int = 16  # pixels between exact flow vectors of the approximate blur
    tap_spacing_px: float = 1.2  # between samples along a blur; linear interpolation fills the gaps
    max_taps: int = 21


_BLUR = _BlurRules()
_WALL_MARGIN_M = 1.2  # of a room built around a recorded flight


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """Faults of whole frames and of the clocks."""

    dropped: float = 0.0  # share of frames that never arrive
    duplicated: float = 0.0  # share of frames that repeat the previous image under their own time
    time_offset_ms: float = 0.0  # frame stamps are true times plus this; the IMU's clock is exact


@dataclass(frozen=True, slots=True)
class Simulation:
    """The full definition of a simulated recording; equal definitions give the same bits."""

    world: World
    rig: StereoRig  # the true cameras
    motion: MotionSpline
    # (F,) when the content of each frame was exposed, true time; repeats where duplicated
    taken_ns: IntArray
    stamps_ns: IntArray  # (F,) time stamp of each frame, strictly increasing
    imu: ImuRecord | None
    velocity: Sequence[VelocitySample]
    effects: SensorEffects
    seed: int
    # as calibrated, which is what is written and read; `rig` is the true one
    calibration: StereoRig
    exposures: ExposurePlan | None = None  # of exposure control; None: it is off

    def rectified_camera(self, why_not: str) -> StereoCamera:
        """Return the rectified pair as calibrated; raise SimulationError, which says `why_not`,
        where it is none.
        """
        if (camera := rectified_pair(self.calibration)) is None:
            raise SimulationError(why_not)
        return camera


@dataclass(frozen=True, slots=True)
class TrueState:
    """The true state at one time."""

    time_ns: int
    T_world_imu: FloatArray  # (4, 4)
    velocity_world: FloatArray  # (3,) m/s
    angular_velocity: FloatArray  # (3,) rad/s, imu frame
    gyro_bias: FloatArray | None  # (3,) rad/s; None where there is no simulated IMU
    accel_bias: FloatArray | None  # (3,) m/s^2; None where there is no simulated IMU


def simulate(
    world: World,
    rig: StereoRig,
    motion: MotionSpline,
    *,
    rate_hz: float = 20.0,
    frame_times_ns: npt.ArrayLike | None = None,
    imu: ImuNoise | ImuRecord | None = None,
    velocity: VelocityNoise | None = None,
    effects: SensorEffects | None = None,
    faults: FrameFaults | None = None,
    calibration_errors: CalibrationErrors | None = None,
    calibration_sigmas: CalibrationSigmas | None = None,
    seed: int = 0,
) -> Simulation:
    """Plan a recording and check that it can be simulated; nothing is rendered yet.

    Args:
        world: scene.
        rig: cameras as calibrated, mounted on the body that `motion` moves.
        motion: motion of the body.
        rate_hz: frames per second.
        frame_times_ns: true times (F,) of the frames instead of a fixed rate; those outside the
            motion are left out.
        imu: noise of a simulated IMU of 200 Hz, or a recorded IMU to use with the images; None: no
            IMU.
        velocity: noise of the paper's velocity sensor, at the rate of the frames; None: no such
            sensor.
        effects: camera effects; None: the defaults of `SensorEffects`.
        faults: dropped and repeated frames, clock offset.
        calibration_errors: how far the true cameras are from `rig`; None: not at all.
        calibration_sigmas: of what further errors are drawn; None: of none.
        seed: seed of all random numbers.

    Raises:
        SimulationError: a camera would be outside the scene or in a box, or no frame is left.
    """
    faults = FrameFaults() if faults is None else faults
    effects = SensorEffects() if effects is None else effects
    true_rig = (
        rig if calibration_errors is None else miscalibrated(rig, calibration_errors, seed=seed)
    )
    true_rig = (
        true_rig
        if calibration_sigmas is None
        else drawn_rig(true_rig, calibration_sigmas, seed=seed)
    )
    times = _frame_times(motion, rate_hz, frame_times_ns, effects, faults)
    _check_cameras(world, true_rig, motion, times)
    taken, stamps = _apply_faults(times, faults, seed)
    record: ImuRecord | None
    if isinstance(imu, ImuNoise):
        record = simulate_imu(motion, noise=imu, seed=seed)
    else:
        record = imu
    samples: Sequence[VelocitySample] = ()
    if velocity is not None:
        samples = simulate_velocity(motion, rate_hz=rate_hz, noise=velocity, seed=seed)
    exposures = None
    if effects.auto_exposure:
        exposures = plan_exposures(world, true_rig, motion, taken, effects, seed=seed)
    return Simulation(
        world, true_rig, motion, taken, stamps, record, samples, effects, seed, rig, exposures
    )


def _frame_times(
    motion: MotionSpline,
    rate_hz: float,
    given: npt.ArrayLike | None,
    effects: SensorEffects,
    faults: FrameFaults,
) -> IntArray:
    """True times of all frames whose shutter interval and stamp are within the motion."""
    if given is None:
        count = int((motion.end_ns - motion.start_ns) * 1e-9 * rate_hz) + 1
        times = motion.start_ns + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    else:
        times = check_increasing(given, lambda k: f"frame time {k}")
    longest_ms = effects.longest_exposure_ms
    half_shutter = int(longest_ms * 0.5e6) + 1 if longest_ms > 0 else 0
    offset = _offset_ns(faults)
    inside = (times - half_shutter >= motion.start_ns) & (times + half_shutter <= motion.end_ns)
    inside &= (times + offset >= motion.start_ns) & (times + offset <= motion.end_ns)
    if not inside.any():
        raise SimulationError(
            "no frame is within the motion; check the frame times and the length of the motion"
        )
    return times[inside]


def _offset_ns(faults: FrameFaults) -> int:
    return round(faults.time_offset_ms * 1e6)


def _apply_faults(times: IntArray, faults: FrameFaults, seed: int) -> tuple[IntArray, IntArray]:
    """Exposure times and stamps of the frames that arrive; the first frame always does."""
    rng = np.random.default_rng([seed, 41])
    draw = rng.random((2, len(times)))
    arrives = draw[0] >= faults.dropped
    arrives[0] = True
    kept = times[arrives]
    repeats = draw[1][arrives] < faults.duplicated
    repeats[0] = False
    source = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(kept))))
    return kept[source], kept + _offset_ns(faults)


def _check_cameras(world: World, rig: StereoRig, motion: MotionSpline, times: IntArray) -> None:
    dense = np.unique(np.concatenate([times, np.arange(times[0], times[-1], _CLEARANCE_STEP_NS)]))
    T = motion_at(motion, dense).T_world_imu
    for name, T_imu_cam in (
        ("the left camera", rig.T_imu_cam0),
        ("the right camera", rig.T_imu_cam1),
    ):
        check_clear(world, (T @ T_imu_cam)[:, :3, 3], what=name)


def true_biases(record: ImuRecord | None, times_ns: npt.ArrayLike) -> FloatArray | None:
    """Return biases (..., 6) of gyroscope and accelerometer at times (...).

    None: there is no simulated IMU.
    """
    if record is None or record.gyro_bias is None or record.accel_bias is None:
        return None
    known = np.hstack([record.gyro_bias, record.accel_bias])
    elapsed = (record.times_ns - record.times_ns[0]).astype(np.float64)
    at = np.asarray(times_ns - record.times_ns[0], dtype=np.float64)
    return np.stack([np.interp(at, elapsed, known[:, i]) for i in range(6)], axis=-1)


def views(simulation: Simulation, time_ns: int) -> tuple[View, View]:
    """Return the true views of both cameras at one time."""
    T = motion_at(simulation.motion, time_ns).T_world_imu[0]
    rig = simulation.rig
    return View(rig.cam0, T @ rig.T_imu_cam0, time_ns), View(rig.cam1, T @ rig.T_imu_cam1, time_ns)


class SimulatedRecording:
    """The `Dataset` of a simulation; frames are rendered on request."""

    def __init__(self, simulation: Simulation) -> None:
        """Store the plan; frames are rendered on request."""
        self.simulation = simulation

    @functools.cached_property
    def rays(self) -> tuple[CameraRays, CameraRays]:
        """The tabulated rays of both cameras.

        Raises:
            SimulationError: the rig's distortion does not reach every pixel.
        """
        return camera_rays(self.simulation.rig.cam0), camera_rays(self.simulation.rig.cam1)

    @property
    def recording(self) -> Recording:
        """Calibration, times and ground truth.

        Raises:
            SimulationError: the rig is not rectified.
        """
        simulation = self.simulation
        why_not = "an unrectified rig has no rectified recording; export it as an EuRoC folder and read that"
        camera = simulation.rectified_camera(why_not)
        stamps = simulation.stamps_ns
        motion: set[MotionSource] = set()
        if simulation.imu is not None:
            motion.add("imu")
        if simulation.velocity:
            motion.add("velocity")
        return Recording(
            kind="simulated",
            path=Path(f"simulated-{simulation.world.name}-{simulation.seed}"),
            camera=camera,
            T_cam0_imu=se3_inverse(simulation.calibration.T_imu_cam0),
            frame_times_ns=stamps,
            has_images=True,
            motion=frozenset(motion),
            reference=self.reference,
        )

    @property
    def reference(self) -> Trajectory:
        """True poses of the IMU at the frames' stamps."""
        stamps = self.simulation.stamps_ns
        poses = motion_at(self.simulation.motion, stamps).T_world_imu
        return Trajectory(poses, stamps, "imu", np.arange(len(stamps)))

    def __len__(self) -> int:
        return len(self.simulation.stamps_ns)

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield motion samples and frames in time order; see `vio.protocols.Dataset`.

        Raises:
            DataError: the range holds no frame.
            SimulationError: the rig is not rectified.
        """
        recording = self.recording
        chosen = frame_range(recording, start, stop)
        if images:
            frames = (self.frame(k) for k in chosen)
        else:
            frames = blank_frames(recording, chosen)
        inertial = () if self.simulation.imu is None else imu_samples(self.simulation.imu)
        return merge_events(
            recording, chosen, in_time_order(self.simulation.velocity, inertial), frames
        )

    def observations(self, index: int) -> Observations | None:
        """Return None: a simulated recording holds images."""
        return None

    def frame(self, index: int) -> StereoFrame:
        """Render one frame with all effects."""
        left, right = self.images(index)
        return StereoFrame(index, int(self.simulation.stamps_ns[index]), left, right)

    def images(self, index: int) -> tuple[Image, Image]:
        """Render both images (H, W) of one frame with all effects."""
        simulation = self.simulation
        time_ns = int(simulation.taken_ns[index])
        # A repeated frame is identical to the bit, so its noise is seeded by the frame it repeats.
        source = int(np.searchsorted(simulation.taken_ns, time_ns))
        sensor = functools.partial(
            apply_effects, time_ns=time_ns, frame_index=source, seed=simulation.seed
        )
        exposures = [self.exposure(index, camera) for camera in (0, 1)]
        left, right = (
            sensor(
                self._seen(camera, time_ns, exposure),
                simulation.effects,
                camera=camera,
                exposure=exposure,
            )
            for camera, exposure in enumerate(exposures)
        )
        return left, right

    def exposure(self, index: int, camera: int) -> Exposure | None:
        """Exposure of one image as the camera's control has set it.

        None where there is no control.
        """
        plan = self.simulation.exposures
        return None if plan is None else plan.at(index, camera)

    def _seen(self, camera: int, time_ns: int, exposure: Exposure | None) -> Radiance:
        """Light (H, W) that reaches the sensor: blurred over the shutter time, with the lens's
        glare.
        """
        shutter_ms = (
            self.simulation.effects.blur_exposure_ms if exposure is None else exposure.shutter_ms
        )
        image = (
            self._blurred(camera, time_ns, shutter_ms)
            if shutter_ms > 0
            else self._sharp(camera, time_ns)
        )
        if self.simulation.effects.readout_ms:
            image = self._rolled(camera, time_ns, image)
        if self.simulation.effects.glare > 0 and self.simulation.world.lights:
            view = views(self.simulation, time_ns)[camera]
            image += glare(
                self.simulation.world, view, self.rays[camera], self.simulation.effects.glare
            )
        return image

    def _sharp(self, camera: int, time_ns: int) -> Radiance:
        view = views(self.simulation, time_ns)[camera]
        return render(self.simulation.world, self.rays[camera], view.T_world_cam, time_ns)

    def _blurred(self, camera: int, time_ns: int, shutter_ms: float) -> Radiance:
        effects = self.simulation.effects
        if effects.blur_exact:
            return average_exposures(
                lambda t: self._sharp(camera, t), time_ns, shutter_ms, effects.blur_samples
            )
        taps = effects.blur_samples
        if taps == 1:
            return self._sharp(camera, time_ns)
        half = round(shutter_ms * 0.5e6)
        before, after = (self.flow(camera, time_ns, time_ns + sign * half) for sign in (-1, 1))
        # short shutters need fewer taps, and long ones leave no gaps between them
        if effects.auto_exposure:
            length = max(float(np.abs(before).max()), float(np.abs(after).max()))
            taps = int(np.clip(2 * round(length / _BLUR.tap_spacing_px) + 1, 1, _BLUR.max_taps))
        return blur_along_flow(self._sharp(camera, time_ns), before, after, taps)

    def _rolled(self, camera: int, time_ns: int, image: Radiance) -> Radiance:
        """The image (H, W) with each row as its own time shows it, along the exact flow of a grid
        of pixels, so that disocclusions are ignored.
        """
        view = views(self.simulation, time_ns)[camera]
        grid = _grid_of(view.camera, _BLUR.flow_grid_px)
        there = np.empty_like(grid)
        height = view.camera.height
        for row, of_row in enumerate(grid):
            late = (of_row[0, 1] - 0.5 * (height - 1)) / height
            at_ns = time_ns + round(late * self.simulation.effects.readout_ms * 1e6)
            seen = views(self.simulation, at_ns)[camera]
            there[row], _ = correspondence(self.simulation.world, seen, view, of_row)
        shift = _between_nodes(there - grid, view.camera)
        return along_flow(image, shift)

    def flow(
        self, camera: int, from_ns: int, to_ns: int, *, step_px: int = _BLUR.flow_grid_px
    ) -> FloatArray:
        """Optical flow (H, W, 2) of one camera between two true times, exact on a grid and
        interpolated between nodes.

        Where a grid point leaves the image its flow is still that of its surface point.
        """
        view = views(self.simulation, from_ns)[camera]
        other = views(self.simulation, to_ns)[camera]
        grid = _grid_of(view.camera, step_px)
        there, _ = correspondence(self.simulation.world, view, other, grid.reshape(-1, 2))
        return _between_nodes(there.reshape(grid.shape) - grid, view.camera)

    def depth(self, camera: int, time_ns: int) -> tuple[FloatArray, IntArray]:
        """Exact depth (H, W) in metres and the surface (H, W) seen by one camera at a true time."""
        view = views(self.simulation, time_ns)[camera]
        return depth_map(self.simulation.world, self.rays[camera], view.T_world_cam, time_ns)

    def true_state(self, time_ns: int) -> TrueState:
        """Return the true state at any time within the motion.

        Raises:
            SimulationError: the time is outside the motion.
        """
        state = motion_at(self.simulation.motion, time_ns)
        biases = true_biases(self.simulation.imu, time_ns)
        gyro, accel = (None, None) if biases is None else (biases[:3], biases[3:])
        return TrueState(
            time_ns,
            state.T_world_imu[0],
            state.velocity_world[0],
            state.angular_velocity[0],
            gyro,
            accel,
        )


def _grid_of(camera: CameraModel, step_px: int) -> FloatArray:
    """Pixels (R, C, 2) about a step apart, the outer ones at the image's outer pixels."""
    u = np.linspace(0, camera.width - 1, camera.width // step_px + 2)
    v = np.linspace(0, camera.height - 1, camera.height // step_px + 2)
    return np.stack(np.meshgrid(u, v), axis=-1)


def _between_nodes(shift: FloatArray, camera: CameraModel) -> FloatArray:
    """Bilinear (H, W, 2) between the nodes (R, C, 2) of `_grid_of`."""
    down = _weights(shift.shape[0], camera.height)
    across = _weights(shift.shape[1], camera.width)
    return np.stack([down @ shift[..., k] @ across.T for k in (0, 1)], axis=-1)


@functools.lru_cache(maxsize=8)
def _weights(nodes: int, size: int) -> FloatArray:
    """Matrix (size, nodes) of linear interpolation between nodes that are spread over `size`
    pixels.
    """
    at = np.linspace(0, nodes - 1, size)
    first = np.minimum(at.astype(int), nodes - 2)
    out = np.zeros((size, nodes))
    out[np.arange(size), first] = 1 - (at - first)
    out[np.arange(size), first + 1] = at - first
    return out


# --- recorded flights
# -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """A real flight: its smoothed motion, real image times, and the real IMU where there is one."""

    motion: MotionSpline
    frame_times_ns: IntArray  # (F,)
    imu: ImuRecord | None = field(default=None)


def read_flight(
    groundtruth: Path, image_times: Path | None = None, imu_csv: Path | None = None
) -> RecordedFlight:
    """Read a recorded flight, to render images along it.

    Args:
        groundtruth: TUM file of the IMU's poses.
        image_times: one integer of nanoseconds a line; None: 20 Hz.
        imu_csv: the real IMU record of that flight in EuRoC's form; None: none.

    Raises:
        DataError: a file cannot be used; the message names it.
    """
    motion, _ = recorded_motion(groundtruth)
    if image_times is None:
        times = np.arange(motion.start_ns, motion.end_ns, 50_000_000)
    else:
        times, _, _ = stamped_rows(image_times, 1, "nanoseconds, one integer a line")
    times = times[(times >= motion.start_ns) & (times <= motion.end_ns)]
    if len(times) == 0:
        raise DataError(
            f"no image time is within the ground truth {groundtruth}; use the same clock for both"
        )
    if imu_csv is None:
        imu = None
    else:
        imu = read_imu_table(imu_csv, whole_ns=True)[0]
    return RecordedFlight(motion, times, imu)


def room_around(motion: MotionSpline, *, seed: int = 0) -> World:
    """Build a room around a motion; its furniture keeps clear of the path."""
    times = np.arange(motion.start_ns, motion.end_ns, _CLEARANCE_STEP_NS)
    p = motion_at(motion, times).T_world_imu[:, :3, 3]
    low = p.min(axis=0) - _WALL_MARGIN_M
    high = p.max(axis=0) + _WALL_MARGIN_M
    area = float(np.prod((high - low)[:2]))
    return room(
        seed,
        bounds=np.stack([low, high]),
        furniture=int(np.clip(area / 3, 8, 40)),
        pictures=int(np.clip(area / 4, 8, 30)),
        keep_clear=p[::5],
    )
