"""Sending a gait to the robot in real time: over MQTT, as the author's software does, or to ROS 2 through rosbridge.

A message holds one angle for each channel, in their order. Over MQTT it is a JSON list of degrees, whole ones where the
channels say so, without acknowledgement; to ROS it is a `std_msgs/Float32MultiArray` in radians, as the author's node
published it. Late messages are skipped, so that the gait stays in time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, Protocol
from urllib.parse import SplitResult, urlsplit

import numpy as np
from jaxtyping import Float

from nermo_mjx.hardware.table import ServoTable
from nermo_mjx.robot.quantity import ParameterError

#: The topic of the author's software.
TOPIC: Final = "q_values"
#: Timeout for the answer of a broker or bridge [s].
PATIENCE: Final = 5.0
ROS_TYPE: Final = "std_msgs/msg/Float32MultiArray"
_PORTS: Final = {"mqtt": 1883, "ws": 9090, "wss": 443}
_EXTRAS: Final = {"paho.mqtt.client": "mqtt", "websockets.sync.client": "ros"}


class SendError(ParameterError):
    """The robot cannot be reached; the message is one sentence."""


class Sender(Protocol):
    """Sends the angles of one row."""

    def __call__(self, angles: Float[np.ndarray, " channels"], given: Float[np.ndarray, " channels"]) -> None:
        """Send the angles [deg], or `given`, in whole degrees, if required; raises `SendError` without a connection."""


@dataclasses.dataclass(frozen=True)
class Sent:
    """Statistics of a transmission.

    Attributes:
        messages: number sent; `skipped`: number left out because they would have been late.
        seconds: duration [s].
        latest: maximum delay of a message [s].
    """

    messages: int
    skipped: int
    seconds: float
    latest: float


def play(
    table: ServoTable,
    send: Sender,
    seconds: float | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Sent:
    """Send the rows of a table at their times, repeatedly, in real time.

    Args:
        table: if it is of whole gait cycles, after the last row comes the first; that of a recorded walk ends then.
        send: function that sends a row, see `connected`.
        seconds: duration; None to send until a `KeyboardInterrupt`, which ends it normally.
        clock, wait: functions for the time and for waiting [s].

    Raises:
        SendError: the connection is lost.
    """
    given, rows = table.given, len(table.time)
    if not table.periodic:
        seconds = min(rows / table.rate, math.inf if seconds is None else seconds)
    begun, row, messages, latest = clock(), 0, 0, 0.0
    with contextlib.suppress(KeyboardInterrupt):
        while seconds is None or row / table.rate < seconds - 1e-9:
            early = row / table.rate - (clock() - begun)
            if early > 1e-6:
                wait(early)
                continue
            if -early * table.rate >= 1.0:
                row += int(-early * table.rate)
                continue
            latest = max(latest, -early)
            send(table.angles[row % rows], given[row % rows])
            row, messages = row + 1, messages + 1
    return Sent(messages, row - messages, clock() - begun, latest)


@contextlib.contextmanager
def connected(url: str, topic: str = TOPIC) -> Iterator[Sender]:
    """A connection to the robot, as a context manager.

    Args:
        url: `mqtt://[USER:PASSWORD@]HOST[:1883]` of a broker, or `ws://HOST[:9090]` of a rosbridge server.
        topic: to which angles are published.

    Raises:
        ParameterError: the URL is invalid, or the required package is missing.
        SendError: no answer, or the connection is refused.
    """
    parts = urlsplit(url)
    if parts.scheme not in _PORTS or not parts.hostname:
        raise ParameterError(f"send is {url!r}: allowed is mqtt://HOST[:PORT] or ws://HOST[:PORT].")
    with (_mqtt if parts.scheme == "mqtt" else _rosbridge)(parts, topic) as sender:
        yield sender


@contextlib.contextmanager
def _mqtt(url: SplitResult, topic: str) -> Iterator[Sender]:
    mqtt, where = _package("paho.mqtt.client"), _place(url)
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    if url.username:
        client.username_pw_set(url.username, url.password)
    answered, answer = threading.Event(), []

    def on_connect(client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        answer.append(reason)
        answered.set()

    client.on_connect = on_connect
    client.connect_timeout = PATIENCE
    try:
        client.connect(url.hostname, url.port or _PORTS["mqtt"])
        client.loop_start()
        if not answered.wait(PATIENCE):
            raise SendError(f"{where}: no MQTT broker answers there.")
        if answer[0].is_failure:
            raise SendError(f"{where}: the MQTT broker refuses the connection ({answer[0]}).")

        def send(angles: np.ndarray, given: np.ndarray) -> None:
            # Without acknowledgement: outdated angles are useless. If the broker is away for a while, the client's
            # thread reconnects, and the messages in between are dropped.
            values = [int(angle) if angle == int(angle) else round(float(angle), 3) for angle in given.tolist()]
            client.publish(topic, json.dumps(values), qos=0)

        yield send
    except OSError as error:
        raise SendError(f"{where}: no MQTT broker answers there ({error.strerror or error}).") from None
    finally:
        client.disconnect()
        client.loop_stop()


@contextlib.contextmanager
def _rosbridge(url: SplitResult, topic: str) -> Iterator[Sender]:
    client, where = _package("websockets.sync.client"), _place(url)
    failures = (OSError, importlib.import_module("websockets.exceptions").WebSocketException)
    name = topic if topic.startswith("/") else f"/{topic}"
    layout = {"dim": [], "data_offset": 0}
    try:
        with client.connect(f"{url.scheme}://{where}", open_timeout=PATIENCE) as socket:
            socket.send(json.dumps({"op": "advertise", "topic": name, "type": ROS_TYPE}))

            def send(angles: np.ndarray, given: np.ndarray) -> None:
                message = {"layout": layout, "data": [round(angle, 6) for angle in np.radians(angles).tolist()]}
                socket.send(json.dumps({"op": "publish", "topic": name, "msg": message}))

            yield send
            socket.send(json.dumps({"op": "unadvertise", "topic": name}))
    except failures as error:
        raise SendError(f"{where}: no rosbridge server answers there ({error}).") from None


def _place(url: SplitResult) -> str:
    return f"{url.hostname}:{url.port or _PORTS[url.scheme]}"


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        extra = _EXTRAS[name]
        package = name.partition(".")[0]
        raise ParameterError(f"send needs {package}: install nermo-mjx with its extra {extra} by pip.") from None
