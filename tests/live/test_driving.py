# Tests of live/driving.py, live/server.py
"""A controller under commands, who gets in and what a page may say, keys, gamepad and pushes, and the drive again."""

from __future__ import annotations

import contextlib
import errno
import json
import re
import signal
import socket as sockets
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import chromium
import firefox
import numpy as np
import pytest
from command import call, json_of
from fakes.wires import until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from nermo_mjx.control.controller import published_controller
from nermo_mjx.control.schedule import Switch
from nermo_mjx.live.driving import Driving, difference, replay_drive
from nermo_mjx.live.server import MAX_CONNECTIONS, REPLACEMENT_CODE, LiveDrive, free
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import values_of
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.sweep import Sweep

pytestmark = pytest.mark.usefixtures("shared_simulators")


@pytest.fixture(scope="module")
def running() -> Driving:
    return Driving(Setup(pilot="open_loop"), {"frequency": 0.8})


def walked(
    driving: Driving, ticks: int, commands=(), callback=lambda: None
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (ticks, nq) and servo targets (ticks, n_servos) under commands; `after` is called after each tick."""
    driving.reset()
    for tick in range(ticks):
        for tick_of_switch, switch in commands:
            if tick_of_switch == tick:
                driving.command(switch)
        driving.tick()
        callback()
    recording = driving.recording()
    return recording.qpos, recording.ctrl


@pytest.mark.release
def test_without_a_command_it_is_a_walk_bit_for_bit():
    """With a given controller, whose program has no more modes."""
    setup = Setup(controller=published_controller(("stride_extension",), "open_loop"))
    qpos, ctrl = walked(Driving(setup, {"frequency": 0.8}), 120)
    trace = Simulator(setup, "c").run({"frequency": 0.8}, Run(duration=1.2), record=True).trace
    np.testing.assert_array_equal(qpos, trace.qpos[0, :120])
    np.testing.assert_array_equal(ctrl, trace.ctrl[0, :120])


@pytest.mark.release
def test_it_switches_as_a_schedule_does():
    """A gait and a mode that it did not start with; the frequency, on which a blend's length hangs, stays."""
    switch = Switch(0.8, gait="lateral_walk", spine="stride_extension", values={"stride": 0.7})
    setup = Setup(pilot="open_loop", schedule=(switch,))
    trace = Simulator(setup, "c").run({"frequency": 0.8}, Run(duration=2.5), record=True).trace
    qpos, ctrl = walked(Driving(setup, {"frequency": 0.8}), 250)
    np.testing.assert_allclose(ctrl, trace.ctrl[0, :250], atol=2e-3)
    np.testing.assert_allclose(qpos[:, :3], trace.qpos[0, :250, :3], atol=2e-3)


@pytest.mark.release
def test_commands_within_a_blend_are_continuous_and_make_the_run_again_bit_for_bit(running):
    commands = [
        (50, Switch(0, gait="lateral_walk")),
        (80, Switch(0, spine="stride_extension", values={"frequency": 1.1})),
        (120, Switch(0, gait="trot", values={"pilot.turn_rate": 0.5})),
        (150, Switch(0, spine="none", blend=0.3)),
    ]
    first = walked(running, 250, commands)
    switch_commands = list(running.commands)
    assert [tick for tick, _ in switch_commands] == [50, 80, 120, 150]
    steady = np.abs(np.diff(walked(running, 250)[1], axis=0)).max()
    for first_array, second_array in zip(first, walked(running, 250, switch_commands), strict=True):
        np.testing.assert_array_equal(first_array, second_array)
    assert np.abs(np.diff(first[1], axis=0)).max() < 2 * steady
    spine = first[1][:, running.simulator.robot.servos.index("spine")]
    assert np.ptp(spine[:50]) == 0 < np.ptp(spine[100:150])


@pytest.mark.release
def test_a_command_beside_a_longer_one_leaves_it_its_length(running):
    """A slider that is moved while the gait changes: the gait is that of the gait's command alone, tick by tick."""
    gait, stride = (
        Switch(0, gait="lateral_walk", blend=1.0),
        Switch(0, values={"stride": 0.8}, blend=0.1),
    )

    def now(driving: Driving) -> list[float]:
        values = dict(values_of(driving.control))
        return [float(np.asarray(values[name])[0]) for name in ("duty", "stride")]

    readings: dict[str, list[list[float]]] = {}
    for name, commands in {
        "gait": [(20, gait)],
        "both": [(20, gait), (50, stride), (60, stride)],
    }.items():
        readings[name] = []
        walked(running, 200, commands, lambda name=name: readings[name].append(now(running)))
    duty, stride = np.array(readings["both"]).T
    np.testing.assert_allclose(duty, np.array(readings["gait"])[:, 0], atol=1e-6)
    assert duty[20] == 0.5 < duty[82] < 0.6 < duty[-1] == pytest.approx(0.68)
    assert stride[49] == 1.0 > stride[56] > stride[-1] == pytest.approx(0.8)
    running.command(gait)
    running.command(Switch(0, gait="trot"))
    with pytest.raises(ParameterError, match="beside the change before"):
        running.command(Switch(0, values={"frequency": 0.1}))


@pytest.mark.release
@pytest.mark.parametrize(
    ("switch", "sentence"),
    [
        (Switch(0, values={"frequency": 9}), r"frequency is 9: allowed is \[0.001, 5\] Hz"),
        (Switch(0, values={"frequency": 1e-20}), r"frequency is 1e-20: allowed is \[0.001, 5\] Hz"),
        (
            Switch(0, values={"frequency": 0.000999}),
            r"frequency is 0.000999: allowed is \[0.001, 5\] Hz",
        ),
        (Switch(0, values={"froquency": 1}), r"'froquency': did you mean 'frequency'"),
        (Switch(0, values={"contact.friction": 1}), r"'contact.friction'"),
        (
            Switch(0, values={"stride": 1.2, "stance.max_stride": 0.08}),
            r"stride is 1.2: .* allowed is \[0, 1.050\]",
        ),
        (Switch(0, spine="pitch_balance"), r"spine is 'pitch_balance'.*allowed"),
        (
            Switch(0, gait="lateral_walk", blend=0.1),
            r"blend is 0.1: allowed is more than 0.32 cycles",
        ),
        (Switch(0, gait="lateral_walk", blend=0.0), r"blend is 0: allowed is \[0.05, 100\]"),
    ],
)
def test_a_command_that_is_refused_changes_nothing(running, switch, sentence):
    reference = walked(running, 30)[1]
    with pytest.raises(ParameterError, match=sentence):
        running.command(switch)
    assert running.commands == []
    running.reset()
    with pytest.raises(ParameterError):
        running.command(switch)
    running.tick()
    np.testing.assert_array_equal(running.recording().ctrl[0], reference[0])


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Iterator[LiveDrive]:
    """One that runs in a thread."""
    live_drive = LiveDrive(
        Driving(Setup(pilot="open_loop"), {"frequency": 0.8}),
        tmp_path_factory.mktemp("drive") / "drive.npz",
    )
    thread = threading.Thread(target=live_drive.run)
    thread.start()
    yield live_drive
    live_drive.over = True
    thread.join(30)


@pytest.fixture
def page(drive):
    """A socket that drives, as a page would open it."""
    with socket(drive) as opened:
        said(
            opened,
            condition=lambda state: not state["paused"] and state["speed"] == 1.0,
            pause=False,
            speed=1.0,
        )
        opened.send('{"reset": true}')
        while isinstance(state := opened.recv(timeout=30), bytes) or "restart" not in state:
            if isinstance(state, bytes):
                opened.send(json.dumps({"shown": int.from_bytes(state[:4], "little")}))
        yield opened


def socket(drive: LiveDrive, **headers):
    address = drive.address.replace("http", "ws") + "socket"
    origin = headers.pop("origin", drive.address.rpartition("/")[0].rpartition("/")[0])
    return connect(address, origin=origin, compression=None, additional_headers=headers)


def said(page, text: str | bytes = "", condition=None, **message) -> dict:
    """The first state after a message that has the values of the message, or what is wanted."""
    page.send(text or json.dumps(message))
    condition = condition or (
        lambda state: all(state.get(name, value) == value for name, value in message.items())
    )
    while True:
        state = page.recv(timeout=30)
        if isinstance(state, bytes):
            page.send(json.dumps({"shown": int.from_bytes(state[:4], "little")}))
        elif "restart" not in (message_of_page := json.loads(state)) and condition(message_of_page):
            return message_of_page


def status(address: str, **headers) -> int:
    try:
        with urllib.request.urlopen(
            urllib.request.Request(address, headers=headers), timeout=10
        ) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.release
def test_only_its_own_page_gets_in(drive):
    address = drive.address
    assert address.startswith("http://127.0.0.1:")
    assert status(address) == 200
    assert (
        status(address[:-2] + "x/")
        == status(address.rpartition("/")[0].rpartition("/")[0] + "/")
        == 404
    )
    assert status(address, Host="attacker.example") == 403
    for origin in ("http://attacker.example", None):
        with pytest.raises(InvalidStatus, match="403"):
            socket(drive, origin=origin)


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        ("garbage", "invalid JSON"),
        (b"\0\1", "invalid JSON"),
        ("[1, 2]", "message:"),
        ('{"speed": NaN}', "speed"),
        ('{"speed": 1e9}', "speed: input should be less than or equal to 4"),
        ('{"open": "a file"}', "open: extra inputs are not permitted"),
        ('{"set": {"frequency": 9}}', r"frequency is 9: allowed is [0.001, 5] Hz."),
        ('{"gait": "walzer"}', "gait is 'walzer'"),
        ('{"set": {}, "gait": "trot", "blend": 0.001}', "blend is 0.001"),
        ('{"push": {"body": 0, "force": [1, 0, 0], "seconds": 0.1}}', "push.body is 0"),
        ('{"push": {"body": 1, "force": [99, 0, 0], "seconds": 0.1}}', "push.force"),
    ],
)
def test_garbage_is_refused_in_a_sentence_and_changes_nothing(drive, page, message, sentence):
    counts = len(drive.driving.commands), len(drive.driving.pushes), drive.speed
    refusal = said(page, message, lambda state: "refused" in state)["refused"]
    assert sentence in refusal
    assert refusal.endswith(".")
    assert (len(drive.driving.commands), len(drive.driving.pushes), drive.speed) == counts
    assert not drive.paused


