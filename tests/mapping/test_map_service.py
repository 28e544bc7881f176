"""A map over HTTP: poses of image pairs, for several clients at once, and one line for requests
that cannot be used.
"""

from __future__ import annotations

import base64
import http.client
import json
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vio.errors import DataError, VioError
from vio.geometry.lie import se3_from_parts, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.live.map_service import MapServer, ask
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.features import extract
from vio.mapping.lookup import MapLookup
from vio.mapping.map_store import MapStore
from vio.records import Image
from vio.sim.motion import look_rotation, spline_from_waypoints
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import room

RIG = small_rig(320, 180)


def _recording(seed: int, radius: float) -> SimulatedRecording:
    """Nine pairs along a quarter of a circle in a room."""
    angle = np.linspace(0, 0.5 * np.pi, 9)
    R = look_rotation(np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1))
    p = np.stack(
        [radius * np.cos(angle), 0.8 * radius * np.sin(angle), np.full_like(angle, 1.4)], axis=1
    )
    motion = spline_from_waypoints(se3_from_parts(R, p), 1.0)
    return SimulatedRecording(simulate(room(seed=seed, texel_m=0.006), RIG, motion, rate_hz=1.0))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of a room, in the frame of its simulation."""
    file, recording = tmp_path_factory.mktemp("maps") / "room.map", _recording(1, 1.1)
    builder = MapBuilder(
        MapStore(file, create=True),
        "room",
        recording.recording.camera,
        upright=True,
        localise=False,
    )
    truth = recording.recording.reference
    before = None
    for k, T in enumerate(truth.T_world_body @ RIG.T_imu_cam0):
        motion = None if before is None else RelativePose(se3_inverse(before) @ T, 1e-6 * np.eye(6))
        builder.add(Keyframe(k, 10**9 * k, T, motion, None, 0.0), extract(*recording.images(k)))
        before = T
    builder.finish()
    builder.close()
    return file


@pytest.fixture(scope="module")
def server(path: Path) -> Iterator[MapServer]:
    """Serves the map at any port."""
    lookup = MapLookup(path)
    server = MapServer(lookup, "127.0.0.1", 0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()
    lookup.close()


def _url(server: MapServer) -> str:
    return f"http://127.0.0.1:{server.server_address[1]}"


def test_clients_get_poses_with_covariances_and_the_map_stays(
    server: MapServer, path: Path
) -> None:
    """Pairs of another path through the room, from four clients at once, and one of another
    room.
    """
    before, flight, other = path.read_bytes(), _recording(1, 1.2), _recording(2, 1.2)
    truth = flight.recording.reference
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: ask(_url(server), *flight.images(k)), range(9)))
    placed = [(k, f) for k, f in enumerate(found) if f is not None]
    assert len(placed) >= 6
    for k, f in placed:
        xi = se3_log(se3_inverse(f.T_map_cam0) @ truth.T_world_body[k] @ RIG.T_imu_cam0)
        assert np.linalg.norm(xi[:3]) < 0.05
        assert xi @ np.linalg.solve(f.covariance, xi) < 22.5, "chi-square of 99.9 %"
        assert f.matches >= 60
        assert 0 <= f.keyframe < 9
    assert [ask(_url(server), *other.images(k)) for k in range(3)] == [None] * 3
    assert path.read_bytes() == before


def _png(image: Image) -> str:
    return base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()


def test_bad_requests_are_one_line_and_the_server_goes_on(server: MapServer) -> None:
    gray = np.full((180, 320), 90, dtype=np.uint8)
    good, damaged = _png(gray), base64.b64encode(base64.b64decode(_png(gray))[:-40]).decode()
    requests: list[tuple[str, Any, int, str]] = [
        ("/localise", {"left": good, "right": good}, 200, ""),
        (
            "/localise",
            {"left": good, "right": good, "camera": {"baseline_m": 0.5}},
            409,
            "camera: baseline_m is 0.5",
        ),
        ("/localise", {"left": good, "right": good, "camera": {"fu": "wide"}}, 400, "give JSON"),
        ("/localise", {"left": good, "right": good, "camera": {"fu": 10**400}}, 400, "give JSON"),
        ("/localise", {"left": good, "right": _png(gray[:90])}, 409, "right: is of 320x90 pixels"),
        ("/localise", {"left": damaged, "right": good}, 400, "left"),
        ("/localise", {"left": "", "right": good}, 400, "left"),
        ("/localise", {"left": "???", "right": good}, 400, "give JSON"),
        ("/localise", {"left": good}, 400, "KeyError"),
        ("/localise", [], 400, "give JSON"),
        ("/localise", b"\xff\x00", 400, "give JSON"),
        ("/localise", b"[" * 100_000, 400, "give JSON"),
        ("/elsewhere", {}, 404, "POST /localise"),
    ]
    for where, request, status, message in requests:
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
        connection.request(
            "POST", where, request if isinstance(request, bytes) else json.dumps(request)
        )
        answer = connection.getresponse()
        facts = json.load(answer)
        assert answer.status == status, facts
        if status == 200:
            assert facts == {"found": False}
        else:
            assert message in facts["error"]
            assert "\n" not in facts["error"]
        connection.close()
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
    for length, status in ((str(1 << 40), 413), ("-1", 413), ("many", 411)):
        connection.putrequest("POST", "/localise")
        connection.putheader("Content-Length", length)
        connection.endheaders()
        assert connection.getresponse().status == status
        connection.close()
    connection.request("GET", "/")
    facts = json.load(connection.getresponse())
    connection.close()
    assert facts["keyframes"] == 9
    assert facts["camera"]["width"] == 320
    with pytest.raises(VioError, match="of 100x50 pixels"):
        ask(_url(server), gray[:50, :100], gray)


def test_what_cannot_be_served_is_said(server: MapServer, path: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has sessions 0 to 0"):
        MapLookup(path, 1)
    MapStore(tmp_path / "empty.map", create=True).close()
    with pytest.raises(DataError, match="holds no session"):
        MapLookup(tmp_path / "empty.map")
    lookup = MapLookup(path)
    with pytest.raises(VioError, match="cannot listen at"):
        MapServer(lookup, "127.0.0.1", server.server_address[1])
    lookup.close()
    for url in ("http://127.0.0.1:1", "no address"):
        with pytest.raises(VioError, match="vio map serve MAP starts a server"):
            ask(url, np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8), timeout_s=2)


def test_the_command_serves_until_it_is_ended(path: Path) -> None:
    command = [sys.executable, "-m", "vio", "map", "serve", str(path), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stderr.readline()
            assert line.startswith("serving 9 keyframes at http://127.0.0.1:"), line
            with urllib.request.urlopen(f"{line.split()[-1]}/", timeout=20) as answer:
                assert json.load(answer)["keyframes"] == 9
            process.terminate()  # SIGINT is ignored where a shell started the tests behind it
            assert process.wait(60) == 0
        finally:
            process.kill()
