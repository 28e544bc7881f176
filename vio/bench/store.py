"""Results of tasks on disk, one file each, by key: a task that has one is never run again."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from vio.errors import DataError
from vio.files.atomic import atomic_write_text
from vio.files.printable import json_text

log = logging.getLogger(__name__)
Record = dict[str, Any]


class Store:
    """A folder of results."""

    def __init__(self, folder: Path) -> None:
        """Name the folder; it is made with the first result."""
        self._folder = folder

    def path(self, key: str) -> Path:
        """Return where a task's result is: in one of 256 folders, so that none gets long."""
        return self._folder / key[:2] / f"{key}.json"

    def get(self, key: str) -> Record | None:
        """Return a task's result; None: there is none, or its file is damaged."""
        path = self.path(key)
        try:
            record: Record = json.loads(path.read_text(encoding="utf-8"))
            record["figures"], record["failure"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as error:
            log.warning("%s: is damaged (%s); its task is run again", path, error)
            return None
        return record

    def put(self, key: str, record: Record) -> None:
        """Keep a task's result, atomically.

        Raises:
            DataError: it cannot be written.
        """
        path = self.path(key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(
                f"cannot write {path}: {error.strerror or error}; choose another --cache"
            ) from error
        atomic_write_text(path, json_text(record) + "\n")
