"""The page of a drive, which only this machine can open, its messages, and the loop that keeps real time.

The address contains a random token, which the page and the socket require. `Host` must be the loopback and `Origin` the
same address, so that pages of other sites cannot connect. One page drives; a second page takes over, and the first one
shows a note. Without a page, the drive is paused. The loop never waits for a page or for the disk, and wrong messages do
not end it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import math
import os
import queue
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlsplit

import mujoco
import numpy as np
from pydantic import BaseModel, Field, ValidationError

from nermo_mjx.control.parameters import STEERING
from nermo_mjx.control.schedule import MODE_GAINS
from nermo_mjx.live.driving import CommandFields, Driving, Finite, Journal
from nermo_mjx.recording import RecordingError
from nermo_mjx.robot import LIMBS
from nermo_mjx.robot.parameters import GAIT_PATTERNS
from nermo_mjx.robot.quantity import ParameterError, require
from nermo_mjx.runs.job import interruptible
from nermo_mjx.view.clip import clips_of
from nermo_mjx.view.page import Packer, document
from nermo_mjx.view.recorded import ARC_POINTS, Motion, motion_of, plots_of, recorded_model

#: Longest message of a page [bytes], and maximum numbers of messages that wait to be read, and to be sent.
MAX_MESSAGE_BYTES: Final = 4096
INBOX_MESSAGES: Final = 32
OUTBOX_MESSAGES: Final = 16
#: Maximum number of simultaneous connections, and longest time for closing one [s].
MAX_CONNECTIONS: Final = 16
CLOSING_SECONDS: Final = 2.0
#: Highest rate of pictures [Hz], and maximum number of pictures on their way to the page.
PICTURE_RATE_HZ: Final = 50.0
MAX_PENDING_PICTURES: Final = 2
#: Delay above which the drive stays behind the clock, instead of catching up [s].
LARGEST_DELAY_SECONDS: Final = 0.1
#: Close code of a page that another page has replaced.
REPLACEMENT_CODE: Final = 4001

#: Sliders of the page: parameter, title, unit, range.
SLIDERS: Final = {
    "frequency": ("frequency", "Hz", 0.2, 2.0),
    "stride": ("stride", "", 0.0, 1.2),
    "pilot.turn_rate": ("turn", "", -1.0, 1.0),
    "spine.amplitude": ("spine amplitude", "rad", 0.0, 0.4),
    "spine.phase": ("spine phase", "rad", -3.15, 3.15),
}

# ---
# The display of a page: its document at the start, then a row of numbers for each picture.

#: Limbs of the contact arrows: two arrows for each limb, and other contacts (-1).
ARROW_SLOTS: Final = (*(limb for limb in range(len(LIMBS)) for _ in range(2)), *(-1,) * 8)
#: Time constant of the point that follows the robot [s].
FOLLOWING_SECONDS: Final = 0.25


class DriveDisplay:
    """The display of a drive on the page."""

    def __init__(self, driving: Driving) -> None:
        self.driving = driving
        start = driving.sample
        self._model = recorded_model(start, driving.simulator.robot)
        self._data = mujoco.MjData(self._model)
        self._packer = Packer()
        self._header = clips_of([start], ["drive"], self._packer)
        wraps = self._model.wrap_type
        #: Maximum number of points of each tendon: one for a site, and two with an arc in between for a pulley.
        self._points = [
            sum(
                1 if wraps[k] == mujoco.mjtWrap.mjWRAP_SITE else 2 + ARC_POINTS
                for k in range(first, first + count)
            )
            for first, count in zip(self._model.tendon_adr, self._model.tendon_num, strict=True)
        ]
        clip = self._header["clips"][0]
        follow = np.frombuffer(self._packer.content, "<f4", 3, clip["follow"]["at"])
        self._centre = follow - start.qpos[0, :3]
        self.restart()

    def restart(self) -> None:
        """Reset the display, because the robot is in its initial state again."""
        self._follow: np.ndarray | None = None
        self._before: np.ndarray | None = None
        self._speeds: list[tuple[float, float]] = []
        self._time = 0.0

    def document(self, description: dict[str, Any]) -> str:
        """The HTML of the page; `description` is the data for its driving part."""
        live = {"points": self._points, "slots": ARROW_SLOTS, **description}
        return document(
            "viewer", "Nermo: drive", self._header | {"live": live}, [self._packer], ("", "live")
        )

    def row(self) -> bytes:
        """The present state as bytes of floats: time, root, followed point; position and rotation of each moving body;
        points and tension of each tendon; point and force of each contact arrow; and the value of each curve."""
        sample = self.driving.sample
        motion = motion_of(sample, self._model, data=self._data)
        bodies = self._header["clips"][0]["moving"]
        origin = motion.position[0, self._header["clips"][0]["root"]]
        turns = motion.quaternion[0, bodies]
        if self._before is not None:
            turns = np.where((turns * self._before).sum(-1, keepdims=True) < 0, -turns, turns)
        self._before = turns
        target, passed = origin + self._centre, self.driving.time - self._time
        self._time = self.driving.time
        position = target if self._follow is None else self._follow
        self._follow = position + (target - position) * (1.0 - np.exp(-passed / FOLLOWING_SECONDS))
        parts = [
            [self.driving.time],
            origin,
            self._follow,
            motion.position[0, bodies] - origin,
            turns,
        ]
        for tendon, points in zip(motion.tendons, self._points, strict=True):
            path = tendon.path[0][:points] - origin
            parts += [np.pad(path, ((0, points - len(path)), (0, 0)), mode="edge"), tendon.tension]
        parts += [self._contacts(motion, origin), self._curves(sample, motion)]
        return np.concatenate([np.ravel(part) for part in parts]).astype("<f4").tobytes()

    def _contacts(self, motion: Motion, origin: np.ndarray) -> np.ndarray:
        slots, taken = np.zeros((len(ARROW_SLOTS), 6)), set[int]()
        for contact in motion.contacts:
            free = next(
                (
                    k
                    for k, limb in enumerate(ARROW_SLOTS)
                    if limb == contact.limb and k not in taken
                ),
                None,
            )
            if free is not None:
                taken.add(free)
                slots[free] = *(contact.point[0] - origin), *contact.force[0]
        return slots

    def _curves(self, sample: Any, motion: Motion) -> list[float]:
        values = []
        for plot in plots_of(sample, motion):
            for line in plot.lines:
                value = float(line.values[0])
                if plot.key == "speed" and not line.faint:
                    value = self._mean_speed(float(plot.lines[1].values[0]))
                values.append(value)
        return values

    def _mean_speed(self, speed: float) -> float:
        """Mean speed over the last gait cycle [m/s]."""
        begin = self._time - 1.0 / self.driving.cycle_rate
        self._speeds = [entry for entry in self._speeds if entry[0] > begin] + [(self._time, speed)]
        return float(np.mean([entry for _, entry in self._speeds]))


# ---
# The messages of a page, and the loop.


class _Push(BaseModel, extra="forbid"):
    body: Annotated[int, Field(strict=True)]
    force: tuple[Finite, Finite, Finite]
    seconds: Finite


class Message(CommandFields):
    """A message of a page: a command, and the following optional fields.

    Attributes:
        push: Force on a body.
        reset: Whether to return to the start.
        pause: Whether to pause.
        speed: Speed of the drive relative to the clock.
        shown: Number of the picture on the screen.
    """

    push: _Push | None = None
    reset: Literal[True] | None = None
    pause: Annotated[bool, Field(strict=True)] | None = None
    speed: Annotated[float, Field(ge=0.05, le=4, allow_inf_nan=False, strict=True)] | None = None
    shown: Annotated[int, Field(strict=True)] | None = None


class LiveDrive:
    """A drive that a page controls in real time.

    Attributes:
        driving, record: Drive, and file of its recording.
        address: Address of the page, with its token.
        paused, speed: Whether the drive is paused, and seconds of the drive per second.
        over: Whether the drive is over; set it to end the drive.
        failure: Error of a recording that could not be written, with the file that contains the drive instead; empty if
            all recordings were written.
        delays: Delays from the end of a tick to its picture on the screen, for the latest pictures [s].
    """

    def __init__(self, driving: Driving, record: Path | None = None, port: int = 0) -> None:
        """
        Args:
            driving: Drive at its start.
            record: File of the recording, see `free`; after a reset, the next recording is FILE-2, FILE-3, ... During the
                drive, a `Journal` with the suffix .jsonl contains it.
            port: Port of the loopback; 0 for any free port.

        Raises:
            ParameterError: The port is in use, the file exists, its folder cannot be written, or websockets is missing.
        """
        require("drive", "websockets", "drive")
        from websockets.sync.server import serve

        self.driving, self._shown = driving, DriveDisplay(driving)
        self.record, self.files, self.failure = record, list[Path](), ""
        self._journal: Journal | None = None
        self._gait, self._steering = driving.setup.gait, str(driving.setup.steering)
        self.paused, self.speed, self.over, self._began = False, 1.0, False, False
        self._sent, self._gone = dict[int, float](), list[float]()
        self._number, self.delays, self._spent = 0, list[float](), [0.0, 0.0]
        # What the page is told next: since when it waits for it, and what was refused last.
        self._changed, self._status_time, self._refused = False, 0.0, ""
        self._token = secrets.token_urlsafe(16)
        self._page: Any = None
        self._outbox, self._sender = queue.Queue[Any](OUTBOX_MESSAGES), threading.Thread()
        self._lock = threading.Lock()
        self._connections = dict[
            socket.socket, bool
        ]()  # whether it got in, in the order in which they came
        # `(page, text)` of each message, `(page, True)` of a page that came, `(page, False)` of one that went.
        self._inbox: queue.Queue[tuple[Any, str | bytes | bool]] = queue.Queue(INBOX_MESSAGES)
        silent = logging.getLogger(
            __name__
        )  # because browsers open connections that they do not use
        silent.setLevel(logging.CRITICAL)
        try:
            self._server = serve(
                self._listen,
                "127.0.0.1",
                port,
                process_request=self._answer,
                max_size=MAX_MESSAGE_BYTES,
                compression=None,
                logger=silent,
            )
        except OSError as error:
            raise ParameterError(
                f"port is {port}: it cannot be opened ({error.strerror or error})."
            ) from None
        self.address = f"http://127.0.0.1:{self._server.socket.getsockname()[1]}/{self._token}/"
        try:
            self._open_journal()
        except ParameterError:
            self._server.socket.close()
            raise
        self._server.socket.settimeout(0.5)  # so that the thread notices that the socket is closed
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        """Accept connections until the socket is closed; websockets' loop would end without free descriptors or threads."""
        listening = self._server.socket
        while listening.fileno() >= 0:
            try:
                threading.Thread(target=self._serve, args=listening.accept()).start()
            except TimeoutError:
                continue
            except (OSError, RuntimeError):
                time.sleep(0.1)

    def _serve(self, accepted: socket.socket, address: Any) -> None:
        """Serve a connection in its own thread; if there are too many, one that is not admitted is closed."""
        with self._lock:
            if len(self._connections) >= MAX_CONNECTIONS:
                out = next(
                    (
                        connection
                        for connection, inside in [*self._connections.items()]
                        if not inside
                    ),
                    accepted,
                )
                _close_socket(out)
                self._connections.pop(out, None)
            self._connections[accepted] = False
        try:
            self._server.handler(accepted, address)
        finally:
            self._connections.pop(accepted, None)

    def _answer(self, connection: Any, request: Any) -> Any:
        """The page, or None to open the socket; all other requests are rejected."""
        try:
            return self._make_answer(connection, request)
        except Exception:  # two hosts, or an address that is none
            return connection.respond(HTTPStatus.BAD_REQUEST, "This request is not understood.\n")

    def _make_answer(self, connection: Any, request: Any) -> Any:
        host = request.headers.get("Host", "")
        if urlsplit(f"//{host}").hostname not in ("127.0.0.1", "localhost"):
            return connection.respond(
                HTTPStatus.FORBIDDEN, "This address is for this machine alone.\n"
            )
        token, _, rest = request.path.lstrip("/").partition("/")
        if not secrets.compare_digest(token.encode(), self._token.encode()) or rest not in (
            "",
            "socket",
        ):
            return connection.respond(
                HTTPStatus.NOT_FOUND, "Open the address that nermo-mjx drive has printed.\n"
            )
        if rest == "socket":
            if request.headers.get("Origin") != f"http://{host}":
                return connection.respond(HTTPStatus.FORBIDDEN, "Only its own page may drive.\n")
            return None
        answer = connection.respond(HTTPStatus.OK, self._document())
        del answer.headers["Content-Type"]
        answer.headers.update(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Cache-Control": "no-store",
                "Referrer-Policy": "no-referrer",
                "X-Frame-Options": "DENY",
            }
        )
        return answer

    def _listen(self, page: Any) -> None:
        """Receive the messages of a page in its own thread."""
        self._connections[page.socket] = True
        self._inbox.put((page, True))
        try:
            for text in page:
                self._inbox.put((page, text))
        finally:
            self._inbox.put((page, False))

    def _send(self, message: bytes | dict[str, Any]) -> bool:
        """Send a message to the driving page by a thread; false if there is no page, or the page is behind."""
        if self._page is None:
            return False
        try:
            self._outbox.put_nowait(message if isinstance(message, bytes) else json.dumps(message))
            return True
        except queue.Full:
            return False

    def _leave(self, code: int, why: str) -> threading.Thread:
        """Close the connection to the page in a thread, even if the page hangs."""

        def part(page: Any, sender: threading.Thread) -> None:
            sender.join(CLOSING_SECONDS / 2)
            closing = threading.Thread(target=page.close, args=(code, why), daemon=True)
            closing.start()
            closing.join(CLOSING_SECONDS)
            _close_socket(page.socket)

        with contextlib.suppress(queue.Full):
            self._outbox.put_nowait(None)
        thread = threading.Thread(target=part, args=(self._page, self._sender), daemon=True)
        thread.start()
        self._page = None
        return thread

    @property
    def away(self) -> float:
        """Time for which there has been no page, or the page has not shown its pictures [s]."""
        now = time.perf_counter()
        return now - min([*self._sent.values(), *self._gone], default=now)

    @property
    def factor(self) -> float:
        """Seconds of the drive per second, without the times when it was paused or slowed down."""
        return self._spent[0] / self._spent[1] if self._spent[1] else 1.0

    def report(self) -> dict[str, Any]:
        """Report of the drive: files, duration [s], real-time factor, and delay of the picture (median, 95 %) [s]."""
        delays = np.quantile(self.delays, (0.5, 0.95)).tolist() if self.delays else [None, None]
        return {
            "files": [str(file) for file in self.files],
            "seconds": self.driving.time,
            "factor": self.factor,
            "delay": delays[0],
            "delay_95": delays[1],
        }

    def run(self, seconds: float | None = None) -> None:
        """Run for a time of the clock [s], or until an interruption, and save the recording."""
        with interruptible() as interruption:
            try:
                self._run(math.inf if seconds is None else time.perf_counter() + seconds)
            finally:
                with interruption.shielded():  # a second Ctrl-C does not lose the recording
                    self._save()
                    self._server.socket.close()
                    if self._page is not None:
                        self._leave(1001, "the drive has ended").join()

    def _run(self, end: float) -> None:
        due, picture, dt = time.perf_counter(), 0.0, self.driving.dt
        while not self.over and time.perf_counter() < end:
            stands = self.paused or not self._began
            for page, message in self._messages(
                0.05 if stands else max(due - time.perf_counter(), 0.0)
            ):
                self._receive(page, message)
                if not stands and time.perf_counter() >= due:  # the rest waits, and time goes on
                    break
            now = time.perf_counter()
            if self._journal is not None and self._journal.error is not None and not self.paused:
                self.paused, why = True, self._journal.error.strerror
                self._refuse(
                    f"{self._journal.path} cannot be written ({why}): time stands still until it can be."
                )
            if self._changed and now - self._status_time >= 1.0 / PICTURE_RATE_HZ:
                self._send_status(now)
            if self.paused or not self._began:
                self.driving.watch()
                due = now
                continue
            if now < due:
                continue
            try:
                self.driving.tick()
            except ParameterError as error:  # from a scheduled switch
                self._refuse(str(error))
                continue
            if not self.driving.is_finite:
                self._refuse("The simulation has lost its numbers: it starts again.")
                self._restart()
            due += dt / self.speed
            late = time.perf_counter() - due
            late = late if late > LARGEST_DELAY_SECONDS else 0.0
            due += late
            if self.speed == 1.0:
                self._spent = [self._spent[0] + dt, self._spent[1] + dt + late]
            if now - picture >= 0.99 / PICTURE_RATE_HZ and len(self._sent) < MAX_PENDING_PICTURES:
                picture = now
                self._show()

    def _messages(self, patience: float) -> Iterator[tuple[Any, Any]]:
        """The waiting messages, or the first message within `patience` [s]."""
        with contextlib.suppress(queue.Empty):
            yield self._inbox.get(timeout=patience) if patience > 0 else self._inbox.get_nowait()
            for _ in range(INBOX_MESSAGES):
                yield self._inbox.get_nowait()

    def _receive(self, page: Any, message: str | bytes | bool) -> None:
        if message is True:
            if self._page is not None:
                self._leave(REPLACEMENT_CODE, "another page drives now")
            self._page, self._began, self._sent, self._gone, self._refused = page, True, {}, [], ""
            self._outbox = queue.Queue(OUTBOX_MESSAGES)
            self._sender = threading.Thread(
                target=_send_all, args=(page, self._outbox), daemon=True
            )
            self._sender.start()
            self._show()
        elif page is not self._page:
            return
        elif message is False:
            self._leave(1001, "the page has gone")
            self.paused, self._sent, self._gone = True, {}, [time.perf_counter()]
        else:
            try:
                command = Message.model_validate_json(message)
                if command.shown is not None:
                    if (sent_time := self._sent.pop(command.shown, None)) is not None:
                        self.delays = [*self.delays[-999:], time.perf_counter() - sent_time]
                    return
                self._execute(command)
            except ValidationError as error:
                first = error.errors()[0]
                location = ".".join(map(str, first["loc"])) or "message"
                self._refuse(f"{location}: {first['msg'][0].lower()}{first['msg'][1:]}."[:200])
            except Exception as error:  # a wrong message does not end the drive
                self._refuse(
                    str(error)
                    if isinstance(error, ParameterError)
                    else f"that failed: {error!r}."[:200]
                )
        self._changed = True

    def _refuse(self, sentence: str) -> None:
        """Send a sentence about an error to the page soon; the last of several sentences is sent."""
        self._refused, self._changed = sentence, True

    def _execute(self, message: Message) -> None:
        driving = self.driving
        if message.set or any(
            (message.gait, message.steering, message.spine, message.head, message.tail_motion)
        ):
            switch = message.switch(driving.time)
            driving.command(switch)
            self._gait = switch.gait or self._gait
            self._steering = switch.steering or self._steering
        if message.push is not None:
            driving.push(message.push.body, message.push.force, message.push.seconds)
        self.paused = self.paused if message.pause is None else message.pause
        self.speed = message.speed or self.speed
        if message.reset:
            self._restart()

    def _restart(self) -> None:
        self._save()
        self.driving.reset()
        self._open_journal()
        self._gait, self._steering = self.driving.setup.gait, str(self.driving.setup.steering)
        self._shown.restart()
        self._send({"restart": True})
        self._show()

    def _open_journal(self) -> None:
        if self.record is not None:
            path = free(self.record, first=not self.files and not self.failure)
            try:
                self._journal = Journal(path.with_suffix(JOURNAL_SUFFIX), self.driving)
            except OSError as error:
                raise ParameterError(
                    f"record is {path}: it cannot be written ({error.strerror})."
                ) from None

    def _save(self) -> None:
        """Write the recording of the drive since the start; if this fails, the journal stays."""
        journal, self._journal, saved = self._journal, None, True
        if self.record is not None and self.driving.rows:
            file = self.record if journal is None else journal.path.with_suffix(self.record.suffix)
            path = free(file, first=False) if os.path.lexists(file) else file
            try:
                self.files.append(self.driving.recording().save(path))
            except RecordingError as error:
                saved = False
                message = (
                    "lost" if journal is None else f"in {journal.path}, for `nermo-mjx replay`"
                )
                self.failure = f"{str(error).rstrip('.')}; what was driven is {message}."
        if journal is not None:
            journal.end(keep=not saved)

    def _show(self) -> None:
        self._number += 1
        if self._send(self._number.to_bytes(4, "little") + self._shown.row()):
            self._sent[self._number] = time.perf_counter()

    def _send_status(self, now: float) -> None:
        self._status_time = now
        if self._refused and self._send({"refused": self._refused}):
            self._refused = ""
        self._changed = bool(self._refused)
        modes = {
            field: "+".join(sorted(names)) or "none" for field, names in self.driving.modes.items()
        }
        self._send(
            {
                "paused": self.paused,
                "speed": self.speed,
                "gait": self._gait,
                "steering": self._steering,
                **modes,
                "values": {name: self.driving.value(name) for name in SLIDERS},
                "factor": round(self.factor, 3),
            }
        )

    def _document(self) -> str:
        driving = self.driving
        sliders = [
            {"name": name, "title": title, "unit": unit, "low": low, "high": high}
            for name, (title, unit, low, high) in SLIDERS.items()
            if name in driving.parameters
        ]
        # Modes without effect are omitted, for example harmonics without amplitudes.
        modes = {
            field: sorted(name for name in names if any(map(driving.value, MODE_GAINS[name])))
            for field, names in driving.simulator.setup.modes.items()
        }
        ours = "offset.front_left" in driving.parameters
        choices = {"gait": [*GAIT_PATTERNS], "steering": [*STEERING]} if ours else {}
        return self._shown.document({"sliders": sliders, "choices": choices | modes})


