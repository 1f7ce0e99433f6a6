"""Sending a gait to the robot in real time: over MQTT, as the author's software does, or to ROS 2 through rosbridge.

A message holds one angle for each channel, in their order. Over MQTT it is a JSON list of degrees, whole ones where the
channels say so, without acknowledgement; to ROS it is a `std_msgs/Float32MultiArray` in radians, as the author's node
published it. Late messages are skipped, so that the gait stays in time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any, Final, TypeAlias
from urllib.parse import SplitResult, unquote, urlsplit

import numpy as np
from jaxtyping import Float

from nermo_mjx.hardware.table import ServoTable
from nermo_mjx.robot.quantity import ParameterError, require

#: The topic of the author's software.
TOPIC: Final = "q_values"
#: How long a broker or bridge may not answer, or be away [s].
ANSWER_SECONDS: Final = 5.0
ROS_TYPE: Final = "std_msgs/msg/Float32MultiArray"
#: The address of no robot: messages are printed.
PRINT_ADDRESS: Final = "print:"
#: Share of commands that come too late or not at all, above which a robot was not driven as it should have been.
LARGEST_LATE_SHARE: Final = 0.1
#: Is called with a message as its JSON reads.
Receiver: TypeAlias = Callable[[Any], None]
_PORTS: Final = {"mqtt": 1883, "ws": 9090, "wss": 443}


class SendError(ParameterError):
    """The robot cannot be reached; the message is one sentence."""


class NotSentError(SendError):
    """A message was not sent, but the connection may come back."""


#: Sends the angles of a row [deg]: as they are, and as they are given in whole degrees, if required. It raises
#: `NotSentError` where the next message may be sent, and `SendError` where the connection is lost.
Sender: TypeAlias = Callable[[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]], None]


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


def lateness(late: float, total: float) -> str:
    """A sentence on commands that this machine was too slow for, if they are more than a share of `LARGEST_LATE_SHARE`."""
    if late <= LARGEST_LATE_SHARE * total:
        return ""
    return f"{late / total:.0%} of the commands were late and left out: this machine is too slow, or too busy."


def send_table(
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
            `ANSWER_SECONDS`.
    """
    column_given, rows = table.given, len(table.time)
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
                send(table.angles[row % rows], column_given[row % rows])
                messages, reached, latest = messages + 1, clock(), max(latest, -early)
            except SendError as error:
                lost = str(error).rstrip(".")
                if not isinstance(error, NotSentError) or clock() - reached > ANSWER_SECONDS:
                    row = (
                        row + 1
                        if seconds is None
                        else max(row + 1, math.ceil(seconds * table.rate - 1e-9))
                    )
                    break
            row += 1
    if lost:
        raise SendError(
            f"{lost}: {messages} messages were sent, {row - skipped - messages} were not."
        )
    return Sent(messages, skipped, clock() - begun, latest)


@contextlib.contextmanager
def connected(url: str, topic: str = TOPIC) -> Iterator[Sender]:
    """A connection to the robot, as a context manager.

    Args:
        url: see `linked`.
        topic: to which angles are published.

    Raises:
        ParameterError: the URL or topic is invalid, or the required package is missing.
        SendError: no answer, or the connection is refused.
    """
    with linked(url, topic, ROS_TYPE) as publish:
        yield lambda angles, column_given: publish(servo_message(url, angles, column_given))


def servo_message(
    url: str, angles: Float[np.ndarray, " channels"], column_given: Float[np.ndarray, " channels"]
) -> Any:
    """The message with the angles of a row [deg], as the robot behind this URL takes it."""
    if url.startswith(("mqtt", PRINT_ADDRESS)):
        return [
            int(angle) if angle == int(angle) else round(float(angle), 3)
            for angle in column_given.tolist()
        ]
    return {
        "layout": {"dim": [], "data_offset": 0},
        "data": [round(a, 6) for a in np.radians(angles).tolist()],
    }


def linked(
    url: str,
    topic: str,
    kind: str,
    heard: str = "",
    receive: Receiver | None = None,
    field: str = "send",
) -> AbstractContextManager[Callable[[Any], None]]:
    """A connection over which messages go both ways, as a context manager that gives the function to publish one.

    Args:
        url: `mqtt://[USER:PASSWORD@]HOST[:1883]` of a broker, or `ws://[USER:PASSWORD@]HOST[:9090][/PATH]` of a
            rosbridge server (`ros` is another name of `ws`, and `wss` has TLS); special characters of user and
            password as %XX. `print:` is no robot: messages are printed, and none comes.
        topic, kind: to which messages are published, and their type in ROS.
        heard, receive: topic that is subscribed to, and what is called with its messages, in the connection's thread:
            with None for what is not JSON.
        field: that the URL was given as, for errors.

    Raises:
        ParameterError: the URL or a topic is invalid, or the required package is missing.
        SendError: no answer, or the connection is refused.
    """
    parts = address(url, field)
    if parts.scheme == "print":
        return contextlib.nullcontext(
            lambda message: print(f"{topic}: {json.dumps(message)}", flush=True)
        )
    for name in (topic, heard or topic):
        if not name or (parts.scheme == "mqtt" and any(mark in name for mark in "+#\0")):
            raise ParameterError(f"topic is {name!r}: expected a name, without + and #.")
    return (_mqtt if parts.scheme == "mqtt" else _rosbridge)(parts, topic, kind, heard, receive)


