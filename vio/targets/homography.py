"""Homographies of many sets of corners at once, from a board's plane to pixels, and the light
there.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray
from vio.records import Image

NEIGHBOURS = 12  # nearest corners that predict another one


def predict(
    at: FloatArray, board: FloatArray, uv: FloatArray, *, leave_out: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Pixels (K, 2) of places (K, 2) on the board by the homographies (K, 3, 3) of the nearest
    known corners, and these.

    With `leave_out` a known corner at the place itself is not used.
    """
    apart = np.linalg.norm(at[:, None] - board, axis=2)
    if leave_out:
        apart = np.where(apart < 1e-9, np.inf, apart)
    count = min(NEIGHBOURS, len(board) - leave_out)
    rows = np.argsort(apart, axis=1, kind="stable")[:, :count]
    H = homographies(board[rows], uv[rows])
    return mapped(H, at[:, None])[:, 0], H


def mapped(H: FloatArray, board: FloatArray) -> FloatArray:
    """Pixels (K, S, 2) of places (K, S, 2) on the board by homographies (K, 3, 3)."""
    q = board @ np.swapaxes(H[:, :, :2], 1, 2) + H[:, None, :, 2]
    depth = np.where(np.abs(q[..., 2:]) < 1e-12, 1e-12, q[..., 2:])
    return np.asarray(q[..., :2] / depth)


def derivative(H: FloatArray, board: FloatArray, uv: FloatArray) -> FloatArray:
    """Derivatives (K, 2, 2) of pixels (K, 2) by places (K, 2) on the board."""
    depth = np.einsum("ki,ki->k", H[:, 2, :2], board) + H[:, 2, 2]
    depth = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    change = H[:, :2, :2] - uv[..., None] * H[:, 2:, :2]
    return np.asarray(change / depth[:, None, None])


def homographies(board: FloatArray, uv: FloatArray) -> FloatArray:
    """Homographies (K, 3, 3) from the board to pixels by S corners each (K, S, 2)."""
    T_board = _normalising(board)
    T_uv = _normalising(uv)
    a = board * T_board[:, :1, 0][..., None] + T_board[:, :2, 2][:, None]
    b = uv * T_uv[:, :1, 0][..., None] + T_uv[:, :2, 2][:, None]
    one = np.ones(a.shape[:2])
    zero = np.zeros((*one.shape, 3))
    p = np.stack([a[..., 0], a[..., 1], one], axis=-1)
    upper = np.concatenate([p, zero, -b[..., :1] * p], axis=-1)
    lower = np.concatenate([zero, p, -b[..., 1:] * p], axis=-1)
    A = np.concatenate([upper, lower], axis=1)
    _, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)
    H = vectors[..., 0].reshape(-1, 3, 3)
    H = np.linalg.inv(T_uv) @ H @ T_board
    last = H[:, 2:, 2:]
    return np.asarray(H / np.where(np.abs(last) < 1e-15, 1e-15, last))


def _normalising(p: FloatArray) -> FloatArray:
    """Similarities (K, 3, 3) that move points (K, S, 2) around the origin, at unit distance."""
    centre = p.mean(axis=1)
    scale = 1 / np.maximum(np.linalg.norm(p - centre[:, None], axis=2).mean(axis=1), 1e-12)
    out = np.zeros((len(p), 3, 3))
    out[:, 0, 0] = scale
    out[:, 1, 1] = scale
    out[:, 2, 2] = 1
    out[:, :2, 2] = -scale[:, None] * centre
    return out


def gray_at(image: Image, at: FloatArray) -> FloatArray:
    """Gray values (K, S) of an image at pixels (K, S, 2); beside it, those of its border."""
    import cv2

    pixels = np.clip(at, -1e4, 2e4).astype(np.float32)
    values = cv2.remap(
        image,
        np.ascontiguousarray(pixels[..., 0]),
        np.ascontiguousarray(pixels[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(values, dtype=np.float64)
