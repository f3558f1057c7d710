"""Check the images of a recording before training or replaying uses it."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError, printable
from cloning.base.files import written_whole
from cloning.base.progress import progress_bar
from cloning.recordings.columns import Finding, Rejected
from cloning.recordings.format import DRIVING_LOG, IMAGE_FOLDER
from cloning.recordings.frames import FrameCache
from cloning.recordings.images import REMEDY, RULES, decode, read_jpeg
from cloning.recordings.log import CheckedRecording, Recording

STANDING = 1.0  # mph: a slower car may see the same again
STALE = 0.4  # s: a picture that is older shows another place; a newer one may stand for frames that were lost
IMAGES_AT_ONCE = 32  # for each thread: Ctrl-C waits for them, and a future takes memory, of perhaps millions of images


def check_images(
    recording: Recording, threads: int = 2, frames: FrameCache | None = None, show_progress: bool = True
) -> CheckedRecording:
    """Decode every image of a recording, and return its rows without those that have an unusable image.

    An image that is a copy of another camera's is unusable, too: a network would take it for a view from the side. So
    is a moving car's centre image if it is a copy of one before the last 0.4 s: it shows another moment.

    Usable images are remembered in the user's cache folder: one whose file has not changed since (same size and time of
    change) is not decoded again. threads: that decode at the same time; frames: becomes the recording's, and keeps what
    is decoded. Raises RecordingError if `IMG/` cannot be listed.
    """
    frames = frames or FrameCache()
    names, folder = recording.names, recording.folder / IMAGE_FOLDER
    states = _file_states(folder, names)
    cache = cache_file(folder)
    digests, is_usable = _read_cache(cache, names, states)
    is_missing = states[:, 0] < 0
    reasons: dict[int, str] = {}  # why an image is unusable, by its index, and what to do
    if is_missing.any():
        remedy = _remedies(folder)
        for image in np.flatnonzero(is_missing).tolist():
            reasons[image] = f"missing; {remedy(os.fsdecode(names[image]))}"
    todo = np.flatnonzero(~is_usable & ~is_missing)

    def examine(image: int) -> None:
        try:
            jpeg = read_jpeg(folder / os.fsdecode(names[image]))
            frames.put((recording.folder, image), decode(jpeg))
            digests[image] = int.from_bytes(hashlib.blake2b(jpeg, digest_size=8).digest(), "big")
        except ValueError as error:
            reasons[image] = f"{error}; {REMEDY}"

    title, hidden = f"checking images of {printable(recording.folder.name)}", not show_progress or not len(todo)
    bar, remaining = progress_bar(len(todo), "image", hidden, desc=title, leave=False), iter(todo.tolist())
    try:
        with ThreadPoolExecutor(threads) as pool, bar:
            while part := list(islice(remaining, IMAGES_AT_ONCE * threads)):
                for _ in pool.map(examine, part):
                    bar.update()
                is_usable[part] = True
    finally:  # also what was checked until Ctrl-C
        is_usable[list(reasons)] = False
        if is_usable[todo].any():
            _write_cache(cache, names[is_usable], states[is_usable], digests[is_usable])
    unusable = ~is_usable[recording.images]
    original = _originals(recording, digests)
    unusable |= (original != recording.images) & ~unusable.any(1, keepdims=True)
    rejected = list(recording.rejected)
    for row in np.flatnonzero(unusable.any(1)):
        camera = int(unusable[row].argmax())
        image, copied = recording.images[row, camera].item(), os.fsdecode(names[original[row, camera]])
        finding = Finding.IMAGE_MISSING if is_missing[image] else Finding.IMAGE_UNUSABLE
        reason = reasons.get(image, f"the same picture as {copied}; {REMEDY}")
        detail = f"{IMAGE_FOLDER}/{recording.name(int(row), camera)}: {reason}"
        rejected.append(Rejected(int(recording.lines[row]), finding, detail))
    checked = CheckedRecording(**{**vars(recording), "frames": frames, "rejected": rejected}, digests=digests)
    return checked.take(~unusable.any(1))


def _originals(recording: Recording, digests: np.ndarray) -> np.ndarray:
    """Return the images of which a recording's may wrongly be copies, else themselves: int32 (n, 3), as `images`.

    digests: uint64 (m,), of the images. They may be those of the row's cameras before, or of an earlier row's centre.
    """
    content, original = digests[recording.images], recording.images.copy()
    for camera, other in ((2, 1), (2, 0), (1, 0)):
        same = content[:, camera] == content[:, other]
        original[same, camera] = recording.images[same, other]
    _, first, inverse = np.unique(content[:, 0], return_index=True, return_inverse=True)
    stale = (recording.speed > STANDING) & (recording.time > recording.time[first[inverse]] + STALE)
    original[stale, 0] = recording.images[first[inverse], 0][stale]
    return original


def _remedies(folder: Path) -> Callable[[str], str]:
    """Return what to do about a missing image, as a function of its name; folder: where it should be."""
    patterns = "*", "*/*", f"{folder.name}/*/*"
    present = {path.name.lower(): path for pattern in patterns for path in folder.parent.glob(pattern)}

    def remedy(name: str) -> str:
        similar = present.get(name.lower(), folder / name)
        if similar.parent == folder.parent and folder.parent.name == IMAGE_FOLDER:
            return f"move {DRIVING_LOG} from {folder.parent} to the folder above"
        if similar.parent != folder:
            return f"move the images from {similar.parent} to {folder}"
        if similar.name != name:
            return f"rename {similar.name}, which differs in upper and lower case, or correct the csv"
        if similar.is_symlink():
            return "its link leads nowhere: copy the image instead, or delete the row"
        return REMEDY if folder.is_dir() else f"there is no folder {folder.name}: copy it beside {DRIVING_LOG}"

    return remedy


def _file_states(folder: Path, names: np.ndarray) -> np.ndarray:
    """Return size in bytes and time of change in ns of each named file, -1 if it is missing: int64 (m, 2)."""
    states = np.full((len(names), 2), -1, np.int64)
    if not folder.is_dir():
        return states
    wanted = {name: index for index, name in enumerate(names.tolist())}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if (index := wanted.get(os.fsencode(entry.name))) is not None:
                    with suppress(OSError):  # a link that leads nowhere
                        status = entry.stat()
                        states[index] = status.st_size, status.st_mtime_ns
    except OSError as error:
        raise RecordingError(f"{folder}: {error.strerror}; make it readable") from None
    return states


def cache_file(folder: Path, analysis: str = "") -> Path:
    """Return the file in the user's cache folder in which the results of a slow look at a folder are remembered.

    analysis: what looked, as part of the file's name; empty for `check_images`.
    """
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # nobody's: a container may run as a user without a name
        home = Path(tempfile.gettempdir())
    name = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=12).hexdigest()
    return home / "behavioral-cloning" / f"{name}{analysis}.npz"


def _cache_columns(names: np.dtype) -> np.dtype:
    """Return the columns of the cache: name, size and time of change, digest; names: dtype of the file names."""
    return np.dtype([("name", names), ("state", np.int64, 2), ("digest", np.uint64)])


def _read_cache(cache: Path, names: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each file's digest, uint64 (m,), else 0, and whether it is known to be usable and unchanged, bool (m,)."""
    try:
        with np.load(cache) as file:
            if "rules" not in file or file["rules"] != RULES:
                raise ValueError("checked by the rules of another version")
            known = file["images"]
        if known.ndim != 1 or known.dtype != _cache_columns(known.dtype["name"]):
            raise ValueError("other columns")
        at = np.searchsorted(known["name"], names).clip(max=len(known) - 1)
        is_known = (known["name"][at] == names) & (known["state"][at] == states).all(1)
        return known["digest"][at] * is_known, is_known
    except FileNotFoundError:
        pass  # the first run on this folder
    except Exception as error:  # whatever a damaged file makes NumPy raise
        print(f"{cache}: unreadable ({error}); all images will be checked again")
    return np.zeros(len(names), np.uint64), np.zeros(len(names), bool)


def _write_cache(cache: Path, names: np.ndarray, states: np.ndarray, digests: np.ndarray) -> None:
    """Remember usable images; names: bytes (m,), sorted; states: of `_file_states`; digests: uint64 (m,)."""
    images = np.empty(len(names), _cache_columns(names.dtype))
    images["name"], images["state"], images["digest"] = names, states, digests
    try:
        cache.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(cache) as temporary, open(temporary, "wb") as file:
            np.savez(file, rules=RULES, images=images)
    except OSError as error:
        print(f"{cache}: {error.strerror}; the next run will check all images again")
