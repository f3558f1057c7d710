"""The page's server: figures as JSON, columns of numbers as bytes, frames as the JPEGs that they are."""

import math
import re
from pathlib import Path
from typing import Any

import flask
import numpy as np

from cloning.base import program
from cloning.base.errors import UserError, message_of
from cloning.browse.analyses import UnknownError
from cloning.browse.library import Library, ShownRecording
from cloning.browse.runs import Runs
from cloning.recordings.excluded import BYTES, EXCLUDED, TAGS, Cut, GoneError
from cloning.road.autonomy import LIMITS
from cloning.road.camera import CAMERA_HEIGHT, CAMERA_MATRIX
from cloning.road.motion import AXLE_TO_CAMERA, FULL_LOCK, REAR_AXLE, WHEELBASE
from cloning.server import site

SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")  # of playing
KEPT = 600  # s for which a browser does not ask again for a frame


def create_app(library: Library, runs: Runs) -> flask.Flask:
    """Return the web application; an error is {"message"}.

    What depends on the log takes `?version=`, and is refused with 409 when it has changed since. Columns are
    little-endian float32 (n,); POST tries one's analysis again, which failed. `cuts` and `tags` take [{"first", "last",
    "reason"}, …] to add or, by DELETE, to delete; they answer with the details and the "changed" ones, or with 410 if
    none to be deleted is there any more. POST begins what replays, comparisons and analyses need, DELETE ends or pauses
    it. `film.mp4` takes {"rows"}, "first-end,…"; `export` {"rows", "name", "others"}, the last one "ID,…", and answers
    what did not fit as "notes".
    """
    from cloning.server.libraries import eventlet  # here, because it needs the socket libraries

    eventlet.tpool.setup()  # now, since it fails for good if there are no file handles
    app = flask.Flask(__name__)
    site.prepare(app, "img-src 'self' data:", "media-src data:")
    scripts = sorted(path.name for path in Path(app.static_folder or "").glob("*.js"))  # all are asked for at once

    def shown(identifier: str) -> ShownRecording:
        # Its methods work in threads, so that others are answered while a long log is read.
        return eventlet.tpool.Proxy(library[identifier])

    @app.errorhandler(RecursionError)
    def nested(_: RecursionError) -> tuple[dict[str, str], int]:
        return {"message": "the request's JSON is nested too deeply"}, 400

    @app.errorhandler(UserError)
    @app.errorhandler(OSError)
    def explain(error: UserError | OSError) -> tuple[dict[str, str], int]:
        status = 404 if isinstance(error, UnknownError) else 410 if isinstance(error, GoneError) else 409
        return {"message": program.in_commands(message_of(error))}, status

    @app.after_request
    def keep(response: flask.Response) -> flask.Response:
        if "Cache-Control" not in response.headers or response.status_code >= 400:
            response.headers["Cache-Control"] = "no-store"
        return response

    @app.get("/")
    def index() -> str:
        camera = {"matrix": CAMERA_MATRIX.tolist(), "height": CAMERA_HEIGHT}
        camera |= {"lock": math.radians(FULL_LOCK), "wheelbase": WHEELBASE, "axle": AXLE_TO_CAMERA, "middle": REAR_AXLE}
        limits = [f"{each:g}" for each in LIMITS]
        return flask.render_template("browse.html", limits=limits, speeds=SPEEDS, camera=camera, scripts=scripts)

    @app.get("/recordings")
    def recordings() -> list[dict[str, str]]:
        eventlet.tpool.execute(library.look)
        return [{"id": identifier, "folder": str(folder)} for identifier, folder in library.recordings.items()]

    @app.get("/recordings/<identifier>/overview")
    def overview(identifier: str) -> dict[str, Any]:
        return shown(identifier).overview()

    @app.get("/recordings/<identifier>/details")
    def details(identifier: str) -> dict[str, Any]:
        return shown(identifier).details(asked("limit"))

    @app.route("/recordings/<identifier>/replays/<limit>", methods=["POST", "DELETE"])
    def replay(identifier: str, limit: str) -> dict[str, Any]:
        shown(identifier).replay(limit, begin=flask.request.method == "POST")
        return shown(identifier).details(limit)

    @app.get("/recordings/<identifier>/columns/<name>")
    def column(identifier: str, name: str) -> flask.Response:
        values = shown(identifier).column(name, asked("version"))
        return flask.Response(np.ascontiguousarray(values, "<f4").tobytes(), mimetype="application/octet-stream")

    @app.post("/recordings/<identifier>/columns/<name>")
    def retry(identifier: str, name: str) -> dict[str, Any]:
        shown(identifier).retry(name)
        return shown(identifier).details(asked("limit"))

    @app.get("/recordings/<identifier>/rows/<int:row>")
    def row(identifier: str, row: int) -> dict[str, Any]:
        return shown(identifier).row(row, asked("version"))

    @app.get("/recordings/<identifier>/rows/<int:row>/<picture>.jpg")
    def frame(identifier: str, row: int, picture: str) -> flask.Response:
        return kept(shown(identifier).jpeg(row, picture, asked("version")), "image/jpeg")

    @app.get("/recordings/<identifier>/rows/<int:row>/<picture>/<int:model>.png")
    def attention(identifier: str, row: int, picture: str, model: int) -> flask.Response:
        jpeg = shown(identifier).jpeg(row, picture, asked("version"))
        # In a thread, so that others are answered meanwhile; not kept, since the model may be trained anew.
        png = eventlet.tpool.execute(library.attention.png, jpeg, library.model(model))
        return flask.Response(png, mimetype="image/png")

    @app.route("/recordings/<identifier>/<any(cuts, tags):kind>", methods=["POST", "DELETE"])
    def cut(identifier: str, kind: str) -> dict[str, Any]:
        change = shown(identifier).cut if flask.request.method == "POST" else shown(identifier).restore
        changed = change(cuts(), TAGS if kind == "tags" else EXCLUDED)
        return shown(identifier).details(asked("limit")) | {"changed": changed}

    @app.get("/recordings/<identifier>/matches")
    def matches(identifier: str) -> dict[str, Any]:
        return shown(identifier).matches(flask.request.args.get("condition", ""), asked("limit"), asked("version"))

    @app.route("/recordings/<identifier>/compared", methods=["GET", "POST"])
    def compared(identifier: str) -> dict[str, Any]:
        return shown(identifier).compared(asked("limit") or f"{LIMITS[0]:g}", begin=flask.request.method == "POST")

    @app.post("/recordings/<identifier>/export")
    def export(identifier: str) -> dict[str, Any]:
        body = flask.request.get_json()
        body = body if isinstance(body, dict) else {}
        name, rows, others = (str(body.get(key, "")) for key in ("name", "rows", "others"))
        together = [library[other] for other in others.split(",") if other]
        folder, notes = shown(identifier).export(stretches(rows), asked("version") or "", name, together)
        return {"id": library.add(folder)[0], "folder": str(folder), "notes": notes}

    @app.post("/recordings/<identifier>/film.mp4")  # a request for thousands of stretches is too long for GET
    def film(identifier: str) -> flask.Response:
        body = flask.request.get_json()
        rows = str(body.get("rows", "")) if isinstance(body, dict) else ""
        mp4 = shown(identifier).film(stretches(rows), asked("version") or "")
        return flask.Response(mp4, mimetype="video/mp4", headers={"Content-Disposition": "attachment"})

    @app.route("/analyses", methods=["POST", "DELETE"])
    def analyses() -> dict[str, Any]:
        (library.analyses.resume if flask.request.method == "POST" else library.analyses.pause)()
        return {}

    @app.get("/runs")
    def found() -> list[dict[str, Any]]:
        return eventlet.tpool.execute(runs.found)  # in a thread, as there may be thousands

    @app.get("/runs/<int:index>")
    def run(index: int) -> dict[str, Any]:
        return eventlet.tpool.execute(runs.run, index)  # which waits where others look at the runs

    @app.get("/runs/<int:index>/report.html")
    def run_report(index: int) -> flask.Response:
        return flask.Response(runs.report(index), mimetype="text/html")

    @app.get("/runs/<int:index>/<name>")
    def run_picture(index: int, name: str) -> flask.Response:
        return kept(runs.picture(index, name), "image/png")

    return app


