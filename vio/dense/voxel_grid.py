"""A truncated signed distance function in sparse blocks of voxels, of which a bounded number is in
memory.

Curless & Levoy, A volumetric method for building complex models from range images, SIGGRAPH 1996;
blocks as in Niessner et al., Real-time 3D reconstruction at scale using voxel hashing, 2013.
Samples lie on the lattice of the voxel size.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from types import TracebackType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.dense.stereo_depth import DISPARITY_SIGMA_PX, DepthImage, slant
from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity
from vio.records import Image, IntArray

SIDE = 8  # samples along a block's edge
TRUNCATION = 4  # voxels
MAX_BLOCKS: Capacity[int] = (
    1 << 15
)  # in memory, 200 MB; those farthest from the camera go to a file
_HALF: Capacity[int] = 1 << 20  # block coordinates are within it
_MAX_WEIGHT = 64.0  # so that a surface that changed is taken over in time
_SHAPE = (SIDE, SIDE, SIDE)
BLOCK = np.dtype(
    [
        ("distance", "<f4", _SHAPE),  # in truncations, positive in front of the surface
        ("weight", "<f4", _SHAPE),
        ("seen", "u1", _SHAPE),  # how often, at most 255
        ("colour", "u1", (*_SHAPE, 3)),
    ]
)


def pack(blocks: npt.NDArray[np.int64]) -> IntArray:
    """Return one whole number (N,) for block coordinates (N, 3), which are within `_HALF`."""
    shifted = blocks + _HALF
    out: IntArray = (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]
    return out


def unpack(keys: IntArray) -> IntArray:
    """Return the coordinates (N, 3) that `pack` packed."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - _HALF


