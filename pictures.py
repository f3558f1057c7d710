"""The pictures of a training run: frames with their steering, and the losses by epoch."""

import io

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont


def panel(frame: np.ndarray, title: str, angle: float) -> Image.Image:
    """A frame at twice its size under a title, with the angle as a number and as the way that the wheels point."""
    height, width = frame.shape[0] * 2, frame.shape[1] * 2
    picture = Image.new("RGB", (width, height + 40), "white")
    image = Image.fromarray(np.ascontiguousarray(frame))
    picture.paste(image.resize((width, height), Image.Resampling.BICUBIC), (0, 40))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(26)
    draw.text((10, 4), title, "black", font)
    draw.text((width - 10, 4), f"steering {angle + 0:+.3f}", "black", font, anchor="ra")
    heading = np.radians(25 * angle)  # steering -1..1 is -25°..25° at the front wheels
    start, end = (width / 2, height + 10), (width / 2 + 150 * np.sin(heading), height + 10 - 150 * np.cos(heading))
    draw.line([start, end], "black", 9)
    draw.line([start, end], "yellow", 5)
    return picture


def side_by_side(panels: list[Image.Image]) -> bytes:
    """One PNG of panels of one size, with a margin."""
    width, height = panels[0].size
    whole = Image.new("RGB", (len(panels) * (width + 12) + 12, height + 24), "white")
    for i, one in enumerate(panels):
        whole.paste(one, (12 + i * (width + 12), 12))
    file = io.BytesIO()
    whole.save(file, "PNG", compress_level=1)  # the usual 6 takes half a second and saves a tenth
    return file.getvalue()


def loss_picture(history: list[dict]) -> bytes:
    """Both losses by epoch, the best validation loss marked: a PNG."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    epochs, best = [row["epoch"] for row in history], min(history, key=lambda row: row["val_loss"])
    axes.plot(epochs, [row["loss"] for row in history], "o-", label="training (augmented, with dropout)")
    axes.plot(epochs, [row["val_loss"] for row in history], "o-", label="validation")
    axes.annotate(f"best {best['val_loss']:.4f}", (best["epoch"], best["val_loss"]), (0, 10), ha="center",
                  textcoords="offset points")
    axes.margins(x=0.08)
    axes.set(title="Mean squared error of the steering", xlabel="epoch", ylabel="mean squared error", ylim=(0, None))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend()
    axes.grid(alpha=0.3)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()
