"""Records of constants with some fields changed, for `monkeypatch.setattr`."""

from __future__ import annotations

import importlib
from typing import Any


def replaced(path: str, **changes: float) -> Any:
    """Return a copy of the record `path`, as `vio.module._RULES`, with some fields changed."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)._replace(**changes)
