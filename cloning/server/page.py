"""The web page that shows the car driving and changes its set speed, made with Flask."""

import argparse
import base64
import functools
import itertools
import json
import math
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import flask
import numpy as np

from cloning.base import program
from cloning.base.arguments import number
from cloning.base.errors import UserError
from cloning.base.outputs import as_typed
from cloning.base.processes import PYTHON, environment
from cloning.network.attention import visual_backprop
from cloning.network.network import Network
from cloning.recordings.images import encode
from cloning.recordings.saved_frames import SessionFolder
from cloning.road.autonomy import LIMITS
from cloning.road.motion import TOP_SPEED_MPH
from cloning.road.overlay import overlay
from cloning.server import site
from cloning.wire.protocol import PORT, Place, where_options

SHOWN_SECONDS = 60  # of driving in the graphs
HISTORY_FRAMES = SHOWN_SECONDS * 120  # that a session remembers: enough for 120 frames/s
SHOWN_FRAMES = 1200  # at most, in one event: as many as a graph has pixels; a new page gets the whole minute
UPDATE_INTERVAL = 0.05  # s between two pictures
PHASES = 8  # moments of an interval, at each of which an eighth of the pages get their event; without: 16 ms, not 13
QUIET_INTERVALS = 20  # without driving, after which a page gets an event nevertheless
RATE_SECONDS = 2  # over which frames/s are counted
SILENCE = 2.0  # s without a telemetry, or without a usable one, after which the page says so
MAX_PAGES = 64  # open at once
MAX_BODY = 200  # bytes of a request; more could be JSON that is nested too deeply to read
JPEG_QUALITY = 80  # of the pictures
ROAD_SECONDS = 20.0  # after which a road is not drawn
BROWSE_SECONDS = 0.5  # in which the browser of recordings must answer
speed_argument = number(float, 0, TOP_SPEED_MPH)  # mph: a set speed; 0 stops the car
Pause = Callable[[float], None]  # waits for so many seconds, while others work


class DrivenFrame(NamedTuple):
    """The figures of one driven frame."""

    time: float  # time.monotonic(), which no change of the clock changes
    steering: float  # -1..1
    speed: float  # mph
    throttle: float  # -1..1
    latency: float  # ms in drive.py, from reading the telemetry's first fragment to its finished answer
    cte: float | None = None  # m from the lane's centre, if the simulator tells; the stand-in's sign is right positive
    x: float | None = None  # m to the east, and to the north, if the simulator tells
    y: float | None = None
    risk: float | None = None  # 0..1, that the car will leave the road, if the network's limits are known


class Session:
    """What the page shows of a simulator that is, or was, connected."""

    def __init__(self) -> None:
        self.started = time.perf_counter()  # tells sessions apart
        self.heard = 0.0  # time.monotonic() of the last telemetry
        self.manual = self.ended = False  # whether a person drove then; whether the connection has ended
        self.lost = False  # whether drive.py stopped the car because the network is out of its depth
        self.history: deque[DrivenFrame] = deque(maxlen=HISTORY_FRAMES)
        self.frame: np.ndarray | None = None  # the last one, as the network saw it: uint8 (160, 320, 3), RGB
        self.driven = self.unusable = 0  # frames
        self.reason = ""  # why the last unusable one was
        self.folder: SessionFolder | None = None  # of its saved frames
        self.place: Place | None = None  # at the last driven frame, if the simulator tells


class Server(Protocol):
    """What the page needs of the server that drives."""

    network: Network
    model: str  # the network's name, for people
    set_speed: float  # mph
    go_speed: float  # mph, of the car that is stopped once it drives on, else the set speed
    recording: bool  # whether frames are saved

    def watched_session(self) -> Session | None:
        """Return the session to show, or None."""

    def change_set_speed(self, set_speed: float) -> None:
        """Drive at another set speed, in mph, from now on."""

    def record(self, on: bool) -> None:
        """Save the frames from now on, or no longer. Raises UserError."""


