"""drive.py as a process, over real sockets: the simulator's session, requests of other sites, other clients."""

import json
import queue
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import socketio
from drive_process import awaited, serving
from steer_server import unused_port

from tools.attacks import WEBSOCKET
from tools.simulator_client import Simulator, fragments, telemetry

LINGER = struct.pack("hh" if sys.platform == "win32" else "ii", 1, 0)  # close without waiting: struct linger


@pytest.fixture(scope="module")
def server(model_file):
    with serving(model_file) as process:
        yield process


def test_the_recorded_session_byte_by_byte(server, jpegs, steering):
    """The transcript of the real simulator's session: handshake, ping, driving, a human's intervention, end."""
    raw = socket.create_connection(("127.0.0.1", server.port), 10)
    raw.sendall(
        b"GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\n"
        b"Host: 127.0.0.1:%d\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n" % server.port
    )
    stream = raw.makefile("rb")

    def frame() -> bytes:
        first, length = stream.read(2)
        length = int.from_bytes(stream.read(2), "big") if length == 126 else length
        assert first in (0x81, 0x88)
        payload = stream.read(length)
        return payload if first == 0x81 else b"CLOSE"

    def send(message):
        for fragment in fragments(message):
            raw.sendall(fragment)

    head = b"".join(iter(stream.readline, b"\r\n"))
    assert head.startswith(b"HTTP/1.1 101 ")
    assert b"Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n" in head  # RFC 6455's own example
    assert b"Extensions" not in head
    opening = rb'0\{"sid":"[\w-]+","upgrades":\[\],"pingTimeout":60000,"pingInterval":25000,"maxPayload":1000000\}'
    assert re.fullmatch(opening, frame())
    assert frame() == b'42["steer",{"steering_angle":"0","throttle":"0"}]'
    assert re.fullmatch(rb'40\{"sid":"[\w-]+"\}', frame()), "which its decoder ignores"
    send("2")
    assert frame() == b"3"
    for jpeg, expected in zip(jpegs, steering, strict=True):
        send("42" + json.dumps(["telemetry", telemetry(jpeg, speed="9.0000")], separators=(",", ":")))
        answer = re.fullmatch(rb'42\["steer",\{"steering_angle":"(-?[\d.]+)","throttle":"0"\}\]', frame())
        assert answer and np.float32(answer[1].decode()) == expected, "the same steering as on disk, to the last bit"
    send('42["telemetry",null]')
    assert frame() == b'42["manual",{}]'
    send("41")
    send("1")
    raw.sendall(fragments((1000).to_bytes(2, "big"), opcode=8)[0])
    assert frame() == b"CLOSE"
    assert stream.read() == b""
    raw.close()


BROKEN = [
    '42["telemetry",{"steering_angle":"0.0000"',
    '42["telemetry"',
    '42["telemetry",' + "[" * 50000,
    '42["telemetry",7]',
    '42["telemetry",{},{},{}]',
    '42["telemetry",{"image":"' + "A" * 20_000_000 + '"}]',
]


@pytest.mark.parametrize("message", BROKEN, ids=lambda message: message[2:40])
def test_every_telemetry_gets_exactly_one_answer(server, jpegs, message):
    with Simulator(server.port).open() as simulator:
        last = simulator.drive(telemetry(jpegs[0]))["steering_angle"]
        before = server.memory()
        simulator.send(message)
        assert json.loads(simulator.receive()[2:]) == ["steer", {"steering_angle": last, "throttle": "0"}]
        assert server.memory() < before + 30, "MB; nothing of a huge message is kept"
        simulator.send("2")
        assert simulator.receive() == "3", "no second answer came before"
        assert simulator.drive(telemetry(jpegs[0]))["steering_angle"] == last


OTHERS = (
    *("", "4", "9", "42", "42{", '42["connect"]', '42["disconnect"]', '42["unknown",{}]', "451-[", "43[]", "\x00"),
    *('42/other,["telemetry",{}]', "42" + "1" * 900_000, "ä" * 1000, "42[" * 30000),
)


@pytest.mark.parametrize("message", OTHERS, ids=lambda message: message[:20])
def test_driving_continues_after_other_messages(server, jpegs, steering, message):
    with Simulator(server.port).open() as simulator:
        simulator.send(message)
        simulator.send("2")
        while simulator.receive() != "3":  # "connect" may be answered with a steer
            pass
        assert np.float32(simulator.drive(telemetry(jpegs[1]))["steering_angle"]) == steering[1]


