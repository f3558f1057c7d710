"""What the browser of recordings shows: figures, rows to jump to, and the slow analyses of lane and models."""

import errno
import os
import shutil
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from browse_process import opened
from drive_process import awaited

from cloning.base import program
from cloning.base.errors import RecordingError, UserError, message_of
from cloning.base.outputs import short_names
from cloning.browse import analyse, analyses, computed, library, summary
from cloning.browse.analyses import LANE, Analyses, Analysis, Result, read_result, stamp, write_result
from cloning.browse.filter import matching
from cloning.browse.library import Library, UnknownError
from cloning.lane.search import Localisation
from cloning.network.network import load_model, steer
from cloning.recordings.check import check_images
from cloning.recordings.excluded import TAGS, Cut, add_cuts
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording, read_recording, read_uncut
from cloning.recordings.part import write_part
from cloning.road.track import Track

# ----------------------------------------------------------------------------------------------------------------------
# Figures


def test_seconds_driven_leave_out_breaks():
    time = np.array([100.0, 100.1, 100.2, 7300.0, 7300.1])
    np.testing.assert_allclose(summary.driven_seconds(time), [0, 0.1, 0.2, 0.2 + 1 / 15, 0.3 + 1 / 15], atol=1e-9)


def test_jumps_are_to_rows_that_are_not_cut():
    steering = np.zeros(90, np.float32)
    steering[[5, 70]] = 1, -1
    offset, models = np.linspace(0, 3, 90, dtype=np.float32), [np.full(90, 0.1), np.full(90, np.nan)]
    nothing_cut = summary.jumps(steering, offset, models, np.zeros(90, bool))
    assert nothing_cut == {"stop": [5, 70], "offset": [89, 59, 29], "difference": [70, 5, 35]}
    cut = summary.jumps(steering, offset, models, np.arange(90) >= 60)
    assert cut == {"stop": [5], "offset": [59, 29], "difference": [5, 35]}
    assert summary.jumps(steering, None, [], np.zeros(90, bool)) == {"stop": [5, 70]}
    assert summary.at_stop(np.array([1, 1, 0.5, -1, 1, 0, -0.9, -1, -1, 0], np.float32)) == [0, 3, 4, 7]


def test_figures_are_those_of_the_rows_that_are_not_cut(sample_recording):
    recording = read_recording(sample_recording)
    is_cut = np.arange(60) < 30
    found = summary.figures(recording, is_cut)
    wanted, _ = np.histogram(recording.steering[30:], 41, (-1, 1))
    assert found["histogram"] == wanted.tolist() and (found["frames"], found["cut_frames"]) == (60, 30)
    assert found["seconds"] == pytest.approx(59 * 0.067, abs=0.01)
    assert found["zeros"] == np.mean(recording.steering[30:] == 0)
    assert found["speed"] == pytest.approx([30.19] * 2)
    assert summary.figures(recording, np.ones(60, bool))["speed"] is None


def test_the_road_and_the_path_on_the_map(sample_recording, monkeypatch):
    """Rows placed on the lake at known positions get these coordinates; what is not placed has none."""
    recording, track = read_recording(sample_recording), Track("lake", "cw")
    s = np.linspace(100, 120, 40)
    placed = Localisation(track, np.stack([s, np.full(40, 1.5), np.zeros(40)], axis=1), 0.0, 0.0)
    monkeypatch.setattr("cloning.lane.localise.localise_all", lambda *_: [(slice(10, 50), placed)])
    monkeypatch.setattr(analyse, "detect_centres", lambda part, _: np.zeros((len(part), 3, 5), np.float32))
    result = analyse.lane(recording)
    x, y = (result.column(name, recording.images[:, 0]) for name in "xy")
    for row, at in ((10, 100.0), (49, 120.0)):
        found = track.locate(float(x[row]), float(y[row]))
        assert found == pytest.approx((at, 1.5), abs=0.02)
    assert np.isnan(x[:10]).all() and np.isnan(y[50:]).all()
    road = summary.road_of(result, recording.images[:, 0], np.zeros(60, bool))
    assert road["roads"] == [["lake", "cw"]] and len(road["path"]) == 1 and len(road["path"][0]) == 40
    assert road["path"][0][0] == pytest.approx([x[10], y[10]], abs=0.06)
    before = slice(8), Localisation(Track("jungle", "cw"), placed.states[:8], 0.0, 0.0)
    monkeypatch.setattr("cloning.lane.localise.localise_all", lambda *_: [before, (slice(10, 50), placed)])
    both = summary.road_of(analyse.lane(recording), recording.images[:, 0], np.zeros(60, bool))
    assert both["roads"] == [["lake", "cw"], ["jungle", "cw"]] and both["path"] == road["path"], "the longer one first"