class VoxelGrid:
    """Depth images, fused."""

    def __init__(self, voxel_m: float, *, most_blocks: int = MAX_BLOCKS) -> None:
        """Begin empty.

        Args:
            voxel_m: distance of the samples.
            most_blocks: that are in memory at once, but for those that one image shows.
        """
        self.voxel_m = voxel_m
        self.truncation_m = TRUNCATION * voxel_m
        self._most = most_blocks
        self._pool = np.zeros(min(1024, most_blocks), dtype=BLOCK)
        self._slot: dict[int, int] = {}  # in memory
        self._free = list(range(len(self._pool)))
        self._kept: dict[int, int] = {}  # in the file, by its record
        self._file = tempfile.TemporaryFile(prefix="vio-mesh-")  # noqa: SIM115  # closed by `close`

    def __len__(self) -> int:
        return len(self._slot.keys() | self._kept.keys())

    def __enter__(self) -> VoxelGrid:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def fuse(
        self,
        depth: DepthImage,
        image: Image,
        camera: StereoCamera,
        T_world_cam: FloatArray,
        far_m: float,
    ) -> None:
        """Take up the depths of one image.

        Args:
            depth: (H, W) of a pinhole's pixels.
            image: (H, W) or (H, W, 3) their colours.
            camera: of both.
            T_world_cam: (4, 4).
            far_m: depths beyond it are not used.
        """
        keys = self._blocks_at(depth, camera, T_world_cam, far_m)
        if not len(keys):
            return
        slots = self._slots(keys, T_world_cam[:3, 3])
        if image.ndim == 3:
            colour = image
        else:
            colour = np.repeat(image[:, :, None], 3, axis=2)
        pool = self._pool
        lengths = np.array(
            [
                self.voxel_m,
                self.truncation_m,
                far_m,
                DISPARITY_SIGMA_PX / (camera.fu * camera.baseline_m),
            ]
        )
        _integrate(
            _Samples(pool["distance"], pool["weight"], pool["seen"], pool["colour"]),
            slots,
            SIDE * unpack(keys),
            _View(
                se3_inverse(T_world_cam),
                np.array([camera.fu, camera.fv, camera.cu, camera.cv]),
                np.ascontiguousarray(depth),
                slant(depth, camera),
                np.ascontiguousarray(colour),
            ),
            lengths,
        )

    def keys(self) -> IntArray:
        """Return the keys (B,) of all blocks, sorted."""
        return np.array(sorted(self._slot.keys() | self._kept.keys()), dtype=np.int64)

    def block(self, key: int) -> npt.NDArray[np.void] | None:
        """Return a block, a record of `BLOCK`; None: there is none."""
        if (slot := self._slot.get(key)) is not None:
            found: npt.NDArray[np.void] = self._pool[slot]
            return found
        return self._read(key) if key in self._kept else None

    def padded(self) -> Iterator[tuple[IntArray, npt.NDArray[np.void]]]:
        """Yield for each block the coordinates (3,) of its first sample, and a record with one
        sample more around it.

        Its fields are those of `BLOCK` with 10 samples along each edge, unseen where there is no
        block.
        """
        wide = np.dtype(
            [
                (name, BLOCK[name].base, (10, 10, 10, *BLOCK[name].shape[3:]))
                for name in BLOCK.names or ()
            ]
        )
        parts = {
            -1: (slice(0, 1), slice(7, 8)),
            0: (slice(1, 9), slice(0, 8)),
            1: (slice(9, 10), slice(0, 1)),
        }
        offsets = [(i, j, k) for i in parts for j in parts for k in parts]
        steps = pack(np.array(offsets)) - pack(np.zeros((1, 3), dtype=np.int64))
        for key, first in zip(self.keys().tolist(), SIDE * unpack(self.keys()), strict=True):
            out = np.zeros((), dtype=wide)
            for (i, j, k), step in zip(offsets, steps.tolist(), strict=True):
                if (found := self.block(key + step)) is not None:
                    to = (parts[i][0], parts[j][0], parts[k][0])
                    of = (parts[i][1], parts[j][1], parts[k][1])
                    for name in BLOCK.names or ():
                        out[name][to] = found[name][of]
            yield first, out

    def _blocks_at(
        self, depth: DepthImage, camera: StereoCamera, T_world_cam: FloatArray, far_m: float
    ) -> IntArray:
        """Return the keys (B,) of the blocks within the truncation of the depths."""
        edge_m = SIDE * self.voxel_m
        step = max(1, int(0.25 * edge_m * camera.fu / far_m))
        z = depth[::step, ::step].astype(np.float64)
        v, u = np.nonzero((z > 0) & (z < far_m))
        z = z[v, u]
        rays = np.stack(
            [
                (u * step - camera.cu) / camera.fu,
                (v * step - camera.cv) / camera.fv,
                np.ones(len(u)),
            ],
            axis=1,
        )
        found = []
        for offset in np.linspace(
            -1, 1, 2 * max(1, int(np.ceil(2 * self.truncation_m / edge_m))) + 1
        ):
            along = z + offset * self.truncation_m / np.linalg.norm(rays, axis=1)
            points = transform_points(T_world_cam, rays * along[:, None])
            blocks = np.floor(points / edge_m)
            within = (np.abs(blocks) < _HALF - 1).all(axis=1)  # and those beside them
            found.append(pack(blocks[within].astype(np.int64)))
        return np.unique(np.concatenate(found))

    def _slots(self, keys: IntArray, centre: FloatArray) -> IntArray:
        """Return the slots (B,) in memory of blocks, which are made or read where they are not
        there.
        """
        wanted = keys.tolist()
        missing = [key for key in wanted if key not in self._slot]
        if len(missing) > len(self._free):
            self._make_room(len(missing), set(wanted), centre)
        for key in missing:
            slot = self._free.pop()
            if key in self._kept:
                self._pool[slot] = self._read(key)
            else:
                self._pool[slot] = np.zeros((), dtype=BLOCK)
            self._slot[key] = slot
        return np.array([self._slot[key] for key in wanted], dtype=np.int64)

    def _make_room(self, count: int, wanted: set[int], centre: FloatArray) -> None:
        """Have `count` free slots: by more memory up to the bound, then by writing the farthest
        blocks to the file.
        """
        size = len(self._pool)
        needed = count - len(self._free)
        grown = min(max(2 * size, size + needed), max(self._most, len(wanted)))
        if grown > size:
            self._pool = np.concatenate([self._pool, np.zeros(grown - size, dtype=BLOCK)])
            self._free += range(size, grown)
        if count <= len(self._free):
            return
        others = np.array([key for key in self._slot if key not in wanted], dtype=np.int64)
        distance = np.linalg.norm(SIDE * self.voxel_m * unpack(others) - centre, axis=1)
        leaving = max(count - len(self._free), len(others) // 4)
        for key in others[np.argsort(distance)[len(others) - leaving :]].tolist():
            slot = self._slot.pop(key)
            record = self._kept.setdefault(key, len(self._kept))
            self._file.seek(record * BLOCK.itemsize)
            self._file.write(self._pool[slot].tobytes())
            self._free.append(slot)

    def _read(self, key: int) -> npt.NDArray[np.void]:
        self._file.seek(self._kept[key] * BLOCK.itemsize)
        return np.frombuffer(self._file.read(BLOCK.itemsize), dtype=BLOCK)[0]


class _Samples(NamedTuple):
    """The fields of blocks, as of `BLOCK`."""

    distance: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]
    seen: npt.NDArray[np.uint8]
    colour: npt.NDArray[np.uint8]