def test_a_message_that_is_too_long_ends_the_page_and_pauses(drive, page):
    page.send("x" * 5000)
    assert closed(page) == 1009
    assert paused(drive)


def closed(page) -> int:
    """The code with which the drive closes a page's socket."""
    try:
        while True:
            page.recv(timeout=10)
    except ConnectionClosed as end:
        return end.rcvd.code


def paused(drive: LiveDrive) -> bool:
    """Whether it pauses soon, and stands still then."""
    until(lambda: drive.paused, 10.0)
    ticks = drive.driving.ticks
    time.sleep(0.2)
    return drive.paused and drive.driving.ticks == ticks


def test_a_second_page_takes_over_and_one_that_goes_away_pauses(drive, page):
    with socket(drive) as second:
        said(second, speed=0.5)
        assert closed(page) == REPLACEMENT_CODE
        assert not drive.paused
    assert paused(drive)
    with socket(drive) as third:
        assert said(third, speed=1.0)["paused"]
        said(third, condition=lambda state: not state["paused"], pause=False)


@pytest.mark.release
def test_a_drive_is_made_again_bit_for_bit(tmp_path):
    driving = Driving(
        Setup(pilot="open_loop", schedule=(Switch(0.4, values={"stride": 0.8}),)),
        {"frequency": 0.8},
    )
    for tick in range(150):
        if tick == 50:
            driving.command(Switch(driving.time, gait="lateral_walk", spine="stride_extension"))
        if tick == 70:
            driving.push(1, (1.5, 0.0, 0.5), 0.2)
        driving.tick()
    recording = Recording.load(driving.recording().save(tmp_path / "drive.npz"))
    replayed_recording = replay_drive(recording)
    assert difference(recording, replayed_recording) is None
    assert json_of("replay", tmp_path / "drive.npz")["equal"]
    # What happened mattered.
    calm = dict(recording.metadata["driven"]) | {"pushes": []}
    calm_recording = Recording(
        **{**vars(recording), "metadata": {**recording.metadata, "driven": calm}}
    )
    assert difference(recording, replay_drive(calm_recording)) == pytest.approx(0.71)
    with pytest.raises(RecordingError, match="not of a drive"):
        replay_drive(Recording(**{**vars(recording), "metadata": {}}))
    table = json_of("servos", "--recording", tmp_path / "drive.npz", "--out", tmp_path / "t.csv")
    assert table["rows"] > 50


