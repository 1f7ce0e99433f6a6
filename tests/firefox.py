"""A headless Firefox for tests, by its Marionette protocol over a socket, without a driver program; see `chromium`."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from chromium import PATIENCE, Page, require, started

NAMES = ("firefox-esr", "firefox")
#: A port of its own choice, no look-ups, no first-run pages; the theme is set by each page.
PREFS = {
    "marionette.port": 0,
    "app.update.disabledForTesting": True,
    "browser.shell.checkDefaultBrowser": False,
    "browser.startup.page": 0,
    "browser.aboutwelcome.enabled": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "toolkit.telemetry.enabled": False,
    "ui.prefersReducedMotion": 0,
    "remote.prefs.recommended": True,
}
THEME = "layout.css.prefers-color-scheme.content-override"
KEYS = {
    "Tab": "\ue004",
    "Enter": "\ue007",
    "Escape": "\ue00c",
    "PageUp": "\ue00e",
    "PageDown": "\ue00f",
    "End": "\ue010",
    "Home": "\ue011",
    "ArrowLeft": "\ue012",
    "ArrowUp": "\ue013",
    "ArrowRight": "\ue014",
    "ArrowDown": "\ue015",
}
SHIFT = "\ue008"
#: Errors and warnings of scripts in the pages; that there may be no WebGL is none.
CONSOLE = """return Services.console.getMessageArray().filter((m) => m instanceof Ci.nsIScriptError
    && /^(file:|viewer|data:text.javascript)/.test(m.sourceName)
    && !/css|webgl/i.test(m.category + m.errorMessage)).map((m) => m.message)"""


class Tab(Page):
    """The page of a running Firefox."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._answers, self._numbers = (
            connection,
            connection.makefile("rb"),
            itertools.count(1),
        )
        self._receive()
        self._call(
            "WebDriver:NewSession",
            capabilities={"alwaysMatch": {"timeouts": {"script": 1000 * int(PATIENCE)}}},
        )

    def _call(self, command: str, **params: Any) -> Any:
        number = next(self._numbers)
        message = json.dumps([0, number, command, params]).encode()
        self._connection.sendall(b"%d:%s" % (len(message), message))
        while True:
            kind, answered, error, result = self._receive()
            if kind == 1 and answered == number:
                assert error is None, f"{command}: {error}"
                return (
                    result.get("value")
                    if isinstance(result, dict) and result.keys() == {"value"}
                    else result
                )

    def _receive(self) -> Any:
        """The next message: its length, a colon, and JSON."""
        length = b""
        while not length.endswith(b":"):
            piece = self._answers.read(1)
            assert piece, "Firefox has ended"
            length += piece
        return json.loads(self._answers.read(int(length[:-1])))

    def _in_browser(self, script: str) -> Any:
        self._call("Marionette:SetContext", value="chrome")
        try:
            return self._call("WebDriver:ExecuteScript", script=script, args=[])
        finally:
            self._call("Marionette:SetContext", value="content")

    def open(
        self,
        path: Path | str,
        width: int = 1280,
        height: int = 720,
        dark: bool = False,
        scale: float = 1.0,
    ) -> None:
        """Load a file, or what is served at an address, in a window of so many pixels."""
        self._in_browser(
            f"Services.console.reset(); Services.prefs.setIntPref('{THEME}', {0 if dark else 1})"
        )
        self.resize(width, height)
        self._call(
            "WebDriver:Navigate", url=path if isinstance(path, str) else path.resolve().as_uri()
        )

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        outer = (width, height)
        for _ in range(2):  # the window's own bars take some of it
            self._call("WebDriver:SetWindowRect", width=outer[0], height=outer[1])
            inner = self.evaluate("[innerWidth, innerHeight]")
            outer = (outer[0] + width - inner[0], outer[1] + height - inner[1])

    def evaluate(self, script: str) -> Any:
        """The JSON value of an expression; promises are awaited."""
        return self._call(
            "WebDriver:ExecuteScript", script=f"return ({script});", args=[], sandbox=None
        )

    def key(self, key: str, shift: bool = False) -> None:
        """Press and release a key, named as in a KeyboardEvent."""
        pressed = [SHIFT] if shift else []
        pressed.append(KEYS.get(key, key))
        actions = [{"type": "keyDown", "value": key_name} for key_name in pressed]
        actions += [{"type": "keyUp", "value": key_name} for key_name in reversed(pressed)]
        self._perform({"type": "key", "id": "keyboard", "actions": actions})

    def mouse(self, kind: str, x: float, y: float) -> None:
        move = {
            "type": "pointerMove",
            "duration": 0,
            "x": round(x),
            "y": round(y),
            "origin": "viewport",
        }
        actions = {"mousePressed": ["pointerDown"], "mouseReleased": ["pointerUp"]}.get(kind, [])
        self._perform(
            {
                "type": "pointer",
                "id": "mouse",
                "parameters": {"pointerType": "mouse"},
                "actions": [move, *({"type": action, "button": 0} for action in actions)],
            }
        )

    def _perform(self, actions: dict[str, Any]) -> None:
        self._call("WebDriver:PerformActions", actions=[actions])

    def picture(self) -> bytes:
        """A PNG of the window."""
        return base64.b64decode(self._call("WebDriver:TakeScreenshot", full=False))

    def complaints(self) -> list[str]:
        """Errors and warnings of the page's scripts."""
        messages: list[str] = self._in_browser(CONSOLE)
        return messages


@contextlib.contextmanager
def page() -> Iterator[Tab]:
    """The page of a running Firefox, which ends with the context."""
    path = require(NAMES, "FIREFOX")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        lines = [
            f"user_pref({json.dumps(name)}, {json.dumps(value)});\n"
            for name, value in PREFS.items()
        ]
        (Path(profile) / "user.js").write_text("".join(lines))
        flags = (
            "--headless",
            "--no-remote",
            "--marionette",
            "--remote-allow-system-access",
            "--profile",
            profile,
        )
        with (
            started(path, *flags, profile=profile, tells="MarionetteActivePort") as (port,),
            socket.create_connection(("127.0.0.1", int(port)), PATIENCE) as connection,
        ):
            yield Tab(connection)