def kept(picture: bytes, mime_type: str) -> flask.Response:
    """Return an answer that a browser keeps for KEPT seconds."""
    response = flask.Response(picture, mimetype=mime_type)
    response.headers["Cache-Control"] = f"private, max-age={KEPT}"
    response.add_etag()
    response.make_conditional(flask.request)
    return response


def asked(name: str) -> str | None:
    """Return what the request is about: the `version` of the log, the `limit` of the replays; None if it has none."""
    return flask.request.args.get(name)


def cuts() -> list[Cut]:
    """Return the request's cuts: [{"first", "last", "reason"}, …]. Ends the request with 400 if it has none."""
    try:
        body = flask.request.get_json()
        if not isinstance(body, list) or not body or any(set(each) != {"first", "last", "reason"} for each in body):
            raise TypeError
        for each in body:
            "".join(each.values()).encode(**BYTES)
    except (AttributeError, TypeError, UnicodeEncodeError):  # no texts; half of one
        flask.abort(400, "Cuts are a list of JSON objects with the texts first, last and reason.")
    return [Cut(**each) for each in body]


def stretches(text: str) -> list[list[int]]:
    """Return the stretches in a text such as "0-15,30-45". Ends the request with 400 if it has none."""
    if not re.fullmatch(r"\d{1,9}-\d{1,9}(,\d{1,9}-\d{1,9})*", text):
        flask.abort(400, "Rows are stretches such as 0-15,30-45.")
    return [[int(row) for row in stretch.split("-")] for stretch in text.split(",")]