def test_two_simulators_are_driven_independently(server, jpegs, steering):
    with Simulator(server.port).open() as slow, Simulator(server.port).open() as fast:
        with Simulator(server.port).open() as other:
            alone = [other.drive(telemetry(jpegs[n], speed="8.0000")) for n in range(8)]
        for n in range(8):
            assert slow.drive(telemetry(jpegs[n], speed="8.0000")) == alone[n]
            answer = fast.drive(telemetry(jpegs[7 - n], speed="9,0000"))
            assert np.float32(answer["steering_angle"].replace(",", ".")) == steering[7 - n]
            assert answer["throttle"] == "0"


def test_frames_in_flight_are_answered_in_order(server, jpegs, steering):
    with Simulator(server.port).open() as simulator:
        for jpeg in jpegs:
            simulator.send("42" + json.dumps(["telemetry", telemetry(jpeg)]))
        answers = [json.loads(simulator.receive()[2:])[1]["steering_angle"] for _ in jpegs]
        assert [np.float32(answer) for answer in answers] == steering


def test_a_vanished_simulator_and_a_restarted_server(model_file, jpegs, steering):
    port = unused_port()
    for _ in range(2):
        with serving(model_file, port=port) as process:
            gone = Simulator(port).open()
            for fragment in fragments("42" + json.dumps(["telemetry", telemetry(jpegs[0])]))[:5]:
                gone.socket.sendall(fragment)
            gone.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER)  # so that closing resets the connection
            gone.socket.close()
            with Simulator(port).open() as simulator:
                assert np.float32(simulator.drive(telemetry(jpegs[2]))["steering_angle"]) == steering[2]
                assert process.stop(signal.SIGTERM) == (128 + signal.SIGTERM if sys.platform != "win32" else 1)
                with pytest.raises(OSError):
                    simulator.receive()


# --------------------------------------------------------------------------------------------------
# Requests of other sites


OWN, NAMED = "Host: 127.0.0.1:{port}\r\n", "Host: evil.example:4567\r\n"
NAMED_IN_A_BROWSER = NAMED + "Origin: http://evil.example:4567\r\n"


@pytest.mark.parametrize(
    "headers, status",
    [
        (OWN + "Origin: http://evil.example\r\n", b"403"),
        (OWN + "Sec-Fetch-Site: cross-site\r\n", b"403"),
        (OWN + "Origin: http://127.0.0.1:{port}\r\n", b"101"),
        *((OWN, b"101"), (NAMED, b"101"), (NAMED_IN_A_BROWSER, b"403")),
    ],
)
def test_another_origin_cannot_connect(server, headers, status):
    """A browser names its origin with each websocket. Any site can give this machine a name, for programs alone."""
    request = WEBSOCKET.replace(b"Host: localhost\r\n", headers.format(port=server.port).encode())
    with socket.create_connection(("127.0.0.1", server.port), 10) as client:
        client.sendall(request % b"")
        assert client.recv(13) == b"HTTP/1.1 " + status + b" "
    told = "A browser must use this server's IP address"
    awaited(lambda: headers != NAMED_IN_A_BROWSER or any(told in line for line in server.lines))


def test_a_simulator_that_may_expect_numbers_is_told_of(server, jpegs):
    """Udacity's term-2 simulator sends cte, and nothing more when its first answers are strings."""
    with Simulator(server.port).open() as simulator:
        for jpeg in jpegs[:3]:
            simulator.drive({**telemetry(jpeg), "cte": "0.7598"})
        awaited(lambda: any("if it is Udacity's term-2 simulator" in line for line in server.lines))


def test_an_image_as_bytes_is_answered_and_told_of(server, jpegs):
    """As programs send it that forget to decode what base64 gives them, and browsers that send a Blob."""
    with Simulator(server.port).open() as simulator:
        last = simulator.drive(telemetry(jpegs[0]))["steering_angle"]
        simulator.send('451-["telemetry",{"speed":"9","image":{"_placeholder":true,"num":0}}]')
        assert json.loads(simulator.receive()[2:]) == ["steer", {"steering_angle": last, "throttle": "0"}]
        awaited(lambda: any("sent as bytes, not as base64 text" in line for line in server.lines))


def test_a_client_that_sends_no_telemetry_is_told_of(server, jpegs, steering):
    """As the simulators of udacity-gym and AutoDRIVE, which connect to the same port."""
    before = len(server.lines)
    with Simulator(server.port).open() as simulator:
        for event in ("car_telemetry", "\\u001b[2J" + "x" * 1000, "other"):
            simulator.send(f'427["{event}",{{"speed":0}}]')
        for data in ("", ",{}", ',"x"'):
            simulator.send(f'42["*"{data}]')
        simulator.send("2")
        assert simulator.receive() == "3", "no acknowledgement, so that a client that sends many is disconnected"
        awaited(lambda: any("a client sends 'car_telemetry', which is not answered" in line for line in server.lines))
        assert np.float32(simulator.drive(telemetry(jpegs[1]))["steering_angle"]) == steering[1]
    assert not any("'other'" in line or "xxx" in line for line in server.lines), "of each client the first"
    assert not any("Error" in line for line in server.lines[before:]), "even for an event *"


