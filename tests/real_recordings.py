"""Recordings of the real simulator on this machine; they are too large to come with the project."""

import os
from pathlib import Path

from commands import ROOT

from cloning.recordings.log import logs_below

ELSEWHERE = Path(os.environ.get("RECORDINGS", ROOT.parent / "shared" / "recordings"))
FOLDERS = sorted(log.parent for folder in (ROOT / "data", ELSEWHERE) for log in logs_below(folder))
MISSING = "no recordings of the real simulator in data/, in ../shared/recordings or in $RECORDINGS; see data/README.md"
