"""Rendered images against exact geometry computed independently: photometry, OpenCV, brute
force.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from vio.errors import SimulationError
from vio.geometry.distortion import CameraModel, StereoRig, unproject_pixel
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.sim.motion import car_loop, hand_held, look_rotation
from vio.sim.render import (
    CameraRays,
    Radiance,
    View,
    camera_rays,
    cast,
    correspondence,
    depth_map,
    inside_image,
    render,
    surface_points,
)
from vio.sim.rigs import fisheye_rig, kitti_like_rig, small_rig
from vio.sim.sequence import Simulation, room_around, simulate, views
from vio.sim.textures import build_mips, paint
from vio.sim.world import (
    MovingBox,
    Patch,
    Surfaces,
    TextureStore,
    World,
    check_clear,
    corridor,
    room,
    street,
    surfaces_at,
)

R_BODY_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def _radtan_rig() -> StereoRig:
    rig = small_rig(320, 200)
    bend = (-0.28, 0.07, 0.0004, -0.0003)
    return replace(
        rig,
        cam0=replace(rig.cam0, model="radtan", coefficients=bend),
        cam1=replace(rig.cam1, model="radtan", coefficients=bend),
    )


@pytest.fixture(scope="module")
def small_room() -> World:
    return room(1, texel_m=0.005)


RIGS = {
    "pinhole": small_rig(320, 200),
    "radtan": _radtan_rig(),
    "equidistant": fisheye_rig(320, 240),
}


def _simulation(world: World, rig: StereoRig) -> Simulation:
    return simulate(world, rig, hand_held(duration_s=4.0))


def _sample(image: Radiance, uv: FloatArray) -> FloatArray:
    maps = uv.astype(np.float32).reshape(-1, 1, 2)
    out = np.concatenate(
        [cv2.remap(image, part, None, cv2.INTER_CUBIC) for part in np.array_split(maps, 12)]
    )
    return out.ravel().astype(np.float64)


def _photometric(world: World, a: View, b: View) -> tuple[FloatArray, FloatArray, float]:
    """Gray differences of points seen in both views, the equivalent image shift, and the share
    seen in both.
    """
    rays = camera_rays(a.camera), camera_rays(b.camera)
    image_a, image_b = (
        render(world, r, v.T_world_cam, v.time_ns) for r, v in zip(rays, (a, b), strict=True)
    )
    u, v = np.meshgrid(np.arange(4, a.camera.width - 4), np.arange(4, a.camera.height - 4))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    there, visible = correspondence(world, a, b, uv)
    visible &= inside_image(b.camera, there, margin_px=4)
    there = there[visible]
    error = _sample(image_b, there) - image_a[v.ravel()[visible], u.ravel()[visible]]
    slopes = [_sample(cv2.Sobel(image_b, cv2.CV_32F, i, 1 - i, scale=1 / 8), there) for i in (1, 0)]
    usual = np.abs(error) < 20  # excludes outlines
    shift = np.linalg.lstsq(np.stack(slopes, axis=1)[usual], -error[usual], rcond=None)[0]
    return error, shift, float(visible.mean())


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("to", ["right image", "next frame"])
def test_reprojection_reproduces_the_other_image(small_room: World, name: str, to: str) -> None:
    simulation = _simulation(small_room, RIGS[name])
    a, right = views(simulation, 2_000_000_000)
    b = right if to == "right image" else views(simulation, 2_050_000_000)[0]
    error, shift, seen = _photometric(small_room, a, b)
    assert seen > 0.75
    assert np.median(np.abs(error)) < 1.5  # gray levels
    assert np.mean(np.abs(error) > 20) < 0.02
    assert np.abs(shift).max() < 0.015, "the images are shifted against the geometry"


def test_reprojection_reproduces_the_other_image_of_the_street() -> None:
    world = street(2, texel_m=0.04)
    simulation = simulate(world, kitti_like_rig(414), car_loop(duration_s=2.0))
    error, shift, seen = _photometric(world, *views(simulation, 1_000_000_000))
    assert seen > 0.75
    assert np.median(np.abs(error)) < 1.5
    assert np.abs(shift).max() < 0.02


def _wall(texture_seed: int) -> World:
    """One large wall across the x axis, 3 m ahead of the origin."""
    patch = Patch(
        np.array([3.0, 4.0, 3.0]),
        np.array([0.0, -1, 0]),
        np.array([0.0, 0, -1]),
        np.array([8.0, 6.0]),
        "wall",
        0.004,
    )
    arrays = (patch.origin[None], patch.axis_s[None], patch.axis_t[None], patch.size[None])
    surfaces = Surfaces(*arrays, np.zeros(1, dtype=np.int64))
    return World(
        "wall",
        surfaces,
        TextureStore([patch], texture_seed),
        (),
        np.array([[-9.0] * 3, [2.9, 9, 9]]),
    )


def test_a_plane_is_rendered_where_opencv_projects_it() -> None:
    """Warp the wall's texture with the homography that cv2.projectPoints gives; compare image
    and rendering.
    """
    world = _wall(5)
    camera = CameraModel(300.0, 310.0, 158.0, 101.0, 320, 200)
    T = se3_from_parts(so3_exp([0.05, -0.1, 0.2]) @ R_BODY_CAM, [0.3, -0.2, 0.1])
    image = render(world, camera_rays(camera), T)
    texture = paint("wall", np.array([8.0, 6.0]), 0.004, np.random.default_rng([5, 0])).astype(
        np.float32
    )
    corners = np.array([[0.0, 0], [8, 0], [8, 6], [0, 6]])
    surfaces = world.surfaces
    p_world = surface_points(surfaces, np.zeros(4, dtype=np.int64), corners)
    T_cam_world = se3_inverse(T)
    rvec, _ = cv2.Rodrigues(T_cam_world[:3, :3])
    uv, _ = cv2.projectPoints(p_world, rvec, T_cam_world[:3, 3], camera.K, np.zeros(4))
    scale = 4  # draw four times as large, then average: an independent way to filter
    texel = corners / 0.004 - 0.5
    large = (uv[:, 0] + 0.5) * scale - 0.5
    H = cv2.getPerspectiveTransform(texel.astype(np.float32), large.astype(np.float32))
    drawn = cv2.warpPerspective(texture, H, (320 * scale, 200 * scale), flags=cv2.INTER_LINEAR)
    expected = drawn.reshape(200, scale, 320, scale).mean(axis=(1, 3))
    error = image - expected
    assert np.abs(error).mean() < 2.0
    slopes = [cv2.Sobel(expected, cv2.CV_32F, i, 1 - i, scale=1 / 8).ravel() for i in (1, 0)]
    shift = np.linalg.lstsq(np.stack(slopes, axis=1), error.ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.01


def test_correspondence_agrees_with_opencv_on_a_plane() -> None:
    world = _wall(5)
    camera = CameraModel(300.0, 310.0, 158.0, 101.0, 320, 200)
    T_a = se3_from_parts(R_BODY_CAM, [0.0, 0, 0])
    T_b = se3_from_parts(so3_exp([0.1, 0.05, -0.1]) @ R_BODY_CAM, [0.4, 0.2, -0.1])
    uv = np.random.default_rng(0).uniform((0, 0), (319, 199), (300, 2))
    there, visible = correspondence(world, View(camera, T_a), View(camera, T_b), uv)
    T_b_a = se3_inverse(T_b) @ T_a
    normal = np.array([0.0, 0, 1])  # the wall in camera a: z = 3
    H = camera.K @ (T_b_a[:3, :3] + np.outer(T_b_a[:3, 3], normal) / 3.0) @ np.linalg.inv(camera.K)
    expected = cv2.perspectiveTransform(uv[:, None], H)[:, 0]
    np.testing.assert_allclose(there, expected, atol=1e-8)
    assert np.array_equal(visible, inside_image(camera, expected))


def test_correspondence_is_invertible(small_room: World) -> None:
    a, b = views(_simulation(small_room, RIGS["radtan"]), 1_500_000_000)
    uv = np.random.default_rng(1).uniform((5, 5), (314, 194), (500, 2))
    there, visible = correspondence(small_room, a, b, uv)
    back, again = correspondence(small_room, b, a, there[visible])
    assert again.all()
    np.testing.assert_allclose(back, uv[visible], atol=1e-6)


def test_occluded_points_are_invisible(small_room: World) -> None:
    """A point is occluded exactly when the other camera's ray to it hits something nearer, by
    ray marching.
    """
    camera = RIGS["pinhole"].cam0
    a = View(camera, se3_from_parts(R_BODY_CAM, [-2.0, 0.8, 1.1]))
    b = View(camera, se3_from_parts(so3_exp([0.0, 0.0, 0.3]) @ R_BODY_CAM, [-1.6, -1.3, 0.6]))
    uv = np.random.default_rng(2).uniform((0, 0), (319, 199), (1500, 2))
    rays, _ = unproject_pixel(a.camera, uv)
    surfaces = surfaces_at(small_room, 0)
    hits = cast(surfaces, a.T_world_cam, rays)
    p = surface_points(surfaces, hits.surface, hits.coordinates)
    there, visible = correspondence(small_room, a, b, uv)
    in_view = inside_image(b.camera, there) & (
        (p - b.T_world_cam[:3, 3]) @ b.T_world_cam[:3, 2] > 0
    )
    steps = np.linspace(0.002, 0.998, 400)[:, None, None]
    path = b.T_world_cam[:3, 3] + steps * (p[in_view] - b.T_world_cam[:3, 3])
    blocked = np.zeros(int(in_view.sum()), dtype=bool)
    for solid in small_room.solids:
        local = (path - solid.T_world_box[:3, 3]) @ solid.T_world_box[:3, :3]
        blocked |= (np.abs(local) < solid.half_size - 2e-3).all(axis=2).any(axis=0)
    assert 0.02 < blocked.mean() < 0.9
    assert np.mean(blocked != visible[in_view]) > 0.985  # steps miss the very edges


@pytest.mark.parametrize("name", RIGS)
def test_depth_map_equals_brute_force(small_room: World, name: str) -> None:
    camera = RIGS[name].cam0
    view = views(_simulation(small_room, RIGS[name]), 1_000_000_000)[0]
    depth, surface = depth_map(small_room, camera_rays(camera), view.T_world_cam)
    assert np.isfinite(depth).all(), "the room is closed"
    u, v = np.meshgrid(np.arange(0, camera.width, 7), np.arange(0, camera.height, 7))
    rays, _ = unproject_pixel(camera, np.stack([u, v], axis=-1).reshape(-1, 2))
    hits = cast(small_room.surfaces, view.T_world_cam, rays)
    np.testing.assert_allclose(depth[v.ravel(), u.ravel()], hits.distance * rays[:, 2], rtol=1e-9)
    assert np.array_equal(surface[v.ravel(), u.ravel()], hits.surface)


def test_every_pixel_shows_the_surface_that_its_ray_hits(small_room: World) -> None:
    """Paint each surface with its own gray level: away from outlines the image equals the map of
    surfaces.
    """
    count = len(small_room.surfaces.size)
    level = (np.arange(count) * 67 % 200 + 20).astype(np.uint8)

    class Plain(TextureStore):
        def __getitem__(self, surface: int):  # type: ignore[no-untyped-def]
            return build_mips(np.full((8, 8), level[surface], dtype=np.uint8))

    world = replace(small_room, textures=Plain([], 0))
    for rig in RIGS.values():
        view = views(_simulation(small_room, rig), 1_000_000_000)[0]
        rays = camera_rays(rig.cam0)
        image = render(world, rays, view.T_world_cam)
        _, surface = depth_map(world, rays, view.T_world_cam)
        expected = level[surface].astype(np.float32)
        same = cv2.erode(expected, np.ones((3, 3))) == cv2.dilate(expected, np.ones((3, 3)))
        assert np.abs(image - expected)[same].max() < 1e-3
        assert same.mean() > 0.7
        # On outlines, the mixture is between the neighbours and averages to the exact coverage.
        assert abs(float((image - expected)[~same].mean())) < 4


def test_the_same_seed_gives_the_same_bits(small_room: World) -> None:
    view = views(_simulation(small_room, RIGS["pinhole"]), 0)[0]
    rays = camera_rays(view.camera)
    again = room(1, texel_m=0.005)
    other = room(2, texel_m=0.005)
    first = render(small_room, rays, view.T_world_cam)
    assert np.array_equal(first, render(again, rays, view.T_world_cam))
    assert not np.array_equal(first, render(other, rays, view.T_world_cam))


def test_textures_have_detail_at_every_scale_and_do_not_repeat() -> None:
    texture = paint("wall", np.array([6.0, 3.0]), 0.006, np.random.default_rng(0)).astype(
        np.float32
    )
    spectrum = np.fft.rfft2(texture - cv2.GaussianBlur(texture, (0, 0), 20))
    correlation = np.fft.irfft2(np.abs(spectrum) ** 2, s=texture.shape)
    correlation /= correlation[0, 0]
    away = correlation.copy()
    near = 60  # texels, 0.36 m: marks and posters resemble themselves
    away[:near, :near] = away[-near:, :near] = away[:near, -near:] = away[-near:, -near:] = 0
    assert away.max() < 0.1, "the texture repeats"
    for sigma in (1, 3, 9, 27):  # detail at every scale
        band = cv2.GaussianBlur(texture, (0, 0), sigma) - cv2.GaussianBlur(
            texture, (0, 0), 2 * sigma
        )
        assert band.std() > 2.0, f"nothing to see at {sigma} texels"


def test_a_bare_wall_has_no_texture() -> None:
    world = corridor(0, texel_m=0.01)
    T = se3_from_parts(look_rotation([0.2, 1.0, 0.0]) @ R_BODY_CAM, [10.0, 0.3, 1.4])
    camera = CameraModel(250, 250, 79.5, 49.5, 160, 100)
    image = render(world, camera_rays(camera), T)
    assert image.std() < 1e-3


def test_a_moving_box_moves_and_carries_its_points() -> None:
    def motion(time_ns: int) -> FloatArray:
        return se3_from_parts(
            so3_exp([0.0, 0.0, 0.3 * time_ns * 1e-9]), [1.5, -0.5 + time_ns * 1e-9, 1.3]
        )

    world = room(
        3,
        furniture=0,
        pictures=0,
        moving=[MovingBox(np.array([0.5, 0.5, 0.5]), motion)],
        texel_m=0.01,
    )
    camera = small_rig(320, 200).cam0
    T = se3_from_parts(R_BODY_CAM, [-1.0, 0.0, 1.3])
    a, b = View(camera, T, 0), View(camera, T, 300_000_000)
    depth, surface = depth_map(world, camera_rays(camera), T, 0)
    on_box = world.surfaces.mover[surface] == 1
    assert 0.02 < on_box.mean() < 0.3
    v, u = np.nonzero(on_box)
    uv = np.stack([u, v], axis=1).astype(np.float64)
    there, visible = correspondence(world, a, b, uv)
    rays, _ = unproject_pixel(camera, uv)
    p_box = (
        T[:3, 3] + (rays * (depth[v, u] / rays[:, 2])[:, None]) @ T[:3, :3].T - motion(0)[:3, 3]
    ) @ motion(0)[:3, :3]
    p_later = p_box @ motion(b.time_ns)[:3, :3].T + motion(b.time_ns)[:3, 3]
    p_cam = (p_later - T[:3, 3]) @ T[:3, :3]
    expected = p_cam[:, :2] / p_cam[:, 2:] * (camera.fu, camera.fv) + (camera.cu, camera.cv)
    np.testing.assert_allclose(there[visible], expected[visible], atol=1e-6)
    assert visible.mean() > 0.7
    error, _, _ = _photometric(world, a, b)
    assert np.median(np.abs(error)) < 1.0


def test_rejects_cameras_in_boxes_or_outside(small_room: World) -> None:
    with pytest.raises(SimulationError, match="leaves the room at position 1 of 2"):
        check_clear(small_room, [[0, 0, 1], [0, 0, 9]])
    with pytest.raises(SimulationError, match="inside box 0 of the room"):
        check_clear(small_room, small_room.solids[0].T_world_box[:3, 3])
    with pytest.raises(SimulationError, match="the left camera leaves the room"):
        simulate(small_room, RIGS["pinhole"], car_loop(duration_s=1.0))


def test_a_room_built_around_a_motion_keeps_clear_of_it() -> None:
    motion = hand_held(extent=(3.0, 2.0, 0.3), duration_s=12.0)
    world = room_around(motion, seed=4)
    assert len(world.solids) > 8
    simulate(world, RIGS["pinhole"], motion)  # raises if a camera meets a box


def test_rays_look_through_pixel_centres() -> None:
    camera = CameraModel(200, 200, 10.0, 5.0, 40, 20)
    rays: CameraRays = camera_rays(camera)
    np.testing.assert_allclose(rays.centre[:, 5, 10], [0, 0, 1], atol=1e-7)
    np.testing.assert_allclose(rays.corner[:, 5, 10], [-0.5 / 200, -0.5 / 200, 1], atol=1e-7)
