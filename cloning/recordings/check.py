"""Check a recording's `IMG/` before it is trained on or replayed."""

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cloning.recordings.images import decode
from cloning.recordings.log import Recording


def check_images(recording: Recording, threads: int = 2, show_progress: bool = True) -> None:
    """Look at every image of a recording once; leave out, with name and reason, the rows that cannot be used.

    What was found is kept in the user's cache folder, so that an unchanged file (size and time of change) is not
    decoded again by a later run. Sets `digests`; adds to `rejected`.
    """
    names, folder = recording.names, recording.folder / "IMG"
    states = _file_states(folder, names)
    cache = _cache_file(folder)
    reasons, digests, fresh = _remembered(cache, names, states)
    reasons[states[:, 0] < 0] = b"missing"
    todo = np.flatnonzero(fresh & (states[:, 0] >= 0))
    if len(todo):

        def examine(at):
            try:
                jpeg = (folder / os.fsdecode(names[at])).read_bytes()
                decode(jpeg)
            except (OSError, ValueError) as error:
                return str(error).encode()[:80], 0
            return b"", int.from_bytes(hashlib.blake2b(jpeg, digest_size=8).digest(), "big")

        with (
            ThreadPoolExecutor(threads) as pool,
            tqdm(
                total=len(todo),
                desc=f"checking images of {recording.folder.name}",
                unit="image",
                leave=False,
                disable=None if show_progress else True,
            ) as bar,
        ):
            todo_left = iter(todo)
            while part := list(islice(todo_left, 4096)):  # in pieces: a future for each of millions is too many
                for at, (reason, digest) in zip(part, pool.map(examine, part), strict=True):
                    reasons[at], digests[at] = reason, digest
                    bar.update()
        _remember(cache, names, states, reasons, digests)
    recording.digests = digests
    bad = reasons != b""
    unusable = bad[recording.images]
    for row in np.flatnonzero(unusable.any(1)):
        image = recording.images[row][unusable[row]][0]
        reason = reasons[image].decode()
        recording.rejected.append(
            (
                int(recording.lines[row]),
                f"image {reason}",
                f"IMG/{os.fsdecode(names[image])}: {reason}; copy it again, or delete the row",
            )
        )
    recording.keep(~unusable.any(1))


def _file_states(folder: Path, names: np.ndarray) -> np.ndarray:
    """Size in bytes and time of change in ns of each named file, -1 where it is missing: int64 (m, 2)."""
    states = np.full((len(names), 2), -1, np.int64)
    if not folder.is_dir():
        return states
    with os.scandir(folder) as entries:
        while part := list(islice(entries, 8192)):
            found = np.array([os.fsencode(entry.name) for entry in part])
            at = np.searchsorted(names, found).clip(max=len(names) - 1)
            for entry, place in zip(np.array(part)[names[at] == found], at[names[at] == found], strict=True):
                state = entry.stat()
                states[place] = state.st_size, state.st_mtime_ns
    return states


def _cache_file(folder: Path) -> Path:
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    name = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=12).hexdigest()
    return home / "behavioral-cloning" / f"{name}.npz"


def _remembered(cache: Path, names, states):
    """Of each file: why it cannot be used (b"" if it can), its digest, and whether it must be looked at (again)."""
    reasons, digests, fresh = np.zeros(len(names), "S80"), np.zeros(len(names), np.uint64), np.ones(len(names), bool)
    try:
        with np.load(cache) as old:
            at = np.searchsorted(old["names"], names).clip(max=len(old["names"]) - 1)
            fresh = (old["names"][at] != names) | (old["states"][at] != states).any(1)
            reasons, digests = np.where(fresh, b"", old["reasons"][at]).astype("S80"), old["digests"][at]
    except FileNotFoundError:
        pass  # the first run on this folder
    except (OSError, ValueError, KeyError, EOFError) as error:
        print(f"{cache}: unreadable ({error}); all images are checked anew")
    return reasons, digests, fresh


def _remember(cache: Path, names, states, reasons, digests) -> None:
    beside = cache.with_suffix(f".{os.getpid()}.npz")
    try:
        cache.parent.mkdir(parents=True, exist_ok=True)
        np.savez(beside, names=names, states=states, reasons=reasons, digests=digests)
        os.replace(beside, cache)
    except OSError as error:
        beside.unlink(missing_ok=True)
        print(f"{cache}: {error.strerror}: the next run has to check the images again")