@pytest.mark.release
def test_a_sweep_walks_as_was_driven(tmp_path):
    """The file that `replay --sweep` writes; more commands than a schedule has are refused in a sentence."""
    driving = Driving(Setup(pilot="open_loop"), {"frequency": 0.8, "pilot.turn_rate": 0.2})
    for tick in range(150):
        if tick == 20:
            driving.command(Switch(driving.time, blend=0.15, values={"stride": 0.8}))
        if tick == 60:
            driving.command(Switch(driving.time, gait="lateral_walk", spine="stride_extension"))
        driving.tick()
    file, recorded = tmp_path / "drive.npz", driving.recording()
    recorded.save(file)
    answer = call("replay", file, "--sweep", tmp_path / "drive.yaml", "--quiet")
    assert answer.exit_code == 0, answer.output
    sweep = Sweep.from_file(tmp_path / "drive.yaml")
    walked = Simulator(sweep.setup, "c").run(sweep.constants, sweep.run, record=True).recording()
    last = len(recorded.time) - 1
    assert walked.time[last] == pytest.approx(recorded.time[last])
    assert np.linalg.norm(recorded.qpos[last, :2]) > 0.05
    np.testing.assert_allclose(walked.qpos[last, :3], recorded.qpos[last, :3], atol=1e-4)
    driven = dict(recorded.metadata["driven"]) | {
        "commands": [[9 * k, {"at": 0.0, "set": {"stride": 0.9}}] for k in range(9)]
    }
    Recording(**{**vars(recorded), "metadata": {**recorded.metadata, "driven": driven}}).save(file)
    refused = call("replay", file, "--sweep", tmp_path / "none.yaml")
    assert (refused.exit_code, "schedule has 9 switches: allowed are 8" in refused.stderr) == (
        2,
        True,
    ), refused.output
    assert not (tmp_path / "none.yaml").exists()


