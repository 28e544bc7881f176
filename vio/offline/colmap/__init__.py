"""Interface to COLMAP: model files, bundle adjustment, reconstruction. The only package that
imports pycolmap.

Two conventions of COLMAP are converted here. Its pixels put the *corner* of the top-left pixel at
(0, 0), ours its centre: half a pixel is added on input and subtracted on output. Its poses map the
world to the camera (`cam_from_world`, our `T_cam_world`), ours are the inverse.
"""

from __future__ import annotations

import signal
import threading

from vio.errors import MissingDependencyError

try:
    import pycolmap
except ImportError as _error:
    raise MissingDependencyError(
        "this command needs pycolmap, which has wheels for Linux and Windows on x86-64 and macOS "
        "14 on ARM; "
        "install it with: pip install 'pycolmap>=4.2'"
    ) from _error

if threading.current_thread() is threading.main_thread():
    # its import takes SIGTERM away from Python, and ends the process with a stack trace at once
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

SEED = 0
SIFT_FEATURES = 1500  # per image


def quiet() -> None:
    """Restrict COLMAP's own log to errors."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    pycolmap.logging.verbose_level = -1