# ----------------------------------------------------------------------------------------------------------------------
# Finding rows

STEERING = np.array([-0.9, -0.5, 0.0, 0.5, 0.9], np.float32)
OFFSET = np.array([np.nan, -2.0, 0.0, 2.0, np.nan], np.float32)
NUMBERS = {"steering": STEERING, "offset": OFFSET, "speed": np.arange(5, dtype=np.float32)}


@pytest.mark.parametrize(
    "condition, rows",
    [
        ("abs(steering) > 0.8 and speed < 3", [0]),
        ("-0.6 <= steering <= 0.6", [1, 2, 3]),
        ("not speed > 1 or steering == 0.5", [0, 1, 3]),
        ("abs(offset - steering) > 1", [1, 3]),
        ("not abs(offset) > 1", [2]),  # what is not known is not smaller either
        ("max(speed, 2) / 2 * (steering + 1) >= +2.2", [3, 4]),
        ("steering == -9 / 10", [0]),
        ("speed > 1 / 0", []),
    ],
)
def test_rows_are_found_by_a_condition(condition, rows):
    found = matching(condition, NUMBERS.__getitem__, list(NUMBERS))
    assert found.dtype == bool and np.flatnonzero(found).tolist() == rows


@pytest.mark.parametrize(
    "condition, words",
    [
        ("steering >", "not complete"),
        ("", "not complete"),
        ("wheel > 1", "there is no wheel here; there are steering, offset, speed"),
        ("speed", "compares no column"),
        ("1 < 2", "compares no column"),
        ("speed > 1 and speed + 1", "compares no column"),
        ("-(speed > 1)", "not complete"),
        ("__import__('os')", "has no meaning"),
        ("speed.max() > 1", "has no meaning"),
        ("[speed][0] > 1", "has no meaning"),
        ("speed ** 99 > 1", "has no meaning"),
        ("abs(speed, 1) > 1", "has no meaning"),
        ("'a' < speed", "has no meaning"),
        ("speed in steering", "has no meaning"),
        ("(" * 200 + "speed" + ")" * 200, "longer than"),
        ("-" * 290 + "speed", "not complete|compares no"),
    ],
)
def test_a_condition_without_meaning_is_refused(condition, words):
    with pytest.raises(UserError, match=words):
        matching(condition, NUMBERS.__getitem__, list(NUMBERS))


def test_a_part_of_a_recording_is_a_recording_with_the_same_images(linked, tmp_path):
    """Numbers to the last bit, hard links, its lane.csv; nothing is left of one that could not be written."""
    recording = read_recording(linked)
    lane = ["center image,lateral offset (m),heading error (radians)"]
    lane += [f"{recording.name(row)},{row / 100},0" for row in range(60)]
    (linked / "lane.csv").write_text("\n".join(lane) + "\n", encoding="utf-8")
    chosen = recording.take(np.arange(60) % 3 == 1)
    add_cuts(linked, Cut(recording.name(1), recording.name(4), "bend"), file=TAGS)
    assert write_part([chosen], tmp_path / "part") == ["tags do not go along"]
    written = read_recording(tmp_path / "part")
    for name in ("steering", "throttle", "brake", "speed", "time"):
        assert (getattr(written, name) == getattr(chosen, name)).all(), name
    assert not written.repairs and not written.rejected
    assert len(list((tmp_path / "part/IMG").iterdir())) == 60 and written.path(7, 2).samefile(chosen.path(7, 2))
    known = (tmp_path / "part/lane.csv").read_text(encoding="utf-8").splitlines()
    assert known == [lane[0], *lane[2::3]]
    (linked / "lane.csv").write_text("\n".join(lane[:31]) + "\n", encoding="utf-8")
    notes = ["tags do not go along", "lane.csv is left out: it names none of these rows"]
    assert write_part([recording.take(slice(30, 60))], tmp_path / "unnamed") == notes
    assert not (tmp_path / "unnamed/lane.csv").exists()  # training refuses one that names no row
    (linked / "lane.csv").unlink()
    os.mkfifo(linked / "lane.csv")  # would be waited for without end
    assert write_part([recording.take(slice(30, 60))], tmp_path / "pipe") == notes
    (linked / "lane.csv").unlink()
    (linked / "lane.csv").write_text("\n".join([lane[0], f'"{lane[1]}', *lane[2:]]), encoding="utf-8")
    with pytest.raises(RecordingError, match="unexpected end of data; mend it"):
        write_part([chosen], tmp_path / "other")
    (linked / "lane.csv").unlink()
    with pytest.raises(RecordingError, match="part: exists already"):
        write_part([chosen], tmp_path / "part")
    recording.path(10).unlink()
    with pytest.raises(RecordingError, match=f"{recording.name(10)}: No such file"):
        write_part([chosen], tmp_path / "other")
    recording.path(10).symlink_to(linked / "driving_log.csv")
    with pytest.raises(RecordingError, match=f"{recording.name(10)}: a link to another file .not a JPEG"):
        write_part([chosen], tmp_path / "other")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "part", "pipe", "unnamed"]


