"""video.py as a user calls it, and its films."""

import _thread
import errno
import gc
import os
import signal
import sys
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest
import torch
from commands import ROOT, call_here, python
from rendered import film_of

import video
from cloning.base.film import FilmWriter, frame_rate
from cloning.base.outputs import as_typed
from cloning.network.network import Network, save_model
from cloning.replay import command
from cloning.replay.replay import Drive

FIRST, SECOND = "2018_07_16_17_11_42_000.jpg", "2018_07_16_17_11_42_001.jpg"  # before those of `save`


def red_frame(brightness: int, rows=160, columns=320) -> np.ndarray:
    """A red frame, BGR."""
    frame = np.zeros((rows, columns, 3), np.uint8)
    frame[..., 2] = 40 + 6 * brightness
    return frame


def save(folder: Path, count: int):
    """Save frames at 20 frames/s, each brighter than the one before."""
    folder.mkdir(exist_ok=True)
    for index in range(count):
        time = datetime(2018, 7, 16, 17, 11, 43) + timedelta(seconds=0.05 * index)
        name = time.strftime("%Y_%m_%d_%H_%M_%S_%f")[:-3]
        cv2.imwrite(str(folder / f"{name}.jpg"), red_frame(index))


@pytest.fixture
def run(tmp_path):
    """The command, in this process and in tmp_path: its exit status and what it says."""

    def run(*arguments) -> tuple[int, str]:
        done = call_here(video.main, "video.py", *arguments, cwd=tmp_path)
        return done.returncode, done.stdout + done.stderr

    return run


