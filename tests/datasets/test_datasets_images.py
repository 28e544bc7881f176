"""Strict image loading, pairing by name, and the prefetch thread."""

from __future__ import annotations

import threading
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.dataset_makers import make_images
from tests.datasets.test_datasets_png import chunk
from vio.datasets.image_pairs import pair_images
from vio.datasets.images import UnreadableImageError, list_images, load_gray, prefetch
from vio.errors import DataError

PIXELS = np.random.default_rng(5).integers(0, 256, (24, 32)).astype(np.uint8)


def test_gray_png_is_read_to_the_bit(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.png"), PIXELS)
    image, bits = load_gray(tmp_path / "a.png")
    assert bits == 8
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, PIXELS)


def test_jpeg_is_read(tmp_path: Path) -> None:
    smooth = np.tile(np.arange(0, 248, 8, dtype=np.uint8), (24, 1))
    assert cv2.imwrite(str(tmp_path / "a.jpg"), smooth)
    image, bits = load_gray(tmp_path / "a.jpg")
    assert bits == 8
    assert np.abs(image.astype(int) - smooth).max() <= 4


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_is_weighted_to_gray(channels: int, tmp_path: Path) -> None:
    bgr = np.zeros((4, 4, channels), dtype=np.uint8)
    bgr[..., :3] = [10, 100, 200]
    assert cv2.imwrite(str(tmp_path / "a.png"), bgr)
    image, _ = load_gray(tmp_path / "a.png")
    assert image.shape == (4, 4)
    assert int(image[0, 0]) == round(0.114 * 10 + 0.587 * 100 + 0.299 * 200)


def test_sixteen_bits_are_scaled_to_eight(tmp_path: Path) -> None:
    deep = (np.arange(256, dtype=np.uint16) * 257).reshape(16, 16)
    assert cv2.imwrite(str(tmp_path / "a.png"), deep)
    image, bits = load_gray(tmp_path / "a.png")
    assert bits == 16
    np.testing.assert_array_equal(image.reshape(-1), np.arange(256))


def _png(tmp_path: Path) -> bytes:
    assert cv2.imwrite(str(tmp_path / "whole.png"), PIXELS)
    return (tmp_path / "whole.png").read_bytes()


@pytest.mark.parametrize("kept", [0.03, 0.5, 0.9, 0.999])
def test_truncated_png_is_unreadable_although_opencv_may_decode_it(
    kept: float, tmp_path: Path
) -> None:
    data = _png(tmp_path)
    (tmp_path / "cut.png").write_bytes(data[: int(kept * len(data))])
    with pytest.raises(
        UnreadableImageError, match=r"cut\.png: the PNG is truncated; copy the image again"
    ):
        load_gray(tmp_path / "cut.png")


def test_damaged_png_is_unreadable(tmp_path: Path) -> None:
    data = bytearray(_png(tmp_path))
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "bent.png").write_bytes(bytes(data))
    with pytest.raises(
        UnreadableImageError, match=r"bent\.png: the PNG is damaged \(wrong checksum in its 'IDAT'"
    ):
        load_gray(tmp_path / "bent.png")


