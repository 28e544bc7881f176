"""Back ends: estimators fed with motion samples and observations.

None of them imports cv2 or torch.
"""

from __future__ import annotations

from collections.abc import Callable

from vio.protocols import Backend

__all__ = ["BACKENDS", "backend_class"]


def _vislam() -> type[Backend]:
    from vio.filters.vislam import Vislam

    return Vislam


def _msckf() -> type[Backend]:
    from vio.filters.msckf_of_rig import MsckfOfRig

    return MsckfOfRig


# The back ends by their names in the configuration; the settings of one are the section of the same
# name, if any.
BACKENDS: dict[str, Callable[[], type[Backend]]] = {"vislam": _vislam, "msckf": _msckf}


def backend_class(name: str) -> type[Backend]:
    """Return the class of the back end called `name`, a key of `BACKENDS`."""
    return BACKENDS[name]()
