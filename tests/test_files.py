"""Files are written completely or not at all."""

import errno
import multiprocessing
import os
import sys
import time
from pathlib import Path

import pytest

from cloning.base.errors import OutputError, UserError
from cloning.base.files import folder_written_whole, locked, write, written_whole
from cloning.base.outputs import check_folders, claimed, run_all


@pytest.mark.parametrize("name", ["runs", "."])
def test_a_folder_is_refused_at_once(tmp_path, monkeypatch, name):
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(IsADirectoryError) as caught, written_whole(name):
        pytest.fail("the work began")
    assert caught.value.filename == name
    with pytest.raises(OutputError, match="is a folder"):
        check_folders(name)
    with pytest.raises(OutputError, match="is a folder"):
        check_folders("new/")


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "report.json").symlink_to(tmp_path / "frozen" / "report.json")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "frozen" or mode != os.W_OK)
    with pytest.raises(OutputError, match=r"report\.json: its folder cannot be written; name a file in another one"):
        check_folders(str(tmp_path / "report.json"))


def test_a_file_appears_only_when_it_is_complete(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")
    with written_whole(path) as temporary:
        temporary.write_bytes(b"new")
        assert temporary.parent == tmp_path
        assert path.read_bytes() == b"old"
    with written_whole(path):
        pass  # a block that writes nothing changes nothing
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["film.mp4"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes among files")
def test_a_link_stays_and_a_pipe_is_not_replaced(tmp_path):
    disk, link, pipe = tmp_path / "disk", tmp_path / "report.json", tmp_path / "pipe"
    disk.mkdir()
    link.symlink_to(disk / "report.json")
    for data in (b"old", b"new"):
        write(link, data)
        assert link.is_symlink() and (disk / "report.json").read_bytes() == data
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="is a device or a pipe") as caught:
        write(pipe, b"new")
    assert caught.value.filename == str(pipe) and pipe.is_fifo()
    with pytest.raises(OutputError, match="pipe: is a device or a pipe; name a file"):
        check_folders(str(pipe))


def test_on_windows_a_program_that_has_the_file_open_for_a_moment_is_waited_for(tmp_path, monkeypatch):
    replace, tries = os.replace, list[str]()

    def held_at_first(old, new):
        tries.append(str(new))
        if len(tries) < 3:
            raise PermissionError(errno.EACCES, "Access is denied", str(old))
        replace(old, new)

    monkeypatch.setattr(os, "replace", held_at_first)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(PermissionError):
        write(tmp_path / "file", b"new")
    monkeypatch.setattr("sys.platform", "win32")
    tries.clear()
    write(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new" and len(tries) == 3
    monkeypatch.setattr("cloning.base.files.HELD_OPEN", -1.0)
    tries.clear()
    with pytest.raises(PermissionError, match=r"Access is denied .*close it there.*file'"):
        write(tmp_path / "file", b"newer")


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError, ValueError])
def test_an_exception_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")
    with pytest.raises(error), written_whole(path) as temporary:
        temporary.write_bytes(b"half")
        raise error
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["film.mp4"]


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.ENOSPC, "No space left on device", "temporary"),
        OSError("100 requested and 7 written"),  # NumPy's, without a number
    ],
)
def test_a_full_disk_names_the_file_that_the_user_knows(tmp_path, error):
    path = tmp_path / "film.mp4"
    with pytest.raises(OSError) as raised, written_whole(path) as temporary:
        temporary.write_bytes(b"half")
        if error.filename:
            error.filename = str(temporary)
        raise error
    assert raised.value.filename == str(path)
    assert raised.value.strerror in ("No space left on device", "100 requested and 7 written")
    assert raised.value.errno and os.listdir(tmp_path) == []


def test_a_missing_folder_or_another_file_is_named(tmp_path):
    path = tmp_path / "nowhere" / "model.pt"
    with pytest.raises(FileNotFoundError) as raised:
        write(path, b"data")
    assert raised.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as raised, written_whole(tmp_path / "film.mp4") as temporary:
        temporary.write_bytes(b"half")
        (tmp_path / "frame.jpg").read_bytes()
    assert raised.value.filename == str(tmp_path / "frame.jpg")
    assert os.listdir(tmp_path) == []


def test_several_may_write_a_file_at_the_same_time(tmp_path):
    """The first one to finish does not put the other's half under the file's name."""
    path = tmp_path / "film.mp4"
    with written_whole(path) as first, open(first, "wb") as film:
        film.write(b"first")
        with written_whole(path) as second:
            second.write_bytes(b"second")
        assert path.read_bytes() == b"second"
        film.write(b", whole")
    assert path.read_bytes() == b"first, whole"
    assert os.listdir(tmp_path) == ["film.mp4"]


def test_several_may_write_a_folder_at_the_same_time(tmp_path):
    """The first one to finish has only its own files in it; the others fail, and leave nothing."""
    path = tmp_path / "lake"
    with pytest.raises(OSError) as raised, folder_written_whole(path) as second:
        (second / "second.csv").write_bytes(b"second")
        with folder_written_whole(path) as first:
            (first / "first.csv").write_bytes(b"first")
    assert raised.value.filename == str(path)
    assert os.listdir(tmp_path) == ["lake"] and os.listdir(path) == ["first.csv"]


def test_what_killed_processes_left_goes_after_a_day(tmp_path):
    """Each use has its own temporary file, which nobody else would ever write or delete."""
    old, new, foreign = (tmp_path / name for name in (".other.npz.0123abcd.part", ".film.mp4.89ef0123.part", ".a.part"))
    for path, age in ((old, 86_500), (new, 86_300), (foreign, 86_500)):
        path.write_bytes(b"half")
        os.utime(path, (time.time() - age,) * 2)
    (tmp_path / ".lake.0123abcd.part" / "IMG").mkdir(parents=True)
    os.utime(tmp_path / ".lake.0123abcd.part", (time.time() - 86_500,) * 2)
    write(tmp_path / "film.mp4", b"new")
    left = {new.name, foreign.name, "film.mp4"}
    assert set(os.listdir(tmp_path)) == left, "another process may still write the new one"


def test_all_outputs_are_tried_and_every_failure_is_reported():
    done = []

    def fails(reason):
        raise reason

    with pytest.raises(UserError, match="first; second"):
        run_all(lambda: fails(UserError("first")), lambda: fails(UserError("second")), lambda: done.append("report"))
    with pytest.raises(KeyboardInterrupt):
        run_all(lambda: fails(KeyboardInterrupt()), lambda: done.append("film"), lambda: fails(UserError("third")))
    assert done == ["report", "film"]


def test_a_claimed_folder_is_made_and_no_file_is_taken_for_one(tmp_path):
    (tmp_path / "file").write_text("mine")
    for wrong, reason in (("file", "file: not a folder"), ("file/in", "in: cannot be made")):
        with pytest.raises(OutputError, match=f"{reason}.*; name another folder"), claimed(tmp_path / wrong):
            pytest.fail("claimed")
    with claimed(tmp_path / "new" / "in"):
        assert (tmp_path / "new" / "in").is_dir()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no locks on folders")
def test_a_folder_is_free_at_the_end_of_its_lock_whatever_was_forked_meanwhile(tmp_path):
    with locked(tmp_path) as free, locked(tmp_path) as again:
        other = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
        other.start()
        assert (free, again) == (True, False)
    until = time.monotonic() + 30  # the copy lets go as soon as it runs
    try:
        while time.monotonic() < until:
            with locked(tmp_path) as free:
                if free:
                    return
        pytest.fail("still locked")
    finally:
        other.kill()
