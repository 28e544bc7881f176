"""What every lens model in the registry keeps to, and that a new one costs one file and one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import vio
from tests.board_views import GRID, views_around
from tests.jacobians import numeric_jacobian
from tests.plain_maker import rig_of
from vio.cameras.rig import Rectifier, Rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import CalibrationError
from vio.evaluation.alignment import align_poses
from vio.geometry.distortion import (
    CameraModel,
    StereoRig,
    holds_distortion,
    project_point,
    unproject_pixel,
    uv_D_camera,
    uv_D_point,
)
from vio.geometry.lenses.model import Coefficients, FileNames, KalibrForm, Lens
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.rectify import field_of_view
from vio.live.odometry import Odometry
from vio.records import FrameResult
from vio.sim.effects import CLEAN
from vio.sim.imu import ImuNoise
from vio.sim.motion import hand_held, motion_at
from vio.sim.render import camera_rays, render
from vio.sim.rigs import fisheye_rig
from vio.sim.sequence import SimulatedRecording, simulate, views
from vio.sim.world import room
from vio.targets.results import basalt_text
from vio.targets.start import one_camera
from vio.targets.views import sightings

SIZE = (320.0, 240.0, 640, 480)
# Of each model, with every number of coefficients that it takes.
EXAMPLES = {
    "pinhole": CameraModel(400, 401, *SIZE),
    "radtan4": CameraModel(400, 401, *SIZE, "radtan", (-0.28, 0.07, 2e-4, 2e-5)),
    "radtan5": CameraModel(400, 401, *SIZE, "radtan", (-0.37, 0.2, 2e-3, 1e-3, -0.07)),
    "radtan8": CameraModel(
        400, 401, *SIZE, "radtan", (0.3, -0.1, 1e-4, 2e-4, 0.01, 0.6, -0.12, 0.03)
    ),
    "equidistant": CameraModel(190, 191, *SIZE, "equidistant", (0.003, 0.0007, -0.002, 0.0002)),
    "equidistant, folds": CameraModel(190, 191, *SIZE, "equidistant", (-0.05, -0.02, 0.0, 0.0)),
    "unified1": CameraModel(300, 301, *SIZE, "unified", (0.9,)),
    "unified5": CameraModel(660, 661, *SIZE, "unified", (1.4, -0.2, 0.05, 1e-3, -2e-3)),
    "double_sphere": CameraModel(170, 171, *SIZE, "double_sphere", (-0.25, 0.57)),
    "eucm": CameraModel(180, 181, *SIZE, "eucm", (0.61, 1.1)),
    "eucm, less than 180 deg": CameraModel(300, 301, *SIZE, "eucm", (0.35, 0.9)),
    "fov": CameraModel(270, 271, *SIZE, "fov", (0.93,)),
}
# Pixels of three points before the models had files of their own.
POINTS = [[0.31, -0.22, 1.0], [-0.45, 0.4, 0.9], [0.05, 0.6, 1.3]]
PIXELS_BEFORE = {
    "pinhole": (
        ("0x1.bc00000000000p+8", "0x1.2f8f5c28f5c29p+7"),
        ("0x1.e000000000000p+6", "0x1.a238e38e38e39p+8"),
        ("0x1.4f62762762762p+8", "0x1.a913b13b13b14p+8"),
    ),
    "radtan4": (
        ("0x1.b727ee728ee8cp+8", "0x1.367a36507decap+7"),
        ("0x1.1c75a5929e7f7p+7", "0x1.8e73bcef5c131p+8"),
        ("0x1.4e83c70f04319p+8", "0x1.9e9bec659c029p+8"),
    ),
    "radtan5": (
        ("0x1.b5e335e20500ep+8", "0x1.38924b2bde242p+7"),
        ("0x1.24c4bc84aabccp+7", "0x1.8b3ab785dcbb8p+8"),
        ("0x1.4e68f2cfb7ae1p+8", "0x1.9c7ddb2d074bfp+8"),
    ),
    "radtan8": (
        ("0x1.b71ad3189ad08p+8", "0x1.368daf5a1c2e2p+7"),
        ("0x1.1a7773f1a7e72p+7", "0x1.8f59d07216314p+8"),
        ("0x1.4e883aba7b8a9p+8", "0x1.9e9fb7135c481p+8"),
    ),
    "equidistant": (
        ("0x1.784f0f8c21e60p+8", "0x1.8fa83aa8a041fp+7"),
        ("0x1.d85e7802dac26p+7", "0x1.3ae510250cbf0p+8"),
        ("0x1.46d8f8cebafe8p+8", "0x1.429a607a741e6p+8"),
    ),
    "unified1": (
        ("0x1.6f616a1be77c8p+8", "0x1.9c86ab9de7ac0p+7"),
        ("0x1.eff6ebe0e8c78p+7", "0x1.303aa9663b478p+8"),
        ("0x1.45caf9a067501p+8", "0x1.35bf052f19536p+8"),
    ),
    "unified5": (
        ("0x1.9173804e5ebb0p+8", "0x1.6c343115c1816p+7"),
        ("0x1.8cb6392db4240p+7", "0x1.5c428e6a0b1bcp+8"),
        ("0x1.49e0526d3324cp+8", "0x1.673e2a6b3484cp+8"),
    ),
    "double_sphere": (
        ("0x1.83191a2b9ffaep+8", "0x1.80342ec58169bp+7"),
        ("0x1.b887257532834p+7", "0x1.492cfe501fa13p+8"),
        ("0x1.4827fad42c6f3p+8", "0x1.527324f806474p+8"),
    ),
}
_SAME_ULPS = 2  # other processors round trigonometric functions in another way


@pytest.fixture(params=EXAMPLES)
def camera(request: pytest.FixtureRequest) -> CameraModel:
    return EXAMPLES[request.param]


def test_every_model_has_an_example_of_each_number_of_coefficients() -> None:
    shown = {(camera.model, len(camera.coefficients)) for camera in EXAMPLES.values()}
    assert shown == {(name, count) for name, lens in LENSES.items() for count in lens.counts}


def test_every_model_is_named_as_its_file() -> None:
    folder = Path(vio.__file__).parent / "geometry" / "lenses"
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "model", "registry"}
    assert set(LENSES) == files
    for name, lens in LENSES.items():
        assert lens.name == name
        assert lens.counts[-1] == len(lens.parameters)
        assert set(lens.files.kalibr) == set(lens.counts)


@pytest.mark.parametrize("name", PIXELS_BEFORE)
def test_models_project_as_before_they_were_classes(name: str) -> None:
    expected = np.array([[float.fromhex(x) for x in row] for row in PIXELS_BEFORE[name]])
    uv, _ = project_point(EXAMPLES[name], POINTS)
    np.testing.assert_array_max_ulp(uv, expected, maxulp=_SAME_ULPS)


def _inside(camera: CameraModel, share: float = 0.97, count: int = 60) -> FloatArray:
    """Points in all directions up to a share of the model's angle, some on or near the axis."""
    rng = np.random.default_rng(5)
    # From further out Newton's method does not find back to a slope that nearly ends.
    widest = np.arctan(2.5) if camera.lens.planar else np.radians(150)
    limit = min(camera.lens.max_angle(camera.coefficients), widest)
    theta = np.append(rng.uniform(0, share * limit, count), [0.0, 1e-9, 1e-4])
    around = rng.uniform(-np.pi, np.pi, len(theta))
    ray = np.stack(
        [np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=1
    )
    return ray * rng.uniform(0.3, 20, (len(theta), 1))


def test_derivatives_are_those_of_the_projection(camera: CameraModel) -> None:
    values = np.array([camera.fu, camera.fv, camera.cu, camera.cv, *camera.coefficients])

    def of_camera(p: FloatArray, x: FloatArray) -> FloatArray:
        fu, fv, cu, cv, *c = x.tolist()
        moved = replace(camera, fu=fu, fv=fv, cu=cu, cv=cv, coefficients=tuple(c))
        return project_point(moved, p)[0]

    # Near the end of a model its derivatives grow without a bound, and differences are useless.
    for p in _inside(camera, 0.85, 25):
        near = float(np.linalg.norm(p))
        by_point = numeric_jacobian(lambda q: project_point(camera, q)[0], p, eps=1e-6 * near)
        scale = np.abs(by_point).max()
        np.testing.assert_allclose(uv_D_point(camera, p), by_point, atol=1e-6 * scale)
        by_camera = numeric_jacobian(lambda x, p=p: of_camera(p, x), values)
        scale = max(np.abs(by_camera).max(), 1.0)
        np.testing.assert_allclose(uv_D_camera(camera, p), by_camera, atol=1e-6 * scale)


def test_derivatives_of_many_points_are_those_of_each(camera: CameraModel) -> None:
    p = _inside(camera, 0.85, 5).reshape(2, 4, 3)
    many = uv_D_point(camera, p), uv_D_camera(camera, p)
    for k in np.ndindex(2, 4):
        np.testing.assert_allclose(many[0][k], uv_D_point(camera, p[k]), rtol=1e-12)
        np.testing.assert_allclose(many[1][k], uv_D_camera(camera, p[k]), rtol=1e-12)


def test_pixels_lead_back_to_their_rays_over_the_whole_model(camera: CameraModel) -> None:
    p = _inside(camera)
    uv, valid = project_point(camera, p)
    ray, found = unproject_pixel(camera, uv)
    assert valid.all()
    assert found.all()
    np.testing.assert_allclose(ray, p / np.linalg.norm(p, axis=1, keepdims=True), atol=1e-7)


def test_the_valid_field_of_view_ends_at_the_models_angle(camera: CameraModel) -> None:
    limit = camera.lens.max_angle(camera.coefficients)
    theta = np.linspace(0, np.pi, 4001)
    around = 0.7
    ray = np.stack(
        [np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=1
    )
    uv, valid = project_point(camera, ray)
    assert np.isfinite(uv).all()
    clear = np.abs(theta - limit) > 2e-3
    np.testing.assert_array_equal(valid[clear], (theta < limit)[clear])
    # Within it no two angles share a pixel.
    centre = (camera.cu, camera.cv)
    radius = np.linalg.norm((uv - centre) / (camera.fu, camera.fv), axis=1)[valid]
    assert (np.diff(radius) > 0).all()


def test_what_no_model_can_project_is_finite_and_marked(camera: CameraModel) -> None:
    p = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [3.0, 1.0, -9.0], [1e-13, 0, 1e-13]])
    uv, valid = project_point(camera, p)
    assert np.isfinite(uv).all()
    assert not valid[:2].any()
    ray, found = unproject_pixel(camera, [[np.nan, 3.0], [np.inf, 0.0], [1e9, 1e9]])
    assert not found[:2].any()
    assert np.isfinite(ray[found]).all()