def test_recordings_become_one_with_each_drive_as_it_was(linked, tmp_path):
    """Those of the same time are put on different days; what does not fit is told, or refused."""
    recording, lane = read_recording(linked), "center image,lateral offset (m),heading error (radians)\n"
    (linked / "lane.csv").write_text(lane + f"{recording.name(0)},0.5,0\n", encoding="utf-8")
    parts = [recording.take(slice(0, 20)), recording.take(slice(20, 40)), recording.take(slice(15, 25))]
    days = ["lake is put 1 day later, after another drive", "lake is put 2 days later, after another drive"]
    assert write_part(parts, tmp_path / "one") == days
    near = [recording.take(slice(0, 1), time=np.array([second])) for second in (0.0, 1.0)]  # which is no break yet
    assert write_part(near, tmp_path / "near") == days[:1]
    one = read_recording(tmp_path / "one")
    assert (one.steering == np.concatenate([part.steering for part in (parts[0], parts[2], parts[1])])).all()
    assert not one.repairs and not one.rejected and one.path(20).samefile(recording.path(15))
    assert (np.flatnonzero(np.diff(one.time) > 1) == [19, 29]).all() and one.time[20] - recording.time[15] == 86400
    assert (tmp_path / "one/lane.csv").read_text(encoding="utf-8") == lane + f"{recording.name(0)},0.5,0\n"
    plain = shutil.copytree(linked, tmp_path / "data" / "plain")
    (plain / "lane.csv").unlink()
    notes = ["plain is put 1 day later, after another drive", "lane.csv is left out: plain has none"]
    assert write_part([recording, read_recording(plain)], tmp_path / "two") == notes
    assert len(read_recording(tmp_path / "two")) == 120 and not (tmp_path / "two/lane.csv").exists()
    log = (plain / "driving_log.csv").read_text(encoding="utf-8").splitlines()[0]
    for image in (plain / "IMG").glob("*"):
        if image.name in log:
            image.rename(image.with_name(f"{image.name.split('_')[0]}_1.jpg"))
            log = log.replace(image.name, f"{image.name.split('_')[0]}_1.jpg")
    (plain / "driving_log.csv").write_text(log + "\n", encoding="utf-8")
    with pytest.raises(RecordingError, match="no time in its name"):
        write_part([recording, read_recording(plain)], tmp_path / "three")
    (plain / "driving_log.csv").write_text(f"{log}\n" + 16 * "\n" + log.replace("_1.", "_2."), encoding="utf-8")
    with pytest.raises(RecordingError, match="no time in its name"):  # the pause would be lost
        write_part([read_recording(plain)], tmp_path / "three")
    assert not (tmp_path / "three").exists()


# ----------------------------------------------------------------------------------------------------------------------
# Analyses


def test_a_models_steering_is_that_of_drive_py(sample_recording, model_file):
    recording = read_recording(sample_recording)
    result = analyse.steering(recording, str(model_file))
    network = load_model(model_file)
    wanted = [float(steer(network, read_frame(recording.path(row)))) for row in (0, 31, 59)]
    np.testing.assert_allclose(result.column("steering", recording.images[:, 0])[[0, 31, 59]], wanted, atol=1e-6)