def test_the_command_prints_its_address_and_waits_for_a_page(tmp_path):
    answer = call(
        "drive", "--no-browser", "--seconds", "0.1", "--record", tmp_path / "d.npz", "--json"
    )
    assert answer.exit_code == 0, answer.output
    assert "drive: http://127.0.0.1:" in answer.stderr
    assert json.loads(answer.stdout) == {
        "files": [],
        "seconds": 0.0,
        "factor": 1.0,
        "delay": None,
        "delay_95": None,
    }
    assert not (tmp_path / "d.npz").exists()


# ---
# Nothing ends the loop, and it waits for nothing.


def test_any_error_of_a_message_is_a_refusal(drive, page, monkeypatch):
    """Of a controller of one's own, for example."""

    def failing(*_):
        raise ZeroDivisionError("of a cycle")

    with monkeypatch.context() as patched:
        patched.setattr(drive.driving, "command", failing)
        answer = said(page, '{"set": {"stride": 0.8}}', lambda state: "refused" in state)
        assert answer["refused"] == "that failed: ZeroDivisionError('of a cycle')."
        patched.setattr(drive.driving, "push", failing)
        push = '{"push": {"body": 1, "force": [1, 0, 0], "seconds": 0.1}}'
        assert "that failed" in said(page, push, lambda state: "refused" in state)["refused"]
    assert said(page, speed=1.0)["speed"] == 1.0