def test_whole_png_without_an_image_is_unreadable(tmp_path: Path) -> None:
    (tmp_path / "void.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""))
    with pytest.raises(UnreadableImageError, match=r"void\.png: does not decode"):
        load_gray(tmp_path / "void.png")


def test_missing_image_is_unreadable(tmp_path: Path) -> None:
    with pytest.raises(UnreadableImageError, match=r"cannot read .*a\.png"):
        load_gray(tmp_path / "a.png")


def test_lists_images_in_order_without_other_files(tmp_path: Path) -> None:
    make_images(tmp_path / "images", 11)
    for name in ("notes.txt", ".hidden.png"):
        (tmp_path / "images" / name).write_text("x")
    assert [path.name for path in list_images(tmp_path / "images")] == [
        f"{k:06d}.png" for k in range(11)
    ]


def test_rejects_folders_without_images(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot list .*nowhere"):
        list_images(tmp_path / "nowhere")
    with pytest.raises(DataError, match="holds no image"):
        list_images(tmp_path)


@pytest.mark.parametrize(("side", "counts"), [("left", (4, 5)), ("right", (5, 4))])
def test_error_names_the_first_missing_partner(
    side: str, counts: tuple[int, int], tmp_path: Path
) -> None:
    for name in ("left", "right"):
        make_images(tmp_path / name, 5)
    (tmp_path / side / "000003.png").unlink()
    message = (
        rf"left holds {counts[0]} images and .*right {counts[1]}: .*{side}.000003\.png is missing"
    )
    with pytest.raises(DataError, match=message):
        pair_images(tmp_path / "left", tmp_path / "right")


def test_pairs_hold_names_and_not_paths(tmp_path: Path) -> None:
    """Two paths took 700 bytes a frame, 100 MB in an hour of a stereo camera."""
    count = 1000
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for k in range(count):
            (tmp_path / side / f"{10**18 + 50_000_000 * k}.png").touch()
    tracemalloc.start()
    pairs = pair_images(tmp_path / "left", tmp_path / "right")
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 400 * count
    assert [path.parent.name for path in pairs[0]] == ["left", "right"]
    assert [left.name for left, right in pairs[-2:] if left.name == right.name] == [
        f"{10**18 + 50_000_000 * k}.png" for k in (count - 2, count - 1)
    ]


# --- prefetching
# --------------------------------------------------------------------------------------------------


def _prefetch_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("vio-prefetch")]


@pytest.mark.parametrize("depth", [0, 1, 4, 50])
def test_prefetch_keeps_the_order(depth: int) -> None:
    assert list(prefetch(lambda k: k * k, range(20), depth)) == [k * k for k in range(20)]
    assert _prefetch_threads() == []


def test_prefetch_loads_no_more_than_its_depth_ahead() -> None:
    loaded: list[int] = []
    taken = prefetch(lambda k: loaded.append(k) or k, range(100), 3)  # type: ignore[func-returns-value]
    for k in range(10):
        assert next(taken) == k
        assert len(loaded) <= k + 1 + 3
    taken.close()
    assert len(loaded) <= 13
    assert _prefetch_threads() == []


def test_prefetch_runs_beside_its_consumer() -> None:
    begun = threading.Event()

    def load(k: int) -> int:
        if k == 1:
            begun.set()
        return k

    taken = prefetch(load, range(3), 2)
    assert next(taken) == 0
    assert begun.wait(timeout=10)  # item 1 is loaded before it is requested
    taken.close()


def test_prefetch_takes_its_items_in_the_thread_and_closes_them() -> None:
    """The items of a bag are its messages: reading them is the larger part of the work."""
    takers: set[str] = set()
    closed = threading.Event()

    def items() -> Iterator[int]:
        try:
            for k in range(100):
                takers.add(threading.current_thread().name)
                yield k
        finally:
            closed.set()

    taken = prefetch(lambda k: k, items(), 2)
    assert [next(taken) for _ in range(5)] == [0, 1, 2, 3, 4]
    taken.close()
    assert all(name.startswith("vio-prefetch") for name in takers)
    assert closed.is_set()
    assert _prefetch_threads() == []


@pytest.mark.parametrize("depth", [0, 4])
def test_prefetch_passes_exceptions_at_their_place(depth: int) -> None:
    def load(k: int) -> int:
        if k == 3:
            raise DataError("frame 3 is corrupt")
        return k

    taken = prefetch(load, range(10), depth)
    assert [next(taken) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(DataError, match="frame 3 is corrupt"):
        next(taken)
    assert _prefetch_threads() == []


def test_prefetch_passes_exceptions_of_its_source() -> None:
    def items() -> Iterator[int]:
        yield 0
        raise DataError("no more")

    with pytest.raises(DataError, match="no more"):
        list(prefetch(lambda k: k, items(), 1))
    assert _prefetch_threads() == []