def test_it_listens_on_loopback_alone(server):
    def accepts(address: str, port: int) -> bool:
        try:
            socket.create_connection((address, port), 2).close()
        except OSError:
            return False
        return True

    others = ["127.0.0.2", "::1"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):  # no network here
        probe.connect(("192.0.2.1", 9))  # sends nothing; the system chooses the address that faces the network
        others.append(probe.getsockname()[0])
    assert accepts("127.0.0.1", server.port) and not any(accepts(address, server.port) for address in others)
    with socket.create_server(("0.0.0.0", 0)) as everywhere:
        assert any(accepts(address, everywhere.getsockname()[1]) for address in others), "reachable"


# --------------------------------------------------------------------------------------------------
# Independent clients


CLIENT = """
const [, , library, port, options, file] = process.argv;
const socket = require(library)(`http://127.0.0.1:${port}`, {reconnection: false, ...JSON.parse(options)});
const telemetry = JSON.parse(require('fs').readFileSync(file));
const answers = [];
const refused = error => { console.log(JSON.stringify({refused: error.message || error})); process.exit(); };
socket.on('connect_error', refused);
socket.on('error', refused);
socket.on('steer', data => {
  answers.push(data);
  if (answers.length < 6) socket.emit('telemetry', telemetry); else socket.emit('telemetry', null);
});
socket.on('manual', data => { console.log(JSON.stringify({answers, data})); socket.close(); });
"""
VERSIONS = ["2.1.1", "2.5.0", "3.1.3", "4.8.1"]  # of JavaScript's client; 2 speaks Engine.IO 3, the others 4
ONLY_WEBSOCKET = "Only the websocket transport is served: connect with transports=['websocket']."


@pytest.fixture(scope="module")
def node_client(tmp_path_factory) -> Path:
    npm = shutil.which("npm")
    if not npm:
        pytest.skip("no node here")
    folder = tmp_path_factory.mktemp("node")
    libraries = [f"client{version}@npm:socket.io-client@{version}" for version in VERSIONS]
    command = [npm, "install", "--no-audit", "--no-fund", "--silent", *libraries]
    try:
        subprocess.run(command, cwd=folder, check=True, timeout=60, capture_output=True)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
        pytest.skip("npm can't install socket.io-client here")
    (folder / "client.js").write_text(CLIENT, encoding="utf-8")
    return folder


@pytest.mark.parametrize("version", VERSIONS)
def test_javascripts_client(server, node_client, jpegs, steering, version):
    def session(options):
        command = ["node", "client.js", f"client{version}", str(server.port), json.dumps(options), "telemetry.json"]
        return json.loads(subprocess.run(command, cwd=node_client, capture_output=True, timeout=60).stdout)

    message = json.dumps(telemetry(jpegs[3], speed="9.0000"))
    (node_client / "telemetry.json").write_text(message, encoding="utf-8")
    driven = session({"transports": ["websocket"]})
    assert driven["answers"][0] == {"steering_angle": "0", "throttle": "0"} and driven["data"] == {}
    for answer in driven["answers"][1:]:
        assert np.float32(answer["steering_angle"]) == steering[3] and answer["throttle"] == "0"
    assert session({})["refused"] == ONLY_WEBSOCKET
    awaited(lambda: any(ONLY_WEBSOCKET in line for line in server.lines))  # the terminal tells, too


def test_pythons_client(server, jpegs, steering):
    client, received = socketio.Client(reconnection=False), queue.Queue[Any]()
    client.on("steer", received.put)
    client.on("connect_error", received.put)
    with pytest.raises(socketio.exceptions.ConnectionError):
        client.connect(f"http://127.0.0.1:{server.port}")
    assert received.get(timeout=20) == {"message": ONLY_WEBSOCKET}

    def answer(data):  # as the simulator does, to the greeting, too
        received.put(data)
        if data["steering_angle"] == "0":
            client.emit("telemetry", telemetry(jpegs[3], speed="9.0000"))

    client.on("steer", answer)
    client.connect(f"http://127.0.0.1:{server.port}", transports=["websocket"])
    assert received.get(timeout=20) == {"steering_angle": "0", "throttle": "0"}
    assert np.float32(received.get(timeout=20)["steering_angle"]) == steering[3]
    client.disconnect()