def test_a_trailing_slash_and_the_rate_of_the_time_stamps(tmp_path):
    save(tmp_path / "run1", 30)
    result = python(ROOT / "video.py", "run1/", cwd=tmp_path)
    assert result.returncode == 0 and "run1.mp4: 30 frames at 20 frames/s" in result.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run1", "run1.mp4"]
    fps, seen = film_of(tmp_path / "run1.mp4")
    assert fps == pytest.approx(20) and len(seen) == 30
    for index, frame in enumerate(seen):
        assert np.abs(frame.mean((0, 1)) - red_frame(index).mean((0, 1))).max() < 4, "in order, red still red"
    with av.open(str(tmp_path / "run1.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")


def test_other_files_and_unreadable_frames_are_left_out_and_named(run, tmp_path):
    folder = tmp_path / "run.1"
    save(folder, 10)
    (folder / "notes\x7f.txt").write_text("mine", encoding="utf-8")
    filmed = "run.1.mp4: 10 frames at 60 frames/s\n"
    assert run("run.1", "--fps", "60") == (0, filmed + "video.py: left out, not frames: notes\\x7f.txt\n")
    cv2.imwrite(str(folder / FIRST), red_frame(0, 80, 160))  # which does not make the film as small
    (folder / "2018_07_16_17_11_44_900.jpg").write_bytes(b"")
    whole = (folder / "2018_07_16_17_11_43_000.jpg").read_bytes()
    (folder / "2018_07_16_17_11_44_901.jpg").write_bytes(whole[: len(whole) // 2])
    status, printed = run("run.1", "--fps", "60")
    assert status == 1, "the film lacks frames"
    assert f"unreadable (the first: 160x80 pixels where 320x160 are expected): {FIRST}, " in printed
    assert "2018_07_16_17_11_44_900.jpg, 2018_07_16_17_11_44_901.jpg\n" in printed
    fps, seen = film_of(tmp_path / "run.1.mp4")
    assert fps == pytest.approx(60) and len(seen) == 10
    assert {frame.shape for frame in seen} == {(160, 320, 3)}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pipes in folders")
def test_what_is_only_named_like_a_frame(run, tmp_path):
    """A lost frame behind a link counts as unreadable; a folder and a pipe are no frames; nothing waits for them."""
    folder, third = tmp_path / "run1", "2018_07_16_17_11_42_002.jpg"
    save(folder, 3)
    (folder / FIRST).symlink_to(tmp_path / "gone.jpg")
    (folder / SECOND).mkdir()
    os.mkfifo(folder / third)
    status, printed = run("run1")
    assert status == 1 and f"left out, not frames: {SECOND}, {third}\n" in printed
    assert f"unreadable (the first: No such file or directory): {FIRST}\n" in printed


def test_a_film_that_cannot_be_written(run, tmp_path, monkeypatch):
    save(tmp_path / "run1", 3)
    (tmp_path / "run1.mp4").mkdir()
    assert run("run1") == (2, "video.py: run1.mp4: Is a directory\n")
    (tmp_path / "run1.mp4").rmdir()
    monkeypatch.setattr("av.VideoFrame.from_ndarray", Mock(side_effect=av.error.ArgumentError(22, "Invalid argument")))
    assert run("run1") == (2, "video.py: run1.mp4: Invalid argument\n")
    assert [path.name for path in tmp_path.iterdir()] == ["run1"]


@pytest.mark.parametrize("room", [0, 1000])
def test_a_full_disk_is_a_clear_error_and_leaves_nothing(run, tmp_path, room, longest_file):
    save(tmp_path / "run1", 30)
    longest_file(room)
    status, error = run("run1")
    longest_file()
    assert status == 2 and error.startswith("video.py: run1.mp4: File too large")
    assert [path.name for path in tmp_path.iterdir()] == ["run1"]


def test_on_windows_a_full_disk_is_as_clear_though_the_film_stays_open(run, tmp_path, longest_file, monkeypatch):
    def is_open(path, **_):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    save(tmp_path / "run1", 3)
    monkeypatch.setattr(os, "unlink", is_open)
    longest_file(0)
    status, error = run("run1")
    longest_file()
    assert status == 2 and error.startswith("video.py: run1.mp4: File too large")
    assert not (tmp_path / "run1.mp4").exists()


def test_ctrl_c_in_the_first_frame_leaves_no_film(tmp_path, monkeypatch):
    writer = FilmWriter(tmp_path / "none.mp4", 15)
    frame = Mock(from_ndarray=Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(writer, "av", SimpleNamespace(VideoFrame=frame, FFmpegError=av.FFmpegError))
    with pytest.raises(KeyboardInterrupt):
        writer.add(red_frame(1))
    monkeypatch.undo()
    writer.close()
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(not command.CAN_FORK, reason="on this system drives follow one another")
def test_drives_in_processes_do_not_wait_for_the_threads_of_an_old_film(tmp_path):
    """A fork copies none of them: where a film was garbage by then, its collection in a process never ended."""
    line: Any = SimpleNamespace(go_on=lambda _: gc.collect())
    gc.disable()
    try:
        with FilmWriter(tmp_path / "old.mp4", 15) as writer:
            writer.add(red_frame(1))
        old: list[object] = [writer]
        old.append(old)
        del writer, old
        with command.ForkedDrives({}) as forked:
            forked.start(line, [Drive(1.0)])
            forked.collect(20)
        assert forked.drives
    finally:
        gc.enable()


def test_odd_sizes_lose_a_row_and_a_column(tmp_path):
    writer = FilmWriter(tmp_path / "odd.mp4", 15)
    writer.add(red_frame(0, 121, 161))
    writer.close()
    assert film_of(tmp_path / "odd.mp4")[1][0].shape == (120, 160, 3)


@pytest.mark.parametrize(
    "name, words",
    [
        (None, f"{as_typed('model.pt', 'my run')}` saves"),
        ("notes.txt", "name the folder in which"),
        (FIRST, "none of its 1"),
    ],
)
def test_no_film_is_a_clear_error(run, tmp_path, name, words):
    if name:
        (tmp_path / "my run").mkdir()
        (tmp_path / "my run" / name).write_bytes(b"")
    status, error = run("my run")
    assert status == 2 and words in error
    assert not list(tmp_path.glob("*.mp4")) and not list(tmp_path.glob(".*"))
    (tmp_path / "run1.mp4").touch()
    assert run("run1.mp4") == (2, "video.py: run1.mp4: a file; name the folder in which drive.py has saved frames\n")


@pytest.mark.parametrize(
    "fps", ["0", "-5", "fast", "nan", "inf", "1/0", "0/0", "1/", "1e-9", "1e300", "1e-999999999", "1000.1", "1/1/1", ""]
)
def test_an_impossible_rate_is_refused(run, fps):
    status, printed = run("run1", f"--fps={fps}")
    assert status == 2 and "--fps" in printed and "a finite number of at least 0.01 and at most 1000" in printed


@pytest.mark.parametrize(("fps", "filmed"), [("0.01", 0.01), ("30000/1001", 30000 / 1001), ("1000", 1000)])
def test_a_possible_rate_is_that_of_the_film(run, tmp_path, fps, filmed):
    save(tmp_path / "run1", 3)
    assert run("run1", "--fps", fps)[0] == 0
    with av.open(str(tmp_path / "run1.mp4")) as container:
        rate = container.streams.video[0].average_rate
    assert rate is not None and float(rate) == pytest.approx(filmed)


def test_a_pause_and_bunches_leave_the_rate_alone():
    times: list[float] = []
    for bunch in range(100):  # three frames within two milliseconds, ten times a second, and a minute's pause
        at = bunch / 10 + (60 if bunch >= 50 else 0)
        times += [at, at + 0.001, at + 0.002]
    assert float(frame_rate(times, 15)) == pytest.approx(30, rel=0.02)
    assert frame_rate([1.0], 15) == frame_rate([], 15) == frame_rate([1.0, 1.0], 15) == 15


def test_the_overlay_draws_steering_and_attention(run, tmp_path):
    torch.manual_seed(0)
    network = Network()
    torch.nn.init.constant_(network.get_parameter("dense.3.bias"), -0.3)
    save_model(tmp_path / "model.pt", network)
    save(tmp_path / "run1", 3)
    assert run("run1", "--overlay", "model.pt")[0] == 0
    frame = film_of(tmp_path / "run1.mp4")[1][0]
    assert frame.shape == (320, 640, 3)
    green = (frame[..., 1] > 150).nonzero()[1]
    assert len(green) > 200 and green.min() < 280 and green.max() < 330, "the line bends to the left"
    assert "video.py: none.pt: no such file" in run("run1", "--overlay", "none.pt")[1]
    network = Network(offset=0.0)
    for values in network.parameters():
        torch.nn.init.constant_(values, 3e38 * (values.ndim > 1))  # its steering is finite for black frames alone
    save_model(tmp_path / "broken.pt", network)
    printed = run("run1", "--overlay", "broken.pt")[1]
    assert "video.py: broken.pt: the network's steering is not finite; train the model again" in printed
    assert not list(tmp_path.glob(".*"))


def test_ctrl_c_while_a_frame_is_encoded_loses_no_packet(tmp_path):
    """A film without its first packet is black."""
    writer: Any = FilmWriter(tmp_path / "film.mp4", 15)
    written: list[object] = []
    writer.discard()
    number = SimpleNamespace(from_ndarray=lambda *_: signal.SIGINT)
    writer.av = SimpleNamespace(VideoFrame=number, FFmpegError=OSError)
    writer.stream = SimpleNamespace(encode=_thread.interrupt_main)
    writer.container = SimpleNamespace(mux=written.append)
    with pytest.raises(KeyboardInterrupt):
        writer.add(np.zeros((160, 320, 3), np.uint8))
    assert len(written) == 1
