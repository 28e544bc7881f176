"""Dense depth, its fusion into a surface, the floor plan, and `vio mesh`."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.commands import json_of, refused
from vio.cli import main
from vio.dense.occupancy import occupancy_grid
from vio.dense.preview import preview
from vio.dense.stereo_depth import (
    DISPARITY_SIGMA_PX,
    StereoMatcher,
    depth_sigma_m,
    farthest_m,
    slant,
)
from vio.dense.surface import Mesh, extract_surface
from vio.dense.voxel_grid import SIDE, VoxelGrid, pack, unpack
from vio.files.meshes import FREE, OCCUPIED, R_GLTF_UPRIGHT, UNKNOWN, glb_mesh, ply_points
from vio.geometry.distortion import rectified_camera
from vio.geometry.lie import FloatArray, se3_exp
from vio.geometry.stereo import StereoCamera
from vio.sim.motion import hand_held
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import room

CAMERA = StereoCamera(200.0, 200.0, 159.5, 119.5, 0.2, 320, 240)
CENTRE, RADIUS_M = np.array([0.1, -0.05, 2.0]), 0.7
# of a camera that looks ahead: right, ahead, up
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def _sphere_depth(T_world_cam: FloatArray) -> np.ndarray:
    """Exact depth (H, W) of a sphere, 0 beside it."""
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = np.stack(
        [(u - CAMERA.cu) / CAMERA.fu, (v - CAMERA.cv) / CAMERA.fv, np.ones_like(u)], axis=-1
    )
    c = T_world_cam[:3, :3].T @ (CENTRE - T_world_cam[:3, 3])
    a, b = np.sum(rays**2, axis=-1), rays @ c
    root = b**2 - a * (c @ c - RADIUS_M**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0.0).astype(np.float32)


def _around() -> list[FloatArray]:
    """Poses on an arc that look at the sphere."""
    return [
        se3_exp(np.array([0.4 * k, 0.0, 0.03 * k * k, 0.0, -0.2 * k, 0.0])) for k in range(-2, 3)
    ]


def _fused(voxel_m: float, most_blocks: int, blocks_away: int = 0) -> Mesh:
    tint = np.zeros((240, 320, 3), dtype=np.uint8)
    tint[:] = (200, 100, 50)
    with VoxelGrid(voxel_m, most_blocks=most_blocks) as grid:
        for T in _around():
            depth = _sphere_depth(T)
            T[:3, 3] += blocks_away * SIDE * voxel_m
            grid.fuse(depth, tint, CAMERA, T, 4.0)
        assert len(grid._slot) <= max(most_blocks, 900)
        return extract_surface(grid)


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return _fused(0.02, 100_000)


def test_fuses_a_sphere_to_a_fraction_of_a_voxel(sphere: Mesh) -> None:
    outwards = sphere.vertices - CENTRE
    off = np.linalg.norm(outwards, axis=1) - RADIUS_M
    assert len(sphere.vertices) > 2000
    assert abs(np.median(off)) < 0.002
    assert np.percentile(np.abs(off), 90) < 0.006
    agree = np.sum(sphere.normals * outwards, axis=1) / np.linalg.norm(outwards, axis=1)
    # outwards, so the corners run counter-clockwise seen from outside
    assert np.percentile(agree, 5) > 0.95
    assert np.abs(sphere.colours.astype(int) - (200, 100, 50)).max() <= 4


def test_a_bounded_memory_gives_the_same_surface(sphere: Mesh) -> None:
    bounded = _fused(0.02, 64)
    np.testing.assert_array_equal(bounded.vertices, sphere.vertices)
    np.testing.assert_array_equal(bounded.triangles, sphere.triangles)


@pytest.mark.parametrize("kilometres", [-100, 30])
def test_a_surface_far_away_is_that_of_the_same_views_here(sphere: Mesh, kilometres: int) -> None:
    far = _fused(0.02, 100_000, blocks_away=round(kilometres * 1000 / (SIDE * 0.02)))
    assert len(far.triangles) == pytest.approx(len(sphere.triangles), rel=0.01)
    corners = far.vertices[far.triangles].astype(np.float64)
    assert np.ptp(corners, axis=1).max() < 0.1  # triangles of neighbouring cells


def test_what_is_farther_than_blocks_can_be_numbered_is_left_out() -> None:
    T = np.eye(4)
    T[:3, 3] = (1 << 20) * SIDE * 0.02
    with VoxelGrid(0.02) as grid:
        grid.fuse(_sphere_depth(np.eye(4)), np.zeros((240, 320), np.uint8), CAMERA, T, 4.0)
        assert len(grid) == 0


def test_packs_block_coordinates_in_their_order() -> None:
    rows = np.array([[-5, 3, 1000], [0, 0, 0], [7, -1, -1]])
    np.testing.assert_array_equal(unpack(pack(rows)), rows)
    assert (np.diff(pack(rows)) > 0).all()


def test_distance_from_a_slanted_plane_is_along_its_normal() -> None:
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = np.stack(
        [(u - CAMERA.cu) / CAMERA.fu, (v - CAMERA.cv) / CAMERA.fv, np.ones_like(u)], axis=-1
    )
    n = np.array([0.0, 1.0, 0.08])  # a floor 1 m below, which rises a little
    z = np.where(rays @ n > 0.15, 1.0 / np.maximum(rays @ n, 1e-6), 0).astype(np.float32)
    factor = slant(z, CAMERA)
    inner = np.s_[200:220, 100:200]
    point = rays[inner] * (z[inner] + 0.1)[..., None]
    distance = (1 - point @ n) / np.linalg.norm(n)
    np.testing.assert_allclose(-0.1 * factor[inner], distance, rtol=0.03)


def test_depth_of_rendered_images_is_as_exact_as_stated() -> None:
    simulation = simulate(
        room(1, texel_m=0.008), small_rig(320, 240), hand_held(duration_s=2.0), rate_hz=10.0
    )
    recording, camera = SimulatedRecording(simulation), rectified_camera(simulation.rig)
    depth = StereoMatcher(camera, 320).depth(*recording.images(3))
    truth, _ = recording.depth(0, int(simulation.taken_ns[3]))
    near = (truth >= 1.0) & (truth < farthest_m(camera, 0.3))
    assert near.sum() > 10_000
    assert (depth[near] > 0).mean() > 0.7
    known = (depth > 0) & (truth < farthest_m(camera, 0.3))
    sigmas = np.abs(depth - truth)[known] / (depth_sigma_m(camera, 1.0) * truth[known] ** 2)
    assert np.median(sigmas) < 1.0  # 0.67 of a normal distribution


@pytest.mark.parametrize("disparity_px", [10.0, 10.25, 10.5, 10.75])
def test_the_sigma_of_a_match_covers_what_the_matcher_pulls_to_whole_pixels(
    disparity_px: float,
) -> None:
    """A plane parallel to the images, of waves."""
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:120, :320].astype(float)
    waves = [(*rng.normal(0, 0.7, 2), rng.uniform(0, 2 * np.pi)) for _ in range(100)]
    left, right = (
        (128 + 5 * sum(np.cos(a * (u + shift) + b * v + c) for a, b, c in waves))
        .clip(0, 255)
        .astype(np.uint8)
        for shift in (0.0, disparity_px)
    )
    depth = StereoMatcher(CAMERA, 320).depth(left, right)[10:-10, 60:-20]
    known = depth > 0
    assert known.mean() > 0.9
    errors = CAMERA.fu * CAMERA.baseline_m / depth[known] - disparity_px
    assert abs(errors.mean()) < DISPARITY_SIGMA_PX
    assert np.sqrt(np.mean(errors**2)) < 1.1 * DISPARITY_SIGMA_PX


def test_floor_plan_of_a_box_on_a_floor() -> None:
    x, y = (g.ravel() for g in np.meshgrid(np.arange(0, 4, 0.05), np.arange(0, 3, 0.05)))
    floor = np.stack([x, y, np.where((x > 3.5) & (y > 2.5), np.nan, 0.0)], axis=1)
    wall = np.array([[1.0, b, c] for b in np.arange(0.5, 2, 0.05) for c in np.arange(0, 1, 0.05)])
    lamp = np.array(
        [[2.0 + a, 1.0 + b, 2.6] for a in np.arange(0, 0.3, 0.05) for b in np.arange(0, 0.3, 0.05)]
    )
    p = np.concatenate([floor[np.isfinite(floor).all(axis=1)], wall, lamp]).astype(np.float32)
    p += 1e-3
    plan = occupancy_grid(
        Mesh(p, p, np.zeros_like(p, np.uint8), np.zeros((0, 3), np.uint32)), np.eye(3), 0.05
    )

    def at(x_m: float, y_m: float) -> int:
        column, row = np.floor((np.array([x_m, y_m]) - plan.origin_m) / plan.cell_m).astype(int)
        return int(plan.levels[row, column])

    assert (at(1.0, 1.2), at(2.1, 1.1), at(0.3, 0.3), at(3.8, 2.8)) == (
        OCCUPIED,
        FREE,
        FREE,
        UNKNOWN,
    )


def test_glb_holds_the_mesh_with_y_up(sphere: Mesh) -> None:
    data = glb_mesh(sphere.vertices, sphere.normals, sphere.colours, sphere.triangles, UPRIGHT)
    assert data[:4] == b"glTF"
    assert int.from_bytes(data[8:12], "little") == len(data)
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    view = document["bufferViews"][0]
    begin = 28 + size + view["byteOffset"]
    points = np.frombuffer(data[begin : begin + view["byteLength"]], dtype="<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, sphere.vertices @ (R_GLTF_UPRIGHT @ UPRIGHT).T, atol=1e-6)
    assert document["accessors"][3]["count"] == sphere.triangles.size
    np.testing.assert_allclose(document["accessors"][0]["min"], points.min(axis=0))
    up = np.array([0.0, -1.0, 0.0], dtype=np.float32)  # of the camera's frame
    assert (R_GLTF_UPRIGHT @ UPRIGHT @ up)[1] == 1.0


def test_ply_states_what_follows(sphere: Mesh) -> None:
    data = ply_points(sphere.vertices, sphere.colours, sphere.normals, sphere.triangles)
    head, _, body = data.partition(b"end_header\n")
    assert f"element vertex {len(sphere.vertices)}\n".encode() in head
    assert len(body) == 27 * len(sphere.vertices) + 13 * len(sphere.triangles)


def test_preview_shows_the_surface_and_the_path(sphere: Mesh) -> None:
    picture = preview(sphere, np.array([T[:3, 3] for T in _around()]), UPRIGHT, 0.02)
    assert picture.shape == (720, 1280, 3)
    red = (picture[..., 0] > 200) & (picture[..., 1] < 60)
    ours = (picture[..., 0] > picture[..., 2] + 40) & ~red
    assert red.sum() > 200
    assert ours.sum() > 10_000


@pytest.fixture(scope="module")
def run_folder(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mesh") / "run"
    assert (
        main(["run", str(flight), "--out", str(out), "--map", str(out.parent / "m.map"), "--json"])
        == 0
    )
    return out


def test_makes_a_mesh_of_a_run(run_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = json_of(capsys, "mesh", run_folder)
    assert facts["triangles"] > 1000
    assert facts["stopped"] is None
    names = {path.name for path in (run_folder / "mesh").iterdir()}
    assert names == {
        *(
            "mesh.json",
            "mesh.ply",
            "points.ply",
            "mesh.glb",
            "preview.png",
            "occupancy.pgm",
            "occupancy.yaml",
        ),
    }
    plan = yaml.safe_load((run_folder / "mesh" / "occupancy.yaml").read_text())
    assert (
        (255 - FREE) / 255 < plan["free_thresh"] < (255 - UNKNOWN) / 255 < plan["occupied_thresh"]
    )
    assert plan["image"] == "occupancy.pgm"
    assert plan["resolution"] >= 0.05
    page = run_folder / "report.html"
    assert main(["report", str(run_folder)]) == 0
    assert "<h2>Mesh</h2>" in page.read_text()
    in_map = run_folder.parent / "in_map"
    assert (
        main(
            [
                "mesh",
                str(run_folder),
                "--map",
                str(run_folder.parent / "m.map"),
                "--out",
                str(in_map),
            ]
        )
        == 0
    )
    assert json.loads((in_map / "mesh.json").read_text())["poses"] == "map"


def test_interrupted_it_keeps_what_is_fused(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vio.cli.output import ProgressBar

    monkeypatch.setattr(
        ProgressBar, "update", lambda self, done, total=None: signal.raise_signal(signal.SIGINT)
    )
    # a shell's background jobs ignore it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["mesh", str(run_folder), "--out", str(tmp_path / "m"), "--voxel", "0.1"]) == 0
    finally:
        signal.signal(signal.SIGINT, before)
    facts = json.loads((tmp_path / "m" / "mesh.json").read_text())
    assert (facts["frames"], facts["stopped"]) == (1, "interrupted")
    assert facts["chosen"] > 1


def test_refusals_are_one_line(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = tmp_path / "run"
    shutil.copytree(run_folder, moved)
    metrics = json.loads((moved / "metrics.json").read_text())
    metrics["source"] = str(tmp_path / "gone")
    (moved / "metrics.json").write_text(json.dumps(metrics))
    other = tmp_path / "other.map"
    shutil.copy(run_folder.parent / "m.map", other)
    for arguments, message in (
        ([str(moved)], "name the recording with --source"),
        ([str(run_folder), "--voxel", "0"], "--voxel takes 0.001 to 100 m"),
        ([str(run_folder), "--memory", "1"], "--memory takes 16"),
        ([str(tmp_path)], "holds the results of runs; give one of them"),
        ([str(run_folder), "--map", str(tmp_path / "none.map")], "there is no such map"),
    ):
        assert message in refused(capsys, "mesh", *arguments)


def _dated(flight: Path, out: Path, start_s: int) -> Path:
    """Convert a flight to a plain folder without an IMU, whose times are dates from a start on."""
    assert main(["convert", str(flight), "--to", "plain", "--out", str(out)]) == 0
    (out / "imu.csv").unlink()
    count = len((out / "times.txt").read_text().split())
    times = [f"{start_s + k // 20}.{50 * (k % 20):03d}\n" for k in range(count)]
    (out / "times.txt").write_text("".join(times))
    return out


def test_another_recording_of_the_same_rig_is_refused(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = _dated(flight, tmp_path / "first", 1_700_000_000)
    other = _dated(flight, tmp_path / "other", 1_700_000_100)
    run = tmp_path / "run"
    assert main(["run", str(first), "--out", str(run), "--quiet"]) == 0
    mesh = ["mesh", str(run), "--voxel", "0.1", "--out", str(tmp_path / "mesh")]
    assert "is another recording than that of the run" in refused(
        capsys, *mesh, "--source", str(other)
    )
    assert json_of(capsys, *mesh, "--source", str(first))["triangles"] > 100


def test_voxels_as_large_as_the_scene_are_to_be_smaller(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["mesh", str(run_folder), "--out", str(tmp_path / "m"), "--voxel", "50"]
    assert "with voxels of 50 m; give smaller ones" in refused(capsys, *arguments)


def test_exports_keep_the_colours_of_the_images(flight: Path, tmp_path: Path) -> None:
    """The same flight with images that are tinted: exported in colour, the points too."""
    tinted = tmp_path / "flight"
    shutil.copytree(flight, tinted)
    for file in tinted.glob("mav0/cam*/data/*.png"):
        gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(file), np.stack([gray // 2, gray, gray], axis=2))  # blue, green, red
    run = tmp_path / "run"
    assert (
        main(["run", str(tinted), "--save-observations", "--out", str(run), "--no-plot", "--json"])
        == 0
    )
    assert main(["export", "colmap", str(run), "--keyframes", "3"]) == 0
    image = cv2.imread(str(next((run / "colmap" / "images").rglob("*.png"))), cv2.IMREAD_UNCHANGED)
    assert image.shape[2] == 3
    assert np.abs(image[..., 0].astype(int) - image[..., 2] // 2).max() <= 3
    head, _, body = (run / "colmap" / "points.ply").read_bytes().partition(b"end_header\n")
    assert b"property uchar red" in head
    points = np.frombuffer(body, dtype=[("p", "<f4", 3), ("rgb", "u1", 3)])["rgb"].astype(int)
    assert points[:, 0].mean() > 1.5 * points[:, 2].mean()
    (model,) = (run / "colmap").glob("sparse/0/points3D.*")
    assert model.stat().st_size > 0


def test_depth_without_a_surface_gives_none() -> None:
    depth = np.zeros((64, 64), np.float32)
    depth[32, 32] = 2
    with VoxelGrid(0.05) as grid:
        camera = StereoCamera(100.0, 100.0, 32.0, 32.0, 0.1, 64, 64)
        grid.fuse(depth, np.zeros((64, 64), np.uint8), camera, np.eye(4), 5.0)
        assert len(extract_surface(grid, least_seen=1).triangles) == 0


def _plan_at(p: FloatArray, x_m: float) -> int:
    """Level of the floor plan of points (N, 3) at (x, 1)."""
    vertices = p.astype(np.float32) + np.float32(1e-3)
    mesh = Mesh(vertices, vertices, np.zeros_like(vertices, np.uint8), np.zeros((0, 3), np.uint32))
    plan = occupancy_grid(mesh, np.eye(3), 0.1)
    assert plan is not None
    column, row = np.floor((np.array([x_m, 1.01]) - plan.origin_m) / plan.cell_m).astype(int)
    return int(plan.levels[row, column])


def _floor(x_m: FloatArray, z_m: float) -> FloatArray:
    x, y = (g.ravel() for g in np.meshgrid(x_m, np.arange(0, 2, 0.1)))
    return np.stack([x, y, np.full_like(x, z_m)], axis=1)


@pytest.mark.parametrize(
    ("height_m", "level"), [(0.17, FREE), (0.23, OCCUPIED), (1.8, OCCUPIED), (2.2, FREE)]
)
def test_an_obstacle_stands_above_a_step_and_below_a_door(height_m: float, level: int) -> None:
    things = np.array([[1.01, 1.01, height_m], [1.02, 1.02, height_m]])
    assert _plan_at(np.concatenate([_floor(np.arange(0, 2, 0.1), 0.0), things]), 1.01) == level


def test_a_floor_is_free_up_to_its_rim() -> None:
    at = np.arange(0.025, 2, 0.05)
    x, y = (g.ravel() for g in np.meshgrid(at, at))
    vertices = np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32)
    mesh = Mesh(vertices, vertices, np.zeros_like(vertices, np.uint8), np.zeros((0, 3), np.uint32))
    plan = occupancy_grid(mesh, np.eye(3), 0.05)
    assert plan is not None
    assert (plan.levels == FREE).all()


@pytest.mark.parametrize(("points", "level"), [(1, FREE), (2, OCCUPIED)])
def test_one_vertex_is_no_obstacle(points: int, level: int) -> None:
    things = np.tile([1.01, 1.01, 1.0], (points, 1))
    assert _plan_at(np.concatenate([_floor(np.arange(0, 2, 0.1), 0.0), things]), 1.01) == level


@pytest.mark.parametrize(("x_m", "level"), [(1.3, OCCUPIED), (2.0, FREE)])
def test_a_plateau_is_ground_away_from_its_edge(x_m: float, level: int) -> None:
    """1.5 m is about the reach of a robot: what is that far is not beside it."""
    below = _floor(np.arange(-2, 0, 0.1), 0.0)
    above = _floor(np.arange(0, 4, 0.1), 0.5)
    assert _plan_at(np.concatenate([below, above]), x_m) == level
