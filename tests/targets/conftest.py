"""Recordings of a board, rendered once for all tests here."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.board_views import SMALL, render_pairs, render_record
from vio.targets.description import target_text


@pytest.fixture(scope="session")
def board_pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen pairs of `SMALL`, in left and right."""
    return render_pairs(tmp_path_factory.mktemp("board") / "pairs", 16, seed=5)


@pytest.fixture(scope="session")
def board_record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One camera turned and moved before `SMALL`, with its IMU."""
    return render_record(tmp_path_factory.mktemp("board") / "record", 12.0, seed=1)


@pytest.fixture(scope="session")
def board_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The description of `SMALL`."""
    file = tmp_path_factory.mktemp("board") / "board.yaml"
    file.write_text(target_text(SMALL))
    return file
