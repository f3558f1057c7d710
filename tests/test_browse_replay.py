"""Replays and attention in the browser of recordings, and the training runs that it shows."""

import json
import os
import shutil
import sys
import time
from contextlib import closing

import cv2
import numpy as np
import pytest
from browse_process import browsing, opened, placed, replayed, steered, written_run
from browser import needs_chromium
from commands import trained
from drive_process import awaited
from test_excluded import center

from cloning.base.errors import ModelError, UserError
from cloning.browse import analyse, analyses, attend, computed, library, runs
from cloning.browse.analyses import Analysis, UnknownError, stamp, write_result
from cloning.browse.attention import Attention
from cloning.network.attention import visual_backprop
from cloning.network.network import load_checkpoint, load_model, steer
from cloning.recordings.excluded import Cut, add_cuts
from cloning.recordings.images import decode, read_frame
from cloning.recordings.log import read_recording
from cloning.replay import replay
from cloning.replay.model_driver import ModelDriver
from cloning.road.overlay import MAGENTA, overlay
from cloning.training.distributed import Ranks
from cloning.training.run_files import RunFiles
from simulator import __main__ as simulator

# ----------------------------------------------------------------------------------------------------------------------
# Replays


def test_a_replay_on_the_page_is_that_of_the_command(linked, model_file, tmp_path, monkeypatch):
    """Its figures are those of the command's report, its pictures those that the model was given."""
    add_cuts(linked, Cut(center(linked, 0), center(linked, 4), "standing"))
    given = []

    class Watched(ModelDriver):
        def __call__(self, frame):
            given.append((frame.row, frame.jpeg()))
            return super().__call__(frame)

    monkeypatch.setattr(analyse, "ModelDriver", Watched)
    wanted = Analysis("replay", str(model_file), 1.0)
    write_result(linked, wanted, stamp(linked, wanted), analyse.replayed(replay.load_recording(linked), wanted))
    report = tmp_path / "replay.json"
    words = ("replay", linked, "--model", model_file, "--limit", 1, "--report", report)
    assert simulator.main([*map(str, words)]) == 0
    expected = json.loads(report.read_bytes())[0]["limits"]["1"]
    with opened(linked, model_file) as recording:
        shown = recording.details("1")["replays"][0]
        assert shown["state"] == "ready" and shown["driven"] == 55
        for key in ("autonomy_percent", "interventions", "distance_mean_m", "distance_p95_m"):
            assert shown[key] == expected[key]
        known = json.loads(report.read_bytes())[0]["unknown"]
        parts = [{"first": center(linked, row), "rows": rows, "why": why} for row, rows, why in shown["unknown"]]
        assert [{key: each[key] for key in ("first", "rows", "why")} for each in known] == parts
        # The row before the one in which the car has been set back.
        images = [recording.row(row + 1)["images"][0] for row, _ in shown["where"]]
        assert images == [each["image"] for each in expected["where"]] and len(images) > 0
        column = recording.column("replay-0-1")
        assert np.isnan(column[:5]).all() and not np.isnan(column[5:]).any()
        for row, jpeg in given[::9]:
            seen = decode(recording.jpeg(row + 5, "replay-0-1"))  # the replay does not have the five rows
            assert np.abs(seen.astype(int) - decode(jpeg)).mean() < 0.5
            steered = recording.column("driver-0-1")[row + 5]
            assert steered == pytest.approx(float(steer(load_model(model_file), decode(jpeg))), abs=1e-6)
        with pytest.raises(UnknownError):
            recording.jpeg(4, "replay-0-1")


def test_a_replay_begins_only_when_asked_for_and_can_be_stopped(linked, model_file, monkeypatch):
    code = "import sys, time; print('progress 0.25', flush=True); time.sleep('replay' in sys.argv and 600)"
    monkeypatch.setattr(analyses, "COMMAND", (sys.executable, "-c", code))
    placed(linked, np.zeros(60))
    with opened(linked, model_file) as recording:

        def state(limit: str = "2.5") -> dict:
            return recording.details(limit)["replays"][0]

        assert state() == {"state": "none"}
        recording.replay("2.5", begin=True)
        awaited(lambda: state() == {"state": "running", "progress": 0.25})
        recording.replay("1", begin=True)
        assert state("1") == {"state": "waiting"}
        for limit in ("1", "2.5"):
            recording.replay(limit, begin=False)
        awaited(lambda: state()["state"] != "running")
        assert state() == state("1") == {"state": "none"}


