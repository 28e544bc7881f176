"""PyTorch: landmarks as tensors of float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.interop.loading import package
from vio.records import IntArray, Landmarks

_INSTALL = ".[learned]"


def to_points(landmarks: Landmarks) -> tuple[Any, Any]:
    """Return points (M, 3) and their covariances (M, 3, 3) as tensors with memory of their own."""
    torch = package("torch", _INSTALL)
    return torch.tensor(landmarks.p_world), torch.tensor(landmarks.covariance)


def from_points(ids: IntArray, points: Any, covariance: Any) -> Landmarks:
    """Return tensors of points (M, 3) and covariances (M, 3, 3), on any device, as landmarks."""
    p_world = points.detach().cpu().double().numpy()
    spread = covariance.detach().cpu().double().numpy()
    return Landmarks(np.asarray(ids, dtype=np.int64), p_world, spread)
