"""Drive the Udacity simulator with a trained model.

python drive.py                       # model.pt, or else the model that comes with the project
python drive.py model.pt              # then start the simulator in autonomous mode
python drive.py model.pt run1         # also save each frame in run1/, for `python video.py run1`
python drive.py --stop-when-lost      # slow down and stop where the network would probably leave the road
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("drive.py")  # also while the libraries below are loaded

import argparse
import gc
import logging
import reprlib
import time
from collections import Counter
from contextlib import suppress
from datetime import datetime
from pathlib import Path

import numpy as np
import torch

from cloning.base.arguments import MAX_PORT, address, command_line, number
from cloning.base.errors import UserError
from cloning.base.frame import FRAME
from cloning.base.outputs import as_typed, plural
from cloning.lane.foretell import ALARM, Foreteller, Limits, Observer, limits_file, load_limits
from cloning.lane.pilot import Pilot
from cloning.network.network import FOREIGN, SHIPPED_MODEL, Network, load_model, steer
from cloning.recordings import saved_frames
from cloning.road.motion import MPH, SET_SPEED_MPH, TOP_SPEED_MPH
from cloning.server import page, terminal
from cloning.server.speed import SpeedController
from cloning.server.status_line import StatusLine
from cloning.server.telemetry import UnusableTelemetry, decimal_separator, format_number, parse_speed, parse_telemetry
from cloning.wire.protocol import PORT

DEFAULT_MODEL = Path("model.pt")  # that `python model.py` writes
SLOWEST_MPH = 5.0  # to which risk slows the car down, before it is stopped
FRAMES_IN_FLIGHT = 3  # that a simulator sends at its start, before it has used an answer
PATIENCE = 5.0  # s until a simulator that sends nothing more is told of
log = logging.getLogger("drive")


# ----------------------------------------------------------------------------------------------------------------------
# One simulator


class Session(page.Session):
    """A connected simulator, with its speed controller."""

    def __init__(self, server: "DriveServer"):
        super().__init__()
        self.server = server
        self.controller = SpeedController(server.set_speed)
        foretell = Foreteller(server.observer, server.limits) if server.observer and server.limits else None
        self.pilot = Pilot(lambda frame: steer(server.network, frame), foretell, server.as_mounted)
        self.late = 0  # how many frames late its frames are, as was told last
        self.moved = [0.0] * 3  # in which ways its camera's picture is moved, likewise
        self.heeds = server.stop_when_lost  # whether it slows down and stops where the network is lost
        self.separator = "."  # decimal separator of the simulator's culture, the only one that it understands
        self.steering = np.float32(0)  # of the last answer, -1..1
        self.puzzled = False  # whether the log tells that it may be another simulator
        self.warned: Counter[str] = Counter()  # kinds of warnings logged: see terminal.Few
        self.folders: list[saved_frames.SessionFolder] = []  # of its saved frames; the last one may be `folder`

    def answer(self, message: object, arrived: float | None = None) -> dict[str, str]:
        """Return the answer to a telemetry message: steering and throttle, -1..1, as strings. Never raises.

        arrived: time.perf_counter() when its first fragment was read; None: now.
        """
        arrived = time.perf_counter() if arrived is None else arrived
        self.heard, self.manual, throttle = time.monotonic(), False, 0.0
        try:
            self.separator = decimal_separator(message, self.separator)
            telemetry = parse_telemetry(message)
            place = telemetry.place
            # On Windows monotonic() may have ticks of 15.6 ms.
            now = time.perf_counter() if telemetry.time is None else telemetry.time
            self.steering, risk = self.pilot(telemetry.image, now, telemetry.speed * MPH)
            if risk is not None:
                self.slow_down(risk)
            self.tell_of_camera()
            throttle = self.controller.throttle(telemetry.speed)
        except Exception as error:  # whatever it is: without an answer the car would stand still
            self.unusable += 1
            self.reason = str(error) if isinstance(error, UnusableTelemetry) else f"{type(error).__name__}: {error}"
            if self.controller.set_speed == 0:  # a car that is to stop needs no picture for that
                with suppress(UnusableTelemetry):
                    throttle = self.controller.throttle(parse_speed(message))
            log.warning(
                f"a frame can't be used: {self.reason}; the answer repeats the last steering with throttle "
                f"{throttle:g}",
                extra={"warned": self.warned},
            )
        else:
            self.frame = self.pilot.seen
            self.driven += 1
            self.place = place
            if self.server.saver and self.server.recording:
                if not self.folder:
                    self.folder = self.server.saver.start_session()
                    self.folders.append(self.folder)
                driven = float(self.steering), throttle, telemetry.speed
                self.folder.save(telemetry.jpeg, driven, telemetry.time)
            where = (place.offset, place.x, place.y, risk) if place else (telemetry.cte, None, None, risk)
            latency = (time.perf_counter() - arrived) * 1000
            figures = (time.monotonic(), float(self.steering), telemetry.speed, throttle, latency)
            self.history.append(page.DrivenFrame(*figures, *where))
        return {
            "steering_angle": format_number(self.steering, self.separator),
            "throttle": format_number(throttle, self.separator),
        }

    def tell_of_camera(self) -> None:
        """Log how late the frames are and how they are moved, if either is found to be otherwise than before."""
        if self.late != self.pilot.predictor.delay.frames:
            self.late = self.pilot.predictor.delay.frames
            what = f"frames come late, by {plural(self.late, 'frame')}: steering for where the car is now"
            log.warning(what if self.late else "frames are no longer known to come late", extra={"warned": self.warned})
        mount = self.pilot.mount
        if mount and self.moved != (found := np.sign(mount.found).tolist()):
            self.moved = found
            what = f"the camera seems turned or shifted, by {mount}: frames are moved back (with --as-mounted: not)"
            log.warning(what if any(found) else "the camera seems well mounted again", extra={"warned": self.warned})

    def slow_down(self, risk: float) -> None:
        """Slow the car down from a risk of ALARM on, and stop it for good at that of the network's limits."""
        limits, before = self.server.limits, self.lost
        assert limits is not None, "without limits there is no risk"
        if not self.heeds:
            self.heeds = self.server.stop_when_lost and risk < ALARM  # again, after a person let it drive on
            return
        self.lost = self.lost or risk >= limits.stop
        if self.lost and not before:
            log.warning(f"the network is lost (risk {risk:.0%}): the car is stopped")
        eased = self.server.set_speed * float(np.interp(risk, (ALARM, limits.stop), (1, 0)))
        self.controller.set_speed = 0.0 if self.lost else min(self.server.set_speed, max(SLOWEST_MPH, eased))

    def drive_at(self, set_speed: float) -> None:
        """Drive at another set speed, in mph; a car that stopped because it was lost drives on, heeding no risk."""
        self.controller.set_speed = set_speed  # its sum stays: it is what holds the speed on this slope
        self.heeds, self.lost = self.heeds and not self.lost, False

    def summary(self) -> str:
        """Return a line about the whole session: how many frames, and how many are saved where."""
        saved = "".join(f"; {folder.progress()}" for folder in self.folders)
        return f"session ended: {self.driven} frames driven, {self.unusable} unusable{saved}"