def test_a_replay_is_there_no_more_once_one_of_other_cuts_has_taken_its_place(linked, tmp_path):
    (model := tmp_path / "model.pt").touch()
    placed(linked, np.zeros(60))
    steered(linked, model)
    with opened(linked, model) as recording:
        replayed(linked, model, 1.0, np.zeros(60), [])
        assert recording.details("1")["replays"][0]["state"] == "ready"
        cuts = recording.cut([Cut(center(linked, 50), center(linked, 59), "")])
        assert recording.details("1")["replays"][0]["state"] == "none"
        replayed(linked, model, 1.0, np.zeros(50), [])
        assert recording.details("1")["replays"][0]["state"] == "ready"
        recording.restore(cuts)
        computed.result.cache_clear()  # as if other recordings had been looked at
        assert recording.details("1")["replays"][0]["state"] == "none"


def test_what_a_page_asks_for_again_and_again_is_computed_once(linked, tmp_path, model_file, monkeypatch):
    """The rows of each cut; and of a comparison all that needs the logs of more recordings than stay in memory."""
    folders = [linked, *(shutil.copytree(linked, tmp_path / name) for name in "abc")]
    for folder in folders:
        add_cuts(folder, Cut(center(folder, 3), center(folder, 5), "off"))
        steered(folder, model_file)
        replayed(folder, model_file, 1.0, np.zeros(60), [])
    with closing(library.Library(folders, [model_file])) as browsed:
        browsed.analyses.pause()
        recordings = [browsed[each] for each in browsed.recordings]

        def asked() -> list:
            return [*(each.compared("1", begin=False) for each in recordings), recordings[0].details("1")]

        first = asked()
        assert [cut["stretches"] for cut in first[-1]["cuts"]] == [[[3, 6]]] and first[2]["models"][0]["error"]
        monkeypatch.setattr(computed, "read_uncut", None)
        monkeypatch.setattr(computed, "cut_rows", None)
        assert asked() == first


def test_a_log_that_grows_while_it_is_read_is_shown(linked, tmp_path, monkeypatch):
    """As of a recording that is being made: its version is then older than its rows."""
    (model := tmp_path / "model.pt").touch()
    with opened(linked, model) as recording:
        recording.analyses.pause()
        monkeypatch.setattr(library.ShownRecording, "version", lambda _: "one")
        recording.details()
        log = linked / "driving_log.csv"
        log.write_text("".join(log.read_text(encoding="utf-8").splitlines(keepends=True)[:-5]), encoding="utf-8")
        steered(linked, model)
        computed._read_once.cache_clear()  # as if other recordings had been looked at
        assert recording.compared("1", begin=False)["models"][0]["error"] is not None
        assert recording.details()["jumps"]


# ----------------------------------------------------------------------------------------------------------------------
# What a model looks at


def test_the_attention_laid_over_a_frame_is_that_of_the_films(sample_recording, model_file):
    path = read_recording(sample_recording).path(20)
    png = cv2.imdecode(np.frombuffer(attend.picture(path.read_bytes(), str(model_file)), np.uint8), -1)
    assert png is not None
    frame = read_frame(path)
    alpha = png[..., 3:].astype(float) / 255
    laid = frame * (1 - alpha) + np.array(MAGENTA) * alpha
    steering, mask = visual_backprop(load_model(model_file), frame)
    film = cv2.resize(overlay(frame, steering, mask), (320, 160), interpolation=cv2.INTER_AREA)[:60]
    assert mask[60:].any() and np.abs(laid[:60] - film).mean() < 2
    assert alpha.max() == pytest.approx(0.7, abs=0.01)


def test_attention_comes_from_a_process_that_is_started_again_when_it_has_ended(sample_recording, model_file, tmp_path):
    jpeg = read_recording(sample_recording).path(20).read_bytes()
    with closing(Attention()) as attention:
        png = attention.png(jpeg, str(model_file))
        assert png == attend.picture(jpeg, str(model_file))
        first = attention.process
        assert first
        first.kill()
        first.wait()
        assert attention.png(jpeg, str(model_file)) == png
        (tmp_path / "spoilt.pt").write_bytes(b"no model")
        with pytest.raises(ModelError, match=r"spoilt\.pt: "):
            attention.png(jpeg, str(tmp_path / "spoilt.pt"))
    assert attention.process not in (None, first) and attention.process.poll() is not None


