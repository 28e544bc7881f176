"""Image and IMU messages into the odometry: decoding, pairing, stamps that go back, and what is
silent.
"""

from __future__ import annotations

import functools
import logging
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vio.datasets.bags.cdr import live_decoded
from vio.datasets.bags.index import stamp_of
from vio.datasets.bags.pictures import band_of_message, gray_of
from vio.datasets.bags.topics import COMPRESSED, IMAGE, IMU
from vio.datasets.levels import LEVEL_IMAGES, Band, Levels, levels_of
from vio.errors import DataError, VioError
from vio.geometry.lie import FloatArray
from vio.live.live_odometry import LiveOdometry
from vio.live.pairing import Pairing
from vio.records import NS_PER_S, Image
from vio.ros2.transport import Quality, Transport

log = logging.getLogger(__name__)

SILENT_S = 5.0  # without a message, before it is said


class _StampRules(NamedTuple):
    """When stamps begin anew."""

    # a stamp that is so much older than the last one begins anew: a bag in a loop, a new driver
    back_ns: int = 500_000_000
    passed_share: float = 0.1


_STAMPS = _StampRules()
# A stamp so far ahead of the last one begins anew, too, where less than a tenth of that time has
# passed: the clock was set. A gap in a bag that is played ten times as fast is none.
_AHEAD_NS = 5 * NS_PER_S
_MAX_REASONS = 50  # that are named


@dataclass(frozen=True, slots=True)
class SensorTopics:
    """The topics that an odometry is fed from."""

    left: str
    right: str | None = None  # None: one camera
    imu: str | None = None  # None: images alone

    @property
    def cameras(self) -> tuple[str, ...]:
        """The image topics."""
        if self.right is None:
            return (self.left,)
        return (self.left, self.right)

    @property
    def kinds(self) -> dict[str, str]:
        """All topics with their types: those of image_transport end in /compressed."""
        kinds = {
            name: COMPRESSED if name.endswith("/compressed") else IMAGE for name in self.cameras
        }
        if self.imu is None:
            return kinds
        return {**kinds, self.imu: IMU}


@dataclass(frozen=True, slots=True)
class _Step:
    """How far a stamp is from the last one of its topic."""

    stamped_ns: int
    arrived_ns: int  # and between their arrivals

    @property
    def is_back(self) -> bool:
        """Whether the stamp lies far before the last one."""
        return self.stamped_ns < -_STAMPS.back_ns

    @property
    def is_ahead(self) -> bool:
        """Whether it lies far after the last one, by far more than the time that has passed."""
        return (
            self.stamped_ns > _AHEAD_NS and self.arrived_ns < _STAMPS.passed_share * self.stamped_ns
        )

    @property
    def is_usual(self) -> bool:
        """Whether it is after the last one, and not far."""
        return self.stamped_ns > 0 and not self.is_ahead


