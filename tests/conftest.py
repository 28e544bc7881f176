"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from tests.commands import render
from vio.numerics import prebuilt
from vio.numerics.threads import one_blas_thread

ROOT = Path(__file__).resolve().parent.parent

# The files that take longest. They begin first, so that no worker is left with one when the others
# have ended.
LONGEST = (
    "test_same_results", "test_examples", "test_inertial_check", "test_docs", "test_imu_start", "test_tutorials",
    "test_cli", "test_unfinished_runs", "test_imu_gaps",
    "test_ros2", "test_msckf", "test_bench", "test_colmap", "test_frontend_renders", "test_filter_truth",
    "test_bench_cluster", "test_sim_realism", "test_render_cli", "test_online_calibration", "test_frontend_prior",
    "test_live_odometry", "test_bench_maps", "test_sources", "test_earth", "test_stereo_calibration",
    "test_map_builder", "test_imu_trial", "test_calibrate_cli", "test_frontend_contract", "test_frontend_learned",
    "test_sim_recording", "test_frozen_images",
)  # fmt: skip

# Files whose tests look at the picture of a run. All others write an empty one: drawing takes
# longer than a short run.
DRAWN = ("test_plotting",)

# Tests judge the sources: numba compiles them, and no module that an earlier state of them has
# left. The hundred runs of tools/mutate.py would wait for that an hour.
if "VIO_TEST_MACHINE_CODE" not in os.environ:
    prebuilt.FOLDER = Path("no machine code")
# of torch and COLMAP: other workers use the other cores
os.environ.setdefault("OMP_NUM_THREADS", "1")

settings.register_profile("vio", deadline=None)  # no test judges a machine by its speed
# For tools/mutate.py: the same examples each time, and a failure is not made simpler.
settings.register_profile(
    "once", deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate]
)
settings.load_profile("vio")


# Figures to a millionth hold for one processor and one set of libraries.
_SAME_RESULTS = pytest.mark.skipif(
    "VIO_SAME_RESULTS" not in os.environ, reason="set VIO_SAME_RESULTS=1: for developers"
)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the longest files first among workers, where `--no-loadscope-reorder` keeps this order;
    alone, tools/mutate.py wants the quickest first, as it names them.
    """
    for item in items:
        if item.path.stem == "test_same_results":
            item.add_marker(_SAME_RESULTS)
    if hasattr(config, "workerinput"):
        rank = {name: k for k, name in enumerate(LONGEST)}
        items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """As the command line does: on small matrices a second thread costs a hundred times what it
    brings.
    """
    with one_blas_thread():
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings named by VIO_DATA (empty: not set); the test is skipped
    where it is absent.
    """
    folder = Path(os.environ.get("VIO_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; set VIO_DATA to the folder that holds them")
    return folder


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered flight as an EuRoC folder: 16 frames of 160 pixels with an IMU."""
    options = {"rig": "small", "width": "160", "rate": "20", "duration": "0.8", "format": "euroc"}
    return render(tmp_path_factory.mktemp("flight") / "flight", **options)


@pytest.fixture(autouse=True, scope="module")
def _no_picture(request: pytest.FixtureRequest) -> Iterator[None]:
    """Write an empty picture of each run, see `DRAWN`."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem not in DRAWN:
            patch.setattr(
                "vio.runs.picture.RunPicture.write",
                lambda picture, path: path.write_bytes(b"\x89PNG"),
            )
        yield


@pytest.fixture(autouse=True)
def _no_make_around_us(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where `make` runs the tests, a `make` that a test runs must not take itself for a part of
    that one.
    """
    for name in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def white_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the filter begin with what is true of simulated pixels: their errors are independent."""
    monkeypatch.setattr("vio.filters.overdispersion.PRIOR_FACTOR", 1.0)