def test_more_distortion_moves_pixels_where_the_model_holds_it(camera: CameraModel) -> None:
    p = np.array([[0.3, 0.2, 1.0]])
    start, _ = project_point(camera, p)
    for radial, tangential in (
        ((1e-3, 0.0), (0.0, 0.0)),
        ((0.0, 1e-3), (0.0, 0.0)),
        ((0.0, 0.0), (1e-3, 0.0)),
        ((0.0, 0.0), (0.0, 1e-3)),
    ):
        model, coefficients = camera.lens.bent(camera.coefficients, radial, tangential)
        bent = replace(camera, model=model, coefficients=coefficients)
        moved = (project_point(bent, p)[0] - start)[0] / (camera.fu, camera.fv)
        length = float(np.linalg.norm(moved))
        held = holds_distortion(camera, radial, tangential)
        assert (length > 1e-8) == held
        if held:  # radial distortion moves along the radius, tangential does not
            across = abs(moved[0] * p[0, 1] - moved[1] * p[0, 0]) / length
            assert (across < 1e-6) == any(radial)


def _pair(camera: CameraModel) -> Rig:
    T = se3_from_parts(so3_exp([0.004, -0.006, 0.003]), [-0.11, 0.0004, -0.0006])
    return Rig(camera, replace(camera, cu=camera.cu + 3), T)


