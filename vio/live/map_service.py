"""Poses in a map over HTTP: one process reads the map, many clients ask.

`GET /` says what the map is; `POST /localise` takes a rectified pair as JSON,
`{"left": …, "right": …}`, each a PNG or JPEG file in base64, and gives
`{"found": true, "T_map_cam0": …, "covariance": …, "matches": …, "keyframe": …}` or
`{"found": false}`. With `"camera": {"fu": …, …}`, another camera than the map's is refused. A
request that cannot be used gets a status 4xx and `{"error": …}` in one line.
"""

from __future__ import annotations

import base64
import http.client
import json
import os
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

import cv2
import numpy as np

from vio.datasets.images import UnreadableImageError, decode_gray
from vio.errors import DataError, VioError
from vio.geometry.stereo import StereoCamera
from vio.mapping.lookup import FoundPose, MapLookup
from vio.numerics.kinds import Capacity
from vio.records import Image


class _RequestLimits(NamedTuple):
    """What a request may be."""

    max_bytes: int = 64 << 20  # of a request: two images of 16 megapixels
    silent_s: Capacity[float] = 30.0  # after which a connection that says nothing is closed
    same_camera_share: float = 1e-3  # by which the lengths of one camera may differ


_LIMITS = _RequestLimits()
_CAMERA = ("fu", "fv", "cu", "cv", "baseline_m")


