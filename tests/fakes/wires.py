"""Robots driven over messages: a clock for tests, a controller with a simulated robot, a broker and a bridge."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from tiers import needs

from nermo_mjx.hardware import Channels, read_channels
from nermo_mjx.live.wire import Measurements, RobotDriving, SimulatedRobot, sensor_message

#: The author's order, with angles that are not cut to whole degrees.
CHANNELS = dataclasses.replace(read_channels("published"), whole_degrees=None)


def until(is_so: Callable[[], Any], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


class Clock:
    """A time that passes where it is waited for, and jumps once."""

    def __init__(self, jump_at: float = math.inf, jump: float = 0.0) -> None:
        self.now, self.jump_at, self.jump = 100.0, 100.0 + jump_at, jump

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds
        if self.now >= self.jump_at:
            self.now, self.jump_at = self.now + self.jump, math.inf


class Together:
    """A controller and a simulated robot, tick by tick in one time."""

    def __init__(
        self,
        driving: RobotDriving,
        channels: Channels = CHANNELS,
        delay: float = 0.0,
        loss: float = 0.0,
        rate: float | None = None,
        values: dict[str, float] | None = None,
    ) -> None:
        self.clock, self.silent = Clock(), False
        self.body = SimulatedRobot(driving.setup, values or {}, channels, delay, loss, self.clock)
        self.measured = Measurements(self.body.robot, channels, clock=self.clock)
        self.commands: list[np.ndarray] = []
        self.body.outward.put(
            -1.0, sensor_message(self.body.robot, channels, self.body._readings[0, -1], 0.0)
        )
        self.tell()
        self.driving = driving
        driving._period = 1.0 / (rate or 100.0)
        driving.connect(self.measured, self.publish)
        self.walk(self.measured.watchdog)
        assert not self.commands, "the first messages may be old"

    def publish(self, message: Any) -> None:
        self.commands.append(np.array(message["data"]))
        self.body.receive(message)

    def tell(self) -> None:
        for message in self.body.outward.arrivals(self.clock() + 1e-9):
            if not self.silent:
                self.measured.receive(message)

    def walk(self, seconds: float) -> None:
        for _ in range(round(seconds / self.body.dt)):
            self.tell()
            self.driving.step()
            self.body.tick(self.clock())
            self.clock.now += self.body.dt


@contextlib.contextmanager
def broker() -> Iterator[int]:
    """An MQTT broker; its port."""
    needs("paho", "amqtt")
    from amqtt.broker import Broker

    logging.getLogger("amqtt").setLevel(logging.ERROR)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    settings = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }

    async def begin() -> Broker:
        started = Broker(settings)
        await started.start()
        return started

    running = asyncio.run_coroutine_threadsafe(begin(), loop).result(20)
    yield port
    asyncio.run_coroutine_threadsafe(running.shutdown(), loop).result(20)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10)


@contextlib.contextmanager
def bridge() -> Iterator[int]:
    """What a rosbridge server does with `advertise`, `subscribe` and `publish`; its port."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import serve

    subscribers: dict[str, list[Any]] = {}

    def handle(peer: Any) -> None:
        types: dict[str, str] = {}
        with contextlib.suppress(ConnectionClosed):  # of a process that was killed
            for text in peer:
                frame = json.loads(text)
                if frame["op"] == "advertise":
                    types[frame["topic"]] = frame["type"]
                elif frame["op"] == "subscribe":
                    subscribers.setdefault(frame["topic"], []).append(peer)
                elif frame["op"] == "publish":
                    assert frame["topic"] in types, "rosbridge publishes what was advertised only"
                    for subscriber in list(subscribers.get(frame["topic"], [])):
                        with contextlib.suppress(ConnectionClosed):
                            subscriber.send(text)

    with serve(handle, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.socket.getsockname()[1]
        server.shutdown()
        thread.join(10)