def test_a_switch_that_comes_due_is_refused_as_a_command_is_and_the_drive_goes_on(drive, page):
    drive.driving._due = [Switch(0.0, values={"stride": 1.2, "stance.max_stride": 0.08})]
    assert (
        "stride is 1.2" in said(page, '{"speed": 1.0}', lambda state: "refused" in state)["refused"]
    )
    ticks = drive.driving.ticks
    until(lambda: drive.driving.ticks > ticks + 5)


@pytest.mark.release
@pytest.mark.parametrize(
    "message",
    [
        "garbage",
        *(
            pytest.param(message, marks=pytest.mark.release)
            for message in ('{"set": {"stride": 0.8}}', '{"shown": 1}')
        ),
    ],
)
def test_a_page_that_sends_without_reading_stops_neither_time_nor_a_second_page(drive, message):
    with socket(drive) as first:
        said(first, condition=lambda state: not state["paused"], pause=False, speed=1.0)
        stop = threading.Event()

        def flood() -> None:
            with contextlib.suppress(ConnectionClosed):
                while not stop.is_set():
                    first.send(message)

        sender = threading.Thread(target=flood)
        sender.start()
        time.sleep(1.0)
        ticks = drive.driving.ticks
        with socket(drive) as second:
            until(
                lambda: (
                    drive._page is not None and drive._page.remote_address == second.local_address
                ),
                10,
            )
            until(lambda: drive.driving.ticks > ticks + 30, 10)
            stop.set()
            said(second, speed=0.5)
        sender.join(10)
    second_socket = socket(drive)
    said(second_socket, condition=lambda state: not state["paused"], pause=False, speed=1.0)
    second_socket.close()


def test_connections_that_do_not_get_in_make_room_for_those_that_do(drive, page):
    port = int(drive.address.split(":")[2].split("/")[0])
    idle = [sockets.create_connection(("127.0.0.1", port), 5) for _ in range(MAX_CONNECTIONS + 5)]
    assert status(drive.address) == 200
    assert len(drive._connections) <= MAX_CONNECTIONS
    said(page, speed=1.0)
    with socket(drive) as second:
        said(second, condition=lambda state: not state["paused"], pause=False)
    for connection in idle:
        connection.close()


@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, "Too many open files"), RuntimeError("can't start new thread")]
)
def test_accepting_goes_on_after_an_error(drive, monkeypatch, error):
    failed, real = list[int](), sockets.socket.accept

    def failing(listening):
        if len(failed) < 3:
            failed.append(1)
            raise error
        return real(listening)

    monkeypatch.setattr(sockets.socket, "accept", failing)
    sockets.create_connection(
        ("127.0.0.1", int(drive.address.split(":")[2].split("/")[0])), 10
    ).close()  # the call that waits
    assert status(drive.address) == 200
    assert len(failed) == 3


@pytest.mark.parametrize(
    "lines",
    [
        ["GET /\u00e4/ HTTP/1.1", "Host: 127.0.0.1"],
        ["GET / HTTP/1.1", "Host: ["],
        ["GET / HTTP/1.1", "Host: 127.0.0.1", "Host: localhost"],
        ["GET / HTTP/1.1", "Host: 127.0.0.1:x"],
        ["GET {token} HTTP/1.1", "Host: 127.0.0.1", "Origin: a", "Origin: b"],
    ],
)
def test_a_request_that_is_none_is_refused(drive, lines):
    port = int(drive.address.split(":")[2].split("/")[0])
    with sockets.create_connection(("127.0.0.1", port), 10) as raw:
        path = "/" + drive.address.split("/", 3)[3] + "socket"
        raw.sendall("\r\n".join([*lines, "", ""]).replace("{token}", path).encode())
        answer = raw.makefile("rb").readline().decode()
    assert not answer or answer.split()[1] in ("400", "403", "404"), answer


def test_the_token_is_not_in_the_process_list(tmp_path, monkeypatch):
    opened = []

    def browser(address: str) -> None:
        path = Path(address.removeprefix("file://"))
        opened.append((address, path.read_text(), path.stat().st_mode & 0o777))

    monkeypatch.setattr("webbrowser.open", browser)
    answer = call("drive", "--seconds", "0.1")
    ((address, text, mode),) = opened
    secret = answer.stderr.split("http://", 1)[1].split()[0]
    assert secret.split("/")[1] not in address
    assert (f"http://{secret}" in text, mode) == (True, 0o600)
    assert not Path(address.removeprefix("file://")).exists()


