"""A front end with access to ground truth: exact or noisy observations, with known outliers.

Features are points on the scene's surfaces, found by casting rays through the left image, so they
are spread evenly over it and are never occluded. It needs no images and runs at hundreds of frames
a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vio.errors import SimulationError
from vio.geometry.distortion import unproject_pixel
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, FrontendOutput, IntArray, StereoFrame, TrackPrior, observations
from vio.setting import setting
from vio.sim.render import View, cast, observe, surface_points
from vio.sim.sequence import Simulation, views
from vio.sim.world import Surfaces, surfaces_at


@dataclass(frozen=True, slots=True)
class OracleSettings:
    """Feature count, noise and outliers of the oracle."""

    max_features: int = setting(100, "features kept in view")
    sigma_px: float = setting(
        0.5, "standard deviation of the noise on each of the four pixel coordinates", unit="px"
    )
    outlier_fraction: float = setting(0.0, "share of rows replaced by gross errors", unit="0..1")
    outlier_px: float = setting(
        30.0, "outliers are off by 5 px to this much, in both images alike or not", unit="px"
    )
    left_only_fraction: float = setting(0.0, "share of rows without a right match", unit="0..1")
    max_track_length: int | None = setting(
        None, "frames after which a feature is dropped; None: never"
    )
    max_depth_m: float = setting(80.0, "features farther away are not used", unit="m")
    margin_px: float = setting(4.0, "features this close to the border are not seen", unit="px")

    def __post_init__(self) -> None:
        if self.max_features < 1 or self.sigma_px < 0 or (self.max_track_length or 1) < 1:
            raise SimulationError(
                "max_features and max_track_length must be positive, sigma_px must not be negative"
            )
        if not (0 <= self.outlier_fraction <= 1 and 0 <= self.left_only_fraction <= 1):
            raise SimulationError("outlier_fraction and left_only_fraction must be between 0 and 1")
        if self.outlier_px < _MIN_OUTLIER_PX:
            raise SimulationError(f"outlier_px must be at least {_MIN_OUTLIER_PX:g}")


_MIN_OUTLIER_PX = 5.0
_CELL_PX = 48  # new features are sampled one per cell


class OracleFrontend:
    """The `Frontend` of a simulation with a rectified rig; equal arguments give the same bits."""

    def __init__(
        self, simulation: Simulation, settings: OracleSettings | None = None, *, seed: int = 0
    ) -> None:
        """Initialise; process the simulation's frames in order.

        Raises:
            SimulationError: the rig is not rectified.
        """
        simulation.rectified_camera("the oracle outputs rectified pixels and needs a rectified rig")
        self._simulation = simulation
        self._settings = OracleSettings() if settings is None else settings
        self._seed = seed
        # All features created so far, by id, and those now in view.
        self._surface: IntArray = np.zeros(0, dtype=np.int64)
        self._coordinates: FloatArray = np.zeros((0, 2))
        self._age: IntArray = np.zeros(0, dtype=np.int64)
        self._live: IntArray = np.zeros(0, dtype=np.int64)
        self._outliers: dict[int, BoolArray] = {}
        self._exact: dict[int, FloatArray] = {}

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Observe one frame; its images and the prior are ignored."""
        settings = self._settings
        time_ns = int(self._simulation.taken_ns[frame.index])
        rng = np.random.default_rng([self._seed, frame.index, 51])
        left, right = views(self._simulation, time_ns)
        surfaces = surfaces_at(self._simulation.world, time_ns)
        z, seen = self._observe(surfaces, left, right, self._live)
        if settings.max_track_length is not None:
            seen &= self._age[self._live] < settings.max_track_length
        kept = self._live[seen]
        z = z[seen]
        fresh, z_fresh = self._detect(
            surfaces, left, right, z[:, :2], settings.max_features - len(kept), rng
        )
        self._live = np.concatenate([kept, fresh])
        exact = np.concatenate([z, z_fresh])
        self._age[self._live] += 1
        n = len(self._live)
        noisy = exact + settings.sigma_px * rng.standard_normal((n, 4))
        wrong = rng.random(n) < settings.outlier_fraction
        noisy[wrong] += _gross_errors(rng, int(wrong.sum()), settings.outlier_px)
        has_right = rng.random(n) >= settings.left_only_fraction
        self._outliers[frame.index] = wrong
        self._exact[frame.index] = exact
        output = observations(frame.index, frame.time_ns, self._live, noisy, has_right)
        return FrontendOutput(
            output, tracked=len(kept), matched=int(has_right.sum()), detected=len(fresh)
        )

    def outliers(self, frame_index: int) -> BoolArray:
        """Mask (N,) of the rows of a processed frame that are gross errors."""
        return self._outliers[frame_index]

    def exact(self, frame_index: int) -> FloatArray:
        """Noise-free pixels (N, 4) of the rows of a processed frame."""
        return self._exact[frame_index]

    def points(self, ids: npt.ArrayLike, time_ns: int) -> FloatArray:
        """True world positions (N, 3) of features (N,) at a true time; points on moving boxes
        move with it.
        """
        index = np.asarray(ids, dtype=np.int64)
        surfaces = surfaces_at(self._simulation.world, time_ns)
        return surface_points(surfaces, self._surface[index], self._coordinates[index])

    def _observe(
        self, surfaces: Surfaces, left: View, right: View, ids: IntArray
    ) -> tuple[FloatArray, BoolArray]:
        """Exact pixels (N, 4) of features and a mask (N,) of those that both cameras see."""
        p_world = surface_points(surfaces, self._surface[ids], self._coordinates[ids])
        uv_left, seen_left = observe(surfaces, left, p_world)
        uv_right, seen_right = observe(surfaces, right, p_world)
        z = np.concatenate([uv_left, uv_right], axis=1)
        margin = self._settings.margin_px
        width = left.camera.width - 1 - margin
        height = left.camera.height - 1 - margin
        within = (z >= margin).all(axis=1) & (z <= (width, height, width, height)).all(axis=1)
        depth = (p_world - left.T_world_cam[:3, 3]) @ left.T_world_cam[:3, 2]
        return z, seen_left & seen_right & within & (depth < self._settings.max_depth_m)

    def _detect(
        self,
        surfaces: Surfaces,
        left: View,
        right: View,
        occupied: FloatArray,
        wanted: int,
        rng: np.random.Generator,
    ) -> tuple[IntArray, FloatArray]:
        """Create up to `wanted` features, first in the image cells (`_CELL_PX`) with the fewest."""
        if wanted <= 0:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 4))
        columns = -(-left.camera.width // _CELL_PX)
        rows = -(-left.camera.height // _CELL_PX)
        cell = np.minimum(occupied // _CELL_PX, (columns - 1, rows - 1)).astype(np.int64)
        count = np.bincount(cell[:, 1] * columns + cell[:, 0], minlength=rows * columns)
        rounds = 1 + 2 * wanted // (rows * columns)
        load = (count[None] + np.arange(rounds)[:, None]).ravel() + 0.9 * rng.random(
            rounds * rows * columns
        )
        order = np.argsort(load)[: 2 * wanted] % (rows * columns)
        corner = np.stack([order % columns, order // columns], axis=1)
        uv = (corner + rng.random((len(order), 2))) * _CELL_PX
        rays, _ = unproject_pixel(left.camera, uv)
        hits = cast(surfaces, left.T_world_cam, rays)
        first = len(self._surface)
        self._surface = np.concatenate([self._surface, hits.surface])
        self._coordinates = np.concatenate([self._coordinates, hits.coordinates])
        ids = first + np.arange(len(uv))
        z, seen = self._observe(surfaces, left, right, ids)
        good = np.flatnonzero(seen & hits.found)[:wanted]
        # Discard the rejected points, so that ids count the features created.
        self._surface = np.concatenate([self._surface[:first], hits.surface[good]])
        self._coordinates = np.concatenate([self._coordinates[:first], hits.coordinates[good]])
        self._age = np.concatenate([self._age, np.zeros(len(good), dtype=np.int64)])
        return first + np.arange(len(good)), z[good]


def _gross_errors(rng: np.random.Generator, count: int, largest: float) -> FloatArray:
    """Errors (N, 4): half of them wrong tracks (both images alike), half wrong matches (right
    image only).
    """
    angle = rng.uniform(0, 2 * np.pi, count)
    size = rng.uniform(_MIN_OUTLIER_PX, largest, count)
    shift = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    both = rng.random(count) < 0.5
    return np.concatenate([np.where(both[:, None], shift, 0.0), shift], axis=1)