# ----------------------------------------------------------------------------------------------------------------------
# Training runs


def test_a_run_is_running_while_its_folder_is_claimed_and_then_stopped(tmp_path):
    files = written_run(tmp_path, finished=1, images=500)
    with files.claimed(Ranks()):
        found = runs.overview(files)
    assert found["state"] == "running" and found["robust"] and found["rate"] == 100 and found["loss"] == 0.25
    # 12.5 s an epoch, with its validation: half of this one and two others are left.
    assert found["left"] == 2.5 * 12.5
    assert [row["loss"] for row in found["history"]] == [0.5], "the other rows are an earlier run's"
    assert found["pictures"] == [0, 1200], "those from 6,400 observations on are an earlier run's"
    assert found["trail"] == [[0.25, 0.5], [0.5, 0.49], [0.75, 0.48], [1.0, 0.47], [1.25, 0.46], [1.5, 0.45]]
    assert found["best"] == {"epoch": 1, "by": "val_loss", "value": 0.5}
    found = runs.overview(files)
    assert found["state"] == "stopped" and found["left"] is None


@pytest.mark.parametrize("hours", [-1, 1])
def test_a_changed_clock_changes_no_age_of_a_run(tmp_path, monkeypatch, hours):
    files, now = written_run(tmp_path, finished=1, images=500), time.time
    os.utime(files.arguments, (now() - 60,) * 2)
    os.utime(files.progress, (now() - 40,) * 2)
    assert 40 <= runs.overview(files)["age"] < 50
    monkeypatch.setattr(time, "time", lambda: now() + 3600 * hours)
    assert 40 <= runs.overview(files)["age"] < 50
    os.utime(files.progress, (time.time(),) * 2)
    monkeypatch.undo()
    assert 0 <= runs.overview(files)["age"] < 10


def test_a_finished_run_and_one_of_an_earlier_version(finished, tmp_path):
    found = runs.overview(RunFiles(str(finished[1] / "model.pt")))
    assert (found["state"], found["epochs"], len(found["history"]), found["pictures"]) == ("finished", 2, 2, [0])
    best = load_checkpoint(finished[1] / "model-best.pt")["history"]
    least = {"epoch": len(best), "by": "val_loss", "value": best[-1]["val_loss"]}
    assert found["best"] == least, "too few rows to drift"
    folder = shutil.copytree(finished[1], tmp_path / "a copy")
    begun = (folder / "training_arguments.json").stat().st_mtime
    (folder / "report.html").write_text("", encoding="utf-8")
    for later, has_report in ((-1, False), (1, True)):  # the first one is of an earlier run
        os.utime(folder / "report.html", (begun + later, begun + later))
        assert runs.overview(RunFiles(str(folder / "model.pt")))["has_report"] is has_report
    # It may be a link to another file.
    with pytest.raises(UserError, match=r"not a report; `python -m cloning.report '\S+/a copy'`"):
        runs.Runs([folder]).report(0)
    files = written_run(tmp_path / "old", finished=4, images=0, losses=(0.5, float("nan"), 0.3))
    files.progress.unlink()
    files.arguments.write_text(files.arguments.read_text(encoding="utf-8").replace("lake", "Dünen"), encoding="utf-8")
    found = runs.overview(files)
    assert found["options"]["recordings"] == '["Dünen"]'
    assert found["state"] == "stopped" and [row["loss"] for row in found["history"]] == [0.5, None, 0.3]
    assert found["pictures"] == [0, 1200, 6400]
    files = written_run(tmp_path / "diverged", finished=2, images=0, losses=(float("nan"), float("inf")))
    json.dumps(runs.Runs([files.last.parent]).found(), allow_nan=False)  # which no browser reads
    assert runs.overview(files)["best"] is None
    options = json.loads(files.arguments.read_bytes()) | {"output": "", "from_model": r'C:\runs\"old".pt'}
    files.arguments.write_text(json.dumps(options), encoding="utf-8")
    found = runs.overview(files)
    assert found["models"] == ["model.pt", "model-best.pt"]
    assert found["options"]["from_model"] == options["from_model"]