class _RefusedError(Exception):
    """A request that cannot be answered."""

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class MapServer(ThreadingHTTPServer):
    """Answers clients, each connection in a thread; as many are worked on at a time as there are
    processors.
    """

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, lookup: MapLookup, host: str, port: int) -> None:
        """Listen at an address; port 0 takes any.

        Raises:
            VioError: the address cannot be used.
        """
        self.lookup = lookup
        self.free = threading.BoundedSemaphore(os.cpu_count() or 1)
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise VioError(
                f"cannot listen at {host}:{port} ({error}); give another --host or --port"
            ) from error

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report what went wrong with a connection, unless the client has closed it."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"  # a client keeps its connection
    timeout = _LIMITS.silent_s
    server: MapServer

    def do_GET(self) -> None:
        """Say what the map is."""
        if self.path != "/":
            self._answer(HTTPStatus.NOT_FOUND, {"error": "GET / and POST /localise are served"})
            return
        lookup = self.server.lookup
        self._answer(
            HTTPStatus.OK, {"keyframes": lookup.keyframes, "camera": _camera_values(lookup.camera)}
        )

    def do_POST(self) -> None:
        """Find an image pair."""
        try:
            if self.path != "/localise":
                raise _RefusedError(HTTPStatus.NOT_FOUND, "GET / and POST /localise are served")
            body = self._body()
            lookup = self.server.lookup
            with self.server.free:  # images take more memory than their files
                found = lookup.find(*_pair(body, lookup.camera))
        except _RefusedError as error:
            self.close_connection = True  # its body may be unread
            self._answer(error.status, {"error": " ".join(str(error).split())})
        except DataError as error:
            self._answer(HTTPStatus.INTERNAL_SERVER_ERROR, {"error": " ".join(str(error).split())})
        else:
            self._answer(HTTPStatus.OK, _facts(found))

    def _body(self) -> bytes:
        try:
            length = int(self.headers["Content-Length"])
        except (TypeError, ValueError):
            raise _RefusedError(HTTPStatus.LENGTH_REQUIRED, "Content-Length is missing") from None
        if not 0 <= length <= _LIMITS.max_bytes:
            raise _RefusedError(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"a request has at most {_LIMITS.max_bytes >> 20} MB",
            )
        body = self.rfile.read(length)
        if len(body) < length:
            raise _RefusedError(HTTPStatus.BAD_REQUEST, "the request ended early")
        return body

    def _answer(self, status: HTTPStatus, facts: dict[str, Any]) -> None:
        body = json.dumps(facts).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep the terminal free of a line a request."""


def _request(body: bytes) -> tuple[list[bytes], dict[str, float]]:
    """Return the image files and the camera of a request, by the names of its numbers."""
    try:
        request = json.loads(body)
        texts = [request["left"], request["right"]]
        data = [base64.b64decode(text, validate=True) for text in texts]
        given = {
            name: float(value)
            for name, value in (request.get("camera") or {}).items()
            if name in _CAMERA
        }
    except (
        LookupError,
        TypeError,
        ValueError,
        ArithmeticError,
        AttributeError,
        RecursionError,
    ) as error:
        reason = 'give JSON with "left" and "right", image files in base64'
        raise _RefusedError(HTTPStatus.BAD_REQUEST, f"{reason} ({type(error).__name__})") from None
    return data, given


def _check_camera(given: Mapping[str, float], camera: StereoCamera) -> None:
    """Refuse a camera that is not that of the map."""
    own = _camera_values(camera)
    for name, value in given.items():
        if not abs(value - own[name]) <= _LIMITS.same_camera_share * abs(own[name]):
            raise _RefusedError(
                HTTPStatus.CONFLICT, f"camera: {name} is {value:g}, that of the map {own[name]:g}"
            )


def _pair(body: bytes, camera: StereoCamera) -> tuple[Image, Image]:
    """Return the images of a request."""
    data, given = _request(body)
    _check_camera(given, camera)
    images: list[Image] = []
    shape: tuple[int | None, ...] | None = (
        None if camera.width is None else (camera.height, camera.width)
    )
    for name, content in zip(("left", "right"), data, strict=True):
        try:
            image = decode_gray(content, name)
        except UnreadableImageError as error:
            raise _RefusedError(HTTPStatus.BAD_REQUEST, str(error)) from None
        if shape is not None and image.shape != shape:
            size = f"{image.shape[1]}x{image.shape[0]}"
            wanted = f"{shape[1]}x{shape[0]}"
            raise _RefusedError(
                HTTPStatus.CONFLICT, f"{name}: is of {size} pixels, the map's camera of {wanted}"
            )
        shape = image.shape  # a map of bare features does not say it
        images.append(image)
    return images[0], images[1]


def _camera_values(camera: StereoCamera) -> dict[str, Any]:
    return {name: getattr(camera, name) for name in (*_CAMERA, "width", "height")}


def _facts(found: FoundPose | None) -> dict[str, Any]:
    if found is None:
        return {"found": False}
    T = found.T_map_cam0.tolist()
    P = found.covariance.tolist()
    return {
        "found": True,
        "T_map_cam0": T,
        "covariance": P,
        "matches": found.matches,
        "keyframe": found.keyframe,
    }


def ask(url: str, left: Image, right: Image, *, timeout_s: float = 30.0) -> FoundPose | None:
    """Ask a server where a rectified pair (H, W) was taken; None: it does not know.

    Args:
        url: of the server, such as http://127.0.0.1:8734.
        left: 8-bit gray.
        right: likewise.
        timeout_s: how long an answer is waited for.

    Raises:
        VioError: the server refused the images, or there is none.
    """
    files = {
        name: base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
        for name, image in (("left", left), ("right", right))
    }
    try:
        request = urllib.request.Request(
            f"{url.rstrip('/')}/localise", json.dumps(files).encode(), method="POST"
        )
        with urllib.request.urlopen(request, timeout=timeout_s) as answer:
            facts = json.load(answer)
        if not facts["found"]:
            return None
        T = np.array(facts["T_map_cam0"])
        P = np.array(facts["covariance"])
        return FoundPose(T, P, facts["matches"], facts["keyframe"])
    except urllib.error.HTTPError as error:
        with error:
            raise VioError(f"{url}: {_reason(error)}") from None
    except (OSError, ValueError, LookupError, TypeError, http.client.HTTPException) as error:
        raise VioError(
            f"{url}: does not answer ({error}); vio map serve MAP starts a server"
        ) from error


def _reason(error: urllib.error.HTTPError) -> str:
    """What a server says of a refusal, or its status where another program answers."""
    try:
        return str(json.load(error)["error"])
    except (OSError, ValueError, LookupError, TypeError):
        return f"{error.code} {error.reason}"
