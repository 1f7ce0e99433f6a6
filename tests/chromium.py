"""A headless Chromium for tests: pages, keys, clicks and pictures over its debugging socket, without a driver."""

from __future__ import annotations

import base64
import contextlib
import io
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
#: No sandbox, because tests run as root in containers; no look-ups, because there may be no network; WebGL in software.
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--mute-audio",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WITHOUT_WEBGL = ("--disable-gpu", "--disable-3d-apis")
#: Longest wait for an answer [s]; a picture in software on a busy machine takes seconds.
PATIENCE = 60.0
#: A page of this package has been assembled.
READY = "document.documentElement?.dataset.ready === 'yes'"


def require(names: Sequence[str] = NAMES, variable: str = "CHROMIUM") -> str:
    """Path of a browser, by default a Chromium or Chrome: what the variable says, or the first of these names.

    Without one the test is skipped, with the remedy. In CI, which installs it, that is a failure.
    """
    path = os.environ.get(variable) or next(
        (path for name in names if (path := shutil.which(name))), None
    )
    if path is None:
        remedy = (
            f"no {names[0]}: `apt-get install {names[0]}`, or set {variable} to the path of one"
        )
        (pytest.fail if os.environ.get("CI") else pytest.skip)(remedy)
    return path


@contextlib.contextmanager
def started(path: str, *flags: str, profile: str, tells: str) -> Iterator[list[str]]:
    """A browser that ends with the context: the words of the file of its profile in which it says where it listens."""
    quiet = {
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    process = subprocess.Popen([path, *flags], **quiet)
    try:
        deadline, words = time.monotonic() + PATIENCE, list[str]()
        while not words:
            assert process.poll() is None, f"{path} has ended (exit code {process.poll()})"
            assert time.monotonic() < deadline, f"{path} does not listen after {PATIENCE:g} s"
            time.sleep(0.05)
            with contextlib.suppress(OSError):
                words = Path(profile, tells).read_text().split()
        yield words
    finally:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10)
        process.kill()
        process.wait()


class Page:
    """What pages for tests have in common, in any browser; each has `evaluate`, `mouse` and `complaints`."""

    evaluate: Callable[[str], Any]
    mouse: Callable[[str, float, float], None]
    complaints: Callable[[], list[str]]
    picture: Callable[[], bytes]

    def pixels(self, box: Sequence[float] | None = None) -> np.ndarray:
        """The window, or a part of it (left, top, right, bottom), as (rows, columns, 3) int."""
        return np.asarray(Image.open(io.BytesIO(self.picture())).convert("RGB").crop(box)).astype(
            int
        )

    def nameless(self) -> list[str]:
        """Controls that a screen reader has no name for."""
        return self.evaluate("""[...document.querySelectorAll(
            "button, summary, select, input, dialog, canvas:not([aria-hidden])")].filter((each) =>
            !(each.getAttribute("aria-label") || each.getAttribute("aria-labelledby") || each.textContent.trim()
                || each.closest("label"))).map((each) => each.outerHTML)""")

    def outside(self, ids: list[str], width: int, height: int, minimum: int = 8) -> list[str]:
        """Elements that do not lie in the window, or are smaller than that [pixels]."""
        return self.evaluate(f"""{ids}.filter((id) => {{
            const box = document.getElementById(id).getBoundingClientRect();
            return !(box.width > {minimum} && box.height > {minimum} && box.left >= -1 && box.top >= -1
                && box.right <= {width} + 1 && box.bottom <= {height} + 1);
        }})""")

    def wait(self, condition: str, seconds: float = PATIENCE) -> None:
        """Until an expression is true."""
        deadline = time.monotonic() + seconds
        while not self.evaluate(condition):
            assert time.monotonic() < deadline, (
                f"still not, after {seconds:g} s: {condition}; {self.complaints()}"
            )
            time.sleep(0.05)

    def box(self, selector: str) -> dict[str, float]:
        """Where an element lies in the window: `left`, `top`, `width` and so on [pixels]."""
        return self.evaluate(
            f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()"
        )

    def click(self, selector: str, share: float = 0.5) -> None:
        """Click an element, at a share of its width from the left."""
        self.evaluate(
            f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'nearest'}}) ?? null"
        )
        box = self.box(selector)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, box["left"] + share * box["width"], box["top"] + box["height"] / 2)


