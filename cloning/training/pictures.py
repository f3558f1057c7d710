"""Make the pictures of a training run: frames with their steering, and the losses by epoch."""

import io
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cloning.recordings.format import CAMERAS
from cloning.road.motion import FULL_LOCK
from cloning.training.checkpoint import EpochMetrics
from cloning.training.observations import Augmented, Choices

Augment = Callable[[Choices, np.ndarray, list[np.ndarray], int], list[Augmented]]


def panel(frame: np.ndarray, title: str, steering: float) -> Image.Image:
    """Return a frame at twice its size under a title, with the steering as a number and as the wheels' direction.

    frame: uint8 (rows, columns, 3), RGB; steering: -1..1.
    """
    height, width = frame.shape[0] * 2, frame.shape[1] * 2
    picture = Image.new("RGB", (width, height + 40), "white")
    image = Image.fromarray(np.ascontiguousarray(frame))
    picture.paste(image.resize((width, height), Image.Resampling.BICUBIC), (0, 40))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(26)
    draw.text((10, 4), title, "black", font)
    draw.text((width - 10, 4), f"steering {steering + 0:+.3f}", "black", font, anchor="ra")  # + 0 turns -0 into 0
    heading = np.radians(FULL_LOCK * steering)
    length, start = (
        min(150, height - 40),
        np.array([width / 2, height + 10]),
    )  # within the image, which begins in row 40
    end = start + length * np.array([np.sin(heading), -np.cos(heading)])
    for colour, thickness in (("black", 9), ("yellow", 5)):
        draw.line([*start, *end], colour, thickness)
    return picture


def side_by_side(panels: list[Image.Image]) -> bytes:
    """Return a PNG of panels of equal size in a row, with margins."""
    width, height = panels[0].size
    whole = Image.new("RGB", (len(panels) * (width + 12) + 12, height + 24), "white")
    for i, picture in enumerate(panels):
        whole.paste(picture, (12 + i * (width + 12), 12))
    file = io.BytesIO()
    whole.save(file, "PNG", compress_level=1)  # the default, 6, takes half a second and saves a tenth
    return file.getvalue()


def batch_pictures(choices: Choices, augment: Augment) -> dict[str, bytes]:
    """Return the report's two pictures of a batch's first observation: file name, with {} for the count, -> PNG.

    One shows the left, centre and right image, the other the four kinds of image, each with its label.
    augment: model.augment.
    """
    choices.places[0] = 0  # so that all four kinds of image are made
    example = choices.views.example(0)
    center, left, right = (
        panel(frame, camera, label)
        for frame, camera, label in zip(example.frames, CAMERAS, example.camera_labels, strict=True)
    )
    images = [kind.images[0] for kind in augment(choices, np.array([0]), example.images, example.first_row)]
    titles = [*example.titles, f"brightness x {choices.brightness[0]:.2f}", f"shadow x {choices.darkness[0]:.2f}"]
    kinds = [panel(*column) for column in zip(images, titles, choices.views.labels[0], strict=True)]
    return {
        "training_generator_LRC_{}.png": side_by_side([left, center, right]),
        "training_generator_augmented-{}.png": side_by_side(kinds),
    }


def loss_picture(history: list[EpochMetrics]) -> bytes:
    """Return a PNG of both losses by epoch, with the lowest validation loss marked."""
    # matplotlib is large, and not needed before the first epoch is finished.
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    epochs, best = [row["epoch"] for row in history], min(history, key=lambda row: row["val_loss"])
    axes.plot(epochs, [row["loss"] for row in history], "o-", label="training (augmented, with dropout)")
    name = f"validation (best: {best['val_loss']:.4f} in epoch {best['epoch']:.0f})"
    (line,) = axes.plot(epochs, [row["val_loss"] for row in history], "o-", label=name)
    axes.plot(best["epoch"], best["val_loss"], "o", color=line.get_color(), markersize=13, fillstyle="none")
    axes.margins(x=0.08)
    axes.set(title="Mean squared error of the steering", xlabel="epoch", ylabel="mean squared error", ylim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 2.5, 5, 10], integer=True))
    axes.legend()
    axes.grid(alpha=0.3)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()
