"""COLMAP: models written and read, bundle adjustment, reconstruction. The only package that knows pycolmap.

Two conventions of COLMAP end here. Its pixels put the *corner* of the top-left pixel at (0, 0), ours its centre: half a
pixel is added on the way in and taken off on the way out. Its poses map the world to the camera (`cam_from_world`, our
`T_cam_world`), ours the other way.
"""

from __future__ import annotations

from vio.errors import MissingDependencyError

try:
    import pycolmap
except ImportError as _error:
    raise MissingDependencyError(
        "this command needs pycolmap, which has wheels for Linux and Windows on x86-64 and macOS 14 on ARM; "
        "install it with: pip install 'pycolmap>=4.2'"
    ) from _error

HALF_PX = 0.5  # COLMAP's pixel coordinates minus ours
SEED = 0
SIFT_FEATURES = 1500  # per image


def quiet() -> None:
    """Keep COLMAP's own log to errors."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    pycolmap.logging.verbose_level = -1
