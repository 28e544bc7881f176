"""Pixels of a rolling shutter as one exposure of the whole image would show them.

Rows are exposed one after the other. The camera's velocity since the last frame is fitted to the
features that both show, each with the time between its own rows, and takes every feature to the
time of the middle row, which the frame's stamp is of.
Reference: Ait-Aider, Andreff, Lavest & Martinet, Simultaneous object pose and velocity computation
using a single view from a rolling shutter camera, ECCV (2006).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.cameras.rig import Rectifier
from vio.dataclass import dataclass
from vio.errors import ConfigError
from vio.findings import Finding
from vio.frontend.readout_time import MIN_DEPTH_M, ReadoutTime, RowShares, moved_by
from vio.geometry.lie import FloatArray, circledot
from vio.geometry.stereo import DEPTH_DISPARITY_PX, StereoCamera, project, triangulate, z_D_p_cam
from vio.numerics.robust import cauchy_equations
from vio.records import NS_PER_S, Observations, shared_rows


class _ShutterRules(NamedTuple):
    """How the velocity is fitted."""

    min_features: int = 12  # that two frames share, with depth
    steps: int = 5  # of Gauss-Newton
    least_px: float = 0.06  # width of the pixels' weights, at least
    least_elapsed: float = 0.1  # of the time between frames, between the rows of a wrong match
    held_s: float = 0.25  # for so long a velocity is taken to go on
    # of the rows, those about the middle one, in which features are used as they are seen where
    # there is no velocity
    middle_share: float = 0.3


_RULES = _ShutterRules()


@dataclass(frozen=True, slots=True)
class _Seen:
    """A frame as the camera showed it."""

    features: Observations
    late_s: FloatArray  # (N, 2) times of the left and the right pixels after the middle row


@dataclass(frozen=True, slots=True)
class _Velocity:
    """The camera's mean velocity over an interval."""

    twist: FloatArray  # (6,) [rho; phi] of the points in the camera's frame, per second
    middle_ns: int  # of the interval