def test_rig_files_are_read_as_written(camera: CameraModel, tmp_path: Path) -> None:
    rig = _pair(camera)
    (tmp_path / "camchain.yaml").write_text(kalibr_text(rig))
    assert vio.load_rig(tmp_path / "camchain.yaml").cameras == rig.cameras
    basalt = basalt_text(rig)
    assert (basalt is None) == (camera.lens.files.basalt is None)
    if basalt is not None:
        (tmp_path / "calibration.json").write_text(basalt)
        back = vio.load_rig(tmp_path / "calibration.json")
        uv = project_point(camera, POINTS)[0]
        np.testing.assert_allclose(project_point(back.cam0, POINTS)[0], uv, atol=1e-9)


# --- EUCM, FOV
# --------------------------------------------------------------------------------------------------


def test_eucm_of_a_sphere_is_the_unified_model_in_other_parameters() -> None:
    """Khomutenko et al., section 2: beta = 1, `alpha / (1 - alpha)` is Mei's xi, and focal lengths
    scale by `1 - alpha`.
    """
    points = np.random.default_rng(4).normal(size=(200, 3))
    for alpha in (0.3, 0.6):
        a, valid_a = LENSES["eucm"].project((alpha, 1.0), points)
        b, valid_b = LENSES["unified"].project((alpha / (1 - alpha),), points)
        np.testing.assert_array_equal(valid_a, valid_b)
        np.testing.assert_allclose(a[valid_a] * (1 - alpha), b[valid_a], rtol=1e-12)


