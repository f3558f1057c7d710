"""tools.corrections: the rounds by hand, with recording, training and driving replaced, and how it goes on."""

import contextlib
import csv
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cloning.base.errors import UserError
from tools import corrections
from tools.corrections import CORRECTIONS, LAPS, START, Measured, main, means, picture


def measured(kind, n, departures, seed=0):
    return Measured(seed, kind, n, 1.0 + n, 100, departures, 0.3, 1.0, 2.0)


RESULTS = [
    measured(START, 0, 6),
    measured(START, 0, 2, seed=1),
    measured(CORRECTIONS, 1, 3),
    measured(CORRECTIONS, 2, 1),
    measured(CORRECTIONS, 1, 0, seed=1),
]


def test_a_seed_that_has_ended_counts_with_its_last_result():
    assert means(RESULTS, CORRECTIONS) == [(1, 4), (2, 1.5), (3, 0.5)]
    assert means(RESULTS, LAPS) == [(1, 4)]


def test_the_picture_shows_both_kinds():
    pixels = cv2.imdecode(np.frombuffer(picture(RESULTS, "jungle"), np.uint8), cv2.IMREAD_COLOR)
    for blue_green_red in ((180, 119, 31), (14, 127, 255)):  # matplotlib's tab:blue and tab:orange
        assert (pixels == blue_green_red).all(axis=2).sum() > 50


@pytest.fixture
def done(monkeypatch):
    """What is recorded, trained and driven, instead of doing it; a network has a departure less than the one before."""
    calls = SimpleNamespace(recorded=[], trained=[], commands=[], fails=None)

    def log(folder, rows):
        folder.mkdir(parents=True)
        (folder / "driving_log.csv").write_text("row\n" * rows, encoding="utf-8")

    def record(folder, track, laps, speed, seed, look):
        calls.recorded.append((laps, seed))
        log(folder, 10)

    def run(command, **more):
        words = list(map(str, command))
        calls.commands.append(words)
        if "correct" in words:
            log(corrections.Path(words[words.index("correct") + 1]), 3)
        else:
            calls.trained.append(words)
        return SimpleNamespace(returncode=0, stderr="")

    def drive_laps(ports, mph, laps, place):
        if calls.fails == len(calls.trained):
            raise UserError("the measurement was interrupted")
        rounds = int(corrections.Path(calls.trained[-1][calls.trained[-1].index("--output") + 1]).parent.name[-1])
        return {"departures": max(0, 2 - rounds), "laps_with_departure": 0, "laps": 1, "offset_mean_m": 0.5}

    monkeypatch.setattr(corrections, "record", record)
    monkeypatch.setattr(corrections.subprocess, "run", run)
    monkeypatch.setattr(corrections, "serving", lambda *_: contextlib.nullcontext(SimpleNamespace(get=lambda: 1)))
    monkeypatch.setattr(corrections, "drive_laps", drive_laps)
    return calls


def test_rounds_add_a_recording_and_train_on_until_a_lap_without_a_departure(done, tmp_path):
    assert main(["--seeds", "3", "--laps", "2", "--folder", str(tmp_path / "x")]) == 0
    with open(tmp_path / "x" / "departures.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = [(row["kind"], row["round"], row["laps"], row["rows"], float(row["departures"])) for row in rows]
    assert found == [
        ("start", "0", "2.0", "10", 2),
        ("corrections", "1", "3.0", "13", 1),
        ("corrections", "2", "4.0", "16", 0),
        ("laps", "1", "3.0", "20", 1),
        ("laps", "2", "4.0", "30", 0),
    ]
    assert done.recorded == [(2, 300), (1, 301), (1, 302)]
    place = tmp_path / "x" / "seed-3"
    for words, before, recordings in (
        (done.trained[0], None, ["start/jungle-0"]),
        (done.trained[1], "start/round-0", ["start/jungle-0", "corrections/jungle-1-corrections"]),
        (done.trained[4], "laps/round-1", ["start/jungle-0", "laps/jungle-1", "laps/jungle-2"]),
    ):
        assert words[2 : 2 + len(recordings)] == [str(place / name) for name in recordings]
        assert words[2 + len(recordings)] == "--output"
        assert words[-2:] == ["--from", str(place / before / "model.pt")] if before else "--from" not in words


def test_an_interrupted_measurement_goes_on_with_the_same_options_only(done, tmp_path, capsys):
    command = ["--seeds", "0", "--rounds", "1", "--folder", str(tmp_path / "x")]
    done.fails = 2
    assert main(command) == 2
    done.fails = None
    assert main(command) == 0
    outputs = [words[words.index("--output") + 1].removeprefix(str(tmp_path)) for words in done.trained]
    rounds = [f"/x/seed-0/{name}/model.pt" for name in ("start/round-0", *["corrections/round-1"] * 2, "laps/round-1")]
    assert outputs == rounds
    assert all("--resume" in words for words in done.trained)
    assert sum("correct" in words for words in done.commands) == 1, "the recording was there"
    assert main([*command, "--speed", "20"]) == 2
    assert "began with other options" in capsys.readouterr().err