@pytest.mark.parametrize(
    "name, contents, words",
    [
        ("training_arguments.json", "{", "training_arguments.json: not JSON"),
        ("training_arguments.json", "[" * 100_000, "training_arguments.json: not JSON"),
        ("training_arguments.json", '{"epochs": "4"}', "training_arguments.json: epochs is 4"),
        ("training_arguments.json", '{"epochs": 4, "samples_per_epoch": 0}', "samples_per_epoch is 0"),
        ("training_progress.json", "[]", "training_progress.json: finished is None"),
        ("training_progress.json", '{"finished": -1}', "finished is -1"),
        ("training_log.csv", "epoch,images\n1,2\n", "training_log.csv: not a log of epochs"),
        ("training_log.csv", "epoch,images,seconds,loss,val_loss\n1,2,nan,1,1\n", "not a log of epochs"),
    ],
)
def test_spoilt_files_of_a_run_are_named(tmp_path, name, contents, words):
    written_run(tmp_path, finished=1, images=500)
    (tmp_path / name).write_text(contents, encoding="utf-8")
    [found] = runs.Runs([tmp_path]).found()
    assert words in found["message"] and "state" not in found


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("name", ["training_arguments.json", "training_progress.json", "training_log.csv"])
def test_a_pipe_in_place_of_a_runs_file_is_named_and_does_not_hold_up_the_page(tmp_path, name):
    written_run(tmp_path, finished=1, images=500)
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    [found] = runs.Runs([tmp_path]).found()
    assert f"{name}: not a regular file" in found["message"]


def test_a_runs_log_is_read_again_only_once_it_has_changed(tmp_path, monkeypatch):
    files, shown = written_run(tmp_path, finished=4, images=0), runs.Runs([tmp_path])
    first = shown.run(0)
    assert "history" not in shown.found()[0], "the list needs none, which may be long"
    with monkeypatch.context() as patch:
        patch.setattr(runs, "csv", None)
        assert shown.run(0)["history"] == first["history"]
    files.log.write_text(files.log.read_text(encoding="utf-8").replace("0.5", "0.55"), encoding="utf-8")
    assert shown.run(0)["history"][0]["loss"] == 0.55


def test_a_run_that_was_killed_before_it_told_of_its_end_tells_when_it_is_resumed(finished, tmp_path):
    shutil.copytree(finished[1], tmp_path / "run")
    files = RunFiles(str(tmp_path / "run" / "model.pt"))
    progress = json.loads(files.progress.read_bytes())
    assert progress["finished"] == 2
    files.progress.write_text(json.dumps(progress | {"finished": 1}), encoding="utf-8")
    assert runs.overview(files)["state"] == "stopped"
    trained("--resume", "--output", files.last)
    assert runs.overview(files)["state"] == "finished" and json.loads(files.progress.read_bytes()) == progress


