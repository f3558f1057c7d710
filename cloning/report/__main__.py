"""Write the report of a training run: report.html, one file with everything in it, to hand in or to print.

    python -m cloning.report runs/a                                     # the folder that model.py has written to
    python -m cloning.report runs/a --held-out data/lake-cw             # also let the network drive recordings
    python -m cloning.report runs/a --lap lap.png                       # also show laps

Replays take about as long as the recordings; everything else takes seconds. `python -m simulator drive --picture
lap.png --report lap.json --film lap.mp4` makes the picture of a lap, and what is shown with it.
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("report")

import base64
import re
from pathlib import Path
from typing import Any

from cloning.base.arguments import command_line
from cloning.base.errors import UserError
from cloning.base.files import write
from cloning.base.outputs import check_folders, write_output
from cloning.recordings.log import find_folders
from cloning.report.content import Report
from cloning.training.run_files import RunFiles

SUFFIXES = {"jpeg": "jpg", "svg+xml": "svg"}


def main() -> int:
    """Write the report and print its name; return the exit status."""
    parser = command_line("python -m cloning.report", __doc__)
    add = parser.add_argument
    add("run", type=Path, metavar="FOLDER", help="folder that model.py has written to; report.html is written there")
    held_out = "recordings, or folders of recordings, that the network was not trained on: it drives them"
    add("--held-out", nargs="+", default=[], metavar="FOLDER", help=held_out)
    lap = "pictures of laps, to show with the film FILE.mp4 and the figures of FILE.json if they are beside it"
    add("--lap", nargs="+", type=Path, default=[], metavar="FILE.png", help=lap)
    add("--markdown", action="store_true", help="also write report.md, with its pictures in report/")
    arguments = parser.parse_args()
    if arguments.markdown:
        markdown_library()  # before all is replayed
    output = RunFiles(str(arguments.run / "model.pt")).report
    report = Report(arguments.run, arguments.lap)
    check_folders(str(output))
    report.replay(find_folders(arguments.held_out) if arguments.held_out else [])
    page = report.page()
    write_output(output, page.encode(errors="replace"))
    if arguments.markdown:
        write_markdown(page, output.with_suffix(".md"))
    print(f"{output}: open {output.resolve().as_uri()} in a browser")
    return program.DONE


def markdown_library() -> Any:
    """Return the optional library that converts to Markdown. Raises UserError if it is not installed."""
    try:
        import markdownify
    except ImportError as error:
        raise UserError(f"{error}; pip install markdownify") from None
    return markdownify


def write_markdown(page: str, path: Path) -> None:
    """Write a page's text as Markdown; the pictures are files in the folder of its name, films are left out.

    Raises the error of `markdown_library`, OSError.
    """
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    pictures = list[str]()

    def saved(found: re.Match) -> str:
        pictures.append(f"{folder.name}/{len(pictures) + 1}.{SUFFIXES.get(found[1], found[1])}")
        write(path.with_name(folder.name) / Path(pictures[-1]).name, base64.b64decode(found[2]))
        return pictures[-1]

    content = page[page.index("<main>") : page.index("</main>")]
    content = re.sub(r"<img class=.dark[^>]*>|<video.*?</video>", "", content, flags=re.DOTALL)  # dark twins, films
    content = re.sub(r'<th scope="rowgroup"(.*?)</th>', r"<td\1</td>", content)  # not another head of the table
    content = re.sub(r'data:image/([\w+]+);base64,([^"]+)', saved, content)
    text = markdown_library().markdownify(content, heading_style="ATX", bullets="*", escape_misc=True)
    write(path, text.encode(errors="replace"))


if __name__ == "__main__":
    program.run(main)