def _send_all(page: Any, outbox: queue.Queue[Any]) -> None:
    """Send the messages of a queue until None; this function waits if the page does not read."""
    from websockets.exceptions import ConnectionClosed

    with contextlib.suppress(ConnectionClosed, OSError):
        while (message := outbox.get()) is not None:
            page.send(message)


def _close_socket(connection: socket.socket) -> None:
    """Close a connection at once, so that its readers end."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


#: Suffix of the journal beside a recording's file.
JOURNAL_SUFFIX: Final = ".jsonl"


def free(record: Path, *, first: bool = True) -> Path:
    """The file for a recording: this file, or after the first recording a free one of FILE-2, FILE-3, ..., without journal.

    Raises:
        ParameterError: The file of the first recording, or its journal, exists.
    """
    for number in itertools.count(1):
        path = record if number == 1 else record.with_name(f"{record.stem}-{number}{record.suffix}")
        existing = next(
            (
                candidate
                for candidate in (path.with_suffix(JOURNAL_SUFFIX), path)
                if os.path.lexists(candidate)
            ),
            None,
        )
        if existing is None:
            return path
        if first:
            advice = (
                f" (nermo-mjx replay {existing} makes what was driven again)"
                if existing.suffix == JOURNAL_SUFFIX
                else ""
            )
            raise ParameterError(
                f"record is {record}: {existing} exists{advice}; name another file."
            )
    raise AssertionError
