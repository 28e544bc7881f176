"""A textured wall seen by a moving stereo camera, with analytic ground truth for every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import Image, StereoFrame

CAMERA = StereoCamera(fu=300.0, fv=300.0, cu=239.5, cv=149.5, baseline_m=0.2, width=480, height=300)
NOISE = 1.5  # gray levels


@dataclass(frozen=True, slots=True)
class Wall:
    """The plane `normal . p = offset` in the world frame, textured with a sum of cosines over
    world x and y.
    """

    normal: FloatArray  # (3,)
    offset: float
    seed: int
    waves: int = 40

    def paint(self, p_world: FloatArray) -> FloatArray:
        """Gray levels (...) at points (..., 3) of the wall; wavelengths 0.07 to 1 m."""
        rng = np.random.default_rng(self.seed)
        wavelength = np.exp(rng.uniform(np.log(0.07), np.log(1.0), self.waves))
        angle, phase = rng.uniform(0, 2 * np.pi, (2, self.waves))
        amplitude = np.sqrt(wavelength)
        total = np.zeros(p_world.shape[:-1], dtype=np.float32)
        x, y = p_world[..., 0].astype(np.float32), p_world[..., 1].astype(np.float32)
        for w, a, s, m in zip(wavelength, angle, phase, amplitude, strict=True):
            k = 2 * np.pi / w
            total += np.float32(m) * np.cos(
                np.float32(k * np.cos(a)) * x + np.float32(k * np.sin(a)) * y + np.float32(s)
            )
        return 128.0 + 40.0 * total / np.sqrt((amplitude**2).sum() / 2)

    def hit(
        self, T_world_cam: FloatArray, pixels: FloatArray, camera: StereoCamera = CAMERA
    ) -> FloatArray:
        """Points (..., 3) in the world where the rays of left pixels (..., 2) intersect the
        wall.
        """
        rays = np.stack(
            [
                (pixels[..., 0] - camera.cu) / camera.fu,
                (pixels[..., 1] - camera.cv) / camera.fv,
                np.ones(pixels.shape[:-1]),
            ],
            axis=-1,
        )
        rays = rays @ T_world_cam[:3, :3].T
        scale = (self.offset - self.normal @ T_world_cam[:3, 3]) / (rays @ self.normal)
        return T_world_cam[:3, 3] + scale[..., None] * rays


SLANTED = Wall(normal=np.array([0.1, -0.35, 1.0]), offset=4.0, seed=3)


def truth(
    wall: Wall, T_world_cam: FloatArray, pixels: FloatArray, T_world_other: FloatArray
) -> FloatArray:
    """Stereo pixels (N, 4) at another pose of the points at left pixels (N, 2)."""
    return project(
        CAMERA, transform_points(se3_inverse(T_world_other), wall.hit(T_world_cam, pixels))
    )


def view(wall: Wall, T_world_cam: FloatArray, camera: StereoCamera = CAMERA) -> FloatArray:
    """Noise-free image (H, W) of the wall."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    return wall.paint(wall.hit(T_world_cam, np.stack([u, v], axis=-1), camera))


def eight_bit(image: FloatArray, seed: int) -> Image:
    """The image (H, W) with read noise, rounded to 8 bits."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def right_of(T_world_cam: FloatArray) -> FloatArray:
    """Pose of the right camera."""
    T = T_world_cam.copy()
    T[:3, 3] += T[:3, 0] * CAMERA.baseline_m
    return T


def stereo_frame(index: int, T_world_cam: FloatArray, wall: Wall = SLANTED) -> StereoFrame:
    """The stereo pair at one pose."""
    left = eight_bit(view(wall, T_world_cam), 2 * index)
    right = eight_bit(view(wall, right_of(T_world_cam)), 2 * index + 1)
    return StereoFrame(index, index * 50_000_000, left, right)


def flight(frames: int) -> list[FloatArray]:
    """Poses of a camera that moves sideways and forward and turns slightly."""
    step = np.array([0.03, -0.01, 0.05, 0.003, -0.006, 0.004])
    return [se3_exp(k * step) for k in range(frames)]


def test_left_and_right_images_agree_at_true_pixels() -> None:
    pose = flight(3)[2]
    left, right = view(SLANTED, pose), view(SLANTED, right_of(pose))
    pixels = np.stack(
        np.meshgrid(np.arange(60.0, 420.0, 7), np.arange(10.0, 290.0, 7)), axis=-1
    ).reshape(-1, 2)
    z = truth(SLANTED, pose, pixels, pose)
    np.testing.assert_allclose(z[:, :2], pixels, atol=1e-9)
    nearest = np.rint(z[:, 2]).astype(int)
    exact = np.abs(z[:, 2] - nearest) < 0.03
    assert exact.sum() > 50
    rows = pixels[:, 1].astype(int)
    difference = left[rows, pixels[:, 0].astype(int)] - right[rows, nearest]
    assert np.abs(difference[exact]).max() < 3.0
    assert left.std() > 25
