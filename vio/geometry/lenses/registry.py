"""The lens models by their names. A new one is a file in this folder, imported and listed here."""

from __future__ import annotations

from vio.geometry.lenses import double_sphere, equidistant, eucm, fov, pinhole, radtan, unified
from vio.geometry.lenses.model import Lens

_MODULES = (pinhole, radtan, equidistant, unified, double_sphere, eucm, fov)
LENSES: dict[str, Lens] = {module.LENS.name: module.LENS for module in _MODULES}
