"""The image files of a recording as names; their paths are made when they are asked for.

A path takes 350 bytes and its name 70: an hour of a stereo camera at 20 frames a second has
144,000.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import overload

from vio.dataclass import dataclass


def stem_of(name: str) -> str:
    """Return a file's name without its suffix, as `Path.stem`, which keeps a copy of each name
    for the process.
    """
    return os.path.splitext(name)[0]


@dataclass(frozen=True, slots=True)
class ImageFiles(Sequence[Path]):
    """Files of one folder, in the order of their frames."""

    folder: Path
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> Path: ...

    @overload
    def __getitem__(self, index: slice) -> ImageFiles: ...

    def __getitem__(self, index: int | slice) -> Path | ImageFiles:
        if isinstance(index, slice):
            return ImageFiles(self.folder, self.names[index])
        return self.folder / self.names[index]

    def take(self, rows: Iterable[int]) -> ImageFiles:
        """Return some of the files."""
        return ImageFiles(self.folder, tuple(self.names[k] for k in rows))


@dataclass(frozen=True, slots=True)
class FilePairs(Sequence[tuple[Path, Path]]):
    """Left and right file of each frame."""

    left: Sequence[Path]
    right: Sequence[Path]

    def __len__(self) -> int:
        return len(self.left)

    @overload
    def __getitem__(self, index: int) -> tuple[Path, Path]: ...

    @overload
    def __getitem__(self, index: slice) -> FilePairs: ...

    def __getitem__(self, index: int | slice) -> tuple[Path, Path] | FilePairs:
        if isinstance(index, slice):
            return FilePairs(self.left[index], self.right[index])
        return self.left[index], self.right[index]
