"""Make the pictures of a training run: frames with their steering, and the losses by epoch."""

import io
import math

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cloning.base.figure import png
from cloning.base.files import csv_bytes, write
from cloning.recordings.format import CAMERAS
from cloning.road.motion import FULL_LOCK
from cloning.training.observations import Choices
from cloning.training.recipe import Recipe
from cloning.training.run_files import EpochMetrics, RunFiles

SCALE = 3  # of a frame's pixels: three frames in a row are 25 cm wide at 300 dpi
FONT, MARGIN = 44, 12  # pixels: of the captions, which stay legible at a third of the size; between panels
DPI = 200  # of the curves, which are 8 inches wide


def panel(frame: np.ndarray, title: str, steering: float, caption: str = "") -> Image.Image:
    """Return an enlarged frame under a title, with the steering as a number and as the wheels' direction.

    frame: uint8 (rows, columns, 3), RGB; steering: -1..1; caption: after the number; a line holds 45 characters.
    """
    rows, columns = frame.shape[:2]
    top, width, height = round(2.5 * FONT), columns * SCALE, rows * SCALE
    picture = Image.new("RGB", (width, top + height), "white")
    image = Image.fromarray(np.ascontiguousarray(frame))
    # Every pixel as it is: that is what is trained on, and as a PNG it takes a third of an interpolated one.
    picture.paste(image.resize((width, height), Image.Resampling.NEAREST), (0, top))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(FONT)
    number = f"steering {steering + 0:+.3f}"  # + 0 turns -0 into 0
    for line, text in enumerate((title, f"{number}, {caption}" if caption else number)):
        draw.text((4, line * 1.2 * FONT), text, "black", font)
    heading = np.radians(FULL_LOCK * steering)
    start, length = np.array([width / 2, top + (rows - 15) * SCALE]), min(75, rows - 20) * SCALE  # within the frame
    end = start + length * np.array([np.sin(heading), -np.cos(heading)])
    for colour, thickness in (("black", 13), ("yellow", 7)):
        draw.line([*start, *end], colour, thickness)
    return picture


def grid(panels: list[Image.Image], columns: int) -> bytes:
    """Return a PNG of panels of equal size, row by row, with margins."""
    width, height = panels[0].width + MARGIN, panels[0].height + MARGIN
    rows = -(-len(panels) // columns)
    whole = Image.new("RGB", (columns * width + MARGIN, rows * height + MARGIN), "white")
    for i, picture in enumerate(panels):
        whole.paste(picture, (MARGIN + i % columns * width, MARGIN + i // columns * height))
    file = io.BytesIO()
    whole.save(file, "PNG")
    return file.getvalue()


def batch_pictures(choices: Choices, recipe: Recipe) -> dict[str, bytes]:
    """Return the report's two pictures of a batch's first observation: file name, with {} for the count, -> PNG.

    One shows the left, centre and right image, the other an image of each augmentation, each with its label.
    """
    example = choices.views.example(0)
    center, left, right = map(panel, example.frames, CAMERAS, example.camera_labels)
    panels = []
    for i, augmentation in enumerate(recipe.augmentations):
        chosen = [column[:1] for column in choices.augmenting[i]]
        made = augmentation.change(example.images[i], example.first_row, *chosen)
        image = choices.views.finished(i, made, np.zeros(1, int))[0]
        caption = augmentation.caption.format(*(column[0] for column in chosen))
        panels.append(panel(image, example.titles[i], choices.views.labels[0, i], caption))
    return {
        "training_generator_LRC_{}.png": grid([left, center, right], columns=3),
        "training_generator_augmented-{}.png": grid(panels, columns=2),
    }


def write_losses(files: RunFiles, history: list[EpochMetrics], dropout: bool) -> None:
    """Write training_log.csv, a line for each finished epoch, and `loss_picture`; an unknown figure is empty."""
    rows = (["" if math.isnan(figure) else figure for figure in row.values()] for row in history)
    write(files.log, csv_bytes([history[0], *rows]))
    write(files.losses, loss_picture(history, dropout))


def loss_picture(history: list[EpochMetrics], dropout: bool) -> bytes:
    """Return a PNG of both losses by epoch, and of val_drift where it is known, with the lowest validation loss marked.

    dropout: whether the network is trained with it.
    """
    # matplotlib is large, and not needed before the first epoch is finished.
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    epochs, best = [row["epoch"] for row in history], min(history, key=lambda row: row["val_loss"])
    name = f"training (augmented, with{'' if dropout else 'out'} dropout)"
    axes.plot(epochs, [row["loss"] for row in history], "o-", label=name)
    (line,) = axes.plot(epochs, [row["val_loss"] for row in history], "o-", label="validation")
    axes.plot(best["epoch"], best["val_loss"], "o", color=line.get_color(), markersize=13, fillstyle="none")
    finding = f"The validation loss is lowest in epoch {best['epoch']:.0f}: {best['val_loss']:.4f}"
    axes.set(title=finding, xlabel="epoch", ylabel="mean squared error of the steering", ylim=(0, None))
    axes.set_xlim(0.5, len(history) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 2.5, 5, 10], integer=True, min_n_ticks=1))
    drift = [row["val_drift"] for row in history]
    if not np.isnan(drift).all():
        right = axes.twinx()
        right.plot(epochs, drift, "s--", color="tab:green")
        right.set(ylabel="drift, m", ylim=(0, None))
        label = "drift in two seconds of driving, validation"
        axes.plot([], [], "s--", color="tab:green", label=label)  # for the one legend
    figure.legend(loc="outside lower center")
    axes.grid(alpha=0.3)
    return png(figure, DPI)