def test_fov_is_the_arc_tangent_of_its_authors() -> None:
    """Devernay & Faugeras, equations 13 and 14, on the plane of tangents."""
    w = 0.93
    p = _inside(EXAMPLES["pinhole"])
    xy, valid = LENSES["fov"].project((w,), p)
    assert valid.all()
    ru = np.linalg.norm(p[:, :2], axis=1) / p[:, 2]
    rd = np.linalg.norm(xy, axis=1)
    np.testing.assert_allclose(rd, np.arctan(2 * ru * np.tan(w / 2)) / w, atol=1e-12)
    np.testing.assert_allclose(np.tan(rd * w) / (2 * np.tan(w / 2)), ru, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "coefficients"), [("eucm", (0.0, 1.3)), ("fov", (0.0,)), ("fov", (1e-7,))]
)
def test_without_its_parameter_a_model_is_a_pinhole(model: str, coefficients: Coefficients) -> None:
    pinhole = EXAMPLES["pinhole"]
    p = _inside(pinhole)
    same = replace(pinhole, model=model, coefficients=coefficients)
    uv, _ = project_point(pinhole, p)
    np.testing.assert_allclose(project_point(same, p)[0], uv, atol=1e-7)
    np.testing.assert_allclose(
        unproject_pixel(same, uv)[0], unproject_pixel(pinhole, uv)[0], atol=1e-9
    )


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("eucm", (1.1, 0.6), "alpha=1.1, beta=0.6; check their order"),
        ("eucm", (0.6, 0.0), "beta > 0"),
        ("fov", (-0.1,), "an angle in radians"),
        ("fov", (53.0,), "0 <= w < pi, got 53"),
    ],
)
def test_rejects_impossible_coefficients(
    model: str, coefficients: Coefficients, message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        CameraModel(300, 300, *SIZE, model, coefficients)


# Kalibr's `ConfigReader.py`: what stands before fu fv pu pv, and the distortion.
KALIBR = {
    "pinhole-fov": ("pinhole", "fov", [], [0.93], ("fov", (0.93,))),
    "pinhole-fov of zero": ("pinhole", "fov", [], [0.0], ("pinhole", ())),
    "eucm-none": ("eucm", "none", [0.61, 1.1], [], ("eucm", (0.61, 1.1))),
    "ds-none": ("ds", "none", [-0.25, 0.57], [], ("double_sphere", (-0.25, 0.57))),
    "omni-radtan": (
        "omni",
        "radtan",
        [1.4],
        [-0.2, 0.05, 1e-3, -2e-3],
        ("unified", (1.4, -0.2, 0.05, 1e-3, -2e-3)),
    ),
    "omni-none": ("omni", "none", [0.9], [], ("unified", (0.9,))),
}


@pytest.mark.parametrize("name", KALIBR)
def test_reads_the_models_of_kalibr(name: str, tmp_path: Path) -> None:
    kind, bend, leading, coefficients, expected = KALIBR[name]
    sheet = {
        "camera_model": kind,
        "distortion_model": bend,
        "distortion_coeffs": coefficients,
        "intrinsics": [*leading, 300.0, 301.0, 320.5, 240.5],
        "resolution": [640, 480],
    }
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump({"cam0": sheet}))
    camera = vio.load_rig(tmp_path / "camchain.yaml").cam0
    assert (camera.model, camera.coefficients) == expected
    assert (camera.fu, camera.fv, camera.cu, camera.cv) == (300.0, 301.0, 320.5, 240.5)