# ---
# What is driven is on the disk.


@pytest.fixture
def recorded(tmp_path, running):
    """A drive that runs with a page and a file."""
    running.reset()
    live_drive = LiveDrive(running, tmp_path / "d.npz")
    thread = threading.Thread(target=live_drive.run)
    thread.start()
    with socket(live_drive) as page:
        said(page, speed=1.0)
        yield live_drive, page, thread
    live_drive.over = True
    thread.join(30)


@pytest.mark.release
def test_what_is_driven_is_in_a_journal_at_every_moment(recorded, tmp_path):
    """Copies of the file, as a killed process or a power cut would leave it: each makes the samples that were."""
    live_drive, page, thread = recorded
    copies, journal = list[tuple[int, bytes]](), tmp_path / "d.jsonl"
    for k in range(6):
        page.send(
            json.dumps(
                {"set": {"stride": 0.9 - 0.05 * k}, "blend": 0.3}
                if k != 2
                else {"gait": "lateral_walk"}
            )
        )
        push = {"body": 1, "force": [1.0, 0.0, 0.0], "seconds": 0.1}
        page.send(json.dumps({"push": push} if k == 3 else {"speed": 1.0}))
        time.sleep(0.4)
        ticks = live_drive.driving.ticks
        copies.append((ticks, journal.read_bytes()))
    live_drive.over = True
    thread.join(30)
    recording = Recording.load(tmp_path / "d.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["d.npz"]
    for k, (ticks, content) in enumerate(copies):
        torn = content + (b"\0" * 4096 if k % 2 else b'{"commands": [[1')
        (tmp_path / "cut.jsonl").write_bytes(torn)
        replayed_recording = replay_drive(tmp_path / "cut.jsonl")
        assert ticks - 100 <= len(replayed_recording.time) <= len(recording.time)
        assert (
            difference(recording.between(0.0, replayed_recording.time[-1]), replayed_recording)
            is None
        )
    assert len(recording.metadata["driven"]["commands"]) == 6
    answer = call("replay", tmp_path / "cut.jsonl", "--record", tmp_path / "cut.npz", "--quiet")
    assert answer.exit_code == 0, answer.stderr
    assert Recording.load(tmp_path / "cut.npz").metadata["driven"]["commands"]


@pytest.mark.release
def test_a_full_disk_stops_time_until_there_is_room(recorded, tmp_path):
    live_drive, page, _ = recorded
    journal = live_drive._journal
    real = journal._file

    class Full:
        def write(self, content):
            raise OSError(errno.ENOSPC, "No space left on device")

        def __getattr__(self, name):
            return getattr(real, name)

    journal._file = Full()
    refusal = said(page, '{"set": {"stride": 0.8}}', lambda state: "refused" in state)["refused"]
    assert (
        refusal
        == f"{tmp_path / 'd.jsonl'} cannot be written (No space left on device): time stands still until it can be."
    )
    assert paused(live_drive)
    said(page, '{"pause": false}', lambda state: "refused" in state)
    journal._file = real
    until(lambda: journal.error is None)
    said(page, condition=lambda state: not state["paused"], pause=False)
    until(lambda: len(replay_drive(tmp_path / "d.jsonl").metadata["driven"]["commands"]) == 1)


@pytest.mark.release
def test_where_the_recording_cannot_be_written_the_journal_stays(recorded, tmp_path, monkeypatch):
    live_drive, page, thread = recorded
    until(lambda: live_drive.driving.ticks > 20)

    def failing(self, path):
        raise RecordingError(f"{path}: the recording cannot be written (No space left on device).")

    monkeypatch.setattr(Recording, "save", failing)
    said(page, reset=True)
    until((tmp_path / "d-2.jsonl").exists)
    until(lambda: live_drive.driving.ticks > 20)
    live_drive.over = True
    thread.join(30)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d-2.jsonl", "d.jsonl"]
    assert "d-2.jsonl, for `nermo-mjx replay`" in live_drive.failure
    for name in ("d.jsonl", "d-2.jsonl"):
        assert len(replay_drive(tmp_path / name).time) > 20


@pytest.mark.release
def test_a_file_that_exists_is_never_replaced(tmp_path, running):
    existing = {name: tmp_path / name for name in ("d.npz", "d-2.npz", "e.jsonl", "f-3.jsonl")}
    for path in existing.values():
        path.write_text("mine")
    for name, why in (("d.npz", "d.npz exists;"), ("e.npz", r"e.jsonl exists .nermo-mjx replay")):
        answer = call("drive", "--no-browser", "--record", tmp_path / name)
        assert answer.exit_code == 2
        assert re.search(why, answer.stderr), answer.stderr
        assert "compiling" not in answer.stderr
    assert free(tmp_path / "d.npz", first=False).name == "d-3.npz"
    assert free(tmp_path / "f.npz").name == "f.npz"
    running.reset()
    live_drive = LiveDrive(running, tmp_path / "f.npz")
    live_drive._began = True
    (tmp_path / "f.npz").write_text("mine")  # meanwhile
    live_drive.driving.tick()
    live_drive.run(0.2)
    assert live_drive.files == [tmp_path / "f-2.npz"]
    assert all(path.read_text() == "mine" for path in (*existing.values(), tmp_path / "f.npz"))


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP])
def test_a_drive_outlives_every_signal(number, tmp_path):
    """A terminal that closes saves it, as Ctrl-C does; of one that is killed there is the journal."""
    words = [
        sys.executable,
        "-m",
        "nermo_mjx",
        "drive",
        "--no-browser",
        "--record",
        str(tmp_path / "d.npz"),
    ]
    streams = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    # Tests may run under `nohup`, whose ignored signal a child would inherit.
    with subprocess.Popen(
        words, **streams, preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)
    ) as process:
        try:
            address = next(line for line in process.stderr if "http://" in line).split()[-1]
            origin = address.rpartition("/")[0].rpartition("/")[0]
            with connect(f"ws{address[4:]}socket", origin=origin, compression=None) as page:
                page.send('{"set": {"stride": 0.8}}')
                driven = 0.0
                while driven < 1.5:
                    packet = page.recv(timeout=10)
                    if isinstance(packet, bytes):
                        driven = float(np.frombuffer(packet, "<f4", 1, 4)[0])
                        page.send(json.dumps({"shown": int.from_bytes(packet[:4], "little")}))
                process.send_signal(number)
                process.wait(30)
        finally:
            process.kill()
    remaining_file = tmp_path / ("d.jsonl" if number == signal.SIGKILL else "d.npz")
    assert [path.name for path in tmp_path.iterdir()] == [remaining_file.name]
    assert process.returncode == (-9 if number == signal.SIGKILL else 0)
    replayed_recording = replay_drive(
        remaining_file if number == signal.SIGKILL else Recording.load(remaining_file)
    )
    assert replayed_recording.time[-1] > driven - 1.0
    assert replayed_recording.metadata["driven"]["commands"][0][1]["set"] == {"stride": 0.8}


