"""Foul weather, dirt and faults of the camera, as they change the frames of a drive: 22 kinds in five strengths.

Strength 3 is about what Hendrycks and Dietterich's benchmark (arXiv 1903.12261, for images of 224 x 224, which have as
many pixels as ours) and perturbation-drive (ICST 2025) call the third of five; at 5 a person could hardly drive. OpenCV
does the work, because no library that is kept up has these kinds, lets raindrops stay on the lens from frame to frame,
and is fast enough for a training: albumentations ended in 2025 (its successor has another licence), imagecorruptions in
2020, and kornia's rain and snow choose anew for each image.

`Disturber` changes a drive's frames one after the other; `disturb` a single image.
"""

import functools
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.random import Generator, default_rng

from cloning.recordings.images import encode, pixels

STRENGTHS = (1, 2, 3, 4, 5)


class Kind(NamedTuple):
    """A kind of disturbance."""

    # (image, parameter, seed, frame) -> the changed image, both uint8 (rows, columns, 3), RGB; seed: of what lasts for
    # a drive; frame: random numbers of one frame.
    change: Callable[[np.ndarray, float, int, Generator], np.ndarray]
    strengths: tuple[float, float, float, float, float]  # the parameter of each strength


def _drive(seed: int) -> Generator:
    """Return the random numbers that are the same for all frames of a drive."""
    return default_rng([seed, 0])


MUD = np.array([70, 55, 40], np.float32)

lasting = functools.lru_cache(maxsize=32)  # what lasts is computed once for a drive


def _clipped(image: np.ndarray) -> np.ndarray:
    return np.clip(image, 0, 255).astype(np.uint8)


def _blend(image: np.ndarray, share: np.ndarray, colour: np.ndarray | float) -> np.ndarray:
    """Lay a colour over an image; share: float32 (rows, columns), how much of it covers the image, 0..1."""
    share = share[..., None]
    return _clipped(image * (1 - share) + np.float32(colour) * share)


def _clouds(rng: Generator, rows: int, columns: int, coarsest: int = 3) -> np.ndarray:
    """Return a field of soft patches, float32 (rows, columns), 0..1; coarsest: cells across at first."""
    field = np.zeros((rows, columns), np.float32)
    for octave in range(4):
        cells = rng.random((coarsest * 2**octave, 2 * coarsest * 2**octave), np.float32)
        field += cv2.resize(cells, (columns, rows), interpolation=cv2.INTER_CUBIC) / 2**octave
    return (field - field.min()) / np.ptp(field)


def _line(length: int, angle: float) -> np.ndarray:
    """Return a kernel that blurs along a line: float32 (length, length), sum 1; angle: radians from the horizontal."""
    kernel, middle = np.zeros((length, length), np.float32), (length - 1) / 2
    away = middle * np.array([np.cos(angle), np.sin(angle)])
    first, last = (tuple(map(round, (middle + sign * away).tolist())) for sign in (-1, 1))
    cv2.line(kernel, first, last, 1.0)
    return kernel / kernel.sum()


def _streaks(shape: tuple[int, ...], density: float, length: int, angle: float, rng: Generator) -> np.ndarray:
    """Return drops or flakes drawn out by their fall, float32 (rows, columns), 0..1; density: of pixels hit, 0..1."""
    points = (rng.random(shape[:2], np.float32) < density).astype(np.float32)
    return np.minimum(cv2.filter2D(points, -1, _line(length, angle)) * length * 0.6, 1)


def rain(image: np.ndarray, density: float, seed: int, frame: Generator) -> np.ndarray:
    """Draw streaks, grey the light."""
    streaks = _streaks(image.shape, density, 9 + round(600 * density), _drive(seed).uniform(1.3, 1.85), frame)
    dull = image * np.float32(1 - 12 * density) + np.float32(12 * density * 130)
    return _blend(dull, 0.7 * cv2.GaussianBlur(streaks, (3, 3), 0), 215)


def fog(image: np.ndarray, thickness: float, seed: int, frame: Generator) -> np.ndarray:
    """Lay drifting grey over everything."""
    return _blend(image, *_bank(thickness, seed, *image.shape[:2]))


@lasting
def _bank(thickness: float, seed: int, rows: int, columns: int) -> tuple[np.ndarray, float]:
    drive = _drive(seed)
    patches = _clouds(drive, rows, columns)
    return np.minimum(thickness * (0.85 + 0.3 * patches), 1), drive.uniform(170, 230)


