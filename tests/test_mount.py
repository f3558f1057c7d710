"""How a camera is mounted: read from frames that were moved by known amounts, and moved back in drives."""

import logging
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import real_recordings
import torch
from commands import call_here
from rendered import render_frame
from scenes import Here

import drive as drive_py
import video
from cloning.base.errors import ModelError
from cloning.base.frame import FRAME
from cloning.lane import mount
from cloning.lane.mount import (
    CELLS,
    LEAST,
    MIRRORED_DIRECTION,
    MIRRORED_MOUNT,
    SCALES,
    MeanPicture,
    Mount,
    MountNetwork,
)
from cloning.network import tensors
from cloning.network.network import SHIPPED_MODEL, Network, save_model
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.road.disturbances import Disturbance, moved
from cloning.road.track import Track
from simulator.cameras import Cameras, jpeg
from simulator.driving import Conditions, drive
from simulator.world import Scene
from tools import train_mount
from tools.simulator_client import telemetry


def stripes(degrees: float) -> np.ndarray:
    """Return a picture of soft stripes along a direction, in degrees anticlockwise from the horizontal."""
    down, across = np.mgrid[: FRAME[0], : FRAME[1]]
    angle = math.radians(degrees)
    wave = np.sin((across * math.sin(angle) + down * math.cos(angle)) / 5)
    return np.repeat((128 + 100 * wave)[..., None], 3, axis=2).astype(np.uint8)


def directions_of(*frames: np.ndarray) -> np.ndarray:
    picture = MeanPicture()
    for frame in frames:
        picture.add(frame)
    return picture.directions()


# ----------------------------------------------------------------------------------------------------------------------
# The picture and the network


@pytest.mark.parametrize("degrees", [0, 20, 45, 90, 150])
def test_directions_are_those_of_the_gradient(degrees):
    """It points across the stripes, so twice its angle is 180 degrees more than twice theirs; rows go down."""
    sine, cosine, strength = directions_of(stripes(degrees))[: len(MIRRORED_DIRECTION), 2:-2, 2:-2]
    assert sine == pytest.approx(math.sin(math.radians(2 * degrees)), abs=0.05)
    assert cosine == pytest.approx(-math.cos(math.radians(2 * degrees)), abs=0.05)
    assert (strength > 1).all()


def test_what_changes_from_frame_to_frame_blurs():
    rng = np.random.default_rng(0)
    noisy = [cv2.add(stripes(30), rng.normal(0, 60, FRAME), dtype=cv2.CV_8U) for _ in range(mount.MEMORY)]
    clear, one, all_of_them = (directions_of(*frames)[:2] for frames in ([stripes(30)], noisy[:1], noisy))
    assert np.abs(all_of_them - clear).mean() < 0.3 * np.abs(one - clear).mean()


def test_the_mirror_image_gives_the_mirrored_mounting():
    frame = render_frame(0.5, 3.0, np.random.default_rng(1))
    seen, mirrored = directions_of(frame), directions_of(np.ascontiguousarray(frame[:, ::-1]))
    odd = np.tile(MIRRORED_DIRECTION, SCALES)[:, None, None]
    assert mirrored == pytest.approx(seen[..., ::-1] * odd, abs=0.02)
    network = MountNetwork().eval()
    found, deviations = network(torch.from_numpy(np.stack([seen, seen[..., ::-1] * odd]).astype(np.float32)))
    assert torch.allclose(found[0] * torch.tensor(MIRRORED_MOUNT), found[1], atol=1e-5)
    assert torch.allclose(deviations[0], deviations[1], atol=1e-5)


def test_weights_are_saved_and_a_damaged_file_is_refused(tmp_path):
    torch.manual_seed(0)
    network, path, inputs = MountNetwork().eval(), tmp_path / "mount.pt", torch.rand(2, 3 * SCALES, *CELLS)
    tensors.save_weights(path, network)
    for saved, wanted in zip(mount.load_network(path)(inputs), network(inputs), strict=True):
        assert torch.allclose(saved, wanted, atol=0.01)
    assert path.stat().st_size < 400_000
    tensors.save_weights(tmp_path / "other.pt", MountNetwork(hidden=8))
    with pytest.raises(ModelError, match=r"other\.pt: .*python -m tools.train_mount"):
        mount.load_network(tmp_path / "other.pt")


# ----------------------------------------------------------------------------------------------------------------------
# Drives


