"""Back ends: estimators fed with motion samples and observations. None of them imports cv2 or torch."""

from __future__ import annotations

from importlib import import_module

from vio.protocols import Backend

__all__ = ["BACKENDS", "backend_class"]

# Where each back end is, by its name in the configuration; its settings are the section of the same name, if any.
BACKENDS = {
    "vislam": "vio.filters.vislam:Vislam",
    "msckf": "vio.filters.msckf:Msckf",
}


def backend_class(name: str) -> type[Backend]:
    """Return the class of the back end called `name`, a key of `BACKENDS`."""
    module, _, found = BACKENDS[name].partition(":")
    backend: type[Backend] = getattr(import_module(module), found)
    return backend