@pytest.mark.parametrize(
    ("kind", "bend", "message"),
    [
        ("eucm", "radtan", "eucm with distortion 'radtan' is not read; calibrate eucm-none"),
        ("omni", "fov", "calibrate omni-none or omni-radtan"),
        ("ocam", "none", "'ocam' is not read; calibrate with pinhole, omni, ds, eucm"),
    ],
)
def test_names_what_kalibr_calls_the_models(
    kind: str, bend: str, message: str, tmp_path: Path
) -> None:
    leading = {"eucm": [0.61, 1.1], "omni": [0.9]}.get(kind, [])
    sheet = {
        "camera_model": kind,
        "distortion_model": bend,
        "distortion_coeffs": [0.1] * (1 if bend == "fov" else 4),
        "intrinsics": [*leading, 300.0, 301.0, 320.5, 240.5],
        "resolution": [640, 480],
    }
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump({"cam0": sheet}))
    with pytest.raises(CalibrationError, match=message):
        vio.load_rig(tmp_path / "camchain.yaml")


# --- a new model
# --------------------------------------------------------------------------------------------------


class Stereographic(Lens):
    """The radius is `2 (1 + a) tan(theta / 2)`: a model that this project does not have."""

    name = "stereographic"
    parameters = ("a",)
    counts = (1,)
    files = FileNames(kalibr={1: KalibrForm("stereo", "none", 1)}, basalt="stereo")

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, np.ndarray]:
        length = np.linalg.norm(p, axis=-1)
        depth = p[..., 2] + length
        valid = depth > 1e-9 * np.maximum(length, 1e-9)
        return 2 * (1 + c[0]) * p[..., :2] / np.where(valid, depth, 1.0)[..., None], valid

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, np.ndarray]:
        half = xy / (2 * (1 + c[0]))
        r2 = np.sum(half**2, axis=-1)[..., None]
        ray = np.concatenate([2 * half, 1 - r2], axis=-1) / (1 + r2)
        return ray, np.isfinite(ray).all(axis=-1)

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        length = np.linalg.norm(p, axis=-1)[..., None, None]
        depth = p[..., 2][..., None, None] + length
        by_depth = p[..., None, :] / length + [0.0, 0.0, 1.0]
        plain = p[..., :2, None] / depth
        by_p = np.eye(3)[:2] / depth - plain * by_depth / depth
        return 2 * (1 + c[0]) * by_p, 2 * plain

    def max_angle(self, c: Coefficients) -> float:
        return float(np.pi)

    def start(self, count: int) -> Coefficients:
        return (0.0,)


@pytest.fixture
def new_model(monkeypatch: pytest.MonkeyPatch) -> CameraModel:
    monkeypatch.setitem(LENSES, "stereographic", Stereographic())
    return CameraModel(110.0, 111.0, 158.0, 121.0, 320, 240, "stereographic", (0.04,))


def test_a_new_model_is_read_written_rendered_and_rectified(
    new_model: CameraModel, tmp_path: Path
) -> None:
    """Nothing but its class and its entry in the registry knows it."""
    rig = _pair(new_model)
    (tmp_path / "camchain.yaml").write_text(kalibr_text(rig))
    assert vio.load_rig(tmp_path / "camchain.yaml").cameras == rig.cameras
    basalt = json.loads(basalt_text(rig) or "")["value0"]["intrinsics"][0]
    assert basalt["camera_type"] == "stereo"
    assert basalt["intrinsics"]["a"] == 0.04
    assert _rows_apart(rig.stereo) < 0.15


def test_a_new_model_is_calibrated_by_a_board(new_model: CameraModel) -> None:
    size = (new_model.width, new_model.height)
    found = one_camera(
        sightings(views_around(new_model, 16), GRID.points_m), size, "stereographic", 1
    ).at.cameras[0]
    grid = np.stack(np.meshgrid(np.linspace(20, 300, 9), np.linspace(20, 220, 7)), axis=-1)
    ray, _ = unproject_pixel(new_model, grid.reshape(-1, 2))
    off = project_point(found, ray)[0] - grid.reshape(-1, 2)
    assert np.abs(off).max() < 0.5


def test_files_without_a_name_for_a_model_say_so(
    new_model: CameraModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stereographic, "files", FileNames())
    with pytest.raises(CalibrationError, match="camchain has no stereographic lens; rectify"):
        kalibr_text(Rig(new_model))
    assert basalt_text(Rig(new_model)) is None


