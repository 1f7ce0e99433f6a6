"""A clock of their own for tests in time, and a broker and a bridge on this machine, over which robots are driven."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import logging
import math
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest


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


def needs(*packages: str) -> None:
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"without {' and '.join(missing)}: pip install '.[test]'")


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
                    for other in list(subscribers.get(frame["topic"], [])):
                        with contextlib.suppress(ConnectionClosed):
                            other.send(text)

    with serve(handle, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.socket.getsockname()[1]
        server.shutdown()
        thread.join(10)