# ----------------------------------------------------------------------------------------------------------------------
# Server


class DriveServer:
    """Serves steering to up to MAX_CLIENTS simulators, and the page to browsers."""

    def __init__(
        self,
        network: Network,
        set_speed: float = SET_SPEED_MPH,
        model: str = "",
        limits: Limits | None = None,
        stop_when_lost: bool = False,
        as_mounted: bool = False,
    ):
        """set_speed: mph; model: the network's name on the page; stop_when_lost: needs the network's limits.

        as_mounted: see `Pilot`. Raises ModelError.
        """
        from cloning.server import server  # here, because it needs the socket libraries

        self.network, self.model, self.set_speed = network, model, set_speed
        self.go_speed = set_speed or SET_SPEED_MPH
        self.limits, self.stop_when_lost, self.as_mounted = limits, stop_when_lost, as_mounted
        self.observer = Observer(network) if limits else None
        self.saver: saved_frames.FrameSaver | None = None  # saves the frames
        self.recording = False  # whether it does so now
        self.sessions: dict[str, Session] = {}
        self.last_ended: Session | None = None
        self.socket = server.Server()
        self.socket.on("connect", self.connect)
        self.socket.on("telemetry", self.telemetry)
        self.socket.on("*", self.other_event)
        self.socket.on("disconnect", self.disconnect)
        self.app = server.socketio.WSGIApp(self.socket, page.create_app(self, server.eventlet.sleep))
        # The first pass is slow: do it before the first frame.
        Pilot(lambda frame: steer(network, frame), None, as_mounted)(np.zeros(FRAME, np.uint8), 0.0, 0.0)

    def session(self, sid: str) -> Session:
        """Return the session of a connection; make one for a new connection."""
        if sid not in self.sessions:
            self.sessions[sid] = Session(self)
        return self.sessions[sid]

    def connect(self, sid: str, *_: object) -> None:
        """Greet a new simulator, which sends telemetry only in answer to a message."""
        if sid not in self.sessions:  # a client may also send CONNECT on an open connection
            self.session(sid)
            self.socket.emit("steer", {"steering_angle": "0", "throttle": "0"}, room=sid)

    def telemetry(self, sid: str, message: object = None, *_: object) -> None:
        """Answer each telemetry exactly once: with `steer`, or with `manual` if the human driver steers."""
        session = self.session(sid)
        if message is None:
            session.heard, session.manual = time.monotonic(), True
            self.socket.emit("manual", {}, room=sid)
        else:
            self.socket.emit("steer", session.answer(message, self.socket.arrived(sid)), room=sid)

    def other_event(self, event: object, sid: object = None, *_: object) -> object:
        """Leave an event unanswered; log the first one of a client that has sent no telemetry.

        An event called "*", for which there is a handler, comes without its name: then sid is what the client sent.
        """
        session = self.sessions.get(sid) if isinstance(sid, str) else None
        if session and not session.heard and not session.puzzled:
            session.puzzled = True
            log.warning(
                f"a client sends {reprlib.repr(event)}, which is not answered: the simulator of term 1 sends telemetry",
                extra={"warned": session.warned},
            )
        return self.socket.not_handled

    def disconnect(self, sid: str, *_: object) -> None:
        """Forget a session and log its summary."""
        session = self.sessions.pop(sid, None)
        if session and session.heard:
            session.ended, self.last_ended = True, session
        if session and session.driven + session.unusable:
            if session.folders:
                session.folders[-1].when_written(lambda: log.info(session.summary()))
            else:
                log.info(session.summary())

    def close(self) -> None:
        """End the sessions that are still open."""
        for sid in list(self.sessions):
            self.disconnect(sid)

    def watched_session(self) -> Session | None:
        """Return the session for the page and the status line, or None before the first telemetry.

        This is the newest connected one with driven frames, else one without, else the last one that has ended.
        """
        heard = [session for session in self.sessions.values() if session.heard]
        return max(heard, key=lambda session: (session.driven > 0, session.started), default=self.last_ended)

    def change_set_speed(self, set_speed: float) -> None:
        """Drive all simulators at another set speed, in mph, from the next frame on; 0 stops them."""
        self.set_speed, self.go_speed = set_speed, set_speed or self.go_speed
        for session in self.sessions.values():
            session.drive_at(set_speed)

    def record(self, on: bool) -> None:
        """Save the frames from now on, each session's in a new folder, or no longer. Raises UserError."""
        if on and not self.recording:
            self.saver = self.saver or saved_frames.FrameSaver(Path(f"run-{datetime.now():%Y%m%d-%H%M%S}"))
            for session in self.sessions.values():
                session.folder = None
        self.recording = on

    def tell_of_silence(self) -> None:
        """Log that a simulator may expect other answers, if it looks like that."""
        for session in self.sessions.values():
            first = 0 < session.driven <= FRAMES_IN_FLIGHT and not session.place
            sends_cte = first and session.history[-1].cte is not None
            if sends_cte and time.monotonic() > session.heard + PATIENCE and not session.puzzled:
                session.puzzled = True
                log.warning(
                    f"a simulator that sends cte has been silent for {PATIENCE:g} s after its first frames; if it is "
                    "Udacity's term-2 simulator: that expects JSON numbers, and drive.py drives the term-1 simulator, "
                    "which expects strings"
                )