class Sensors:
    """Subscribes, and adds what comes to an odometry.

    A message that cannot be used is left out, counted, and named once for each topic and reason; it
    ends nothing. All of it happens in the thread that spins the transport.
    """

    def __init__(
        self, transport: Transport, topics: SensorTopics, odometry: LiveOdometry, quality: Quality
    ) -> None:
        self._topics = topics
        self._odometry = odometry
        self._pairing: Pairing[Image] = Pairing()
        # the last two stamps, ns, and when the last one arrived
        self._newest: dict[str, tuple[int | None, int, int]] = {}
        self._stepped: set[str] = set()  # topics whose last stamp lay far from these
        self._bands: list[Band] = []  # of the levels of 16-bit images
        self.gyro: FloatArray | None = None  # (3,) rad/s, of the newest sample
        self.received = dict.fromkeys(topics.kinds, 0)  # messages
        self.refused = 0
        self._reasons: set[str] = set()  # that were named
        for side, name in enumerate(topics.cameras):
            transport.subscribe(
                name,
                topics.kinds[name],
                self._taker(name, functools.partial(self._image, side=side)),
                quality,
            )
        if topics.imu is not None:
            transport.subscribe(topics.imu, IMU, self._taker(topics.imu, self._imu), quality)

    def _taker(self, topic: str, use: Callable[[str, Any], None]) -> Callable[[bytes], None]:
        """Return what takes the messages of a topic, of which those are left out that cannot be
        used.
        """

        def take(data: bytes) -> None:
            self.received[topic] += 1
            try:
                use(topic, live_decoded(data, self._topics.kinds[topic], topic))
            except VioError as error:
                self._odometry.check()  # what the odometry has failed with is no message's fault
                self._refuse(topic, str(error))

        return take

    def _image(self, topic: str, fields: Any, side: int) -> None:
        kind = self._topics.kinds[topic]
        time_ns = self._stamped(topic, fields)
        if time_ns is None:
            return
        where = f"{topic} at {time_ns} ns"
        image = gray_of(
            fields,
            where,
            compressed=kind == COMPRESSED,
            levels=self._gray_levels(fields, kind, where),
        )
        if self._topics.right is None:
            self._odometry.add_images(time_ns, image)
        elif (pair := self._pairing.add(side, time_ns, image)) is not None:
            self._odometry.add_stereo(*pair)

    def _imu(self, topic: str, fields: Any) -> None:
        time_ns = self._stamped(topic, fields)
        if time_ns is None:
            return
        w = fields.angular_velocity
        a = fields.linear_acceleration
        self._odometry.add_imu(time_ns, [w.x, w.y, w.z], [a.x, a.y, a.z])
        self.gyro = np.array([w.x, w.y, w.z])

    def _stamped(self, topic: str, fields: Any) -> int | None:
        """Return a message's stamp; None: it is not after the last one of its topic.

        Where two in a row lie far before that one, or far ahead though little time has passed, all
        begins anew.
        """
        time_ns = stamp_of(fields)
        arrived_ns = round(time.monotonic() * NS_PER_S)
        before, last, last_arrived_ns = self._newest.get(topic, (None, None, 0))
        if last is not None:
            step = _Step(time_ns - last, arrived_ns - last_arrived_ns)
            if step.is_back and before is not None and before < time_ns:
                last = before  # that one was far ahead, alone; the odometry has left it out
            elif (step.is_back or step.is_ahead) and topic in self._stepped:
                self._begin_anew(topic, time_ns - last)
                last = None
            elif not step.is_usual:
                self._refuse_step(topic, step, time_ns)
                return None
        self._newest[topic] = last, time_ns, arrived_ns
        self._stepped.discard(topic)
        return time_ns

    def _refuse_step(self, topic: str, step: _Step, time_ns: int) -> None:
        """Refuse a stamp that is not after the last one, or too far after it."""
        if step.is_back or step.is_ahead:
            self._stepped.add(topic)
        if step.is_ahead:
            self._refuse(
                topic,
                f"the stamp {time_ns} ns is {step.stamped_ns / NS_PER_S:.1f} s ahead of the last "
                "one, and less time has passed",
            )
        else:
            last = time_ns - step.stamped_ns
            self._refuse(topic, f"the stamp {time_ns} ns is not after the last one, {last} ns")

    def _begin_anew(self, topic: str, step_ns: int) -> None:
        """Begin a new trajectory after a step of the stamps."""
        why = (
            f"went back by {-step_ns / NS_PER_S:.1f} s, as of a publisher that was restarted"
            if step_ns < 0
            else f"went ahead by {step_ns / NS_PER_S:.1f} s at once, as of a clock that was set"
        )
        log.warning("%s: the stamps %s: a new trajectory begins", topic, why)
        self._odometry.reset()
        self._newest.clear()
        self._stepped.clear()
        self._pairing = Pairing()

    def _gray_levels(self, fields: Any, kind: str, where: str) -> Levels:
        """Return the levels of black and white of 16-bit images, from the first ones."""
        if len(self._bands) < LEVEL_IMAGES:
            band = band_of_message(fields, where, compressed=kind == COMPRESSED)
            self._bands += [] if band is None else [band]
        return levels_of(self._bands)

    def _refuse(self, topic: str, why: str) -> None:
        self.refused += 1
        line = why if topic in why else f"{topic}: {why}"
        reason = re.sub(r"-?\d[\d.]*", "", line)  # the same for other stamps and sizes
        if reason in self._reasons or len(self._reasons) >= _MAX_REASONS:
            return
        self._reasons.add(reason)
        log.warning("%s; such messages are left out, and counted in /diagnostics", line)


class Silence:
    """Notices topics from which nothing comes, and says once what the graph has in their place."""

    def __init__(self, kinds: Mapping[str, str]) -> None:
        self._kinds = kinds
        # messages so far, and when that changed
        self._heard = {topic: (0, time.monotonic()) for topic in kinds}
        self._said: set[str] = set()

    def check(self, received: Mapping[str, int], transport: Transport) -> list[str]:
        """Return what is to be said now.

        Raises:
            DataError: a topic has messages of another type.
        """
        now = time.monotonic()
        lines = []
        for topic, kind in self._kinds.items():
            count, since = self._heard[topic]
            if received.get(topic, 0) != count:
                self._heard[topic] = received[topic], now
                self._said.discard(topic)
            elif now - since > SILENT_S and topic not in self._said:
                self._said.add(topic)
                lines.append(_why_silent(topic, kind, transport.topics(), began=count > 0))
        return lines


def check_types(kinds: Mapping[str, str], transport: Transport) -> None:
    """Compare the types of topics with those of the graph.

    Raises:
        DataError: a topic has messages of another type.
    """
    there = transport.topics()
    for topic, kind in kinds.items():
        others = there.get(topic, frozenset())
        if others and kind not in others:
            raise DataError(
                f"{topic} has {', '.join(sorted(others))}, not {kind}; name another topic"
            )


def _why_silent(topic: str, kind: str, there: Mapping[str, frozenset[str]], *, began: bool) -> str:
    """Return why nothing may come from a topic, and what to do."""
    if topic in there:
        reason = (
            "its publisher is silent"
            if began
            else "its publisher sends nothing, or cannot be reached"
        )
        return f"no message on {topic} for {SILENT_S:g} s: {reason}; check the driver"
    fitting = sorted(name for name, kinds in there.items() if kind in kinds)
    have = (
        f"topics of its type are {', '.join(fitting[:8])}"
        if fitting
        else "and none of its type; check ROS_DOMAIN_ID"
    )
    return f"no message on {topic} for {SILENT_S:g} s: nobody publishes it; {have}"
