"""What the network that comes with the project is trained on, and that an interrupted rendering continues."""

import errno
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import Here

from cloning.base.errors import ModelError, RecordingError
from cloning.base.program import DONE, INCOMPLETE
from cloning.network.network import Network, load_checkpoint, load_model, save_model
from cloning.recordings.excluded import EXCLUDED
from cloning.recordings.format import IMAGE_FOLDER, PROBLEM_AREAS
from cloning.recordings.log import read_recording, read_uncut
from cloning.road.points import make_road
from simulator.scenery.looks import SHADOWED
from tools import shipped
from tools.lane_frames import FIRST_ROAD, scenes
from tools.shipped import FIRST_LOOK, Lap, drive_lap, laps, render, repeat


def test_what_is_left_to_measure_with_is_not_trained_on():
    chosen, taught = laps(101, 100, {"road": 1000, "mountain": 1000}), scenes(101, {"road": 210, "mountain": 300}, 10)
    for rendered in (chosen, taught):
        assert all(int(str(lap.track).partition("-")[2] or FIRST_ROAD) >= FIRST_ROAD for lap in rendered)
    assert {lap.look % SHADOWED for lap in chosen}.isdisjoint(range(1, FIRST_LOOK))
    assert all(scene.look % SHADOWED <= 100 for scene in taught)
    some = [lap.name for lap in laps(21, 10, {"road": 40, "mountain": 30})]
    assert len(set(some)) == len(some) == 2 * (2 * 3 + 20) + 10 + 40 + 30
    assert sum(name.startswith("jungle-") and name.endswith("-fast") for name in some) == 10
    others = {lap.name for lap in laps(21, 10, {"road": 40, "mountain": 30}, first=1201)}
    assert len(others) == len(some)
    assert {name.rpartition("look")[2] for name in others & set(some)} == {"0", "10000", "20000"}


def test_each_track_is_rendered_in_both_directions_and_lights():
    chosen = laps(21, 20, {"road": 40, "mountain": 40})
    for start in ("lake", "jungle", "road-", "mountain-"):
        some = [lap for lap in chosen if str(lap.track).startswith(start)]
        combined = {(lap.direction, lap.look >= SHADOWED) for lap in some}
        assert combined == {(direction, shadows) for direction in ("ccw", "cw") for shadows in (False, True)}
        assert {lap.look // SHADOWED for lap in some} == {0, 1, 2}, "without shadows, and with both kinds"
        assert 0.4 < np.mean([lap.look >= SHADOWED for lap in some]) < 0.6


CHOSEN = [Lap("road-1001", "ccw", 0, 0.02), Lap("mountain-1001", "cw", 10_000, 0.02)]
NAMES = ["road-1001-ccw-look0", "mountain-1001-cw-look10000"]


def test_rendering_goes_on_where_it_was_interrupted(sample_recording, tmp_path, capsys):
    shutil.copytree(sample_recording, tmp_path / NAMES[0])
    (tmp_path / "unfinished" / NAMES[1]).mkdir(parents=True)  # as a killed run leaves it
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / NAMES[0]).rglob("*")}
    assert render(tmp_path, CHOSEN) == [tmp_path / name for name in NAMES]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert capsys.readouterr().out.count("rows") == 1
    assert sorted(folder.name for folder in tmp_path.iterdir()) == sorted(NAMES)
    rows = read_recording(tmp_path / NAMES[1])
    assert np.diff(rows.time) == pytest.approx(1 / shipped.RATE, abs=0.02)


def test_roads_that_a_search_found_are_rendered_in_both_directions(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "started_workers", Here)
    road = make_road([(0, 0), (20, 0), (40, 5)], name="evolution-1-17")
    chosen = laps(1, 0, {}, [road])[-2:]
    names = ["evolution-1-17-ccw-look21001", "evolution-1-17-cw-look21001"]
    assert [lap.name for lap in chosen] == names
    assert all(len(read_recording(recording)) > 20 for recording in render(tmp_path, chosen))
    with pytest.raises(RecordingError, match="evolution-1-17-ccw-look21001: two roads have the same name; rename"):
        render(tmp_path, [chosen[0], *chosen])


def test_a_lap_that_left_the_road_is_not_trained_on(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "Expert", lambda *_, **__: SimpleNamespace(drive=lambda run: (1.0, 1.0)))
    with pytest.raises(RecordingError, match="lap: the expert left the road"):
        drive_lap(tmp_path / "lap", Lap("lake", "ccw", 0), 0)


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


