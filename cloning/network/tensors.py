"""Files of tensors and plain values that carry a digest of their contents; a damaged file is refused.

They are torch's files: zip archives without compression, with a checksum of each entry, which torch does not compare
when it loads them. Files of earlier versions have no digest and rely on these checksums alone.
"""

import hashlib
import io
import math
import re
import reprlib
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, TypeGuard

import torch

from cloning.base.errors import ModelError
from cloning.base.files import write

MAX_SIZE = 30_000_000  # bytes of a file, and of its contents in memory; the largest file of this project has 7 million
MAX_STRUCTURE = 2_000_000  # bytes of all but the tensors: 24,000 epochs; each of them can become 72 in memory
TENSOR = re.compile("[^/]+/data/")  # the start of the name of a tensor's entry
PLAIN = (str, int, float, bool, type(None))


def save(path: str | Path, contents: Mapping[str, object]) -> None:
    """Write a file of dicts, lists, tuples, tensors and plain values, with their digest. Raises OSError."""
    buffer = io.BytesIO()
    torch.save({**contents, "digest": compute_digest(contents)}, buffer)
    write(path, buffer.getvalue())


def load(path: str | Path, remedy: str) -> dict[str, Any]:
    """Return the contents of a file, without running code from it, with 500 MB of memory at most.

    They include the "digest", None if the file has none, so that its caller can warn of that.
    remedy: how to get a good file, as the end of an error's message. Raises ModelError for a file that is missing, not
    of `save`, or changed since it was saved.
    """
    try:
        with open(path, "rb") as file:
            _check_archive(file)
            contents = torch.load(file, map_location="cpu", weights_only=True)
        if not isinstance(contents, dict):
            raise ValueError("its contents have no names")
        digest = contents.pop("digest", None)
        if compute_digest(contents) != digest and digest is not None:
            raise ValueError("its contents do not match its digest")
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file; {remedy}") from None
    except PermissionError as error:
        raise ModelError(f"{path}: {error.strerror}; make it readable") from None
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror or error}; {remedy}") from error
    except Exception as error:  # torch.load and pickle raise all sorts for a foreign or damaged file
        is_plain = type(error) in (ValueError, zipfile.BadZipFile)
        reason = error if is_plain else type(error).__name__
        raise ModelError(f"{path}: not a model of this project, or damaged ({reason}); {remedy}") from error
    return contents | {"digest": digest}


def save_weights(path: str | Path, network: torch.nn.Module) -> None:
    """Write a network's weights to a file, in half precision. Raises OSError."""
    weights = network.state_dict().items()
    save(path, {name: value.half() if value.is_floating_point() else value for name, value in weights})


def load_weights(path: str | Path, network: torch.nn.Module, name: str, remedy: str) -> None:
    """Give a network the weights of a file; name: of the network, remedy: see `load`. Raises ModelError."""
    weights = load(path, remedy)
    del weights["digest"]
    try:
        network.load_state_dict(matching(weights, network.state_dict()))
    except ValueError as error:
        raise ModelError(f"{path}: holds no weights of {name}: {error}; {remedy}") from None


def matching(found: object, expected: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return copies of a file's tensors, all finite, with the names and shapes of `expected`, and floats where it has.

    Raises ValueError, saying what differs.
    """
    if not isinstance(found, dict) or set(found) != set(expected):
        differing = set(found) ^ set(expected) if isinstance(found, dict) else expected
        raise ValueError(f"missing or unknown: {', '.join(sorted(map(shown, differing))[:3])}")
    for name, like in expected.items():
        value = found[name]
        if (
            not isinstance(value, torch.Tensor)
            or value.shape != like.shape
            or value.is_floating_point() != like.is_floating_point()
        ):
            raise ValueError(f"{name} is {shown(value)}, not a tensor {tuple(like.shape)}, {like.dtype}")
        if not value.to(like.dtype).isfinite().all():
            raise ValueError(f"{name} contains numbers that are not finite")
    return {name: found[name].clone() for name in expected}  # a file's tensors may share their memory


def shown(value: object) -> str:
    """Return a short description of any value of a file, for a message."""
    if isinstance(value, torch.Tensor):
        return f"a tensor {tuple(value.shape)}, {value.dtype}"
    return reprlib.repr(value)


def is_number(value: object, least: float = -math.inf, most: float = math.inf) -> TypeGuard[float]:
    """Return whether a value of a file is an int or a float, from `least` to `most`; never for nan."""
    return isinstance(value, (int, float)) and type(value) is not bool and least <= value <= most


def compute_digest(contents: object) -> str:
    """Return a digest of dicts, lists, tuples, tensors and plain values, whichever file they are in.

    What is contained several times counts each time. Raises ValueError for any other value and for more than MAX_SIZE
    bytes in all: a small file could otherwise stand for any amount of data.
    """
    digest, size = hashlib.blake2b(digest_size=16), 0

    def add(value: object) -> None:
        nonlocal size
        size += sys.getsizeof(value) + (value.nbytes if isinstance(value, torch.Tensor) else 0)
        if size > MAX_SIZE:
            raise ValueError(f"its contents have more than {MAX_SIZE:,} bytes")
        if isinstance(value, torch.Tensor):
            digest.update(f"{value.dtype} {tuple(value.shape)}:".encode())
            digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
        elif isinstance(value, (dict, list, tuple)):
            digest.update(f"{'dict' if isinstance(value, dict) else type(value).__name__} {len(value)}:".encode())
            for item in value.items() if isinstance(value, dict) else [value]:
                for part in item:
                    add(part)
        elif type(value) in PLAIN:
            digest.update(f"{value!r}:".encode())
        else:
            raise ValueError(f"a value is of type {type(value).__name__}")

    add(contents)
    return digest.hexdigest()


def _check_archive(file: IO[bytes]) -> None:
    """Raise ValueError or BadZipFile if a file is not an intact archive without compression; rewind it."""
    size = file.seek(0, io.SEEK_END)
    if size > MAX_SIZE:
        raise ValueError(f"it has {size:,} bytes")
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        unpacked = sum(entry.file_size for entry in entries)
        if unpacked > size or any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("it is compressed")
        structure = sum(entry.file_size for entry in entries if not TENSOR.match(entry.filename))
        if structure > MAX_STRUCTURE:
            raise ValueError(f"it has {structure:,} bytes that are not tensors")
        if damaged := archive.testzip():
            raise ValueError(f"the checksum of {damaged} is wrong")
    file.seek(0)
