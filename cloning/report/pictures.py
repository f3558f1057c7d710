"""Pictures of a report, as data URIs: a page that contains them needs no other file."""

import base64
import io
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from cloning.base.errors import UserError
from cloning.base.film import FilmWriter
from cloning.recordings.format import BINS
from cloning.recordings.images import encode

QUALITY = 85  # of JPEGs
WIDEST = 1400  # px: sharp on paper, and a tenth of the bytes of the run's own pictures
CLEAR = {f"{part}.facecolor": "none" for part in ("figure", "axes", "savefig")}
TEXT = {"svg.fonttype": "none", "svg.hashsalt": "report"}  # as text, not as curves; with the same identifiers each time


class Chart(NamedTuple):
    """The same curves as data URIs: in dark ink for light paper, and the other way round."""

    light: str
    dark: str


def uri(data: bytes, kind: str) -> str:
    """Return a data URI; kind: of the data, such as "image/jpeg"."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def frame_uri(frame: np.ndarray) -> str:
    """Return a data URI of a frame, uint8 (rows, columns, 3), RGB."""
    return uri(encode(frame, QUALITY), "image/jpeg")


def picture_uri(source: Path | Image.Image) -> str:
    """Return a data URI of a picture, at most WIDEST wide. Raises UserError if it is no whole picture, OSError."""
    try:
        picture = (Image.open(source) if isinstance(source, Path) else source).convert("RGB")
    except (OSError, SyntaxError) as error:  # the second for some damaged PNGs
        if isinstance(error, OSError) and error.filename:  # cannot be read
            raise
        raise UserError(f"{source}: not a whole picture, such as a PNG or a JPEG; make it again") from None
    picture.thumbnail((WIDEST, WIDEST))
    file = io.BytesIO()
    picture.save(file, "JPEG", quality=QUALITY)
    return uri(file.getvalue(), "image/jpeg")


def film_uri(film: Path, most: int) -> str:
    """Return a data URI of an mp4 film; one of more than `most` bytes becomes about as small, with half the frames.

    Raises UserError if such a film cannot be read, OSError.
    """
    if film.stat().st_size <= most:
        return uri(film.read_bytes(), "video/mp4")
    import av  # slow to import, and not needed for a short film

    with TemporaryDirectory() as folder:
        small = Path(folder, "film.mp4")
        try:
            with av.open(str(film)) as opened:
                stream = opened.streams.video[0]
                seconds = Fraction(opened.duration or 0, av.time_base)
                rate = Fraction(stream.average_rate or 0) / 2
                with FilmWriter(small, rate, quality=28, max_bits=int(8 * most / seconds)) as writer:
                    for number, frame in enumerate(opened.decode(stream)):
                        if number % 2 == 0:
                            writer.add(frame.to_ndarray(format="rgb24"))
            return uri(small.read_bytes(), "video/mp4")
        except (av.FFmpegError, FileNotFoundError, IndexError, ZeroDivisionError):  # unreadable; no frame, stream, time
            raise UserError(f"{film}: not a whole film; make it again") from None


def chart(*draws: Callable[[Axes], object]) -> Chart:
    """Return what functions draw on axes side by side, without text or background of its own colour."""
    drawn = []
    for style in ("default", "dark_background"):
        with matplotlib.style.context([style, CLEAR, TEXT]):
            figure = Figure(figsize=(7, 3), layout="constrained")
            for axes, draw in zip(figure.subplots(1, len(draws), squeeze=False)[0], draws, strict=True):
                draw(axes)
                axes.grid(alpha=0.3)
            file = io.BytesIO()
            figure.savefig(file, format="svg", metadata={"Date": None})
            drawn.append(uri(file.getvalue(), "image/svg+xml"))
    return Chart(*drawn)


def steering_chart(counts: dict[str, np.ndarray]) -> Chart:
    """Return histograms of steering, on one scale, whose titles say how much of it is straight on.

    counts: what a title calls them, with "{}" for their number -> int (BINS,), rows from -1 to 1.
    """
    most = 1.5 * max(max(each) for each in counts.values())

    def draw(title: str, axes: Axes) -> None:
        axes.stairs(counts[title], np.linspace(-1, 1, BINS + 1), fill=True)
        scale = {"yscale": "log", "xlim": (-1, 1), "ylim": (0.7, most)}
        rows, straight = sum(counts[title]), counts[title][BINS // 2]
        finding = f"{100 * straight / max(1, rows):.0f} % {title.format(rows)},\nsteer straight on"
        axes.set_title(finding, fontsize="medium")  # short enough for two beside each other
        axes.set(xlabel="steering, -1 left to 1 right", ylabel="rows", **scale)

    return chart(*(partial(draw, title) for title in counts))


def epochs_chart(run: dict[str, Any], names: dict[str, str], ylabel: str) -> Chart:
    """Return metrics by epoch, with the best epoch marked.

    run: of `browse.runs.overview`; names: metric -> its name in the legend. With the loss, it shows those within the
    epochs, too, where the run knows them.
    """
    epochs, best = [row["epoch"] for row in run["history"]], run["best"]["epoch"]

    def draw(axes: Axes) -> None:
        for metric, name in names.items():
            values = [row[metric] for row in run["history"]]
            axes.plot(epochs, np.array(values, float), "o-", label=name)  # None, which is unknown, becomes nan
        axes.axvline(best, linestyle=":", color="tab:green", label=f"best epoch: {best}")
        if "loss" in names and run["trail"]:
            axes.plot(*zip(*run["trail"], strict=True), color="tab:gray", linewidth=0.8, label="within the epochs")
        axes.set(xlabel="epoch", ylabel=ylabel, xlim=(0, epochs[-1] + 0.5), ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True))
        axes.legend()

    return chart(draw)
