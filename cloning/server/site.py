"""What every page has in common: its style, the library that draws its curves, and what a browser may do with it."""

import mimetypes

import flask

BROWSE_HOST, BROWSE_PORT = "127.0.0.1", 4568  # of the browser of recordings: next to the port of drive.py


def prepare(app: flask.Flask, *sources: str) -> None:
    """Serve `cloning/server/static/` at /site/, and give all answers the headers that keep other sites out.

    sources: of the Content-Security-Policy, besides scripts, styles and answers of the same address.
    """
    for kind, ending in (("text/javascript", ".js"), ("text/css", ".css")):  # which Windows may call text/plain
        mimetypes.add_type(kind, ending)
    app.register_blueprint(flask.Blueprint("site", __name__, static_folder="static", static_url_path="/site"))
    policy = [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self' 'unsafe-inline'",
        "connect-src 'self'",
        "frame-ancestors 'none'",
    ]

    @app.after_request
    def restrict(response: flask.Response) -> flask.Response:
        response.headers["Content-Security-Policy"] = "; ".join([*policy, *sources])
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        response.headers["X-Content-Type-Options"] = "nosniff"
        return response
