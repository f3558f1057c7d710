"""Drive the Udacity simulator with a trained model.

python drive.py model.pt              # then start the simulator in autonomous mode
python drive.py model.pt run1         # also save each frame in run1/, for `python video.py run1`
"""

import argparse
import base64
import collections
import logging
import math
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import torch

from cloning.errors import ModelError
from cloning.pilot import page
from cloning.pilot.network import Network, load_model, steer
from cloning.recordings import saved_frames as frames
from cloning.recordings.format import FRAME
from cloning.recordings.images import decode
from cloning.wire import server as wire

NUMBERS = ("steering_angle", "throttle", "speed")  # of a telemetry: degrees, -1..1, mph
log = logging.getLogger("drive")


# ---------------------------------------------------------------------------------------------------------------------
# Telemetry


class Unusable(ValueError):
    """Telemetry that can't be driven by; the message is the reason."""


def number(telemetry: dict, key: str) -> float:
    """A finite number out of the telemetry, written with a point or a comma. Raises Unusable."""
    try:
        value = float(str(telemetry[key]).replace(",", "."))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Unusable(f"{key} is not a number")
    return value


def writes_commas(telemetry, before: bool) -> bool:
    """Whether the simulator writes decimal commas; what it was before, if it writes no decimals now."""
    numbers = [telemetry.get(key) for key in NUMBERS] if isinstance(telemetry, dict) else []
    marks = [mark for number in numbers for mark in re.findall(r"\d([.,])\d", str(number))]
    return "," in marks if marks else before


def read(telemetry) -> tuple[bytes, np.ndarray, float]:
    """The image as received (JPEG), decoded (uint8 (160, 320, 3), RGB), and the speed (mph). Raises Unusable."""
    if telemetry is wire.UNREADABLE:
        raise Unusable(f"its JSON breaks off, or it is longer than {wire.MAX_MESSAGE} bytes")
    if not isinstance(telemetry, dict):
        raise Unusable("it is no object")
    for key in (*NUMBERS, "image"):
        if key not in telemetry:
            raise Unusable(f"{key} is missing")
    *_, speed = (number(telemetry, key) for key in NUMBERS)
    try:
        jpeg = base64.b64decode(telemetry["image"], validate=True)
    except (TypeError, ValueError) as error:
        raise Unusable("the image is not base64") from error
    try:
        return jpeg, decode(jpeg), speed
    except ValueError as error:
        raise Unusable(f"the image is unusable: {error}") from error


def text(value: float) -> str:
    """A number as the simulator reads it: never with an exponent, and exact for a float32."""
    return np.format_float_positional(np.float32(value), trim="-")


class SpeedController:
    """The original's PI controller: throttle = 0.1 e + 0.002 Σe, e = set speed - speed (mph), within -1..1.

    The sum stands still while the throttle is at its limit, so that a wait or a hill does not wind it up.
    """

    PROPORTIONAL, INTEGRAL = 0.1, 0.002

    def __init__(self, set_speed: float):
        self.set_speed, self.sum = set_speed, 0.0

    def throttle(self, speed: float) -> float:
        error = self.set_speed - speed
        throttle = self.PROPORTIONAL * error + self.INTEGRAL * (self.sum + error)
        if abs(throttle) <= 1:
            self.sum += error
        return min(1.0, max(-1.0, throttle))


class Session:
    """One connected simulator: its speed controller, its saved frames and its figures."""

    def __init__(self, server: "DriveServer", environ: dict):
        self.server, self.environ = server, environ
        self.controller = SpeedController(server.set_speed)
        self.folder: frames.Folder | None = None
        self.comma = False  # the simulator writes decimal commas, and reads nothing else
        self.steering = "0"  # as last answered
        self.frame: np.ndarray | None = None  # the last one
        self.served = self.unusable = 0
        self.trail = collections.deque(maxlen=page.TRAIL)  # page.Row, of the last minute
        self.round_trip = 0.0  # seconds from a steer to the telemetry that answers it
        self._sent = collections.deque(maxlen=16)  # time.perf_counter() of the steers not yet answered
        self.sent()

    def sent(self) -> None:
        self._sent.append(time.perf_counter())

    def answer(self, telemetry) -> dict[str, str]:
        """What to do about a telemetry: steering -1..1, throttle -1..1, as strings. Never raises."""
        arrived = self.arrived()
        if self._sent:
            self.round_trip = arrived - self._sent.popleft()
        throttle = "0"
        try:
            self.comma = writes_commas(telemetry, self.comma)
            jpeg, frame, speed = read(telemetry)
            steering = steer(self.server.network, frame)
            throttle = text(self.controller.throttle(speed))
        except Exception as error:  # whatever it is: without an answer the car would stand still
            self.unusable += 1
            reason = str(error) if isinstance(error, Unusable) else f"{type(error).__name__}: {error}"
            log.warning(f"a frame can't be used, {reason}; answered with the last steering and no throttle")
        else:
            self.steering, self.frame = text(steering), frame
            self.served += 1
            if self.server.saver:
                self.folder = self.folder or self.server.saver.folder()
                self.folder.save(jpeg)
            self.trail.append(
                page.Row(time.time(), float(steering), speed, float(throttle), (time.perf_counter() - arrived) * 1000)
            )
        answer = {"steering_angle": self.steering, "throttle": throttle}
        return {key: value.replace(".", ",") for key, value in answer.items()} if self.comma else answer

    def arrived(self) -> float:
        """time.perf_counter() at the first fragment of the message that is being answered."""
        websocket = self.environ.get("drive.websocket")  # none while a client still polls
        return websocket.arrived if websocket else time.perf_counter()


# ---------------------------------------------------------------------------------------------------------------------
# Server