def test_a_result_is_kept_until_the_recording_changes(linked):
    images = np.array([2, 0], np.int32)
    result = Result(images, {"offset": np.array([0.5, np.nan], np.float32)}, {"roads": []})
    assert read_result(linked, LANE) is None
    write_result(linked, LANE, stamp(linked, LANE), result)
    found = read_result(linked, LANE)
    assert found
    np.testing.assert_array_equal(found.column("offset", np.array([0, 1, 2, 2])), [np.nan, np.nan, 0.5, 0.5])
    time.sleep(0.02)  # longer than a tick of the file system's clock
    (linked / "driving_log.csv").touch()
    assert read_result(linked, LANE) is None
    shutil.rmtree(linked)
    with pytest.raises(RecordingError, match=r"driving_log.csv: No such file .*put it back"):
        read_result(linked, LANE)


def test_a_result_is_of_the_images_as_they_were(copied):
    """All may be changed in place, as by a program that exchanges their colours."""
    write_result(copied, LANE, stamp(copied, LANE), Result(np.zeros(1, np.int32), {"offset": np.zeros(1)}, {}))
    assert read_result(copied, LANE)
    for image in (copied / "IMG").iterdir():
        os.utime(image, ns=(0, 0))
    assert read_result(copied, LANE) is None


@pytest.fixture
def recording(linked):
    with opened(linked) as recording:
        yield recording


def ended(analyses: Analyses, folder: Path, analysis=LANE) -> dict:
    """The state of an analysis once it is done or has failed."""

    def is_over() -> dict | None:
        state = analyses.state(folder, analysis)
        return None if state["state"] in ("waiting", "running") else state

    return awaited(is_over)


def test_the_open_recording_goes_first_and_then_the_smallest(sample_recording, tmp_path, monkeypatch):
    folders = []
    for name, copies in (("large", 3), ("middle", 2), ("small", 1), ("open", 4)):
        (tmp_path / name / "IMG").mkdir(parents=True)
        text = (sample_recording / "driving_log.csv").read_text(encoding="utf-8")
        (tmp_path / name / "driving_log.csv").write_text(text * copies, encoding="utf-8")
        folders.append(tmp_path / name)
    code = f"import sys; open({str(tmp_path / 'order')!r}, 'a').write(sys.argv[1] + '\\n'); sys.exit('no')"
    monkeypatch.setattr(analyses, "COMMAND", (sys.executable, "-c", code))
    queue = Analyses()
    with queue.changed:  # until all of them wait
        for folder in folders:
            queue.state(folder, LANE)
        queue.urgent = folders[3]
    for folder in folders:
        assert ended(queue, folder)["state"] == "failed"
    queue.close()
    order = [Path(line).name for line in (tmp_path / "order").read_text(encoding="utf-8").splitlines()]
    assert order == ["open", "small", "middle", "large"]


SPOILT = """
import pathlib, sys, time
print("progress 0.5", flush=True)
while not pathlib.Path(sys.argv[1], "go").exists():
    time.sleep(0.01)
sys.exit("details\\nanalyse: spoilt")
"""


def test_an_analysis_tells_how_far_it_is_and_why_it_failed(recording, linked, monkeypatch):
    monkeypatch.setattr(analyses, "COMMAND", (sys.executable, "-c", SPOILT))
    queue, failed = recording.analyses, {"state": "failed", "message": "analyse: spoilt"}
    assert queue.state(linked, LANE) == {"state": "waiting"}
    awaited(lambda: queue.state(linked, LANE) == {"state": "running", "progress": 0.5})
    (linked / "go").touch()
    assert ended(queue, linked) == failed
    (linked / "go").unlink()
    recording.retry("offset")
    assert queue.state(linked, LANE)["state"] in ("waiting", "running"), "tried again when asked to"
    (linked / "go").touch()
    assert ended(queue, linked) == failed
    with pytest.raises(UnknownError):
        recording.retry("steering")
    time.sleep(0.02)  # longer than a tick of the file system's clock
    (linked / "driving_log.csv").touch()
    assert queue.state(linked, LANE)["state"] == "waiting", "tried again once the recording has changed"
    queue.close()
    assert queue.process is None


def test_no_name_is_an_option_or_progress(recording, linked, monkeypatch):
    code = "import sys; sys.exit(sys.argv[1] + sys.argv[3])"
    monkeypatch.setattr(analyses, "COMMAND", (sys.executable, "-c", code))
    monkeypatch.chdir(linked)
    steering = Analysis("steering", "driving_log.csv")
    for name in ("-x", "progress 1"):
        Path(name).symlink_to(linked)
        message = f"{linked / name}{linked / steering.model}"
        assert ended(recording.analyses, Path(name), steering) == {"state": "failed", "message": message}