# --- rendered wide-angle pairs
# --------------------------------------------------------------------------------------------------


WIDE = {
    "eucm": CameraModel(106.0, 106.3, 158.0, 121.0, 320, 240, "eucm", (0.62, 1.05)),
    "double_sphere": CameraModel(86.0, 86.3, 158.0, 121.0, 320, 240, "double_sphere", (-0.2, 0.57)),
    "fov": CameraModel(128.0, 128.5, 158.0, 121.0, 320, 240, "fov", (1.2,)),
    "unified": CameraModel(
        190.0, 190.6, 158.0, 121.0, 320, 240, "unified", (1.2, -0.02, 0.01, 1e-3, 0)
    ),
}


@pytest.mark.parametrize("camera", WIDE.values(), ids=WIDE)
def test_rectified_images_of_a_wide_pair_agree_in_rows(camera: CameraModel) -> None:
    assert np.degrees(field_of_view(camera)[0]) > 115
    rig = _pair(camera).stereo
    assert _rows_apart(rig) < 0.15
    # With a focal length that is off by 2 % the right image's rows are not those of the left.
    other = replace(rig.cam1, fu=1.02 * rig.cam1.fu, fv=1.02 * rig.cam1.fv)
    assert _rows_apart(rig, replace(rig, cam1=other)) > 0.25


@pytest.mark.parametrize("name", ["eucm", "fov"])
def test_a_run_follows_rendered_images_of_a_wide_pair(name: str) -> None:
    mounted = fisheye_rig()
    rig = replace(mounted, cam0=WIDE[name], cam1=replace(WIDE[name], cu=160.0))
    plan = simulate(
        room(seed=1),
        rig,
        hand_held(duration_s=1.0),
        rate_hz=10.0,
        imu=ImuNoise(),
        effects=CLEAN,
        seed=1,
    )
    sim = SimulatedRecording(plan)
    assert plan.imu is not None
    results: list[FrameResult] = []
    odometry = Odometry(rig_of(rig), on_frame=results.append)
    odometry.add_imu(plan.imu.times_ns, plan.imu.gyro, plan.imu.accel)
    for k in range(len(sim)):
        odometry.add_stereo(int(plan.stamps_ns[k]), *sim.images(k))
    odometry.finish()
    poses = np.stack([r.estimate.T_world_imu for r in results])
    truth = motion_at(plan.motion, plan.stamps_ns).T_world_imu
    aligned = align_poses(poses, truth, "se3")
    moved = poses[:, :3, 3] @ aligned.R.T + aligned.t
    off = np.linalg.norm(moved - truth[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.001


def _rectifier(rig: StereoRig) -> Rectifier:
    return Rig(rig.cam0, rig.cam1, se3_inverse(rig.T_cam0_cam1)).rectifier()


def _rows_apart(rig: StereoRig, believed: StereoRig | None = None) -> float:
    """Median distance in pixels of the rows of features that rectified rendered images share.

    Args:
        rig: the true one.
        believed: by which the images are rectified; None: the true one.
    """
    mounted = fisheye_rig()
    T_imu_cam1 = mounted.T_imu_cam0 @ rig.T_cam0_cam1
    rig = replace(rig, T_imu_cam0=mounted.T_imu_cam0, T_imu_cam1=T_imu_cam1)
    motion = hand_held(duration_s=1.0)
    simulation = simulate(room(seed=1), rig, motion, rate_hz=5.0, seed=1)
    both = views(simulation, int(simulation.taken_ns[0]))
    raw = [
        render(simulation.world, camera_rays(view.camera), view.T_world_cam)
        .clip(0, 255)
        .astype(np.uint8)
        for view in both
    ]
    left, right = _rectifier(believed or rig)(*raw)
    corners = cv2.goodFeaturesToTrack(left, 300, 0.01, 6)
    there, status, _ = cv2.calcOpticalFlowPyrLK(left, right, corners, None, winSize=(15, 15))
    back, _, _ = cv2.calcOpticalFlowPyrLK(right, left, there, None, winSize=(15, 15))
    good = (status[:, 0] == 1) & (np.linalg.norm(back - corners, axis=2)[:, 0] < 0.2)
    assert good.sum() > 60
    return float(np.median(np.abs((there - corners)[good, 0, 1])))
