"""What every page has in common: its style, and what a browser may do with it."""

from pathlib import Path

import flask

STYLE = Path(__file__).with_name("style.css").read_text(encoding="utf-8")


def prepare(app: flask.Flask, *sources: str) -> None:
    """Give an application's templates the common `style`, and its answers the headers that keep other sites out.

    sources: of the Content-Security-Policy, besides scripts and answers of the same address, and styles in the page.
    """
    app.jinja_env.globals["style"] = STYLE
    policy = ["default-src 'none'", "style-src 'self' 'unsafe-inline'", "connect-src 'self'", "frame-ancestors 'none'"]

    @app.after_request
    def restrict(response: flask.Response) -> flask.Response:
        response.headers["Content-Security-Policy"] = "; ".join([*policy, *sources])
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        response.headers["X-Content-Type-Options"] = "nosniff"
        return response
