"""A report as Markdown, with its pictures in a folder beside it."""

import base64
import re
from pathlib import Path

from cloning.base.errors import UserError
from cloning.base.files import write

SUFFIXES = {"jpeg": "jpg", "svg+xml": "svg"}


def write_markdown(page: str, path: Path) -> None:
    """Write a page's text as Markdown; the pictures are files in the folder of its name, films are left out.

    Raises UserError if the library that converts it is not installed, OSError.
    """
    try:
        import markdownify  # an optional library
    except ImportError as error:
        raise UserError(f"{error}; pip install markdownify") from None
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    pictures = list[str]()

    def saved(found: re.Match) -> str:
        pictures.append(f"{folder.name}/{len(pictures) + 1}.{SUFFIXES.get(found[1], found[1])}")
        write(path.with_name(folder.name) / Path(pictures[-1]).name, base64.b64decode(found[2]))
        return pictures[-1]

    content = page[page.index("<main>") : page.index("</main>")]
    content = re.sub(r"<source[^>]*>|<video.*?</video>", "", content, flags=re.DOTALL)  # dark twins, films
    content = re.sub(r'data:image/([\w+]+);base64,([^"]+)', saved, content)
    write(path, markdownify.markdownify(content, heading_style="ATX", bullets="*").encode(errors="replace"))
