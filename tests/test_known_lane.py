"""lane.csv: what the stand-in simulator writes into it, who reads it, and what is wrong with it."""

import re
import shutil

import numpy as np
import pytest
from commands import TINY, refused, trained

from cloning.base.errors import RecordingError
from cloning.browse import analyse, analyses
from cloning.lane.known import lane_position
from cloning.recordings.log import read_recording
from cloning.replay.replay import load_recording, reference_lines
from cloning.road.motion import MPH, stretches

HEADER = "center image,lateral offset (m),heading error (radians)\n"


@pytest.fixture
def lane(lake_drive, tmp_path):
    """The lane.csv of a copy of the recording, with links to its images."""
    source, folder = lake_drive[0].folder, tmp_path / "lake"
    folder.mkdir()
    for name in ("driving_log.csv", "lane.csv"):
        shutil.copyfile(source / name, folder / name)
    (folder / "IMG").symlink_to(source / "IMG")
    return folder / "lane.csv"


def known(folder):
    recording = read_recording(folder)
    return lane_position(recording, stretches(recording))


def test_the_simulator_tells_where_its_car_is(lake_drive):
    recording, true = lake_drive
    position = known(recording.folder)
    assert position.trusted.all()
    assert position.lateral_offset == pytest.approx(true, abs=1e-4)
    right = np.diff(true) / (np.diff(recording.time) * recording.speed[1:] * MPH)  # m for each metre driven
    assert np.corrcoef(position.heading_error[16:], right[15:])[0, 1] > 0.97  # measured: 0.99; at first it hardly rolls
    (line,) = reference_lines(load_recording(recording.folder))
    assert line.is_lane_centre and line.offset == pytest.approx(position.lateral_offset[line.rows], abs=1e-6)


def test_the_browser_shows_the_known_offset_and_without_the_file_it_is_estimated(lake_drive, lane, monkeypatch):
    recording, (_, true), estimate = read_recording(lane.parent), lake_drive, object()
    result, stamp = analyse.lane(recording), analyses.stamp(lane.parent, analyses.LANE)
    assert result.column("offset", recording.images[:, 0]) == pytest.approx(true, abs=1e-4)
    lane.unlink()
    assert analyses.stamp(lane.parent, analyses.LANE) != stamp, "then it is analysed again"
    monkeypatch.setattr("cloning.lane.known.estimate_lane_position", lambda *_: estimate)
    assert known(lane.parent) is estimate


def test_rows_that_it_does_not_name_are_not_trusted(lane, capsys):
    lines = lane.read_bytes().splitlines(keepends=True)
    lane.write_bytes(b"".join(lines[:31]) + b"another.jpg,9,3\n")
    position = known(lane.parent)
    assert position.trusted[:30].all() and not position.trusted[30:].any()
    rows = len(position.trusted)
    printed = f"{lane}: the lane is unknown in {rows - 30} of {rows} rows, which it does not name\n"
    assert capsys.readouterr().out == printed
    assert np.abs(position.lateral_offset).max() < 2
    lane.write_bytes(b"".join(lines[:11])[:-3])
    assert known(lane.parent).trusted.sum() == 9, "a line cut by a kill is left out; the log has no row for it"


def test_training_says_that_it_is_read_or_why_not(lane, tmp_path):
    command = (lane.parent, "--robust", *TINY, "--output", tmp_path / "model.pt")
    told = trained(*command)
    assert f"reading the lane in {lane.parent}" in told and "estimating" not in told
    lane.unlink()
    lane.mkdir()
    assert "lane.csv: not a regular file; make it a readable file, or delete it" in refused(*command)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "c.jpg,0,0\n", "names no centre image of a usable row of driving_log.csv;"),
        ("", "line 1: not center image,"),
        (HEADER + "c.jpg,0.5,0.1\nc.jpg,0.5\n", "line 3: 2 fields where 3 are expected"),
        (HEADER + "c.jpg,nan,0\n", r"line 2: lateral offset \(m\): 'nan' is not a number within ±100"),
        (HEADER + "c.jpg,1_0,0\n", r"line 2: lateral offset \(m\): '1_0' is not a number within ±100"),
        (HEADER + "c.jpg,101,0\n", r"line 2: lateral offset \(m\): '101' is not"),
        (HEADER + "c.jpg,0,90\n", r"line 2: heading error \(radians\): '90' is not a number within ±3.14159"),
        (HEADER + "c.jpg,0.5,0\nc.jpg,0.6,0\n", "line 3: another position for c.jpg"),
        (HEADER + "/data/IMG/c.jpg,0,0\n", "line 2: '/data/IMG/c.jpg' is not the name of an image alone"),
        (HEADER + '"c.jpg\n', "line 2: unexpected end of data"),
    ],
)
def test_what_is_wrong_is_named_with_a_remedy(lane, text, message):
    lane.write_text(text, encoding="utf-8")
    remedy = "correct it, or delete lane.csv, and the lane is estimated"
    with pytest.raises(RecordingError, match=f"^{re.escape(str(lane))}: {message}.* {remedy}"):
        known(lane.parent)