class Tells(MountNetwork):
    """A network that tells the same of all pictures, in pixels and degrees."""

    def __init__(self, told: tuple[float, float, float], deviation: float):
        super().__init__()
        self.told, self.deviation = np.divide(told, mount.UNITS), np.divide(deviation, mount.UNITS)

    def forward(self, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what is to be told."""
        return torch.tensor(self.told)[None], torch.tensor(self.deviation)[None]


def test_what_is_certain_is_moved_back_and_nothing_else():
    rng = np.random.default_rng(2)
    frames = [cv2.add(stripes(30), rng.normal(0, 5, FRAME), dtype=cv2.CV_8U) for _ in range(mount.FIRST)]
    small, unsure = 0.9 * LEAST, (-20.0, 8.0, 14.0)
    for told, deviation in ((small, 0.1), (unsure, 11.0), ((0, 0, 0), 0.1)):
        unmoved = Mount(Tells(tuple(told), deviation))
        assert all(unmoved(frame) is frame for frame in frames) and not str(unmoved)
    one = Mount(Tells((-20.0, 8.0, 14.0), 6.0))
    back = [one(frame) for frame in frames][-1]
    assert one.found.tolist() == pytest.approx([-20, 0, 14]), "8 pixels are too few"
    assert str(one) == "20 pixels to the left, 14° anticlockwise"
    seen = moved(stripes(30), (-20, 0, 14), back=True)
    assert np.abs(back[40:120, 80:240].astype(int) - seen[40:120, 80:240]).mean() < 10
    one.network = Tells((0.0, 0.0, 0.6 * LEAST[2]), 0.1)
    one.weights, one.weighted, one.readings = np.zeros(3), np.zeros(3), 0.0
    for frame in frames:
        one(frame[::-1])
    assert one.found.tolist() == pytest.approx([0, 0, 0.6 * LEAST[2]]), "what counts goes on to count"


def test_moved_and_moved_back_is_as_before():
    frame, middle = render_frame(0.2, 1.0, np.random.default_rng(3)), np.s_[45:115, 70:250]
    smooth = cv2.GaussianBlur(frame, (0, 0), 3)
    for how in ((0, 0, 14), (20, -12, 0), (12, 9, -9)):
        back = moved(moved(smooth, how), how, back=True)
        assert np.abs(back[middle].astype(int) - smooth[middle]).mean() < 1 < np.abs(moved(smooth, how) - back).mean()


def test_frames_that_repeat_tell_nothing_new():
    one, frame = Mount(Tells((0, 0, 20), 0.1)), stripes(10)
    for _ in range(3 * mount.FIRST):
        assert one(frame) is frame
    assert one.picture.frames == 1


def test_a_rendered_camera_that_is_mounted_otherwise_is_found():
    """The training moves frames and mounts cameras; both must mean the same."""
    cameras, rng = Cameras(Scene.of("lake", 107), ("center",)), np.random.default_rng(4)
    for how in ((0.0, 0.0, 12.0), (0.0, -18.0, -12.0)):
        train_mount.mount_camera(cameras.mounted[0], np.array(how))
        one = Mount()
        for transform in train_mount.random_drive(Track("lake"), rng):
            one(decode(jpeg(cameras.frames(transform)[0])))
        assert one.found == pytest.approx(how, abs=4.5)


@pytest.mark.parametrize("as_mounted", [False, True])
def test_a_turned_camera_is_driven_with(as_mounted, monkeypatch):
    """14 degrees lead the network off the road, unless frames are moved back."""
    if as_mounted:
        monkeypatch.setattr(Mount, "__call__", lambda self, frame: frame)
    conditions = Conditions(str(SHIPPED_MODEL), 15, 106, metres=150, start=(100, 0, 0), set_back=True)
    driven = drive(conditions._replace(disturbance=Disturbance("turned", 4)), "jungle")
    assert bool(driven.departures) == as_mounted


def test_drive_py_tells_of_it_once_and_leaves_it_on_demand(network: Network, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(5)
    frames = [drive_py.page.encode(render_frame(offset, 0.0, rng), 90) for offset in rng.uniform(-1, 1, 15)]
    session = drive_py.DriveServer(network).session("sid")
    assert session.pilot.mount
    session.pilot.mount.network = Tells((0, -25, 14), 1.0)
    with caplog.at_level(logging.WARNING):
        for frame in frames:
            session.answer(telemetry(frame))
    assert [record.message for record in caplog.records] == [
        "the camera seems turned or shifted, by 25 pixels up, 14° anticlockwise: "
        "frames are moved back (with --as-mounted: not)"
    ]
    assert drive_py.parse_arguments(["--as-mounted"]).as_mounted
    assert drive_py.DriveServer(network, as_mounted=True).session("sid").pilot.mount is None


@pytest.mark.parametrize("options", [(), ("--as-mounted",)])
def test_a_film_shows_what_drive_py_gave_to_the_network(options, network, tmp_path, monkeypatch):
    """Also where that was told to take frames as they are."""
    rng, seen = np.random.default_rng(5), list[np.ndarray]()
    (tmp_path / "run1").mkdir()
    for number, offset in enumerate(rng.uniform(-1, 1, mount.FIRST)):
        name = f"2018_07_16_17_11_{number:02}_000.jpg"
        (tmp_path / "run1" / name).write_bytes(drive_py.page.encode(render_frame(offset, 0.0, rng), 90))
    save_model(tmp_path / "model.pt", network)
    monkeypatch.setattr(mount, "load_network", lambda: Tells((0, -25, 14), 1.0))

    def picture(frame: np.ndarray, *_: object) -> np.ndarray:
        seen.append(frame)
        return frame

    monkeypatch.setattr(video, "overlay", picture)
    call_here(video.main, "video.py", "run1", "--overlay", "model.pt", *options, cwd=tmp_path)
    *_, last = sorted((tmp_path / "run1").iterdir())
    assert len(seen) == mount.FIRST
    assert np.array_equal(seen[-1], decode(last.read_bytes())) == bool(options)


@pytest.mark.skipif(not real_recordings.FOLDERS, reason=real_recordings.MISSING)
@pytest.mark.parametrize("folder", real_recordings.FOLDERS, ids=lambda folder: folder.name)
def test_real_cameras_are_mounted_as_ever_and_turned_ones_are_found(folder: Path) -> None:
    recording = read_recording(folder).take(slice(240))
    as_ever, turned = Mount(), Mount()
    for row in range(len(recording)):
        frame = decode(recording.path(row).read_bytes())
        assert as_ever(frame) is frame
        turned(moved(frame, (0, 0, -14), cv2.BORDER_REFLECT_101))
    assert turned.found == pytest.approx([0, 0, -14], abs=4)


# ----------------------------------------------------------------------------------------------------------------------
# Training


def test_the_training_writes_weights_and_measures_them(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_mount, "started_workers", Here)
    options = ["--looks", "0", "--roads", "1", "--drives", "1", "--epochs", "2"]
    assert train_mount.main(options) == 0
    printed = capsys.readouterr().out
    assert "epoch 2: loss" in printed and "| none | " in printed
    mount.load_network(tmp_path / "mount.pt")
