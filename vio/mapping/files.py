"""Maps as files: what one holds, and two made into one."""

from __future__ import annotations

import contextlib
import os
import uuid
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vio.errors import DataError
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.map_store import MapStore, check_path


def describe_map(path: Path) -> dict[str, Any]:
    """Return what a map holds, for `vio map show`.

    Raises:
        DataError: the file is no map.
    """
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        sessions, keyframes, loops = store.sessions(), store.keyframes(), store.loops()
        home = sessions[0].part if sessions else 0
        own = [[k for k in keyframes if k.session == n] for n in range(len(sessions))]
        positions = np.array([k.T_map_cam[:3, 3] for k in keyframes if sessions[k.session].part == home])
        return {
            "map": str(path),
            "version": store.version,
            "bytes": path.stat().st_size,
            "keyframes": len(keyframes),
            "loops": sum(o.kept for o in loops),
            "loops_rejected": sum(not o.kept for o in loops),
            "extent_m": np.ptp(positions, axis=0).tolist() if len(positions) else [0.0, 0.0, 0.0],
            "sessions": [
                {
                    "source": session.source,
                    "keyframes": len(rows),
                    "path_m": rows[-1].path_m - rows[0].path_m if rows else 0.0,
                    "joined": session.part == home,
                    "upright": session.upright,
                    "camera": asdict(session.camera),
                }
                for session, rows in zip(sessions, own, strict=True)
            ],
        }


def merge_maps(first: Path, second: Path, out: Path) -> dict[str, Any]:
    """Write a map that holds the sessions of two, joined where they show one place; return what it holds.

    The keyframes of the second map are taken up again one after the other, so that its loops are found anew, and those
    with the first map beside them. The frame is that of the first map.

    Raises:
        DataError: a file is no map, both are the same, or `out` exists or cannot be written.
    """
    if out.exists():
        raise DataError(f"{out}: exists; give another name for the merged map")
    check_path(out)
    if first.exists() and second.exists() and first.samefile(second):
        raise DataError(f"{second}: is the same map as {first}; give two different ones")
    partial = out.with_name(f".{out.name}.{uuid.uuid4().hex[:12]}.partial")
    try:
        source = MapStore(first, read_only=True)
        source.copy_to(partial, known_as=out)
        source.close()
        other, store = MapStore(second, read_only=True), MapStore(partial, known_as=out)
        with contextlib.closing(other), contextlib.closing(store):
            for number in range(len(other.sessions())):
                _take_up(other, number, store)
        os.replace(partial, out)
    except OSError as error:
        raise DataError(f"{out}: cannot be written ({error.strerror or error}); check the folder") from error
    finally:
        partial.unlink(missing_ok=True)
    return describe_map(out)


def _take_up(other: MapStore, number: int, store: MapStore) -> None:
    """Add a session of one map to another."""
    session = other.sessions()[number]
    motions = {second: motion for _, second, motion in other.odometry()}
    builder = MapBuilder(store, session.source, session.camera, upright=session.upright, localise=False)
    for k, row in enumerate(other.keyframes()):
        if row.session == number:
            motion = motions.get(k)
            keyframe = Keyframe(
                row.frame, row.time_ns, row.T_odom_cam, motion, row.up_cam, row.up_sigma_rad, session.field
            )
            builder.add(keyframe, other.features(k))
    builder.finish()