def snow(image: np.ndarray, density: float, seed: int, frame: Generator) -> np.ndarray:
    """Draw flakes of several sizes, whiten what is bright."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]
    share = np.float32(min(8 * density, 0.5))
    white = image * (1 - share) + share * np.maximum(image, np.minimum(grey * np.float32(1.5) + 128, 255))
    angle = _drive(seed).uniform(0.8, 2.3)
    for size in (1, 2, 3):
        rows, columns = -(-image.shape[0] // size), -(-image.shape[1] // size)
        flakes = _streaks((rows, columns), density, 4, angle, frame)
        flakes = cv2.resize(flakes, image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
        white = _blend(white, np.clip(flakes, 0, 1) * np.float32(0.9), 250)
    return white


def night(image: np.ndarray, light: float, seed: int, frame: Generator) -> np.ndarray:
    """Leave a bluish rest of the light, and the camera's noise."""
    noise = frame.standard_normal(image.shape[:2], np.float32)[..., None] * np.float32(5 + 5 * (0.5 - light))
    return _clipped(image * (light * np.array([0.8, 0.9, 1.15], np.float32)) + noise)


def sun(image: np.ndarray, glare: float, seed: int, frame: Generator) -> np.ndarray:
    """Blind the camera from a place above the road."""
    return _clipped(image + _glare(glare, seed, *image.shape[:2]))


@lasting
def _glare(glare: float, seed: int, rows: int, columns: int) -> np.ndarray:
    drive, (down, across) = _drive(seed), np.ogrid[:rows, :columns]
    distance = np.hypot(across - drive.uniform(0.2, 0.8) * columns, (down - drive.uniform(0, 0.4) * rows) * 1.3)
    light = glare * (np.exp(-distance / 40) + 0.35 * np.exp(-distance / 160))
    return (255 * light[..., None]).astype(np.float32) * np.array([1, 0.95, 0.8], np.float32)


def dirt(image: np.ndarray, covered: float, seed: int, frame: Generator) -> np.ndarray:
    """Cover a share of the lens with brown patches."""
    return _blend(image, _patches(covered, seed, *image.shape[:2]), MUD)


@lasting
def _patches(covered: float, seed: int, rows: int, columns: int) -> np.ndarray:
    patches = _clouds(_drive(seed), rows, columns, coarsest=6)
    return np.clip((patches - np.quantile(patches, 1 - covered)) * 12, 0, 0.97).astype(np.float32)