class DriveServer:
    """Serves steering to any number of simulators, and the page to whoever looks."""

    def __init__(self, network: Network, set_speed: float = 9.0, saver: frames.Saver | None = None):
        self.network, self.set_speed, self.saver = network, set_speed, saver
        self.sessions: dict[str, Session] = {}
        self.socket = wire.Server()
        self.socket.on("connect", self.connect)
        self.socket.on("telemetry", self.telemetry)
        self.socket.on("disconnect", self.disconnect)
        self.app = wire.closed_to_strangers(wire.socketio.WSGIApp(self.socket, page.create_app(self)))
        steer(network, np.zeros(FRAME, np.uint8))  # the first pass is slow, so it is not the first frame's

    def session(self, sid: str) -> Session:
        if sid not in self.sessions:
            self.sessions[sid] = Session(self, self.socket.environ[sid])
        return self.sessions[sid]

    def connect(self, sid, *_):
        if sid not in self.sessions:  # a client may send CONNECT on top of connecting
            self.session(sid)
            self.socket.emit("steer", {"steering_angle": "0", "throttle": "0"}, room=sid)

    def telemetry(self, sid, telemetry=None, *_):
        session = self.session(sid)
        if telemetry is None:  # the driver holds the wheel
            event, answer = "manual", {}
        else:
            event, answer = "steer", session.answer(telemetry)
        self.socket.emit(event, answer, room=sid)
        session.sent()

    def disconnect(self, sid, *_):
        session = self.sessions.pop(sid, None)
        if session and session.served + session.unusable:
            log.info(f"a simulator has left: {session.served} frames driven, {session.unusable} unusable")

    def watched(self) -> Session | None:
        """The session for the page and the status line: the newest that has driven."""
        return next((session for session in reversed(self.sessions.values()) if session.served), None)


# ---------------------------------------------------------------------------------------------------------------------
# Command line


class OncePerKind(logging.Filter):
    """Lets a warning through once, whatever its digits, so that a broken client fills no log."""

    def __init__(self):
        super().__init__()
        self.seen = set()

    def filter(self, record):
        kind = (record.name, re.sub(r"\d+", "", str(record.msg)))
        if record.levelno < logging.WARNING or kind not in self.seen:
            self.seen.add(kind)
            return True
        return False


def status(session: Session, rate: float) -> str:
    row = session.trail[-1]
    line = (
        f"{rate:5.1f} frames/s, round trip {session.round_trip * 1000:5.1f} ms, steering {row.steering:+.2f}, "
        f"{row.speed:4.1f} mph, {session.served} frames"
    )
    return f"{line}, {session.unusable} unusable" if session.unusable else line


def run(server: DriveServer, listener) -> None:
    """Serve, with a status line, until SIGINT or SIGTERM."""
    stopped = []
    for number in (signal.SIGINT, signal.SIGTERM):
        # An exception raised in the middle of a handler would be caught by python-engineio, so only a mark is left.
        signal.signal(number, lambda *_: stopped.append(True))
    serving = wire.eventlet.spawn(wire.serve, listener, server.app)
    terminal = sys.stderr.isatty()
    every = 0.5 if terminal else 60
    before, shown, due = 0, None, time.perf_counter() + every
    while not stopped and not serving.dead:
        wire.eventlet.sleep(0.1)
        if (now := time.perf_counter()) < due:
            continue
        session = server.watched()
        if session:
            before = before if session is shown else 0
            line = status(session, (session.served - before) / (every + now - due))
            before, shown = session.served, session
            print(f"\r{line}\033[K" if terminal else line, end="" if terminal else "\n", file=sys.stderr, flush=True)
        due = now + every
    if serving.dead:
        serving.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a model file that model.py wrote")
    parser.add_argument("folder", nargs="?", type=Path, help="where to save the frames; emptied first")
    parser.add_argument("--speed", type=float, default=9, help="set speed in mph, at most 30 (default %(default)s)")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on (default %(default)s: this machine alone; 0.0.0.0: everyone)",
    )
    parser.add_argument("--port", type=int, default=4567, help="the simulator's is %(default)s")
    parser.add_argument(
        "--device",
        default="cpu",
        choices=["cpu", "cuda"],
        help="where the network runs (default %(default)s, which is fast enough)",
    )
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch finds no GPU here; leave it out")
    if not 0 < args.speed < math.inf:
        parser.error("--speed: a number of mph above 0, please")

    handler = logging.StreamHandler()
    handler.addFilter(OncePerKind())
    logging.basicConfig(format="\r\033[K%(message)s" if sys.stderr.isatty() else "%(message)s", handlers=[handler])
    log.setLevel(logging.INFO)
    torch.set_num_threads(1)  # a second thread makes one frame slower and less steady
    saver = None
    try:
        network = load_model(args.model, args.device)
        if args.folder:
            frames.check(args.folder)
        server = DriveServer(network, args.speed)
        try:
            listener = wire.listen(args.host, args.port)
        except (OSError, OverflowError) as error:
            sys.exit(
                f"drive.py: can't listen on {args.host}:{args.port} ({getattr(error, 'strerror', error)}); "
                "is another server running? Stop it, or choose another --port"
            )
        if args.folder:
            server.saver = saver = frames.Saver(args.folder)  # empties the folder, so it comes last
    except (ModelError, frames.FolderError, OSError) as error:
        sys.exit(f"drive.py: {error}")
    port = listener.getsockname()[1]
    print(
        f"Listening on {args.host}:{port}. Now start the simulator, choose a track and AUTONOMOUS MODE.\n"
        f"Watch at http://127.0.0.1:{port}/ . Ctrl-C ends.",
        file=sys.stderr,
        flush=True,
    )
    try:
        run(server, listener)
    finally:
        if saver:
            saver.close()


if __name__ == "__main__":
    main()
