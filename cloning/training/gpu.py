"""Make training images on a GPU, which keeps all frames in its memory.

They are those of `lanes.py` and `light.py`, but for rounding: OpenCV computes these in fixed-point numbers. Images are
uint8 (n, rows, columns, 3), RGB, on the GPU; choices are NumPy's arrays, as for the CPU.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any, Self

import numpy as np
import torch
from torch.nn.functional import grid_sample

from cloning.network.compute import Graphed
from cloning.recordings.frames import ROAD_SHAPE
from cloning.road.warp import CroppedView

LOADED_AT_ONCE = 256  # frames that are decoded and copied to the GPU together
MOST_MEMORY = 0.8  # share of the GPU's free memory that frames may take; the rest is for training


def to_device(values: np.ndarray, device: torch.device) -> torch.Tensor:
    """Return values on a device; float64 as float32."""
    found = values.astype(np.float32) if values.dtype == np.float64 else np.ascontiguousarray(values)
    return torch.from_numpy(found).to(device)


class GpuFrames:
    """The `ROAD_ROWS` of all frames of a training, in a GPU's memory: pixels, uint8 (frames, 90, 320, 3), RGB."""

    def __init__(self, used: Sequence[np.ndarray], device: torch.device):
        """used: of each recording, bool (m,): which of its images are needed. `load` reads them."""
        self.first, self.slots = np.cumsum([0, *map(len, used)]), np.cumsum(np.concatenate(used)) - 1
        self.count = int(self.slots[-1]) + 1
        self.pixels = torch.empty((0, *ROAD_SHAPE), dtype=torch.uint8, device=device)

    def fit(self) -> bool:
        """Return whether the GPU's memory has room for them."""
        needed, device = self.count * math.prod(ROAD_SHAPE), self.pixels.device
        return device.type != "cuda" or needed < MOST_MEMORY * torch.cuda.mem_get_info(device)[0]

    def load(self, read: Sequence[Callable[[], np.ndarray]], pool: Executor) -> Self:
        """Read all frames, in the order of recordings and images; pool: its threads decode the images."""
        self.pixels = self.pixels.new_empty((self.count, *ROAD_SHAPE))

        def load(start: int) -> None:
            part = np.stack([decode() for decode in read[start : start + LOADED_AT_ONCE]])
            self.pixels[start : start + len(part)] = torch.from_numpy(part)

        for _ in pool.map(load, range(0, self.count, LOADED_AT_ONCE)):
            pass
        return self

    def road(self, recording: np.ndarray, image: np.ndarray) -> torch.Tensor:
        """Return the `ROAD_ROWS` of these images of recordings, int (n,) each: uint8 (n, 90, 320, 3)."""
        return self.pixels[to_device(self.slots[self.first[recording] + image], self.pixels.device)]


# ----------------------------------------------------------------------------------------------------------------------
# Views from other poses


