"""The page's server: figures as JSON, columns of numbers as bytes, frames as the JPEGs that they are."""

from typing import Any

import flask
import numpy as np

from cloning.browse.library import Library, UnknownError
from cloning.errors import UserError, message_of
from cloning.pilot import site

KEPT = 600  # s for which a browser does not ask again for a frame


def create_app(library: Library) -> flask.Flask:
    """Return the web application.

    `/` is the page; `/recordings` lists identifiers. Below `/recordings/ID`: `overview` and `details`, JSON;
    `columns/NAME`, little-endian float32 (n,); `rows/N`, JSON, and `rows/N/CAMERA.jpg`; `cuts`, to which POST adds and
    DELETE deletes one, {"first", "last", "reason"}; they answer with the details, and with the cut as "changed". What
    depends on the log takes `?version=`, and is refused with 409 when it has changed since. An error is {"message"}.
    """
    app = flask.Flask(__name__)
    site.prepare(app, "img-src 'self' data:")

    @app.errorhandler(UserError)
    @app.errorhandler(OSError)
    def explain(error: UserError | OSError) -> tuple[dict[str, str], int]:
        return {"message": message_of(error)}, 404 if isinstance(error, UnknownError) else 409

    @app.after_request
    def keep(response: flask.Response) -> flask.Response:
        if "Cache-Control" not in response.headers or response.status_code >= 400:
            response.headers["Cache-Control"] = "no-store"
        return response

    @app.get("/")
    def index() -> str:
        return flask.render_template("browse.html")

    @app.get("/recordings")
    def recordings() -> list[dict[str, str]]:
        return [{"id": identifier, "folder": str(folder)} for identifier, folder in library.folders.items()]

    @app.get("/recordings/<identifier>/overview")
    def overview(identifier: str) -> dict[str, Any]:
        return library.overview(identifier)

    @app.get("/recordings/<identifier>/details")
    def details(identifier: str) -> dict[str, Any]:
        return library.details(identifier)

    @app.get("/recordings/<identifier>/columns/<name>")
    def column(identifier: str, name: str) -> flask.Response:
        values = library.column(identifier, name, version())
        return flask.Response(np.ascontiguousarray(values, "<f4").tobytes(), mimetype="application/octet-stream")

    @app.get("/recordings/<identifier>/rows/<int:row>")
    def row(identifier: str, row: int) -> dict[str, Any]:
        return library.row(identifier, row, version())

    @app.get("/recordings/<identifier>/rows/<int:row>/<camera>.jpg")
    def frame(identifier: str, row: int, camera: str) -> flask.Response:
        response = flask.Response(library.jpeg(identifier, row, camera, version()), mimetype="image/jpeg")
        response.headers["Cache-Control"] = f"private, max-age={KEPT}"
        response.add_etag()
        response.make_conditional(flask.request)
        return response

    @app.post("/recordings/<identifier>/cuts")
    def cut(identifier: str) -> dict[str, Any]:
        changed = library.cut(identifier, **stretch())
        return library.details(identifier) | {"changed": changed}

    @app.delete("/recordings/<identifier>/cuts")
    def restore(identifier: str) -> dict[str, Any]:
        changed = library.restore(identifier, **stretch())
        return library.details(identifier) | {"changed": changed}

    return app


def version() -> str | None:
    """Return the version of the log that the request is about."""
    return flask.request.args.get("version")


def stretch() -> dict[str, str]:
    """Return the request's cut: {"first", "last", "reason"}. Ends the request with 400 if it has none."""
    body = flask.request.get_json()
    names = ("first", "last", "reason")
    if not isinstance(body, dict) or set(body) != set(names) or any(type(body[name]) is not str for name in names):
        flask.abort(400, "A cut is a JSON object with the texts first, last and reason.")
    return {name: body[name] for name in names}
