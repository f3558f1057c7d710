"""The pictures of a training run: frames with their steering, and the losses by epoch."""

import io

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from cloning.pilot.network import CROP
from cloning.recordings.format import CAMERAS
from cloning.road.motion import FULL_LOCK


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
    heading = np.radians(FULL_LOCK * angle)
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


def batch_pictures(generator, number: int) -> dict[str, bytes]:
    """The report's two pictures of the first observation in a batch of model.py's Generator, by the three cameras and
    augmented: file name, with {} for the count, -> PNG."""
    drawn, observations = generator.draw(number), generator.observations
    at, camera = drawn["observation"][0], drawn["camera"][0]
    frames = [observations.read(at, i) for i in range(3)]
    drawn["places"][0] = 0  # show every kind, also what chance left out of the batch
    if observations.lanes:
        angles = observations.lanes.beside_cameras(at)
        shown, first_row, titles = generator.images(drawn, np.array([0])), CROP[0], ["from a pose", "from another"]
    else:
        angles = observations.steering[at] + generator.corrections
        frame = frames[camera][None]
        shown, first_row, titles = [frame, frame[:, :, ::-1], frame, frame], 0, [f"{CAMERAS[camera]} camera", "flipped"]
    titles += [f"brightness x {drawn['brightness'][0]:.2f}", f"shadow x {drawn['darkness'][0]:.2f}"]
    augmented = [made[0] for _, made in generator.augment(drawn, np.array([0]), shown, first_row)]
    angle = drawn["angles"][0]
    center, left, right = (panel(*one) for one in zip(frames, CAMERAS, angles, strict=True))
    return {
        "training_generator_LRC_{}.png": side_by_side([left, center, right]),
        "training_generator_augmented-{}.png": side_by_side(
            [panel(*one) for one in zip(augmented, titles, angle, strict=True)]
        ),
    }


def loss_picture(history: list[dict]) -> bytes:
    """Both losses by epoch, the best validation loss marked: a PNG."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    epochs, best = [row["epoch"] for row in history], min(history, key=lambda row: row["val_loss"])
    axes.plot(epochs, [row["loss"] for row in history], "o-", label="training (augmented, with dropout)")
    axes.plot(epochs, [row["val_loss"] for row in history], "o-", label="validation")
    axes.annotate(
        f"best {best['val_loss']:.4f}",
        (best["epoch"], best["val_loss"]),
        (0, 10),
        ha="center",
        textcoords="offset points",
    )
    axes.margins(x=0.08)
    axes.set(title="Mean squared error of the steering", xlabel="epoch", ylabel="mean squared error", ylim=(0, None))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend()
    axes.grid(alpha=0.3)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()