class GpuViews:
    """Makes what `lanes.Poses.view` does, of many poses at once."""

    def __init__(self, view: CroppedView, shades: np.ndarray, device: torch.device):
        """view: the rows that a network sees; shades: of `light.shades`, uint8 (k, 75, 320, 3)."""
        self.view, self.shades = view, to_device(shades, device)
        self.sky = to_device(np.stack(view.sky), device) > 0
        y, x = np.mgrid[: view.rows, : view.columns].reshape(2, -1)
        self.pixels = to_device(np.stack([x, y, np.ones_like(x)]).astype(np.float32), device)
        self.make = Graphed(self._make)

    def __call__(self, road: torch.Tensor, earlier: torch.Tensor, poses: Any) -> torch.Tensor:
        """Return n views: uint8 (n, 75, 320, 3); poses: `lanes.Poses`.

        road, earlier: uint8 (n, 90, 320, 3), `ROAD_ROWS` of a pose's own and earlier frame.
        """
        columns = np.linalg.inv(poses.warps), poses.colours, poses.mirrored, poses.shade
        packed = np.concatenate([column.reshape(len(poses), -1) for column in columns], axis=1)
        return self.make(road, earlier, to_device(packed.astype(np.float32), road.device))[0]

    def _make(self, road: torch.Tensor, earlier: torch.Tensor, packed: torch.Tensor) -> list[torch.Tensor]:
        warps, colours, mirrored, shade = packed.split([36, 9, 1, 1], dim=1)
        to_frames, sky_rows = warps.view(-1, 2, 2, 3, 3), self.view.sky_rows
        frames = torch.cat([road, earlier]).permute(0, 3, 1, 2).float()
        right, down = self._seen_at(torch.cat([to_frames[:, 0, 0], to_frames[:, 1, 0]]), self.view.rows)
        ground, other = _sampled(frames, right, down, "border").chunk(2)
        column, row = right[: len(road)].round(), down[: len(road)].round()
        height, width = road.shape[1:3]
        seen = (column > 0) & (column < width - 1) & (row >= 0) & (row < height)  # as `warp.road_mask` does
        image = torch.where(seen[:, None], ground, other)
        far = _sampled(frames[: len(road)], *self._seen_at(to_frames[:, 0, 1], sky_rows), "reflection")
        sky = self.sky[mirrored[:, 0].long()][:, None]
        image[:, :, :sky_rows] = torch.where(sky, far, image[:, :, :sky_rows])
        image = _whole(colours.view(-1, 3, 3) @ _whole(image).flatten(2))
        which = shade[:, 0].long()
        light = torch.where((which < 0)[:, None, None], 255, self.shades[which.clamp(min=0)].flatten(1, 2).mT)
        return [_whole(image * light / 255).mT.unflatten(1, (self.view.rows, -1)).byte().contiguous()]

    def _seen_at(self, to_frames: torch.Tensor, rows: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the columns and rows of frames, float32 (n, rows, columns) each, that are seen in views' first rows.

        to_frames: float32 (n, 3, 3), homographies from the views' pixels.
        """
        right, down, scale = (to_frames @ self.pixels[:, : rows * self.view.columns]).unflatten(2, (rows, -1)).unbind(1)
        return right / scale, down / scale


def _sampled(frames: torch.Tensor, right: torch.Tensor, down: torch.Tensor, border: str) -> torch.Tensor:
    """Return frames' colours, interpolated bilinearly, as cv2.warpPerspective: float32 (n, 3, rows, columns).

    frames: float32 (n, 3, height, width); right, down: float32 (n, rows, columns), pixels; border: what is beyond.
    """
    height, width = frames.shape[2:]
    grid = torch.stack([right * (2 / (width - 1)) - 1, down * (2 / (height - 1)) - 1], dim=-1)
    return grid_sample(frames, grid, "bilinear", border, align_corners=True)


def _whole(values: torch.Tensor) -> torch.Tensor:
    """Return values rounded and clipped to 0..255."""
    return values.round().clamp(0, 255)


# ----------------------------------------------------------------------------------------------------------------------
# Light


def _brighten(images: torch.Tensor, factors: torch.Tensor) -> list[torch.Tensor]:
    """Do as `light.brighten`: the HSV value is the largest of the three colours; hue and saturation stay."""
    rgb = images.float()
    value = rgb.amax(-1, keepdim=True)
    scaled = (value * factors[:, None, None, None]).clamp(max=255)
    return [_whole(rgb * (scaled / value.clamp(min=1))).byte()]


def _darken(images: torch.Tensor, factors: torch.Tensor, edges: torch.Tensor, left: torch.Tensor) -> list[torch.Tensor]:
    """Do as `light.shade`; edges: float32 (n, rows), the columns that end the shadow's side of each row.

    The HLS lightness is the mean of the largest and the smallest colour. With the same hue and saturation, a colour's
    distance from it is proportional to that of the lightness from black or white, whichever is nearer.
    """
    rgb = images.float() / 255
    light = (rgb.amax(-1, keepdim=True) + rgb.amin(-1, keepdim=True)) / 2
    darker = light * factors[:, None, None, None]
    room, before = (torch.minimum(each, 1 - each) for each in (darker, light))
    shaded = _whole((darker + (rgb - light) * (room / before.clamp(min=1e-6))) * 255).byte()
    lit = (torch.arange(images.shape[2], device=images.device) < edges[:, :, None]) != left[:, None, None]
    return [torch.where(lit[..., None], images, shaded)]


brightened, darkened = Graphed(_brighten), Graphed(_darken)
