"""What the reader of a kind of recordings states of itself.

A reader is one file, whose `READERS` has one of these for each kind, and one line in the list
`vio.datasets.MODULES`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vio.dataclass import dataclass
from vio.datasets.settings import DatasetSettings
from vio.protocols import Dataset


def never(path: Path) -> bool:
    """Return False."""
    return False


@dataclass(frozen=True, slots=True)
class Reader:
    """One kind of recordings.

    Whose a path is, is asked in the order of the list: first all by `is_folder` or `is_file`, then
    all by `may_be_folder`, for signs that others have, too.
    """

    kind: str  # as in kind:path
    looked_for: str  # what is said to be looked for, where a path is of no kind
    read: Callable[[Path, DatasetSettings], Dataset]
    is_folder: Callable[[Path], bool] = never
    may_be_folder: Callable[[Path], bool] = never
    is_file: Callable[[Path], bool] = never
    # the kind that reads it with another calibration than its own; None: there is none
    calibrated_as: str | None = None