@pytest.mark.release
@pytest.mark.parametrize("module", [chromium, firefox], ids=["chromium", "firefox"])
def test_the_robot_follows_keys_gamepad_and_hand(drive, module):
    running = drive.driving
    with module.page() as tab:
        tab.open(drive.address)
        tab.wait('document.documentElement?.dataset.ready === "yes"')
        tab.wait("viewer.drive.socket.readyState === WebSocket.OPEN")
        tab.evaluate("viewer.drive.send({reset: true, pause: false, speed: 1})")
        tab.wait("viewer.drive.state.paused === false && viewer.player.time > 0.3")
        tab.key("v")
        tab.wait('viewer.drive.state.gait === "walking_trot"')
        tab.key("x")
        tab.wait('viewer.drive.state.spine === "stride_extension"')
        assert running.modes["spine"] == {"stride_extension"}
        tab.key("ArrowDown")
        tab.wait("Math.abs(viewer.drive.state.values.stride - 0.9) < 1e-6")
        # A key that is held turns, and no longer when it is released.
        tab.evaluate('dispatchEvent(new KeyboardEvent("keydown", {key: "a"}))')
        tab.wait('viewer.drive.state.values["pilot.turn_rate"] > 0.5')
        tab.evaluate('dispatchEvent(new KeyboardEvent("keyup", {key: "a"}))')
        tab.wait('viewer.drive.state.values["pilot.turn_rate"] === 0')
        # A stick to the right turns right, and the robot follows.
        # Over a gait cycle, in which the torso sways by 10 degrees to either side.
        tab.evaluate("""(window.yaw = () => {
            const clip = viewer.clips[0], yaw = clip.plots.find((plot) => plot.key === "attitude").lines[2].values;
            const last = yaw.subarray(clip.rowAt(clip.end - 1.25)).filter((each) => !Number.isNaN(each));
            return last.reduce((sum, each) => sum + each, 0) / last.length;
        }, 1)""")
        tab.evaluate(
            "(window.pad = {connected: true, axes: [0.8, -1], buttons: []}, "
            "navigator.getGamepads = () => [window.pad], 1)"
        )
        tab.wait('viewer.drive.state.values["pilot.turn_rate"] < -0.7')
        initial_yaw = tab.evaluate("yaw()")
        tab.wait(f"yaw() < {initial_yaw - 10}")
        tab.evaluate(
            "(window.pad = {connected: true, axes: [0, 0], buttons: [{pressed: true}]}, 1)"
        )
        tab.wait(
            'viewer.drive.state.gait === "lateral_walk" && viewer.drive.state.values.stride === 0'
        )
        # On a telephone nothing is wider than the window, and all sliders are there; Firefox has no narrower window.
        tab.resize(390, 844)
        tab.wait("innerWidth <= 500 && document.documentElement.scrollWidth <= innerWidth")
        boxes = "[...document.querySelectorAll('#drive input')].map((each) => each.getBoundingClientRect())"
        assert tab.evaluate(
            f"{boxes}.every((box) => box.width > 60 && box.left >= 0 && box.right <= innerWidth)"
        )
        tab.resize(1280, 720)
        if tab.evaluate("viewer.stage !== null"):  # a Firefox without a screen draws no picture
            # A drag with Shift pushes the body that is next to it.
            tab.evaluate("""(() => {
                const canvas = document.getElementById("canvas");
                const {left, top, width, height} = canvas.getBoundingClientRect();
                const at = (kind, x, y) => canvas.dispatchEvent(new PointerEvent(kind, {shiftKey: true, pointerId: 1,
                    bubbles: true, clientX: left + x * width, clientY: top + y * height}));
                canvas.setPointerCapture = () => {};
                at("pointerdown", 0.5, 0.5); at("pointermove", 0.6, 0.5); at("pointerup", 0.6, 0.5);
            })()""")
            until(lambda: drive.driving.pushes)
            assert np.linalg.norm(drive.driving.pushes[0].force) > 0.2
        # Of each picture that is shown the page tells when; how many a second is the machine's.
        until(lambda: len(drive.delays) > 50, chromium.PATIENCE)
        tab.key(" ")
        tab.wait("viewer.drive.state.paused")
        # What comes long after the last row is joined to it by no line.
        check_script = """((later) => {
            const {clip} = viewer.drive, before = clip.time.length, row = new Float32Array(clip.width);
            row[0] = clip.end + later;
            clip.append(row);
            return [clip.time.length - before, clip.lines.every(({values}) => Number.isNaN(values.at(-2)))];
        })"""
        assert tab.evaluate(f"{check_script}(0.09)") == [1, False]
        assert tab.evaluate(f"{check_script}(0.2)") == [2, True]
        assert tab.complaints() == []
        loaded = tab.requests() if module is chromium else []
        assert [url for url in loaded if not url.startswith(drive.address)] == []
    assert paused(drive)
    path = drive.driving.recording().save(Path(drive.record).with_name("browser.npz"))
    recording = Recording.load(path)
    assert difference(recording, replay_drive(recording)) is None
