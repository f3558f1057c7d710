"""Check the images of a recording before training or replaying uses it."""

import hashlib
import os
import zipfile
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cloning.files import written_whole
from cloning.recordings.format import IMAGE_FOLDER
from cloning.recordings.images import decode
from cloning.recordings.log import Recording


def check_images(recording: Recording, threads: int = 2, show_progress: bool = True) -> None:
    """Decode every image of a recording; remove the rows that have an unusable image.

    The results are kept in the user's cache folder: an image file that has not changed since (same size and time of
    change) is not decoded again. Sets `recording.digests`; adds line, kind and detail of each removed row to
    `recording.rejected`. threads: that decode at the same time.
    """
    names, folder = recording.names, recording.folder / IMAGE_FOLDER
    states = _file_states(folder, names)
    cache = _cache_file(folder)
    reasons, digests, changed = _read_cache(cache, names, states)
    reasons[states[:, 0] < 0] = b"missing"
    todo = np.flatnonzero(changed & (states[:, 0] >= 0))
    if len(todo):

        def examine(at: int) -> tuple[bytes, int]:
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
            remaining = iter(todo)
            while part := list(
                islice(remaining, 4096)
            ):  # in parts, because a future takes memory and there may be millions of images
                for at, (reason, digest) in zip(part, pool.map(examine, part), strict=True):
                    reasons[at], digests[at] = reason, digest
                    bar.update()
        _write_cache(cache, names, states, reasons, digests)
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
                f"{IMAGE_FOLDER}/{os.fsdecode(names[image])}: {reason}; copy it again, or delete the row",
            )
        )
    recording.keep(~unusable.any(1))


def _file_states(folder: Path, names: np.ndarray) -> np.ndarray:
    """Return size in bytes and time of change in ns of each named file, -1 if it is missing: int64 (m, 2)."""
    states = np.full((len(names), 2), -1, np.int64)
    if not folder.is_dir():
        return states
    with os.scandir(folder) as entries:
        while part := list(islice(entries, 8192)):
            entry_names = np.array([os.fsencode(entry.name) for entry in part])
            at = np.searchsorted(names, entry_names).clip(max=len(names) - 1)
            is_wanted = names[at] == entry_names
            for entry, index in zip(np.array(part)[is_wanted], at[is_wanted], strict=True):
                status = entry.stat()
                states[index] = status.st_size, status.st_mtime_ns
    return states


def _cache_file(folder: Path) -> Path:
    """Return the cache file for the images in a folder."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    name = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=12).hexdigest()
    return home / "behavioral-cloning" / f"{name}.npz"


def _read_cache(cache: Path, names: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each file why it is unusable (b"" if it is usable), its digest, and whether it is new or changed."""
    n = len(names)
    reasons, digests, changed = np.zeros(n, "S80"), np.zeros(n, np.uint64), np.ones(n, bool)
    try:
        with np.load(cache) as old:
            at = np.searchsorted(old["names"], names).clip(max=len(old["names"]) - 1)
            changed = (old["names"][at] != names) | (old["states"][at] != states).any(1)
            reasons, digests = np.where(changed, b"", old["reasons"][at]).astype("S80"), old["digests"][at]
    except FileNotFoundError:
        pass  # the first run on this folder
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        print(f"{cache}: unreadable ({error}); all images will be checked again")
    return reasons, digests, changed


def _write_cache(cache: Path, names: np.ndarray, states: np.ndarray, reasons: np.ndarray, digests: np.ndarray) -> None:
    try:
        cache.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(cache, per_process=True) as temporary, open(temporary, "wb") as file:
            np.savez(file, names=names, states=states, reasons=reasons, digests=digests)
    except OSError as error:
        print(f"{cache}: {error.strerror}; the next run will check all images again")