@needs_chromium
def test_a_training_run_refreshes_itself(tmp_path, page):
    files = written_run(tmp_path / "a b" / "a", finished=1, images=500, drifts=(0.9, 0.8, 0.6, 0.7))
    options = json.loads(files.arguments.read_bytes()) | {"output": "a b/a/net.pt"}  # not model.pt
    files.arguments.write_text(json.dumps(options), encoding="utf-8")
    written_run(tmp_path / "b", finished=4, images=0, epochs=5)
    (tmp_path / "none").mkdir()
    for path in files.pictures.iterdir():
        cv2.imwrite(str(path), np.zeros((1, 1), np.uint8))
    with browsing("--run", *(tmp_path / name for name in ("a b/a", "b", "none"))) as server:
        page.open(f"{server.base}#/run/1?with=2")
        page.shows("#run-figures", "stopped or killed")
        page.open(f"{server.base}#/run/2")
        page.shows("#notice", "none: no training run in this folder yet; `python model.py --output")
        assert page.barriers() == []
        page.open(server.base)
        page.shows("#runs", "stopped or killed in epoch 2 of 4")
        page.click("#runs a")
        page.wait("document.querySelectorAll('#losses .uplot').length == 2")
        assert page.run("document.title").startswith("stopped: ")
        assert "Drift" in page.text("#losses section") and "within the epoch" in page.text("#losses")
        page.shows("#run-figures", f"not written yet: python -m cloning.report '{files.report.parent}'")
        page.shows("#run-figures", f"python model.py --resume --output '{files.last.with_name('net.pt')}'")
        files.report.write_text("<!doctype html>", encoding="utf-8")
        page.shows("#run-figures a", "report.html")
        assert page.run("fetch(document.querySelector('#run-figures a')).then(a => a.text())") == "<!doctype html>"
        page.run("""document.querySelector('#run-figures a').focus(); told = [];
            const observer = new MutationObserver(all => told.push(...all.map(({target}) => target.id)));
            document.querySelectorAll('output, [role]').forEach(each => observer.observe(each, {childList: true}));
            new Promise(go => setTimeout(go, 15000))""")
        assert page.run("document.activeElement.textContent") == "report.html", "though the page has asked again"
        assert page.run("told") == [], "nothing is read out again"
        page.click("#run-others button")
        page.shows("#losses", "b drift")
        assert page.run("getComputedStyle(document.querySelector('.u-marker')).forcedColorAdjust") == "none"
        assert page.run("location.hash") == "#/run/0?with=1"
        page.run("smooth.value = 0.5; smooth.oninput(); smooth.onchange()")
        page.wait("location.hash == '#/run/0?with=1&smooth=0.5'")
        assert page.run("document.querySelectorAll('#losses .u-series.smoothed').length") == 6, "beside the raw ones"
        average = page.run("import('/static/run.js').then(({average}) => average([1, 0, null, 0], 0.5))")
        assert average == [1, pytest.approx(1 / 3), None, pytest.approx(1 / 7)], "sums of 1, 1/2, 1/4, 1/8"
        run = {"state": "running", "finished": 0, "epochs": 2, "samples_per_epoch": 100, "images": 50}
        run |= {"left": 33.2, "age": 30}  # s: it told of itself 30 s ago
        told = page.run(f"import('/static/run.js').then(({{stateOf}}) => stateOf({json.dumps(run)}))")
        assert told == "running: epoch 1 of 2, 50 % of it, 4 s left"
        page.run("smooth.focus()")
        page.press("ArrowLeft", "ArrowRight", "ArrowRight")  # which elsewhere show other pictures
        page.wait("location.hash == '#/run/0?with=1&smooth=0.51'")
        page.press("ArrowLeft")
        page.wait("location.hash == '#/run/0?with=1&smooth=0.5'")
        page.run("smooth.blur(); dispatchEvent(new HashChangeEvent('hashchange'))")
        page.wait("smoothed.textContent == '0.50'")
        page.wait("document.querySelectorAll('#losses .u-series.smoothed').length == 6")
        page.click("#run-options summary")
        assert page.text("#run-table").split("\n") == ["option\ta\tb", "epochs\t4\t5"]
        page.shows("#run-which", "after 1,200 observations")
        page.press("ArrowLeft")
        page.shows("#run-which", "after 0 observations")
        page.run("document.querySelector('#run-read summary').focus()")
        page.press("Enter")
        page.wait("document.querySelector('#run-read').open")
        assert "It reads 1 recording\nlake" in page.text()
        page.wait("document.querySelector('#run-pictures img').naturalWidth == 1")
        progress = files.progress.read_text(encoding="utf-8")
        files.progress.write_text(progress.replace('"finished": 1', '"finished": 4'), encoding="utf-8")
        page.shows("#run-figures", "finished: 4 epochs")
        page.shows("#run-figures", "epoch 4, in net-best.pt: it has the least validation loss, 0.2000")
        page.shows("#run-figures", "the least drift, 0.60 m, is that of epoch 3")
        assert page.run("document.querySelector('#run-bar').value") == 1
        assert page.run("document.querySelector('#run-read').open"), "after it has refreshed itself"
        page.run("smooth.value = 0.7; smooth.oninput(); location.hash = '#'")
        page.wait("!document.querySelector('#list').hidden")
        page.run("location.hash = '#/run/0?with=1&smooth=0.5'")
        page.wait("!document.querySelector('#run').hidden")
        page.click("#run-others button")
        page.wait("location.hash == '#/run/0?smooth=0.5'")
        page.run("location.hash = '#/run/1'")
        page.shows("#losses section", "Not known: no two seconds")
        assert page.complaints() == []