def drops(image: np.ndarray, number: float, seed: int, frame: Generator) -> np.ndarray:
    """Let drops on the lens show the view upside down and blurred."""
    inside, across, down = _lens(round(number), seed, *image.shape[:2])
    seen = cv2.remap(cv2.blur(image, (5, 5)), across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return _clipped(image * (1 - inside) + seen * inside)


@lasting
def _lens(number: int, seed: int, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the drops are, float32 (rows, columns, 1), 0..1, and the columns and rows that are seen in them."""
    drive, (down, across) = _drive(seed), np.mgrid[:rows, :columns].astype(np.float32)
    inside = np.zeros((rows, columns), np.float32)
    source = [across.copy(), down.copy()]
    for _ in range(number):
        x, y, radius = drive.uniform(0, columns), drive.uniform(0, rows), drive.uniform(5, 17)
        distance = np.hypot(across - x, (down - y) * drive.uniform(0.7, 1))
        drop = distance < radius
        source[0][drop], source[1][drop] = (x - 3 * (across - x))[drop], (y - 3 * (down - y))[drop]
        inside = np.maximum(inside, np.clip((radius - distance) / 2, 0, 1))
    return inside[..., None].astype(np.float32), *source


def motion_blur(image: np.ndarray, length: float, seed: int, frame: Generator) -> np.ndarray:
    """Blur along a line."""
    return cv2.filter2D(image, -1, _line(round(length), _drive(seed).uniform(-0.8, 0.8)))


def defocus(image: np.ndarray, radius: float, seed: int, frame: Generator) -> np.ndarray:
    """Blur by a disc."""
    size = 2 * round(radius) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(np.float32)
    return cv2.filter2D(image, -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT_101)


def noise(image: np.ndarray, deviation: float, seed: int, frame: Generator) -> np.ndarray:
    """Add normally distributed noise."""
    return _clipped(image + frame.standard_normal(image.shape, np.float32) * np.float32(255 * deviation))


def contrast(image: np.ndarray, share: float, seed: int, frame: Generator) -> np.ndarray:
    """Leave a share of the contrast."""
    mean = image.mean((0, 1), dtype=np.float32)
    return _clipped((image - mean) * np.float32(share) + mean + np.float32(0.5))


def exposed(image: np.ndarray, factor: float, seed: int, frame: Generator) -> np.ndarray:
    """Multiply the light; what is beyond white is lost, and so are the steps of what is too dark."""
    return cv2.convertScaleAbs(image, alpha=factor)


def colour(image: np.ndarray, turn: float, seed: int, frame: Generator) -> np.ndarray:
    """Turn the hue to either side, and strengthen the colours."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0] + _drive(seed).choice((-1, 1)) * turn / 2) % 180  # OpenCV has half degrees
    hsv[..., 1] = cv2.convertScaleAbs(hsv[..., 1], alpha=1 + turn / 60)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def jpeg(image: np.ndarray, quality: float, seed: int, frame: Generator) -> np.ndarray:
    """Encode and decode."""
    return pixels(encode(image, round(quality)))


def pixelated(image: np.ndarray, scale: float, seed: int, frame: Generator) -> np.ndarray:
    """Leave large pixels."""
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, image.shape[1::-1], interpolation=cv2.INTER_NEAREST)


def occluded(image: np.ndarray, covered: float, seed: int, frame: Generator) -> np.ndarray:
    """Cover a share of the view, less where they overlap, with three boxes that stay where they are."""
    drive, changed, (rows, columns) = _drive(seed), image.copy(), image.shape[:2]
    for _ in range(3):
        height = min(1, np.sqrt(covered / 3) * np.exp(drive.uniform(-0.5, 0.5)))
        width = min(1, covered / 3 / height)
        top, left = drive.uniform(0, 1 - height), drive.uniform(0, 1 - width)
        box = (top * rows, (top + height) * rows, left * columns, (left + width) * columns)
        above, below, left_edge, right_edge = map(round, box)
        changed[above:below, left_edge:right_edge] = drive.integers(20, 200, 3)
    return changed


def moved(
    image: np.ndarray, mount: Sequence[float] | np.ndarray, border: int = cv2.BORDER_REPLICATE, back: bool = False
) -> np.ndarray:
    """Return a picture turned anticlockwise about its middle, then moved; its edges are drawn out, or as `border` says.

    mount: pixels to the right, pixels down and degrees; back: undo that.
    """
    (rows, columns), (right, down, degrees) = image.shape[:2], mount
    matrix = cv2.getRotationMatrix2D((columns / 2, rows / 2), degrees, 1)
    matrix[:, 2] += np.array([right, down])
    flags = cv2.INTER_LINEAR | (cv2.WARP_INVERSE_MAP if back else 0)
    return cv2.warpAffine(image, matrix, (columns, rows), flags=flags, borderMode=border)


def shifted(image: np.ndarray, pixels: float, seed: int, frame: Generator) -> np.ndarray:
    """Let the camera look in another direction."""
    angle = _drive(seed).uniform(0, 2 * np.pi)
    return moved(image, (pixels * np.cos(angle), pixels * np.sin(angle), 0))


def turned(image: np.ndarray, degrees: float, seed: int, frame: Generator) -> np.ndarray:
    """Roll the camera to either side."""
    return moved(image, (0, 0, _drive(seed).choice((-1, 1)) * degrees))


def shaken(image: np.ndarray, pixels: float, seed: int, frame: Generator) -> np.ndarray:
    """Shake the camera from frame to frame."""
    return moved(image, frame.normal(0, [pixels, pixels, pixels / 3]))


def _as_it_is(image: np.ndarray, parameter: float, seed: int, frame: Generator) -> np.ndarray:
    return image


KINDS = {
    "rain": Kind(rain, (0.003, 0.006, 0.012, 0.022, 0.04)),  # share of pixels hit by a drop
    "fog": Kind(fog, (0.4, 0.55, 0.7, 0.8, 0.88)),  # share of the light that is the fog's
    "snow": Kind(snow, (0.005, 0.012, 0.025, 0.05, 0.1)),  # share of pixels hit by a flake
    "night": Kind(night, (0.5, 0.35, 0.22, 0.13, 0.08)),  # share of the light that is left
    "sun": Kind(sun, (0.5, 0.8, 1.2, 1.8, 2.8)),  # light of the glare's middle, white is 1
    "dirt": Kind(dirt, (0.06, 0.12, 0.22, 0.35, 0.5)),  # share of the lens that is covered
    "drops": Kind(drops, (8, 18, 35, 60, 100)),  # drops on the lens
    "motion_blur": Kind(motion_blur, (5, 9, 15, 23, 35)),  # length, pixels
    "defocus": Kind(defocus, (2, 4, 6, 8, 11)),  # radius, pixels
    "noise": Kind(noise, (0.08, 0.12, 0.22, 0.32, 0.45)),  # standard deviation, white is 1
    "contrast": Kind(contrast, (0.4, 0.3, 0.2, 0.1, 0.05)),  # share of the contrast that is left
    "overexposed": Kind(exposed, (1.3, 1.6, 2, 3, 4.5)),  # factor of the light
    "underexposed": Kind(exposed, (0.6, 0.4, 0.25, 0.14, 0.07)),  # factor of the light
    "colour": Kind(colour, (20, 40, 70, 110, 170)),  # turn of the hue, degrees
    "jpeg": Kind(jpeg, (30, 18, 15, 8, 3)),  # quality
    "pixelated": Kind(pixelated, (0.6, 0.5, 0.4, 0.25, 0.13)),  # scale
    "occluded": Kind(occluded, (0.06, 0.12, 0.2, 0.32, 0.45)),  # share of the view that boxes cover without overlap
    "shifted": Kind(shifted, (4, 8, 14, 20, 28)),  # pixels, in any direction
    "turned": Kind(turned, (2, 5, 9, 14, 20)),  # degrees
    "shaken": Kind(shaken, (1.5, 3, 6, 9, 14)),  # standard deviation, pixels
    "dropped": Kind(_as_it_is, (0.2, 0.4, 0.6, 0.75, 0.88)),  # share of the frames that are lost: the last one stays
    "late": Kind(_as_it_is, (1, 2, 3, 4, 6)),  # frames late, 15 a second
}
# A third of the kinds: no network of the project is trained on them, so that they tell how far its skill carries.
HELD_OUT = ("snow", "drops", "motion_blur", "overexposed", "jpeg", "dropped", "late")


class Disturbance(NamedTuple):
    """A kind and its strength, 1..5; written `fog:3`."""

    kind: str
    strength: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the disturbance of a text such as `fog:3`. Raises ValueError."""
        kind, _, strength = text.partition(":")
        if kind not in KINDS or strength not in map(str, STRENGTHS):
            raise ValueError(f"{text!r} is not KIND:STRENGTH, such as fog:3; kinds: {', '.join(KINDS)}; strengths: 1-5")
        return cls(kind, int(strength))

    def __str__(self) -> str:
        return f"{self.kind}:{self.strength}"

    @property
    def parameter(self) -> float:
        """What the strength means for this kind: see `KINDS`."""
        return KINDS[self.kind].strengths[self.strength - 1]


def disturb(image: np.ndarray, disturbance: Disturbance, seed: int, frame: int = 0) -> np.ndarray:
    """Return the disturbed image, which is not changed itself: uint8 (rows, columns, 3), RGB.

    seed: of a drive; frame: the number of the frame in it. Late and dropped frames are the `Disturber`'s.
    """
    return KINDS[disturbance.kind].change(image, disturbance.parameter, seed, default_rng([seed, 1, frame]))


class Disturber:
    """Disturbs the frames of one drive, given one after the other; the same seed disturbs them in the same way."""

    def __init__(self, disturbance: Disturbance, seed: int = 0):
        self.disturbance, self.seed, self.frames = disturbance, seed, 0
        late = round(disturbance.parameter) if disturbance.kind == "late" else 0
        self.shown: deque[np.ndarray] = deque(maxlen=late + 1)  # the last frames; the first of them is the one to see

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return what is seen instead of the next frame, uint8 (rows, columns, 3), RGB, as `image`."""
        number, self.frames = self.frames, self.frames + 1
        lost = self.disturbance.kind == "dropped" and number > 0
        if not (lost and default_rng([self.seed, 2, number]).random() < self.disturbance.parameter):
            self.shown.append(image.copy())
        return disturb(self.shown[0], self.disturbance, self.seed, number)