class Browser:
    """One process of Chromium."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self._events: list[dict[str, Any]] = []

    def call(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
        """The result of one command of the DevTools protocol."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params} | (
            {"sessionId": session} if session else {}
        )
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
            self._events.append(answer)

    @contextlib.contextmanager
    def tab(self) -> Iterator[Tab]:
        """A new page, closed with the context."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        try:
            yield Tab(
                self, self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            )
        finally:
            self.call("Target.closeTarget", targetId=target)

    def events(self, session: str) -> list[dict[str, Any]]:
        """What a page has reported so far."""
        return [event for event in self._events if event.get("sessionId") == session]


class Tab(Page):
    """A page in it."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        return self._browser.call(method, self._session, **params)

    def open(
        self,
        path: Path | str,
        width: int = 1280,
        height: int = 720,
        dark: bool = False,
        scale: float = 1.0,
    ) -> None:
        """Load a file, or what is served at an address, in a window of so many pixels."""
        self.resize(width, height, scale)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self._call("Emulation.setEmulatedMedia", features=scheme)
        self._call("Page.navigate", url=path if isinstance(path, str) else path.resolve().as_uri())

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=False,
        )

    def evaluate(self, script: str) -> Any:
        """The JSON value of an expression; promises are awaited."""
        answer = self._call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def key(self, key: str, shift: bool = False) -> None:
        """Press and release a key, named as in a KeyboardEvent."""
        text = {"text": key} if len(key) == 1 else {"text": "\r"} if key == "Enter" else {}
        code = {" ": "Space"}.get(key, key)
        modifiers = 8 if shift else 0
        self._call(
            "Input.dispatchKeyEvent",
            type="keyDown",
            key=key,
            code=code,
            modifiers=modifiers,
            **text,
        )
        self._call("Input.dispatchKeyEvent", type="keyUp", key=key, code=code, modifiers=modifiers)

    def mouse(self, kind: str, x: float, y: float) -> None:
        buttons = 0 if kind == "mouseReleased" else 1
        button = "none" if kind == "mouseMoved" else "left"
        self._call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            button=button,
            buttons=buttons,
            clickCount=1,
        )

    def picture(self) -> bytes:
        """A PNG of the window."""
        return base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])

    def complaints(self) -> list[str]:
        """Errors and warnings of the page, and exceptions that nobody caught."""
        messages = []
        for event in self._browser.events(self._session):
            method, params = event["method"], event["params"]
            if method == "Runtime.exceptionThrown":
                messages.append(json.dumps(params["exceptionDetails"])[:500])
            elif method == "Runtime.consoleAPICalled" and params["type"] in (
                "error",
                "warning",
                "assert",
            ):
                messages.append(
                    " ".join(
                        str(part.get("value", part.get("description"))) for part in params["args"]
                    )
                )
            elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
                messages.append(params["entry"]["text"])
        return messages

    def requests(self) -> list[str]:
        """Addresses that the page has loaded anything from, data and blobs left out."""
        requests = [
            e
            for e in self._browser.events(self._session)
            if e["method"] == "Network.requestWillBeSent"
        ]
        urls = [event["params"]["request"]["url"] for event in requests]
        return [url for url in urls if not url.startswith(("data:", "blob:"))]


@contextlib.contextmanager
def browser(path: str, webgl: bool = True) -> Iterator[Browser]:
    """A running Chromium, ended with the context."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        flags = (*FLAGS, *(SOFTWARE if webgl else WITHOUT_WEBGL), f"--user-data-dir={profile}")
        with started(path, *flags, profile=profile, tells="DevToolsActivePort") as (
            port,
            path_of_socket,
        ):
            address = f"ws://127.0.0.1:{port}{path_of_socket}"
            from websockets.sync.client import connect

            with connect(address, max_size=None, compression=None, ping_interval=None) as socket:
                yield Browser(socket)


@contextlib.contextmanager
def page() -> Iterator[Tab]:
    """A page in a running Chromium."""
    with browser(require()) as running, running.tab() as tab:
        yield tab
