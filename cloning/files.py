"""Files that are whole or not there: written beside their place and renamed."""

import os
from pathlib import Path


def write(path: Path, data: bytes) -> None:
    """Write a file beside its place and rename it there, so that a kill leaves the old file or the new one, whole.

    Raises OSError with the file's name (a full disk, say); the old file stays.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.part")
    try:
        with open(beside, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