def address(url: str, field: str) -> SplitResult:
    """The parts of a URL as for `linked`; its package is installed.

    Raises:
        ParameterError: the URL is invalid, or the package is missing; the message names the field.
    """
    try:
        parts = urlsplit(re.sub("^ros://", "ws://", url))
        # A port out of range raises; MQTT has no path (the topic is none), and takes a user without a password.
        right = url == PRINT_ADDRESS or all(
            (
                parts.scheme in _PORTS and parts.hostname,
                parts.port != 0,
                not parts.fragment,
                parts.username or parts.password is None,
                parts.scheme == "mqtt" or not parts.username or parts.password,
                parts.scheme != "mqtt" or not (parts.path.strip("/") or parts.query),
            )
        )
    except ValueError:
        right = False
    if not right:
        # Up to the last @, as a # or / that was not quoted may stand in the password.
        masked = re.sub("^([^/]*//)?.*@", r"\1...@", url, flags=re.DOTALL)
        raise ParameterError(
            f"{field} is {masked!r}: allowed is mqtt://HOST[:PORT], ws://HOST[:PORT] or {PRINT_ADDRESS}, with a port from 1 to "
            "65535, and USER:PASSWORD@ before HOST, special characters as %XX."
        )
    if url != PRINT_ADDRESS:
        require(field, *(("paho", "mqtt") if parts.scheme == "mqtt" else ("websockets", "drive")))
    return parts


@contextlib.contextmanager
def _mqtt(
    url: SplitResult, topic: str, kind: str, heard: str, receive: Receiver | None
) -> Iterator[Callable[[Any], None]]:
    import paho.mqtt.client as mqtt

    where = _place(url)
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    if url.username:
        client.username_pw_set(
            unquote(url.username), None if url.password is None else unquote(url.password)
        )
    answered, answer = threading.Event(), []

    def on_connect(client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if heard:  # also after the broker was away: it may have forgotten
            client.subscribe(heard)
        answer.append(reason)
        answered.set()

    client.on_connect = on_connect
    if receive is not None:
        client.on_message = lambda client, data, message: receive(_parsed(message.payload))
    client.connect_timeout = ANSWER_SECONDS
    try:
        client.connect(
            str(url.hostname), url.port or _PORTS["mqtt"], keepalive=round(ANSWER_SECONDS)
        )
        client.loop_start()
        if not answered.wait(ANSWER_SECONDS):
            raise SendError(f"{where}: no MQTT broker answers there.")
        if answer[0].is_failure:
            raise SendError(f"{where}: the MQTT broker refuses the connection ({answer[0]}).")

        def publish(message: Any) -> None:
            # Without acknowledgement: outdated angles are useless. If the broker is away for a while, the client's
            # thread reconnects, and the messages in between are dropped.
            if client.publish(topic, json.dumps(message), qos=0).rc != mqtt.MQTT_ERR_SUCCESS:
                raise NotSentError(f"{where}: the MQTT broker is gone")

        yield publish
    except (OSError, UnicodeError) as error:
        raise SendError(
            f"{where}: no MQTT broker answers there ({getattr(error, 'strerror', '') or error})."
        ) from None
    finally:
        client.disconnect()
        client.loop_stop()


@contextlib.contextmanager
def _rosbridge(
    url: SplitResult, topic: str, kind: str, heard: str, receive: Receiver | None
) -> Iterator[Callable[[Any], None]]:
    from websockets.exceptions import WebSocketException
    from websockets.sync import client

    where, failures = _place(url), (OSError, UnicodeError, WebSocketException)
    topic, heard = (
        name if name.startswith("/") or not name else f"/{name}" for name in (topic, heard)
    )

    def listen(socket: Any, receive: Receiver) -> None:
        with contextlib.suppress(*failures):
            for text in socket:
                frame = _parsed(text)
                if not isinstance(frame, dict):
                    receive(None)
                elif (frame.get("op"), frame.get("topic")) == ("publish", heard):
                    receive(frame.get("msg"))

    try:
        address = url._replace(netloc=url.netloc[: url.netloc.rfind("@") + 1] + where).geturl()
        with client.connect(
            address,
            open_timeout=ANSWER_SECONDS,
            ping_interval=ANSWER_SECONDS,
            ping_timeout=ANSWER_SECONDS,
        ) as socket:
            socket.send(json.dumps({"op": "advertise", "topic": topic, "type": kind}))
            if receive is not None:
                threading.Thread(target=listen, args=(socket, receive), daemon=True).start()
                socket.send(json.dumps({"op": "subscribe", "topic": heard, "queue_length": 1}))

            def publish(message: Any) -> None:
                try:
                    socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))
                except failures:
                    raise SendError(f"{where}: the rosbridge server is gone") from None

            yield publish
            socket.send(json.dumps({"op": "unadvertise", "topic": topic}))
    except failures as error:
        raise SendError(f"{where}: no rosbridge server answers there ({error}).") from None


def _parsed(text: str | bytes | bytearray) -> Any:
    """What a message says; None for what is not JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _place(url: SplitResult) -> str:
    host = f"[{url.hostname}]" if ":" in str(url.hostname) else url.hostname
    return f"{host}:{url.port or _PORTS[url.scheme]}"
