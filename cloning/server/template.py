"""Pages that are one file with everything in it, in the style of every page; without flask, which needs eventlet."""

from pathlib import Path

import jinja2

STATIC = Path(__file__).with_name("static")
STYLES = STATIC / "style.css", STATIC / "report.css"


def whole_page(templates: Path, **values: object) -> str:
    """Return a folder's report.html with these values, and `style`. Raises jinja2.UndefinedError if it needs others."""
    loader = jinja2.FileSystemLoader(templates)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    style = "".join(sheet.read_text(encoding="utf-8") for sheet in STYLES)
    return environment.get_template("report.html").render(style=style, **values)