def test_on_windows_a_repeated_recording_has_copies_of_the_images(linked, tmp_path, monkeypatch):
    def refused(*_):
        raise OSError(errno.EINVAL, "A required privilege is not held by the client")

    monkeypatch.setattr(Path, "symlink_to", refused)
    [twin] = repeat(tmp_path / "repeated", [linked])
    assert len(read_recording(twin)) == 60
    assert read_recording(twin).path(0).read_bytes() == read_recording(linked).path(0).read_bytes()


@pytest.fixture
def commands(monkeypatch) -> SimpleNamespace:
    """The commands that were run, in `run`; each ends with the exit status `status`."""
    commands = SimpleNamespace(run=[], status=DONE)

    def python(*words):
        commands.run.append([str(word) for word in words])
        return SimpleNamespace(returncode=commands.status)

    monkeypatch.setattr(shipped, "python", python)
    return commands


@pytest.fixture
def rendered(monkeypatch) -> list[str]:
    """The laps that are to be rendered, none of which is."""
    names = list[str]()

    def render(folder, chosen):
        names.extend(lap.name for lap in chosen)
        return [folder / lap.name for lap in chosen]

    monkeypatch.setattr(shipped, "render", render)
    return names


def test_what_is_trained_on_is_not_written_over(linked, model_file, tmp_path, capsys):
    """Another start, after an interruption, would take the mean of the mean."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copyfile(model_file, out / "model.pt")
    with pytest.raises(SystemExit):
        shipped.main([str(linked), "--from", str(out / "model.pt"), "--folder", str(out)])
    assert "the mean is written there; copy the file first" in capsys.readouterr().err


def test_training_reads_only_what_this_run_asked_for(sample_recording, tmp_path, rendered, commands):
    """The folder may hold laps and recordings of an earlier run with other options."""
    out, commands.status = tmp_path / "out", INCOMPLETE
    for name, roads in (("first", "2"), ("second", "1")):
        shutil.copytree(sample_recording, tmp_path / name)
        options = [str(tmp_path / name), "--looks", "1", "--roads", roads, "--mountains", "1", "--folder", str(out)]
        assert shipped.main(options) == INCOMPLETE
    first, second = commands.run
    assert sum("road-" in part for part in first) == 2 and sum("road-" in part for part in second) == 1
    assert [part for part in second if "/real/" in part] == [str(out / "real" / f"second{PROBLEM_AREAS[0]}")]
    assert sum("mountain-1001" in part for part in first) == 1
    with pytest.raises(RecordingError, match="none: no such folder"):
        shipped.main([str(tmp_path / "none"), "--folder", str(out)])


def test_a_trained_network_is_measured(sample_recording, tmp_path, rendered, commands):
    out = tmp_path / "out"
    assert shipped.main([str(sample_recording), "--looks", "1", "--roads", "0", "--folder", str(out)]) == DONE
    training, replaying, driving = commands.run
    assert training[training.index("--output") + 1] == driving[3] == str(out / "model.pt")
    assert replaying[:6] == ["-m", "simulator", "replay", str(sample_recording), "--model", str(out / "model.pt")]
    assert driving[:3] == ["-m", "simulator", "benchmark"]


def test_a_network_that_is_trained_on_becomes_the_mean_of_both(sample_recording, tmp_path, rendered, commands):
    before, out = tmp_path / "before.pt", tmp_path / "out"
    trained = out / "trained-on" / "model.pt"
    options = [str(sample_recording), "--from", str(before), "--folder", str(out)]
    with pytest.raises(ModelError, match=r"before\.pt: no such file"):
        shipped.main(options)
    assert not commands.run and not rendered
    trained.parent.mkdir(parents=True)
    for seed, path in enumerate((before, trained)):
        torch.manual_seed(seed)
        save_model(path, Network(), history=[{"epoch": seed}])
    assert shipped.main(options) == DONE
    training = commands.run[0]
    assert training[training.index("--from") :][:4] == ["--from", str(before), "--output", str(trained)]
    assert (
        training[training.index("--epochs") + 1] == "4" and training[training.index("--learning-rate") + 1] == "0.0005"
    )
    assert commands.run[2][3] == str(out / "model.pt")
    mean, *others = (load_model(path).state_dict() for path in (out / "model.pt", before, trained))
    for name, tensor in mean.items():
        torch.testing.assert_close(tensor, (others[0][name] + others[1][name]) / 2)
    assert load_checkpoint(out / "model.pt")["history"] == [{"epoch": 1}]
