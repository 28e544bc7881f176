"""Bytes to and from a flight controller, over UDP or a serial line."""

from __future__ import annotations

import contextlib
import socket
from typing import Any, Protocol

from vio.errors import ConfigError, DataError, MissingDependencyError, extra_text
from vio.numerics.kinds import Capacity

_BAUD = 921_600
_MAX_BYTES: Capacity[int] = 4096
_WAIT_S: Capacity[float] = 0.1
_FORMS = "give udp:HOST:PORT, or serial:DEVICE[:BAUD]"
MISSING = "--mavlink needs pymavlink, over a serial line also pyserial; " + extra_text("mavlink")


class Link(Protocol):
    """Two-way bytes; both calls raise OSError where the way is gone."""

    def write(self, data: bytes) -> object:
        """Send some bytes."""

    def read(self) -> bytes:
        """Return what has come, after a tenth of a second at most."""

    def close(self) -> None:
        """Let the way go."""


class UdpLink:
    """Datagrams to one address, and whatever comes back from it."""

    def __init__(self, host: str, port: int) -> None:
        """Look the address up.

        Raises:
            DataError: the host is not known.
        """
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise DataError(f"udp:{host}:{port}: {error.strerror or error}") from error
        self._address: Any = found[4]
        self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
        self._socket.settimeout(_WAIT_S)

    def write(self, data: bytes) -> object:
        """Send a datagram."""
        return self._socket.sendto(data, self._address)

    def read(self) -> bytes:
        """Return a datagram of the address; those of others are left out."""
        try:
            data, sender = self._socket.recvfrom(_MAX_BYTES)
        except (TimeoutError, ConnectionRefusedError):
            return b""
        if sender[:2] == self._address[:2]:
            return data
        return b""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialLink:
    """A serial line."""

    def __init__(self, device: str, baud: int) -> None:
        """Open the line.

        Raises:
            DataError: it cannot be opened.
            MissingDependencyError: pyserial is not installed.
        """
        try:
            import serial
        except ImportError as error:
            raise MissingDependencyError(MISSING) from error
        try:
            self._line = serial.Serial(device, baud, timeout=_WAIT_S, write_timeout=_WAIT_S)
        except (OSError, ValueError) as error:
            raise DataError(f"serial:{device}:{baud}: {error}; check device and rights") from error

    def write(self, data: bytes) -> object:
        """Send some bytes."""
        return self._line.write(data)

    def read(self) -> bytes:
        """Return what has come."""
        waiting = self._line.in_waiting
        return bytes(self._line.read(max(1, min(waiting, _MAX_BYTES))))

    def close(self) -> None:
        """Close the line."""
        with contextlib.suppress(OSError):
            self._line.close()


def open_link(address: str) -> Link:
    """Open a way by its address.

    Raises:
        ConfigError: the address has another form.
        VioError: it cannot be opened.
    """
    kind, _, rest = address.partition(":")
    place, _, text = rest.rpartition(":")
    number = int(text) if text.isdigit() else 0
    if kind == "udp" and place and 0 < number < 2**16:
        return UdpLink(place, number)
    if kind == "serial" and rest:
        if not place:
            return SerialLink(rest, _BAUD)
        if number:
            return SerialLink(place, number)
    raise ConfigError(f"--mavlink {address}: {_FORMS}")
