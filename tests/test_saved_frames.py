"""Saved frames: their folders and names; those that cannot be saved are counted and reported, and driving goes on."""

import errno
import itertools
import shutil
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from cloning.base.errors import UserError
from cloning.recordings import saved_frames as frames


def test_each_session_saves_in_a_folder_of_its_own(tmp_path):
    saver = frames.FrameSaver(tmp_path / "run1")
    first, second = saver.start_session(), saver.start_session()
    for n in range(300):  # many within one millisecond
        first.save(b"first %d" % n, (0, 0, 0))
        second.save(b"second %d" % n, (0, 0, 0))
    saver.close()
    for name, session in (("run1", b"first"), ("run1-2", b"second")):
        paths = sorted((tmp_path / name).glob("*.jpg"))
        assert [path.read_bytes() for path in paths] == [b"%s %d" % (session, n) for n in range(300)]
        assert all(frames.taken_at(path.name) for path in paths)


def test_a_folder_is_emptied_of_frames_and_of_nothing_else(tmp_path):
    folder = tmp_path / "run1"
    folder.mkdir()
    (folder / "2018_07_16_17_11_43_382.jpg").write_bytes(b"old")
    (folder / frames.DRIVEN).write_bytes(b"old")
    (folder / ".2018_07_16_17_11_43_420.jpg.0123abcd.part").write_bytes(b"of a drive that was killed")
    (folder / ".DS_Store").write_bytes(b"macOS's")  # of somebody who has looked into it
    frames.empty_folder(folder)
    assert list(folder.iterdir()) == []
    for foreign in ("notes.txt", "2018_13_40_17_11_43_382.jpg", "center_2018_07_16_17_11_43_382.jpg"):
        (folder / "2018_07_16_17_11_43_382.jpg").write_bytes(b"old")
        (folder / foreign).write_bytes(b"mine")
        with pytest.raises(UserError, match=foreign):
            frames.empty_folder(folder)
        assert len(list(folder.iterdir())) == 2
        (folder / foreign).unlink()
    with pytest.raises(UserError, match="not a folder"):
        frames.empty_folder(Path(__file__))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no locks on folders")
def test_a_folder_is_not_emptied_while_another_drive_saves_in_it(tmp_path):
    saver = frames.FrameSaver(tmp_path / "run1")
    saver.start_session().save(b"frame", (0, 0, 0))
    with pytest.raises(UserError, match=r"run1: another program writes there"):
        frames.FrameSaver(tmp_path / "run1")
    saver.close()
    assert len(list((tmp_path / "run1").glob("*.jpg"))) == 1
    frames.FrameSaver(tmp_path / "run1").close()
    assert not list((tmp_path / "run1").glob("*.jpg"))


@pytest.mark.parametrize("trouble", [OSError(errno.ENOSPC, "No space left on device"), ValueError("a bug")])
def test_frames_that_cannot_be_saved_are_counted_per_session_and_in_total(tmp_path, monkeypatch, trouble):
    """Whatever the trouble, the thread goes on: driving would wait for it for ever once its queue is full."""
    monkeypatch.setattr(frames, "MAX_QUEUED", 2)
    saver, write, reports = frames.FrameSaver(tmp_path / "run1"), Path.write_bytes, []

    def fails_for_the_second_session(path, data):
        if data == b"lost":
            raise trouble
        write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fails_for_the_second_session)
    first, second = saver.start_session(), saver.start_session()
    for n in range(20):
        first.save(b"saved", (0, 0, 0))
        second.save(b"lost" if n < 5 else b"saved", (0, 0, 0))
    first.when_written(lambda: reports.append(first.progress()))
    second.when_written(lambda: reports.append(second.progress()))
    reason = "No space left on device" if isinstance(trouble, OSError) else "ValueError: a bug"
    with pytest.raises(UserError, match=rf"run1: 5 of 40 frames were not saved \({reason}\); free"):
        saver.close()
    assert reports == [
        f"20 frames saved in {tmp_path / 'run1'}",
        f"15 frames saved in {tmp_path / 'run1-2'}, 5 LOST ({reason})",
    ]
    assert len(list((tmp_path / "run1-2").glob("*.jpg"))) == 15


def test_a_folder_that_disappears_while_driving_is_made_again_or_its_frames_are_counted(tmp_path):
    saver = frames.FrameSaver(tmp_path / "new" / "run1")
    session = saver.start_session()
    for gone, lost in ((tmp_path / "new" / "run1", 0), (tmp_path / "new", 1)):
        shutil.rmtree(gone)
        written = threading.Event()
        session.save(b"frame", (0, 0, 0))
        session.when_written(written.set)
        assert written.wait(20) and session.lost == lost
    with pytest.raises(UserError, match="1 of 2 frames were not saved"):
        saver.close()


def test_a_clock_that_is_set_while_frames_are_saved_changes_no_name(tmp_path, monkeypatch):
    class Clock(datetime):
        """One that goes an hour forward at each look, then back again."""

        hours = itertools.cycle([0, 1, -1])

        @classmethod
        def now(cls, tz=None):
            return datetime.now(tz) + timedelta(hours=next(cls.hours))

    monkeypatch.setattr(frames, "datetime", Clock)
    saver = frames.FrameSaver(tmp_path / "run1")
    session = saver.start_session()
    for _ in range(3):
        session.save(b"jpeg", (0.0, 0.0, 0.0))
        time.sleep(0.01)
    saver.close()
    taken = sorted(filter(None, (frames.taken_at(path.name) for path in (tmp_path / "run1").glob("*.jpg"))))
    assert timedelta(seconds=0.02) <= taken[-1] - taken[0] < timedelta(minutes=1)


def test_frames_are_named_by_the_simulators_own_time_where_it_tells_it(tmp_path):
    """A simulator that waits for its answers, and begins anew after its third frame."""
    saver = frames.FrameSaver(tmp_path / "run1")
    session = saver.start_session()
    for simulated in (100.0, 100.5, 101.0, 0.0, 0.25):
        session.save(b"frame", (0, 0, 0), simulated)
    saver.close()
    times = [frames.taken_at(path.name) for path in sorted((tmp_path / "run1").glob("*.jpg"))]
    seconds = [(time - times[0]).total_seconds() for time in times if time and times[0]]
    assert seconds == pytest.approx([0, 0.5, 1, 1, 1.25], abs=0.0021)
    assert times[0] and abs(times[0] - datetime.now(UTC).replace(tzinfo=None)) < timedelta(minutes=1)
