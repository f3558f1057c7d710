"""The web page that shows the car driving, made with Flask."""

import base64
import itertools
import json
import time
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import flask
import numpy as np

from cloning.pilot import attention
from cloning.pilot.network import Network
from cloning.recordings.images import encode
from cloning.wire import server as wire

SHOWN_SECONDS = 60  # of driving in the graphs
HISTORY_FRAMES = SHOWN_SECONDS * 120  # that a session remembers: enough for 120 frames/s
UPDATE_INTERVAL = 0.1  # s between two pictures
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

    @app.after_request
    def restrict(response: flask.Response) -> flask.Response:
        response.headers["Content-Security-Policy"] = (
            "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
            "connect-src 'self'; frame-ancestors 'none'"
        )
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        return response

    @app.get("/")
    def index() -> str:
        return flask.render_template("index.html", set_speed=server.set_speed, seconds=SHOWN_SECONDS)

    @app.get("/live")
    def live() -> flask.Response:
        return flask.Response(
            events(server, "attention" in flask.request.args),
            mimetype="text/event-stream",
            headers={"Cache-Control": "no-store"},
        )

    return app


def events(server: Server, with_attention: bool) -> Iterator[str]:
    """Yield the figures and the picture as server-sent events, whenever frames have been driven.

    Their JSON is {"session", "rows": [[time, steering, speed, throttle, latency], …], "image"}.
    with_attention: whether the image shows what the network looks at.
    """
    shown, last = None, 0.0
    while True:
        session = server.watched_session()
        last = last if session is shown else 0.0
        rows = frames_since(session.history, last) if session else []
        if session and rows:
            shown, last = session, rows[-1].time
            event = {"session": id(session), "rows": rows, "image": image(server, session, with_attention)}
            yield f"data: {json.dumps(event)}\n\n"
        else:
            yield ":\n\n"  # a comment: writing it fails once the page is closed, which ends this loop
        wire.eventlet.sleep(UPDATE_INTERVAL)


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
