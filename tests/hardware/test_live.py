# Tests of hardware/live.py
"""The robot's servo commands in the author's order, and sent to it, by way of a broker and a bridge on this machine."""

from __future__ import annotations

import json
import re
import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from command import json_of, run_command
from fakes import wires

from nermo_mjx import Setup, servo_table
from nermo_mjx.hardware import connected, send_table
from nermo_mjx.hardware.live import SendError
from nermo_mjx.robot import LIMBS, ParameterError

ORDER = [f"{limb}_{servo}" for limb in LIMBS for servo in ("hip", "knee")]


@pytest.fixture(scope="module")
def published():
    """A trot at 0.8 Hz with spine and swinging tail, in the author's order."""
    setup = Setup(tail="articulated", tail_motion="swing", spine="stride_extension")
    return servo_table(setup, {"frequency": 0.8}, channels="published")


@pytest.mark.release
def test_the_published_order_is_that_of_the_authors_software(published) -> None:
    """Leg by leg, then tail, neck, head and spine, at 30 Hz, cut to whole degrees, with the tail against ours."""
    assert list(published.names) == [*ORDER, "tail", "neck", "head", "spine"]
    assert published.rate == pytest.approx(30.0, rel=0.02)
    ours = servo_table(
        Setup(tail="articulated", tail_motion="swing", spine="stride_extension"),
        {"frequency": 0.8},
        rate=published.rate,
    )
    signs = {"tail": -1.0}
    for name, column in zip(published.names, published.angles.T, strict=True):
        expected = (
            0.0 if name == "head" else signs.get(name, 1.0) * ours.angles[:, ours.names.index(name)]
        )
        np.testing.assert_allclose(column, expected, atol=1e-4)
    np.testing.assert_array_equal(published.given, published.angles.astype(int))
    assert np.abs(published.given - published.angles).max() > 0.9, "cut, and not rounded"
    # His spine and tail at phase 0: 0.4 and 0.5 rad, both cosines.
    np.testing.assert_allclose(published.angles[0, [11, 8]], np.degrees([0.4, 0.5]), atol=0.01)
    row = published.to_csv().splitlines()[-1].split(",")
    assert [float(cell) for cell in row[1:]] == published.given[-1].tolist()
    assert all("." not in cell for cell in row[1:])


@pytest.mark.release
def test_the_rigid_tail_is_given_what_is_missing() -> None:
    table = servo_table(channels="published")
    assert table.names[8] == "tail"
    np.testing.assert_array_equal(table.given[:, [8, 10]], 0.0)


@pytest.mark.release
def test_rows_are_sent_at_their_times_again_and_again(published) -> None:
    """Three cycles: each row at its time, and after the last one the first."""
    clock, packets = wires.Clock(), []
    report = send_table(
        published,
        lambda angles, angles_of_packet: packets.append((clock.now - 100.0, angles_of_packet)),
        3 / 0.8,
        clock=clock,
        wait=clock.wait,
    )
    rows = len(published.time)
    assert (report.messages, report.skipped, len(packets)) == (3 * rows, 0, 3 * rows)
    np.testing.assert_allclose(
        [time for time, _ in packets], np.arange(3 * rows) / published.rate, atol=1e-9
    )
    np.testing.assert_array_equal(
        [angles_of_packet for _, angles_of_packet in packets], np.tile(published.given, (3, 1))
    )


def test_what_is_late_is_left_out(published) -> None:
    """After half a second in which nothing could be sent the gait is where it would be without."""
    clock, packets = wires.Clock(jump_at=0.5, jump=0.5), []
    report = send_table(
        published,
        lambda angles, angles_of_packet: packets.append((clock.now - 100.0, angles_of_packet)),
        2.0,
        clock=clock,
        wait=clock.wait,
    )
    assert report.skipped == pytest.approx(0.5 * published.rate, abs=1)
    for time, angles_of_packet in packets:
        row = int(time * published.rate + 1e-6)
        np.testing.assert_array_equal(angles_of_packet, published.given[row % len(published.time)])


@pytest.fixture(scope="module")
def broker() -> Iterator[int]:
    """An MQTT broker on this machine; its port."""
    with wires.broker() as port:
        yield port


@pytest.mark.extra
def test_a_broker_passes_on_what_the_author_sent(published, broker) -> None:
    """A subscriber gets every message of half a second, in order: JSON lists of twelve whole degrees."""
    import paho.mqtt.client as mqtt

    payloads: list[bytes] = []
    listening = threading.Event()
    listener = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    listener.on_message = lambda client, data, message: payloads.append(message.payload)
    listener.on_subscribe = lambda *arguments: listening.set()
    listener.connect("127.0.0.1", broker)
    listener.loop_start()
    listener.subscribe("q_values")
    assert listening.wait(10)
    with connected(f"mqtt://127.0.0.1:{broker}") as send:
        report = send_table(published, send, 0.5)
    wires.until(lambda: len(payloads) >= report.messages, 10.0)
    listener.disconnect()
    listener.loop_stop()
    assert report.messages + report.skipped == int(np.ceil(0.5 * published.rate))
    assert len(payloads) == report.messages
    if not report.skipped:
        assert [json.loads(payload) for payload in payloads] == published.given[
            : report.messages
        ].astype(int).tolist()
    assert payloads[0] == json.dumps(published.given[0].astype(int).tolist()).encode()


