"""Maps as files: what one holds, and parts of one."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.relative_pose import RelativePose
from vio.mapping.density import spread
from vio.mapping.map_database import check_path
from vio.mapping.map_store import KeyframeRow, MapStore, SessionRow
from vio.records import BoolArray, IntArray

log = logging.getLogger(__name__)


def describe_map(path: Path) -> dict[str, Any]:
    """Return what a map holds, for `vio map show`.

    Raises:
        DataError: the file is no map.
    """
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        sessions = store.sessions()
        keyframes = store.keyframes()
        loops = store.loops()
        earth = store.earth()
        return {
            "map": str(path),
            "version": store.version,
            "bytes": path.stat().st_size,
            "keyframes": len(keyframes),
            "loops": sum(o.kept for o in loops),
            "loops_rejected": sum(not o.kept for o in loops),
            "extent_m": _extent_m(sessions, keyframes),
            "earth": None
            if earth is None
            else {"origin": earth.origin, "T_enu_map": earth.T_enu_map.tolist()},
            "sessions": _describe_sessions(sessions, keyframes),
        }


def _extent_m(sessions: Sequence[SessionRow], keyframes: Sequence[KeyframeRow]) -> list[float]:
    """Return the extent along x, y and z of the keyframes that are in the map's frame."""
    own = [k for k in keyframes if sessions[k.session].part == sessions[0].part]
    if not own:
        return [0.0, 0.0, 0.0]
    extent: list[float] = np.ptp([k.T_map_cam[:3, 3] for k in own], axis=0).tolist()
    return extent


def _describe_sessions(
    sessions: Sequence[SessionRow], keyframes: Sequence[KeyframeRow]
) -> list[dict[str, Any]]:
    described = []
    for n, session in enumerate(sessions):
        own = [k for k in keyframes if k.session == n]
        described.append(
            {
                "source": session.source,
                "keyframes": len(own),
                "path_m": own[-1].path_m - own[0].path_m if own else 0.0,
                "joined": session.part == sessions[0].part,
                "upright": session.upright,
                "camera": asdict(session.camera),
            }
        )
    return described


def check_map(path: Path) -> dict[str, Any]:
    """Read every row of a map, features too, against its checksum; return what it holds.

    Raises:
        DataError: the file is damaged, or no map.
    """
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        for k in range(len(store.keyframes())):
            store.features(k)
        store.places()
    return describe_map(path)


def drop_session(path: Path, session: int) -> dict[str, Any]:
    """Take a session out of a map, in place; return what it holds then.

    Raises:
        DataError: there is no such session, it is the only one, or the file cannot be used.
    """
    sessions, owner, _ = _outline(path)
    if not 0 <= session < len(sessions):
        numbers = f"0 to {len(sessions) - 1}" if len(sessions) > 1 else "0 alone"
        raise DataError(f"{path}: has no session {session}, but {numbers}")
    if len(sessions) == 1:
        raise DataError(f"{path}: has session 0 alone, and no map is left without it")
    return _keep(path, path, owner != session)


def prune_map(path: Path, density: int) -> dict[str, Any]:
    """Leave at most so many keyframes in a cubic metre, see `spread`, in place; return what the map
    holds then.

    Raises:
        DataError: the file cannot be used.
    """
    _, _, T = _outline(path)
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        loops = np.bincount(
            [k for o in store.loops() if o.kept for k in (o.first, o.second)], minlength=len(T)
        )
        parts = np.array([s.part for s in store.sessions()])[[k.session for k in store.keyframes()]]
        kept = store.show_something()
    kept[kept] = spread(T[kept], parts[kept], loops[kept], density)
    return _keep(path, path, kept)


def extract_map(
    path: Path, out: Path, centre: tuple[float, float, float], radius_m: float
) -> dict[str, Any]:
    """Write the keyframes of a map's first part within a radius of a point (m, in the map) to a new
    map.

    Raises:
        DataError: there are none, or a file cannot be used.
    """
    if out.exists():
        raise DataError(f"{out}: exists; give another name for the new map")
    sessions, owner, T = _outline(path)
    home = (
        np.array([s.part == sessions[0].part for s in sessions])[owner]
        if len(owner)
        else np.zeros(0, np.bool_)
    )
    return _keep(path, out, home & (np.linalg.norm(T[:, :3, 3] - centre, axis=1) <= radius_m))


