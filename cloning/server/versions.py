"""Check the versions of the socket libraries: most refuse the simulator or ignore its telemetry."""

import importlib.metadata
import re
from pathlib import Path

from cloning.base.errors import UserError

SOCKET_LIBRARIES = ("python-socketio", "python-engineio", "eventlet")
# Missing in an installed package, but there pip has installed the same versions.
REQUIREMENTS = Path(__file__).parents[2] / "requirements.txt"


def check_versions(requirements: Path = REQUIREMENTS) -> None:
    """Raise UserError if a socket library is missing, or not of the version in requirements.txt."""
    if not requirements.is_file():
        return
    pinned = dict(re.findall(r"^([\w-]+)==([\w.]+)", requirements.read_text(encoding="utf-8"), re.MULTILINE))
    differences = []
    for name in SOCKET_LIBRARIES:
        try:
            installed = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            installed = "missing"
        if name in pinned and installed != pinned[name]:
            differences.append(f"{name} is {installed} and must be {pinned[name]}")
    if differences:
        raise UserError(
            f"{', '.join(differences)}: the simulator cannot talk to other versions; "
            "run `pip install -r requirements.txt`"
        )
