"""The web page that shows the car driving, made with Flask."""

import base64
import itertools
import json
import math
import time
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import flask
import numpy as np

from cloning.pilot import attention, site
from cloning.pilot.network import Network
from cloning.recordings.images import encode
from cloning.wire.libraries import eventlet
from cloning.wire.turns import STRANGERS, TURNS

SHOWN_SECONDS = 60  # of driving in the graphs
HISTORY_FRAMES = SHOWN_SECONDS * 120  # that a session remembers: enough for 120 frames/s
SHOWN_FRAMES = 1200  # at most, in one event: as many as a graph has pixels; a new page gets the whole minute
UPDATE_INTERVAL = 0.1  # s between two pictures
QUIET_INTERVALS = 10  # without driving, after which a page gets a sign that the server is there
MAX_PAGES = 64  # open at once
JPEG_QUALITY = 80  # of the pictures


class DrivenFrame(NamedTuple):
    """The figures of one driven frame."""

    time: float  # seconds since 1970
    steering: float  # -1..1
    speed: float  # mph
    throttle: float  # -1..1
    latency: float  # ms in drive.py, from reading the telemetry's first fragment to its finished answer


class Session(Protocol):
    """What the page shows of a connected simulator."""

    history: deque[DrivenFrame]
    frame: np.ndarray | None  # the last driven one: uint8 (160, 320, 3), RGB; None before the first


class Server(Protocol):
    """What the page needs of the server that drives."""

    network: Network
    set_speed: float  # mph

    def watched_session(self) -> Session | None:
        """Return the session to show, or None."""


def create_app(server: Server) -> flask.Flask:
    """Return the web application: `/` is the page, `/live` its figures and pictures as server-sent events."""
    app = flask.Flask(__name__)
    site.prepare(app, "script-src 'self' 'unsafe-inline'", "img-src data:")
    pages = {False: Pages(server, with_attention=False), True: Pages(server, with_attention=True)}

    @app.get("/")
    def index() -> str:
        return flask.render_template("index.html", set_speed=server.set_speed, seconds=SHOWN_SECONDS)

    @app.get("/live")
    def live() -> flask.Response:
        if sum(each.open for each in pages.values()) >= MAX_PAGES:
            return flask.Response(f"{MAX_PAGES} pages are open already.\n", 503, mimetype="text/plain")
        return flask.Response(
            pages["attention" in flask.request.args].events(),
            mimetype="text/event-stream",
            headers={"Cache-Control": "no-store"},
        )

    return app


class Pages:
    """The events for the open pages of one kind: what is drawn and encoded for one of them serves all.

    Time is divided into intervals of UPDATE_INTERVAL. Each event shows the driving up to the first moment of its
    interval at which a page asked for one, so that all pages get the same picture, and most of them the same text.
    """

    def __init__(self, server: Server, with_attention: bool):
        """with_attention: whether the pictures show what the network looks at."""
        self.server, self.with_attention = server, with_attention
        self.open = 0  # number of pages
        self.interval = -1
        self.session: Session | None = None  # shown in this interval
        self.until = 0.0  # time of its last frame shown, in seconds since 1970
        self.picture = ""  # data URL, or "" if it is not drawn yet
        self.texts: dict[float, str] = {}  # of this interval's events, by the time of the first frame shown

    def events(self) -> Iterator[str]:
        """Yield the figures and the picture as server-sent events, whenever frames have been driven.

        Their JSON is {"session", "rows": [[time, steering, speed, throttle, latency], …], "image"}.
        """
        self.open += 1
        try:
            shown, last, quiet = None, 0.0, QUIET_INTERVALS - 1  # so that a page hears at once
            while True:
                TURNS.take(STRANGERS)
                self._begin_interval()
                last = last if self.session is shown else 0.0
                if self.session and self.until > last:
                    event = self._event(self.session, last)
                    shown, last, quiet = self.session, self.until, 0
                    yield event
                else:
                    quiet += 1
                    if quiet % QUIET_INTERVALS == 0:
                        yield ":\n\n"  # a comment: writing it fails once the page is closed, which ends this loop
                eventlet.sleep(UPDATE_INTERVAL)
        finally:
            self.open -= 1

    def _begin_interval(self) -> None:
        """Choose what to show, if it is not chosen yet."""
        interval = int(time.monotonic() / UPDATE_INTERVAL)
        if interval > self.interval:
            self.interval, self.session = interval, self.server.watched_session()
            self.until = self.session.history[-1].time if self.session else 0.0
            self.picture, self.texts = "", {}

    def _event(self, session: Session, last: float) -> str:
        """Return an event with the frames later than `last`, in seconds since 1970."""
        if not self.picture:
            self.picture = image(self.server, session, self.with_attention)
        if last not in self.texts:
            rows = [frame for frame in frames_since(session.history, last) if frame.time <= self.until]
            thinned = rows[:: -math.ceil(len(rows) / SHOWN_FRAMES)][::-1]  # with the last one
            event = {"session": id(session), "rows": thinned, "image": self.picture}
            self.texts[last] = f"data: {json.dumps(event)}\n\n"
        return self.texts[last]


def frames_since(history: deque[DrivenFrame], last: float) -> list[DrivenFrame]:
    """Return the frames of the last SHOWN_SECONDS that are later than `last`, in seconds since 1970."""
    first = max(last, time.time() - SHOWN_SECONDS)
    return list(itertools.takewhile(lambda frame: frame.time > first, reversed(history)))[::-1]


def image(server: Server, session: Session, with_attention: bool) -> str:
    """Return the session's last frame with its overlay, as a data URL."""
    assert session.frame is not None, "a session with driven frames has a last one"
    mask = attention.visual_backprop(server.network, session.frame)[1] if with_attention else None
    picture = attention.overlay(session.frame, session.history[-1].steering, mask)
    return "data:image/jpeg;base64," + base64.b64encode(encode(picture, JPEG_QUALITY)).decode()
