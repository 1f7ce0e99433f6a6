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
import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, Protocol
from urllib.parse import SplitResult, unquote, urlsplit

import numpy as np
from jaxtyping import Float

from nermo_mjx.hardware.table import ServoTable
from nermo_mjx.robot.quantity import ParameterError

#: The topic of the author's software.
TOPIC: Final = "q_values"
#: How long a broker or bridge may not answer, or be away [s].
PATIENCE: Final = 5.0
ROS_TYPE: Final = "std_msgs/msg/Float32MultiArray"
_PORTS: Final = {"mqtt": 1883, "ws": 9090, "wss": 443}
_EXTRAS: Final = {"paho.mqtt.client": "mqtt", "websockets.sync.client": "ros"}


class SendError(ParameterError):
    """The robot cannot be reached; the message is one sentence."""


class NotSentError(SendError):
    """A message was not sent, but the connection may come back."""


class Sender(Protocol):
    """Sends the angles of one row."""

    def __call__(self, angles: Float[np.ndarray, " channels"], given: Float[np.ndarray, " channels"]) -> None:
        """Send the angles [deg], or `given`, in whole degrees, if required.

        Raises:
            NotSentError: this message was not sent; the next one may be.
            SendError: the connection is lost.
        """


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
        SendError: messages were not sent, and how many; sending ends when the connection is lost, or has been away for
            `PATIENCE`.
    """
    given, rows = table.given, len(table.time)
    if not table.periodic:
        seconds = min(rows / table.rate, math.inf if seconds is None else seconds)
    begun, row, messages, skipped, latest = clock(), 0, 0, 0, 0.0
    reached, lost = begun, ""
    with contextlib.suppress(KeyboardInterrupt):
        while seconds is None or row / table.rate < seconds - 1e-9:
            early = row / table.rate - (clock() - begun)
            if early > 1e-6:
                wait(early)
                continue
            if -early * table.rate >= 1.0:
                row, skipped = row + int(-early * table.rate), skipped + int(-early * table.rate)
                continue
            try:
                send(table.angles[row % rows], given[row % rows])
                messages, reached, latest = messages + 1, clock(), max(latest, -early)
            except SendError as error:
                lost = str(error).rstrip(".")
                if not isinstance(error, NotSentError) or clock() - reached > PATIENCE:
                    row = row + 1 if seconds is None else max(row + 1, math.ceil(seconds * table.rate - 1e-9))
                    break
            row += 1
    if lost:
        raise SendError(f"{lost}: {messages} messages were sent, {row - skipped - messages} were not.")
    return Sent(messages, skipped, clock() - begun, latest)


@contextlib.contextmanager
def connected(url: str, topic: str = TOPIC) -> Iterator[Sender]:
    """A connection to the robot, as a context manager.

    Args:
        url: `mqtt://[USER:PASSWORD@]HOST[:1883]` of a broker, or `ws://[USER:PASSWORD@]HOST[:9090][/PATH]` (`wss` with
            TLS) of a rosbridge server; special characters of user and password as %XX.
        topic: to which angles are published.

    Raises:
        ParameterError: the URL or topic is invalid, or the required package is missing.
        SendError: no answer, or the connection is refused.
    """
    try:
        parts = urlsplit(url)
        # A port out of range raises; MQTT has no path (the topic is none), and takes a user without a password.
        right = all((
            parts.scheme in _PORTS and parts.hostname, parts.port != 0, not parts.fragment,
            parts.username or parts.password is None, parts.scheme == "mqtt" or not parts.username or parts.password,
            parts.scheme != "mqtt" or not (parts.path.strip("/") or parts.query),
        ))  # fmt: skip
    except ValueError:
        right = False
    if not right:
        # Up to the last @, as a # or / that was not quoted may stand in the password.
        masked = re.sub("^([^/]*//)?.*@", r"\1...@", url, flags=re.DOTALL)
        raise ParameterError(
            f"send is {masked!r}: allowed is mqtt://HOST[:PORT] or ws://HOST[:PORT], with a port from 1 to 65535, and "
            "USER:PASSWORD@ before HOST, special characters as %XX."
        )
    if not topic or (parts.scheme == "mqtt" and any(mark in topic for mark in "+#\0")):
        raise ParameterError(f"topic is {topic!r}: expected a name, without + and #.")
    with (_mqtt if parts.scheme == "mqtt" else _rosbridge)(parts, topic) as sender:
        yield sender


@contextlib.contextmanager
def _mqtt(url: SplitResult, topic: str) -> Iterator[Sender]:
    mqtt, where = _package("paho.mqtt.client"), _place(url)
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    if url.username:
        client.username_pw_set(unquote(url.username), None if url.password is None else unquote(url.password))
    answered, answer = threading.Event(), []

    def on_connect(client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        answer.append(reason)
        answered.set()

    client.on_connect = on_connect
    client.connect_timeout = PATIENCE
    try:
        client.connect(url.hostname, url.port or _PORTS["mqtt"], keepalive=round(PATIENCE))
        client.loop_start()
        if not answered.wait(PATIENCE):
            raise SendError(f"{where}: no MQTT broker answers there.")
        if answer[0].is_failure:
            raise SendError(f"{where}: the MQTT broker refuses the connection ({answer[0]}).")

        def send(angles: np.ndarray, given: np.ndarray) -> None:
            # Without acknowledgement: outdated angles are useless. If the broker is away for a while, the client's
            # thread reconnects, and the messages in between are dropped.
            values = [int(angle) if angle == int(angle) else round(float(angle), 3) for angle in given.tolist()]
            if client.publish(topic, json.dumps(values), qos=0).rc != mqtt.MQTT_ERR_SUCCESS:
                raise NotSentError(f"{where}: the MQTT broker is gone")

        yield send
    except (OSError, UnicodeError) as error:
        raise SendError(f"{where}: no MQTT broker answers there ({getattr(error, 'strerror', '') or error}).") from None
    finally:
        client.disconnect()
        client.loop_stop()


@contextlib.contextmanager
def _rosbridge(url: SplitResult, topic: str) -> Iterator[Sender]:
    client, where = _package("websockets.sync.client"), _place(url)
    failures = (OSError, UnicodeError, importlib.import_module("websockets.exceptions").WebSocketException)
    name = topic if topic.startswith("/") else f"/{topic}"
    layout = {"dim": [], "data_offset": 0}
    try:
        address = url._replace(netloc=url.netloc[: url.netloc.rfind("@") + 1] + where).geturl()
        with client.connect(address, open_timeout=PATIENCE, ping_interval=PATIENCE, ping_timeout=PATIENCE) as socket:
            socket.send(json.dumps({"op": "advertise", "topic": name, "type": ROS_TYPE}))

            def send(angles: np.ndarray, given: np.ndarray) -> None:
                message = {"layout": layout, "data": [round(angle, 6) for angle in np.radians(angles).tolist()]}
                try:
                    socket.send(json.dumps({"op": "publish", "topic": name, "msg": message}))
                except failures:
                    raise SendError(f"{where}: the rosbridge server is gone") from None

            yield send
            socket.send(json.dumps({"op": "unadvertise", "topic": name}))
    except failures as error:
        raise SendError(f"{where}: no rosbridge server answers there ({error}).") from None


def _place(url: SplitResult) -> str:
    host = f"[{url.hostname}]" if ":" in str(url.hostname) else url.hostname
    return f"{host}:{url.port or _PORTS[url.scheme]}"


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        extra = _EXTRAS[name]
        package = name.partition(".")[0]
        raise ParameterError(f"send needs {package}: install nermo-mjx with its extra {extra} by pip.") from None