def test_an_analysis_whose_process_cannot_be_started_has_failed_and_can_be_tried_again(recording, linked, monkeypatch):
    monkeypatch.setattr(analyses, "COMMAND", ("/no/python",))
    message = "its process cannot be started: /no/python: No such file or directory"
    assert ended(recording.analyses, linked) == {"state": "failed", "message": message}
    monkeypatch.setattr(analyses, "COMMAND", (sys.executable, "-c", "import sys; sys.exit('started: python model.py')"))
    monkeypatch.setattr(program, "installed", {"python model.py": "bc train"})
    recording.retry("offset")
    assert ended(recording.analyses, linked) == {"state": "failed", "message": "started: bc train"}
    monkeypatch.setattr(analyses, "COMMAND", (sys.executable, "-c", ""))  # a version that leaves another result
    recording.retry("offset")
    assert "the program was updated" in ended(recording.analyses, linked)["message"], "not begun again and again"


def test_a_recording_without_an_image_has_no_lane(linked):
    shutil.rmtree(linked / "IMG")
    (linked / "IMG").mkdir()
    checked = check_images(read_uncut(linked), show_progress=False)
    result = analyse.lane(checked)
    assert result.about["unusable"] == 60 and not len(result.images)
    road = summary.road_of(result, read_uncut(linked).images[:, 0], np.zeros(60, bool))
    assert road["roads"] == [] and road["offset"] is None and road["first_unusable"][0][0] == 1


def test_a_recording_is_shown_though_its_images_and_a_model_are_gone(linked, tmp_path, monkeypatch):
    (linked / "IMG").rename(linked / "elsewhere")
    with opened(linked, tmp_path / "gone.pt") as recording:
        assert recording.overview()["frames"] == 60
        details = recording.details("1")
        for each in (details["lane"], *details["models"], *details["replays"]):
            assert each["state"] == "failed" and "IMG: No such file" in each["message"]
        (linked / "elsewhere").rename(linked / "IMG")
        assert recording.details()["lane"]["state"] in ("waiting", "running")
        [model] = recording.compared("1", begin=True)["models"]
        for state in (model["steering"], model["replay"]):
            assert state["state"] == "failed" and "gone.pt: No such file or directory; put it back" in state["message"]
        monkeypatch.setattr(recording, "overview", lambda: {"message": "spoilt"})
        with pytest.raises(RecordingError, match="spoilt"):
            recording.details()


def test_what_has_the_same_name_is_told_apart(linked, tmp_path):
    copies = [shutil.copytree(linked, tmp_path / person / "lake") for person in ("b", "c/b")]
    models = [tmp_path / name for name in ("a/m.pt", "a/../b/m.pt", "a/x.pt")]
    with closing(Library([linked, *copies], models)) as shown:
        assert list(shown.models) == ["a/m.pt", "b/m.pt", "x.pt"]
        names = ["data/lake", f"{tmp_path.name}/b/lake", "c/b/lake"]
        assert list(shown.names.values()) == names == [shown[each].overview()["name"] for each in shown.recordings]


def test_without_file_handles_no_file_is_blamed():
    """Python may have wanted to open a module of its own."""
    message = message_of(OSError(errno.EMFILE, os.strerror(errno.EMFILE), "encodings/latin_1.py"))
    assert message == "Too many open files; end other programs, or raise the limit with `ulimit -n`"


def test_names_in_a_message_do_not_change_the_terminal():
    assert message_of(UserError("no \x1b[2J.jpg\rhere\n")) == "no \\x1b[2J.jpg\\rhere\n"


def test_threads_that_want_the_same_recording_read_it_once(recording, monkeypatch):
    read: list[Path] = []

    def slowly(folder: Path) -> Recording:
        read.append(folder)
        time.sleep(0.2)
        return read_uncut(folder)

    monkeypatch.setattr(computed, "read_uncut", slowly)
    with ThreadPoolExecutor() as pool:
        one, two = pool.map(lambda _: recording.read(), range(2))
    assert one is two and read == [recording.folder]


def test_of_recordings_that_are_added_at_the_same_time_none_is_lost(linked, tmp_path, monkeypatch):
    with closing(Library([linked], [])) as shown:
        other = threading.Thread(target=shown.add, args=[tmp_path])

        def slowly(paths) -> list[str]:
            if not other.ident:
                other.start()
                other.join(0.2)
            return short_names(paths)

        monkeypatch.setattr(library, "short_names", slowly)
        shown.look()
        other.join()
        assert list(shown.recordings.values()) == [linked, tmp_path]
