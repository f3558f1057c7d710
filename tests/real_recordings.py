"""Recordings of the real simulator on this machine; they are too large to come with the project."""

import os
from pathlib import Path

from commands import ROOT

from cloning.recordings.log import folders_below

ELSEWHERE = Path(os.environ.get("RECORDINGS", ROOT.parent / "shared" / "recordings"))
FOLDERS = sorted(found for folder in (ROOT / "data", ELSEWHERE) for found in folders_below(folder))
MISSING = "no recordings of the real simulator in data/, in ../shared/recordings or in $RECORDINGS; see data/README.md"