def _outline(path: Path) -> tuple[list[SessionRow], IntArray, FloatArray]:
    """Return the sessions of a map, and of each keyframe its session (K,) and pose (K, 4, 4)."""
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        rows = store.keyframes()
        owner = np.array([k.session for k in rows], dtype=np.int64)
        return store.sessions(), owner, np.array([k.T_map_cam for k in rows]).reshape(-1, 4, 4)


def _keep(path: Path, out: Path, kept: BoolArray) -> dict[str, Any]:
    """Write a map with those keyframes (K,) alone; motions over others are put together, their
    loops go.
    """
    if not kept.any():
        raise DataError(f"{path}: no keyframe would be left")
    check_path(out)
    source = MapStore(path, read_only=out != path)  # in place, no other process writes meanwhile
    with new_map(out) as partial:
        store = MapStore(partial, create=True, known_as=out)
        with contextlib.closing(source), contextlib.closing(store):
            _copy_rows(source, store, kept)
        target = out.resolve()
        # its changes would be taken for those of the new file
        if target.with_name(f"{target.name}-wal").exists():
            raise DataError(f"{out}: another process reads it; try again when that has ended")
        if out == path:
            shutil.copymode(target, partial)
    return describe_map(out)


@contextlib.contextmanager
def new_map(out: Path) -> Iterator[Path]:
    """Give the path of a file to write, which takes the place of `out` at the end of the block;
    else it goes.

    Raises:
        DataError: it cannot be written.
    """
    target = out.resolve()  # what a link leads to
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:12]}.partial")
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        raise DataError(
            f"{out}: cannot be written ({error.strerror or error}); check the folder"
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def _copy_rows(source: MapStore, store: MapStore, kept: BoolArray) -> None:
    sessions = source.sessions()
    rows = source.keyframes()
    owners = np.unique([rows[k].session for k in np.flatnonzero(kept).tolist()]).tolist()
    parts = [sessions[n].part for n in owners]
    all_parts = [s.part for s in sessions]
    for n in owners:
        session = sessions[n]
        upright = session.upright
        if n == owners[parts.index(session.part)]:  # the frame stays that of the part's first
            upright = sessions[all_parts.index(session.part)].upright
        store.add_session(replace(session, part=parts.index(session.part), upright=upright))
    earth = source.earth()
    if earth is not None and parts[0] == sessions[0].part:  # the frame is the same
        store.set_earth(earth)
    number = (np.cumsum(kept) - 1).tolist()
    _copy_keyframes(source, store, kept, number, owners)
    for loop in source.loops():
        if kept[loop.first] and kept[loop.second]:
            store.add_loop(replace(loop, first=number[loop.first], second=number[loop.second]))


def _copy_keyframes(
    source: MapStore, store: MapStore, kept: BoolArray, number: list[int], owners: list[int]
) -> None:
    """Copy the keyframes that are kept, with the motions between them.

    Args:
        source: a map.
        store: the copy.
        kept: (K,) keyframes of the map.
        number: (K,) of those in the copy.
        owners: sessions of the map that are in the copy.
    """
    rows = source.keyframes()
    motions = {second: motion for _, second, motion in source.odometry()}
    since: RelativePose | None = None  # the session's last keyframe that is kept
    for k, row in enumerate(rows):
        if k == 0 or rows[k - 1].session != row.session:
            since = None
        elif since is not None:
            since = since.then(motions[k]) if k in motions else None
        if kept[k]:
            store.add_keyframe(replace(row, session=owners.index(row.session)), source.features(k))
            if since is not None:
                store.add_odometry(number[k] - 1, number[k], since)
            since = RelativePose(np.eye(4), np.zeros((6, 6)))