def test_a_bridge_gets_radians(published) -> None:
    """By rosbridge's protocol: the topic is advertised with its type, and each message is a Float32MultiArray."""
    from websockets.sync.server import serve

    messages: list[dict] = []
    with serve(
        lambda peer: messages.extend(json.loads(entry) for entry in peer), "127.0.0.1", 0
    ) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with connected(
            f"ws://127.0.0.1:{server.socket.getsockname()[1]}", "nermo/q_values"
        ) as send:
            send_table(published, send, 0.2)
        server.shutdown()
        thread.join(10)
    topic = "/nermo/q_values"
    assert messages[0] == {
        "op": "advertise",
        "topic": topic,
        "type": "std_msgs/msg/Float32MultiArray",
    }
    assert messages[-1] == {"op": "unadvertise", "topic": topic}
    assert {(entry["op"], entry["topic"]) for entry in messages[1:-1]} == {("publish", topic)}
    message = messages[1]["msg"]
    assert message["layout"] == {"dim": [], "data_offset": 0}
    np.testing.assert_allclose(message["data"], np.radians(published.angles[0]), atol=1e-6)


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        pytest.param(
            "mqtt://127.0.0.1:9",
            "127.0.0.1:9: no MQTT broker answers there",
            marks=pytest.mark.extra,
        ),
        ("ws://127.0.0.1:9", "127.0.0.1:9: no rosbridge server answers there"),
    ],
)
def test_nobody_there_is_a_sentence(url: str, sentence: str) -> None:
    wires.needs(*["paho"] * url.startswith("mqtt"))
    with pytest.raises(SendError, match=sentence), connected(url):
        pass


@pytest.mark.extra
def test_the_command_sends_and_says_how_it_went(broker) -> None:
    send = ("--send", f"mqtt://127.0.0.1:{broker}", "--seconds", "0.19")
    report = json_of("servos", "--channels", "published", *send)["sent"]
    assert report["messages"] + report["skipped"] == 6


class Broker(threading.Thread):
    """Answers, takes messages for a while, and is gone."""

    def __init__(self, life: float) -> None:
        super().__init__(daemon=True)
        self.socket, self.life, self.got = socket.create_server(("127.0.0.1", 0)), life, b""
        self.port = self.socket.getsockname()[1]
        self.start()

    def run(self) -> None:
        peer, _ = self.socket.accept()
        self.got = peer.recv(1024)
        peer.sendall(bytes([0x20, 2, 0, 0]))
        peer.settimeout(self.life)
        timer = threading.Timer(self.life, lambda: peer.shutdown(socket.SHUT_RDWR))
        timer.start()
        while peer.recv(4096):
            pass
        peer.close()
        self.socket.close()


@pytest.mark.release
def test_a_broker_that_goes_away_is_noticed_and_the_password_unquoted() -> None:
    pytest.importorskip("paho.mqtt.client")
    broker = Broker(0.5)
    url = f"mqtt://us%40er:p%2Fss@127.0.0.1:{broker.port}"
    process = run_command(["servos", "--channels", "published", "--seconds", "2", "--send", url])
    assert process.returncode == 1, process.stderr
    sent_count, lost_count = map(
        int,
        re.search(
            r"broker is gone: (\d+) messages were sent, (\d+) were not", process.stderr
        ).groups(),
    )
    assert sent_count > 3
    assert lost_count > 20
    assert b"us@er\x00\x04p/ss" in broker.got


def test_a_bridge_that_goes_away_is_noticed() -> None:
    from websockets.sync.server import serve

    def leave(peer: Any) -> None:
        for _ in range(6):
            peer.recv()

    with serve(leave, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        with (
            pytest.raises(
                ParameterError, match=r"server is gone: \d+ messages were sent, \d+ were not"
            ),
            connected(address) as send,
        ):
            send_table(servo_table(channels="published"), send, 2.0)
        server.shutdown()
        thread.join(10)


@pytest.mark.extra
@pytest.mark.parametrize("scheme", ["mqtt", "ws"])
@pytest.mark.parametrize(
    "address",
    [
        "u:s3cret@h:99999",
        "u:s3cret/x@h",
        "u:s3#cret@h",
        ":s3cret@h",
        "u:x@s3cret@h:0",
        "u:s3cret@[::1",
        "u:s3cret@127.0.0.1:9",
        "s3cret@127.0.0.1:9",
    ],
)
def test_no_password_is_repeated(scheme: str, address: str) -> None:
    pytest.importorskip("paho.mqtt.client")
    for url in (f"{scheme}://{address}", f"{scheme}s://{address}", address):
        with pytest.raises(ParameterError) as error:
            connected(url).__enter__()
        assert "s3" not in str(error.value)
        assert "cret" not in str(error.value)
