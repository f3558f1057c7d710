"""The page on which to watch the driving, served by Flask."""

import base64
import itertools
import json
import time
from typing import NamedTuple

import cv2
import flask

from cloning.pilot import attention
from cloning.wire import server as wire

TRAIL = 60 * 120  # rows: a minute at 120 frames/s
EVERY = 0.1  # seconds between two pictures


class Row(NamedTuple):
    """One driven frame."""

    time: float  # seconds since 1970
    steering: float  # -1..1
    speed: float  # mph
    throttle: float  # -1..1
    latency: float  # ms from the telemetry's first fragment to its answer


def create_app(server) -> flask.Flask:
    """server: a drive.DriveServer."""
    app = flask.Flask(__name__)

    @app.after_request
    def closed(response):
        response.headers["Content-Security-Policy"] = (
            "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
            "connect-src 'self'; frame-ancestors 'none'"
        )
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        return response

    @app.get("/")
    def index():
        return flask.render_template("index.html", set_speed=server.set_speed)

    @app.get("/live")
    def live():
        """Server-sent events: {"session", "rows": [[time, steering, speed, throttle, latency], …], "image"}."""
        return flask.Response(
            events(server, "attention" in flask.request.args),
            mimetype="text/event-stream",
            headers={"Cache-Control": "no-store"},
        )

    return app


def events(server, with_attention: bool):
    shown, until = None, 0.0
    while True:
        session = server.watched()
        until = until if session is shown else 0.0
        rows = newer(session.trail, until) if session else []
        if rows:
            shown, until = session, rows[-1].time
            live = {"session": id(session), "rows": rows, "image": image(server, session, with_attention)}
            yield f"data: {json.dumps(live)}\n\n"
        else:
            yield ":\n\n"  # a comment, so that a page that has been closed is noticed
        wire.eventlet.sleep(EVERY)


def newer(trail, until: float) -> list[Row]:
    rows = list(itertools.takewhile(lambda row: row.time > until, reversed(trail)))
    return [row for row in reversed(rows) if row.time > time.time() - 60]


def image(server, session, with_attention: bool) -> str:
    """The last frame with the steering drawn on it, as a data URL."""
    mask = attention.visual_backprop(server.network, session.frame)[1] if with_attention else None
    picture = attention.overlay(session.frame, session.trail[-1].steering, mask)
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