class RollingShutter:
    """Moves the features of each frame to the time of its middle row."""

    def __init__(self, camera: StereoCamera, rectifier: Rectifier | None = None) -> None:
        """Prepare for the images of a camera; its `readout_s` is tested, and looked for without.

        Args:
            camera: rectified.
            rectifier: of its raw images, whose rows count; None: they are rectified.

        Raises:
            ConfigError: `readout_s` is stated, and the height of the images is not known.
        """
        self._camera = camera
        self._readout_s = camera.readout_s
        self._shares = RowShares(camera, rectifier)
        self._search = ReadoutTime(camera, self._shares)
        if camera.readout_s and not self._shares.known:
            raise ConfigError(
                "a rolling shutter needs the height of the images, which the recording does not "
                "state; leave frontend.readout_ms out"
            )
        self._last: _Seen | None = None
        self._velocity: _Velocity | None = None
        self._before: _Velocity | None = None

    def take_findings(self) -> tuple[Finding, ...]:
        """Return the findings since the last call."""
        return self._search.take_findings()

    def corrected(self, seen: Observations) -> Observations:
        """Return a frame's features at the time of its middle row; as they are, while no readout
        time is known.

        Features without depth are moved by how far their pixels have moved since the last frame.
        What cannot be moved, as there is no velocity yet, is left out, but for the middle rows.
        """
        self._search.frame(seen)
        if not self._readout_s:
            self._readout_s = self._search.readout_s
            if not self._readout_s:
                return seen
        p, has_depth = triangulate(self._camera, seen.z, min_disparity_px=DEPTH_DISPARITY_PX)
        has_depth &= seen.has_right & ~seen.stale
        late_s = self._readout_s * self._shares.of(seen.z)
        last = self._last
        self._last = _Seen(seen, late_s)
        moved = np.zeros(len(seen), dtype=np.bool_)
        z = seen.z.copy()
        if last is not None:
            rows, others = shared_rows(seen.ids, last.features.ids)
            elapsed_s = (seen.time_ns - last.features.time_ns) / NS_PER_S
            between_s = elapsed_s + late_s[rows, 0] - last.late_s[others, 0]
            between_s = np.maximum(between_s, _RULES.least_elapsed * elapsed_s)
            use = has_depth[rows] & last.features.has_right[others] & ~last.features.stale[others]
            if int(use.sum()) >= _RULES.min_features:
                middle_ns = (last.features.time_ns + seen.time_ns) // 2
                z_before = last.features.z[others[use], :3]
                self._learn(p[rows[use]], z_before, between_s[use], middle_ns)
            flow = (seen.z[rows] - last.features.z[others]) / between_s[:, None]
            both = seen.has_right[rows] & last.features.has_right[others]
            flow[~both, 2:] = 0.0
            z[rows] -= late_s[rows].repeat(2, axis=1) * flow
            moved[rows] = True
        velocity = self._velocity_at(seen.time_ns)
        if velocity is not None:
            here = p[has_depth]
            before = project(self._camera, here)
            for camera in (0, 1):
                columns = slice(2 * camera, 2 * camera + 2)
                there = moved_by(here, -late_s[has_depth, camera, None] * velocity)
                shift = (project(self._camera, there) - before)[:, columns]
                z[has_depth, columns] = seen.z[has_depth, columns] + shift
            moved |= has_depth
        middle_s = 0.5 * _RULES.middle_share * abs(self._readout_s)
        moved |= np.abs(late_s[:, 0]) <= middle_s
        return replace(seen, z=z).take(moved)

    def _learn(self, p: FloatArray, z: FloatArray, between_s: FloatArray, middle_ns: int) -> None:
        """Fit the velocity to points and their pixels before, see `_fitted`, of an interval with
        its middle.
        """
        before = self._velocity
        start = np.zeros(6) if before is None else before.twist
        twist = _fitted(self._camera, p, z, between_s, start)
        if twist is not None:
            self._before = before
            self._velocity = _Velocity(twist, middle_ns)

    def _velocity_at(self, time_ns: int) -> FloatArray | None:
        """The twist (6,) per second at a time, as far as the last velocities go on; None: they
        are too old.
        """
        now = self._velocity
        if now is None or time_ns - now.middle_ns > _RULES.held_s * NS_PER_S:
            return None
        before = self._before
        if before is None or now.middle_ns - before.middle_ns > _RULES.held_s * NS_PER_S:
            return now.twist
        share = (time_ns - now.middle_ns) / (now.middle_ns - before.middle_ns)
        return now.twist + min(share, 1.0) * (now.twist - before.twist)


def _fitted(
    camera: StereoCamera, p: FloatArray, z: FloatArray, between_s: FloatArray, twist: FloatArray
) -> FloatArray | None:
    """Fit the twist (6,) per second of points to their pixels some time before, by Gauss-Newton
    with Cauchy's weights; None: it does not converge.

    Args:
        camera: rectified pair.
        p: points (N, 3), cam0 frame.
        z: their pixels [ul vl ur] before (N, 3).
        between_s: time since then (N,).
        twist: to begin with.
    """
    for _ in range(_RULES.steps):
        there = moved_by(p, -between_s[:, None] * twist)
        ahead = there[:, 2] > MIN_DEPTH_M
        if not ahead.all():
            if ahead.sum() < _RULES.min_features:
                return None
            p, z, between_s, there = p[ahead], z[ahead], between_s[ahead], there[ahead]
        r = z - project(camera, there)[:, :3]
        J = -between_s[:, None, None] * (z_D_p_cam(camera, there)[:, :3] @ circledot(there)[:, :3])
        A, b, _ = cauchy_equations(r, J, _RULES.least_px)
        try:
            step = np.linalg.solve(A, b)
        except np.linalg.LinAlgError:
            return None
        twist = twist + step
    return twist if np.isfinite(twist).all() else None
