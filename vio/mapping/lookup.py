"""Where one image pair stands in a map that is only read: relocalisation without a session.

The search is that of a session that does not know its place (`builder`): words in common, PnP in
both directions, and a search for the points around. A session waits for another keyframe that says
the same; a single pair has none, and must show as many corners as a place that is believed at once.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.features import extract, no_keyframe_features
from vio.mapping.map_store import MapStore
from vio.records import Image


@dataclass(frozen=True, slots=True)
class FoundPose:
    """A pose in the map."""

    T_map_cam0: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6) of xi in T_map_cam0 = T_hat exp(xi), [rho; phi], given the map
    matches: int  # distinct corners that agree
    keyframe: int  # of the map, that shows the place


class MapLookup:
    """A map that is read, and finds image pairs of one rig in it; may be used from several
    threads.
    """

    def __init__(self, path: Path, session: int | None = None) -> None:
        """Open a map.

        Args:
            path: the file, as it is now; later changes are not seen.
            session: whose rig made the images that will be looked for; None: the newest one's.

        Raises:
            DataError: the map cannot be used, or has no such session.
        """
        with contextlib.ExitStack() as undo:
            store = MapStore(path, read_only=True)
            undo.callback(store.close)
            sessions = store.sessions()
            if not sessions:
                raise DataError(f"{path}: holds no session; vio run --map {path} makes one")
            if session is not None and not 0 <= session < len(sessions):
                raise DataError(f"{path}: has sessions 0 to {len(sessions) - 1}; name one of them")
            rig = sessions[-1 if session is None else session]
            self._builder = MapBuilder(store, "lookup", rig.camera, upright=False, localise=True)
            undo.pop_all()
        self.camera: StereoCamera = rig.camera
        self.keyframes = self._builder.first
        self._field = rig.field
        self._home = sessions[0].part
        self._lock = threading.Lock()
        # A keyframe of which nothing is known stands for each query.
        self._builder.add(Keyframe(0, 0, np.eye(4), None, None, 0.0), no_keyframe_features())

    def find(self, left: Image, right: Image) -> FoundPose | None:
        """Return where a rectified pair (H, W) was taken; None: not found."""
        features = extract(left, right).without(self._field)
        with self._lock:
            place = self._builder.places.find(self.keyframes, features)
            graph = self._builder.graph
            if place is None or not place.is_sure or graph.part[place.first] != self._home:
                return None
            T_map_cam0 = graph.T_map_cam[place.first] @ place.seen.pose.T_i_j
        return FoundPose(T_map_cam0, place.seen.pose.covariance, place.seen.inliers, place.first)

    def close(self) -> None:
        """Let the file go."""
        self._builder.close()