def create_app(server: Server, pause: Pause) -> flask.Flask:
    """Return the web application; pause: the server's.

    `/` is the page, `/live` its figures and pictures as server-sent events, `/road` the road that the stand-in
    simulator names, and its centre line: {"track", "points"}, [[x, y], …] in m. `/browse` leads to the browser of
    recordings, if it runs. POST to `/set-speed` changes the set speed: {"set_speed": text, mph}; the answer is
    {"set_speed": number}. POST to `/record` saves frames or does no longer: {"recording": true or false}; the answer is
    the same. Both answer {"message"} with 400 to what can't be done.
    """
    from cloning.server.libraries import eventlet  # here, because it needs the socket libraries

    app = flask.Flask(__name__, static_folder=None)
    app.config["MAX_CONTENT_LENGTH"] = MAX_BODY
    site.prepare(app, "img-src data:")
    outline = functools.lru_cache(maxsize=4)(functools.partial(road_on_map, pause))
    one_road = eventlet.semaphore.Semaphore()  # is generated at a time, and once for all pages that ask meanwhile
    pages = {with_attention: Pages(server, with_attention, pause) for with_attention in (False, True)}

    @app.get("/")
    def index() -> str:
        constants = {"seconds": SHOWN_SECONDS, "top_speed": TOP_SPEED_MPH, "limits": LIMITS}
        host, _, port = flask.request.host.rpartition(":")
        where = (host.strip("[]"), port) if port.isdecimal() else (flask.request.host.strip("[]"), "80")
        commands = [stand_in(words, *where) for words in ("drive --realtime --track jungle", "window --autonomous")]
        shown = {"model": server.model, "commands": commands, "usual_port": PORT, "is_usual": where[1] == str(PORT)}
        shown["activate"] = "" if program.installed else program.ACTIVATE
        return flask.render_template("drive.html", **shown, **constants)

    @app.get("/live")
    def live() -> flask.Response:
        if sum(each.open for each in pages.values()) >= MAX_PAGES:
            return flask.Response(f"{MAX_PAGES} pages are open already.\n", 503, mimetype="text/plain")
        events = pages["attention" in flask.request.args].events()
        return flask.Response(events, mimetype="text/event-stream", headers={"Cache-Control": "no-store"})

    @app.get("/road")
    def road() -> dict[str, Any]:
        session = server.watched_session()
        if not (session and session.place):
            return {}
        track = session.place.track
        with one_road:
            return {"track": track, "points": outline(track)}

    @app.get("/browse")
    def browse() -> Any:
        where = f"http://{site.BROWSE_HOST}:{site.BROWSE_PORT}/"
        try:
            with eventlet.Timeout(BROWSE_SECONDS):
                eventlet.connect((site.BROWSE_HOST, site.BROWSE_PORT)).close()
        except (OSError, eventlet.Timeout):
            why = f"The browser of recordings does not run at {where} yet: type the command beside the link first.\n"
            return flask.Response(why, 503, mimetype="text/plain")
        return flask.redirect(where)

    @app.post("/set-speed")
    def change_set_speed() -> tuple[dict[str, Any], int]:
        try:
            server.change_set_speed(speed_argument(posted("set_speed", str)))
        except argparse.ArgumentTypeError as error:
            return {"message": f"{error} (mph)"}, 400
        return {"set_speed": server.set_speed}, 200

    @app.post("/record")
    def record() -> tuple[dict[str, Any], int]:
        try:
            server.record(posted("recording", bool))
        except UserError as error:
            return {"message": str(error)}, 400
        return {"recording": server.recording}, 200

    return app


def stand_in(words: str, host: str, port: str) -> str:
    """Return a command of the stand-in simulator, with the options by which it connects to a server."""
    return program.in_commands(f"python -m simulator {words}{where_options(host, port)}")


def posted(name: str, kind: type) -> Any:
    """Return the one value, of this type and name, in the request's JSON; else end the request with status 400.

    A browser does not send JSON to another site without asking, whatever else keeps other sites out.
    """
    body = flask.request.get_json()
    if not isinstance(body, dict) or set(body) != {name} or type(body[name]) is not kind:
        flask.abort(400, f"This takes a JSON object with {name} alone.")
    return body[name]


def road_on_map(pause: Pause, track: str) -> list[list[float]]:
    """Return the points of a road's centre line, m to the east and the north; none for an unknown name.

    Another process generates them, for ROAD_SECONDS at most: this one could answer no car meanwhile. Where it can, it
    lets cars go first. pause: the server's.
    """
    code = (
        "import json, os, sys; getattr(os, 'nice', int)(10); from cloning.road.track import centre_line; "
        "print(centre_line(json.loads(sys.argv[1]))[:, :2].tolist())"
    )
    # In JSON, since an argument can't be any text.
    command, until = [*PYTHON, "-c", code, json.dumps(track)], time.monotonic() + ROAD_SECONDS
    with tempfile.TemporaryFile() as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.DEVNULL, env=environment())
        while process.poll() is None:
            if time.monotonic() > until:
                process.kill()
            pause(0.02)
        file.seek(0)
        found = file.read() if process.returncode == 0 else b"[]"
    return [[round(x, 1), round(y, 1)] for x, y in json.loads(found)]


