"""What the network that comes with the project is trained on, and that an interrupted rendering continues."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from cloning.base.errors import RecordingError
from cloning.base.program import DONE, INCOMPLETE
from cloning.recordings.excluded import EXCLUDED
from cloning.recordings.format import IMAGE_FOLDER, PROBLEM_AREAS
from cloning.recordings.log import read_recording, read_uncut
from cloning.road.generated import road_number
from simulator.scenery.looks import SHADOWED
from tools import shipped
from tools.lane_frames import FIRST_ROAD, scenes
from tools.shipped import FIRST_LOOK, Lap, laps, render, repeat


def test_what_is_left_to_measure_with_is_not_trained_on():
    chosen, taught = laps(101, 1000), scenes(101, 101, 10)
    for rendered in (chosen, taught):
        assert all((road_number(lap.track) or FIRST_ROAD) >= FIRST_ROAD for lap in rendered)
    assert {lap.look % SHADOWED for lap in chosen}.isdisjoint(range(1, FIRST_LOOK))
    assert all(scene.look % SHADOWED <= 100 for scene in taught)
    assert len(set(laps(21, 40))) == len(laps(21, 40)) == 2 * (2 * 3 + 20) + 40


def test_each_track_is_rendered_in_both_directions_and_lights():
    chosen = laps(21, 40)
    for start in ("lake", "jungle", "road-"):
        some = [lap for lap in chosen if lap.track.startswith(start)]
        combined = {(lap.direction, lap.look >= SHADOWED) for lap in some}
        assert combined == {(direction, shadows) for direction in ("ccw", "cw") for shadows in (False, True)}
        assert {lap.look // SHADOWED for lap in some} == {0, 1, 2}, "without shadows, and with both kinds"
        assert 0.4 < np.mean([lap.look >= SHADOWED for lap in some]) < 0.6


@pytest.fixture
def expert(monkeypatch):
    """A stand-in for the expert: the laps it was asked to drive, its departures, the lap that is interrupted."""
    expert = SimpleNamespace(laps=[], departures=[], interrupted=0)

    def record(folder, track, laps, seed, look):
        folder.mkdir(parents=True)
        expert.laps.append((track.name, track.direction, look, seed))
        if len(expert.laps) == expert.interrupted:
            raise KeyboardInterrupt
        return SimpleNamespace(departures=expert.departures), 1

    monkeypatch.setattr(shipped, "record", record)
    return expert


def test_rendering_goes_on_where_it_was_interrupted(tmp_path, expert):
    chosen = [Lap("lake", "ccw", 0), Lap("lake", "cw", 10_000), Lap("road-1001", "ccw", 1)]
    expert.interrupted = 2
    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, chosen)
    names = ["lake-ccw-look0", "lake-cw-look10000", "road-1001-ccw-look1"]
    assert render(tmp_path, chosen) == [tmp_path / name for name in names]
    assert expert.laps == [(*lap, seed) for lap, seed in zip([*chosen[:2], *chosen[1:]], (0, 1, 1, 2), strict=True)]
    assert sorted(folder.name for folder in tmp_path.iterdir()) == names


def test_a_lap_that_left_the_road_is_not_trained_on(tmp_path, expert):
    expert.departures = ["one"]
    with pytest.raises(RecordingError, match="lake-ccw-look0: the expert left the road"):
        render(tmp_path, [Lap("lake", "ccw", 0)])
    assert not (tmp_path / "lake-ccw-look0").exists()


@pytest.mark.parametrize("cut", [False, True])
def test_a_repeated_recording_is_read_like_the_original(sample_recording, tmp_path, cut):
    source, folder = tmp_path / "lake", tmp_path / "repeated"
    shutil.copytree(sample_recording, source)
    for is_cut in (True, cut):  # a second run takes over what has changed
        names = [read_uncut(source).name(row) for row in (3, 9)]
        (source / EXCLUDED).write_text(",".join(names) + ",off the road\n" if is_cut else "", encoding="utf-8")
        [twin] = repeat(folder, [source])
    original = read_recording(source)
    assert twin.parent == folder and twin.name.endswith(PROBLEM_AREAS)
    repeated = read_recording(twin)
    assert len(repeated) == 60 - 7 * cut
    np.testing.assert_array_equal(repeated.steering, original.steering)
    assert repeated.path(0).read_bytes() == original.path(0).read_bytes()


def test_a_repeated_recording_shows_the_images_of_this_run(linked, tmp_path):
    for folder in ("before", "now"):
        source = shutil.copytree(linked, tmp_path / folder / "lake")
        [twin] = repeat(tmp_path / "repeated", [source])
    assert (twin / IMAGE_FOLDER).resolve() == source / IMAGE_FOLDER
    with pytest.raises(RecordingError, match=r"now/lake and .*before/lake have the same name"):
        repeat(tmp_path / "repeated", [tmp_path / "before" / "lake", source])


@pytest.fixture
def commands(monkeypatch) -> SimpleNamespace:
    """The commands that were run, in `run`; each ends with the exit status `status`."""
    commands = SimpleNamespace(run=[], status=DONE)

    def python(*words):
        commands.run.append([str(word) for word in words])
        return SimpleNamespace(returncode=commands.status)

    monkeypatch.setattr(shipped, "python", python)
    return commands


def test_training_reads_only_what_this_run_asked_for(sample_recording, tmp_path, expert, commands):
    """The folder may hold laps and recordings of an earlier run with other options."""
    out, commands.status = tmp_path / "out", INCOMPLETE
    for name, roads in (("first", "2"), ("second", "1")):
        shutil.copytree(sample_recording, tmp_path / name)
        options = [str(tmp_path / name), "--looks", "1", "--roads", roads, "--folder", str(out)]
        assert shipped.main(options) == INCOMPLETE
    first, second = commands.run
    assert sum("road-" in part for part in first) == 2 and sum("road-" in part for part in second) == 1
    assert [part for part in second if "/real/" in part] == [str(out / "real" / f"second{PROBLEM_AREAS[0]}")]
    with pytest.raises(RecordingError, match="none: no such folder"):
        shipped.main([str(tmp_path / "none"), "--folder", str(out)])


def test_a_trained_network_is_measured(sample_recording, tmp_path, expert, commands):
    out = tmp_path / "out"
    assert shipped.main([str(sample_recording), "--looks", "1", "--roads", "0", "--folder", str(out)]) == DONE
    training, measuring = commands.run
    assert training[training.index("--output") + 1] == measuring[2] == str(out / "model.pt")
    assert measuring[:2] == ["-m", "tools.scoreboard"] and str(sample_recording) in measuring