class _View(NamedTuple):
    """A depth image and its camera."""

    T: FloatArray  # (4, 4) from the world to the camera
    pinhole: FloatArray  # fu, fv, cu, cv, pixels
    depth: DepthImage  # (H, W) m
    cosine: DepthImage  # (H, W) of the angle between ray and normal
    image: Image  # (H, W, 3)


@compiled
def _integrate(
    samples: _Samples, slots: IntArray, first: IntArray, view: _View, lengths: FloatArray
) -> None:
    """Average the distances of samples from the depth image's surface, along its normals, by
    weights 1 / variance.

    Lengths are those of a voxel, of the truncation, the farthest depth (m), and the standard
    deviation of a depth over its square (1/m).
    """
    distance = samples.distance
    weight = samples.weight
    seen = samples.seen
    colour = samples.colour
    T = view.T
    depth = view.depth
    image = view.image
    fu, fv, cu, cv = view.pinhole
    voxel, truncation, far, sigma_per_z2 = lengths
    height, width = depth.shape
    for m in range(len(slots)):
        s = slots[m]
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    px = voxel * (first[m, 0] + i)
                    py = voxel * (first[m, 1] + j)
                    pz = voxel * (first[m, 2] + k)
                    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
                    if z <= 0.0:
                        continue
                    u = fu * (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) / z + cu
                    v = fv * (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) / z + cv
                    if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
                        continue
                    column = int(u + 0.5)
                    row = int(v + 0.5)
                    d = depth[row, column]
                    if d <= 0.0 or d >= far:
                        continue
                    off = (d - z) * view.cosine[row, column]
                    if off < -truncation:
                        continue
                    sigma = max(voxel, sigma_per_z2 * d * d)
                    w = (voxel / sigma) ** 2
                    old = weight[s, i, j, k]
                    distance[s, i, j, k] += (
                        (min(off / truncation, 1.0) - distance[s, i, j, k]) * w / (old + w)
                    )
                    weight[s, i, j, k] = min(old + w, _MAX_WEIGHT)
                    if off < truncation:
                        n = seen[s, i, j, k]
                        share = max(w / (old + w), 0.125)
                        for c in range(3):
                            before = (
                                float(colour[s, i, j, k, c])
                                if n > 0
                                else float(image[row, column, c])
                            )
                            colour[s, i, j, k, c] = np.uint8(
                                before + (image[row, column, c] - before) * share + 0.5
                            )
                        if n < 255:
                            seen[s, i, j, k] = n + 1