# ----------------------------------------------------------------------------------------------------------------------
# Command line


def choose_model(argument: Path | None, folder: Path | None) -> Path:
    """Return the model file to drive with: the given one, else model.pt if it exists, else the shipped one.

    argument, folder: of the command line. Raises UserError if the only argument is probably meant as the folder.
    """
    usual = DEFAULT_MODEL if DEFAULT_MODEL.is_file() else SHIPPED_MODEL
    if argument is None:
        return usual
    if folder is None and not argument.is_file() and argument.suffix not in (".pt", ".pth", *FOREIGN):
        command = as_typed("python", "drive.py", usual, argument)
        raise UserError(
            f"{argument}: not a model file; name the model first and the folder for the frames second: `{command}`"
        )
    return argument


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line; arguments: those of this process if None."""
    status = "Exit status: 130 after Ctrl-C, 1 if frames could not be saved, 2 if the server could not start."
    parser = command_line(None, __doc__, status)
    add = parser.add_argument
    add("model", nargs="?", type=Path, help="model file (default: model.pt if it exists, else the project's own)")
    add("folder", nargs="?", type=Path, help="save the frames here; frames saved here earlier are deleted")
    speed = f"set speed in mph, 0 to {TOP_SPEED_MPH}, which is the car's most (default %(default)g)"
    add("--speed", type=page.speed_argument, default=SET_SPEED_MPH, help=speed)
    host = "address to listen on (default %(default)s: this machine only; 0.0.0.0: any machine may connect)"
    add("--host", type=address, default="127.0.0.1", help=host)
    port = "port to listen on (default %(default)s, which the simulator uses; 0: any free one)"
    add("--port", type=number(int, 0, MAX_PORT), default=PORT, help=port)
    lost = "slow down and stop the car where the network would probably leave the road"
    add("--stop-when-lost", action="store_true", help=lost)
    mounted = (
        "take frames as they are, also if the camera seems turned or shifted, as for a network trained on such frames"
    )
    add("--as-mounted", action="store_true", help=mounted)
    device = "device that runs the network (default %(default)s, which is fast enough)"
    add("--device", default="cpu", choices=["cpu", "cuda"], help=device)
    parsed = parser.parse_intermixed_args(arguments)  # the folder may follow options
    if parsed.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch finds no GPU here; leave it out")
    return parsed


def main() -> int:
    """Load the model, listen, and drive until Ctrl-C; return the exit status."""
    arguments = parse_arguments()
    stderr = terminal.log_to_stderr(program.name)
    log.setLevel(logging.INFO)
    torch.set_num_threads(1)  # a second thread would make single frames slower and their latency less regular
    from cloning.server import connections  # here, because it needs the socket libraries

    model = choose_model(arguments.model, arguments.folder)
    network = load_model(model, arguments.device)
    limits = load_limits(model, network)
    if arguments.stop_when_lost and not limits:
        raise UserError(
            f"{limits_file(model)}: no such file for this network, so nothing tells when it is lost; "
            f"`{as_typed('python', '-m', 'tools.foretell', model)}`, in a clone of the project, makes it, or leave out "
            "--stop-when-lost"
        )
    if arguments.folder:
        saved_frames.check_folder(arguments.folder)
    origin = "the model that comes with the project" if model == SHIPPED_MODEL else ""
    stop, as_mounted = arguments.stop_when_lost, arguments.as_mounted
    server = DriveServer(network, arguments.speed, origin or str(model), limits, stop, as_mounted)
    where_taken = f"for the stand-in alone choose another --port: Udacity's simulator connects to {PORT} only"
    listener = connections.claim_port(arguments.host, arguments.port, where_taken)
    if arguments.folder:
        server.saver, server.recording = saved_frames.FrameSaver(arguments.folder), True  # last: it empties it
    stopped, (host, port) = connections.noted_signals(), listener.getsockname()[:2]
    watched = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # a browser is not served under a name
    stand_in = f"in a second terminal its stand-in: `{page.stand_in('drive', watched, str(port))}`"
    simulator = "Now start the simulator, choose a track and AUTONOMOUS MODE,\nor"
    if port != PORT:
        simulator = f"The simulator connects to port {PORT} only.\nNow start"
    stderr.write(
        f"Driving with {model}{origin and f' ({origin})'}.\n"
        f"Listening on {arguments.host}:{port}. {simulator} {stand_in}.\n"
        f"Watch at http://{f'[{watched}]' if ':' in watched else watched}:{port}/ . Ctrl-C ends.\n"
    )
    gc.collect()
    gc.freeze()  # else a client can make the collector look through all the libraries' objects: 0.2 s each time
    lost = False
    try:
        connections.serve(listener, server.app, stopped, server.tell_of_silence, StatusLine(server, stderr).update)
    finally:
        server.close()
        if server.saver:
            try:
                server.saver.close()
            except UserError as error:
                stderr.write(f"{program.name}: {error}\n")  # after the sessions' last lines, which wait there, too
                lost = True
        stderr.finish()
    return program.INCOMPLETE if lost else 128 + stopped[0]


if __name__ == "__main__":
    program.run(main)