class Pages:
    """The events for the open pages with or without attention: what is drawn and encoded for one of them serves all.

    Time is divided into intervals of UPDATE_INTERVAL. Each event shows the driving up to the first moment of its
    interval at which a page asked for one, so that all pages get the same picture, and most of them the same text.
    """

    def __init__(self, server: Server, with_attention: bool, pause: Pause):
        """with_attention: whether the pictures show what the network looks at; pause: the server's."""
        self.server, self.with_attention, self.pause = server, with_attention, pause
        self.open = 0  # number of pages
        self.interval = -1
        self.session: Session | None = None  # shown in this interval
        self.now = 0.0  # the time.monotonic() at which the graphs end
        self.state = ""
        self.until = 0.0  # time.monotonic() of its last frame shown
        self.picture = ""  # JPEG in base64, or "" if it is not drawn yet
        self.texts: dict[float, str] = {}  # of this interval's events, by the time of the first frame shown

    def events(self) -> Iterator[str]:
        """Yield server-sent events: when frames have been driven, when the state changes, and else once a second.

        Writing one fails once the page is closed, which ends this loop. Their JSON is that of `figures`, and with new
        frames also {"rows": [each a DrivenFrame], "image": JPEG in base64}.
        """
        self.open += 1
        phase = self.open % PHASES / PHASES / 2 * UPDATE_INTERVAL  # in the first half: a late event is still in time
        try:
            shown, state, last, quiet = None, "", 0.0, 0
            self.pause(0)
            while True:
                self._begin_interval()
                last = last if self.session is shown else 0.0
                quiet += 1
                if self.until > last or self.state != state or quiet >= QUIET_INTERVALS:
                    event = self._event(last)
                    shown, state, last, quiet = self.session, self.state, self.until, 0
                    yield event
                self.pause(UPDATE_INTERVAL - (time.perf_counter() - phase) % UPDATE_INTERVAL)  # so that none is missed
        finally:
            self.open -= 1

    def _begin_interval(self) -> None:
        """Choose what to show, if it is not chosen yet."""
        interval = int(time.perf_counter() / UPDATE_INTERVAL)  # on Windows monotonic() may have ticks of 15.6 ms
        if interval > self.interval:
            self.interval, self.session = interval, self.server.watched_session()
            self.now = self.session.heard if self.session and self.session.ended else time.monotonic()
            self.state = state_of(self.session, self.now)
            self.until = self.session.history[-1].time if self.session and self.session.history else 0.0
            self.picture, self.texts = "", {}

    def _event(self, last: float) -> str:
        """Return an event with the frames later than `last`, a time.monotonic()."""
        if last not in self.texts:
            event = {"state": self.state, **figures(self.server, self.session, self.now)}
            if self.session and self.until > last:
                self.picture = self.picture or image(self.server, self.session, self.with_attention)
                rows = frames_since(self.session.history, max(last, self.now - SHOWN_SECONDS))
                rows = [frame for frame in rows if frame.time <= self.until]
                rows = rows[:: -math.ceil(len(rows) / SHOWN_FRAMES)][::-1] if rows else []  # with the last one
                event |= {"rows": rows, "image": self.picture}
            self.texts[last] = f"data: {json.dumps(event)}\n\n"
        return self.texts[last]


def state_of(session: Session | None, now: float) -> str:
    """Return what a session does, by a name for which drive.js has the words; now: time.monotonic()."""
    if session is None:
        return "waiting"
    if session.ended:
        return "gone"
    if session.heard < now - SILENCE:
        return "silent"
    if session.manual:
        return "manual"
    if not session.history or session.history[-1].time < now - SILENCE:
        return "unusable"
    return "doubtful" if session.lost else "driving"


def figures(server: Server, session: Session | None, now: float) -> dict[str, Any]:
    """Return what the page tells besides the state and the graphs, for JSON; now: time.monotonic()."""
    shown: dict[str, Any] = {"set_speed": server.set_speed, "go_speed": server.go_speed, "recording": server.recording}
    if session and session.folder:
        saved, copy = (as_typed(f"{session.folder.path}{ending}") for ending in ("", "-recording"))
        convert, browse = f"python -m cloning.lerobot {saved} --output {copy}", f"python -m cloning.browse {copy}"
        commands = {"film": f"python video.py {saved}", "convert": convert, "browse": browse}
        shown |= {"saving": session.folder.progress()}
        shown |= {name: program.in_commands(command) for name, command in commands.items()}
    if session:
        recent = frames_since(session.history, now - RATE_SECONDS)
        rate = (len(recent) - 1) / max(now - recent[0].time, 1e-3) if recent else 0.0
        shown |= {"session": session.started, "now": now, "rate": rate, "frames": session.driven}
        shown |= {"unusable": session.unusable, "reason": session.reason}
        if session.place:
            shown |= {"track": session.place.track, "departures": session.place.departures}
    return shown


def frames_since(history: deque[DrivenFrame], first: float) -> list[DrivenFrame]:
    """Return the frames that are later than `first`, a time.monotonic()."""
    return list(itertools.takewhile(lambda frame: frame.time > first, reversed(history)))[::-1]


def image(server: Server, session: Session, with_attention: bool) -> str:
    """Return the session's last frame with its overlay, as a JPEG in base64."""
    assert session.frame is not None, "a session with driven frames has a last one"
    mask = visual_backprop(server.network, session.frame)[1] if with_attention else None
    picture = overlay(session.frame, session.history[-1].steering, mask)
    return base64.b64encode(encode(picture, JPEG_QUALITY)).decode()
