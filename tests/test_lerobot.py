"""Recordings as LeRobot's data sets and back; donkeycar's tubs, and drives that drive.py saved, as recordings."""

import json
import runpy
import shutil
import tracemalloc
from collections import Counter
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import call_here
from rendered import render_frame, render_recording

from cloning.base import program
from cloning.lerobot import __main__ as lerobot
from cloning.lerobot import dataset
from cloning.lerobot.source import Sample, decoded, write_recording
from cloning.recordings.check import check_images
from cloning.recordings.images import encode, read_frame
from cloning.recordings.log import CheckedRecording, read_recording
from cloning.recordings.saved_frames import FrameSaver

CENTER = "observation.images.center"
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:"  # a clone's file without git-lfs
IMAGE = '{"cam/image_array": "0_cam_image_array_.jpg", "user/angle": %s}'
VAST = {
    "action": {"dtype": "float32", "shape": [10**6], "names": None},
    "state": {"dtype": "float32", "shape": [1], "names": {"motors": {}}},
}


def run(*arguments) -> tuple[str, str]:
    """What `python -m cloning.lerobot` prints, and its error; here, as a start takes longer than most conversions."""
    done = call_here(lerobot.main, "lerobot", *arguments, cwd=Path.cwd())
    return done.stdout, done.stderr.removeprefix("lerobot: ").removesuffix("\n")


def converted(*arguments) -> str:
    """What is printed without an error."""
    printed, error = run(*arguments)
    assert not error
    return printed


def refused(*arguments) -> str:
    """The error, in one line."""
    _, error = run(*arguments)
    assert error and "\n" not in error
    return error


def checked(folder: Path) -> CheckedRecording:
    """A recording whose rows and images are all usable."""
    recording = check_images(read_recording(folder), show_progress=False)
    assert not recording.rejected and not recording.repairs
    return recording


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> list[Path]:
    """Two recordings, the first with a pause and with a row twice; not to be changed."""
    folder = tmp_path_factory.mktemp("data")
    log = render_recording(folder / "a", rows=30) / "driving_log.csv"
    lines = log.read_text(encoding="utf-8").splitlines(keepends=True)
    log.write_text("".join([*lines[:8], lines[7], *lines[24:]]), encoding="utf-8")
    return [folder / "a", render_recording(folder / "b", rows=5, seed=1)]


@pytest.fixture(scope="module")
def written(recordings, tmp_path_factory) -> Path:
    """The data set of these recordings; not to be changed."""
    folder = tmp_path_factory.mktemp("data sets") / "lake"
    printed = converted(*recordings, "--output", folder)
    assert printed.endswith("lake: 19 frames of 3 cameras in 3 episodes, 15 a second\n")
    return folder


@pytest.fixture
def data_set(written, tmp_path) -> Path:
    """A copy that a test may change."""
    return shutil.copytree(written, tmp_path / "lake")


def edit(data_set: Path, **changed) -> None:
    """Change what its info.json says."""
    path = data_set / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changed), encoding="utf-8")


def features(data_set: Path) -> dict:
    return json.loads((data_set / "meta" / "info.json").read_text(encoding="utf-8"))["features"]


def test_a_data_set_has_what_lerobots_format_names(written):
    """Its documentation, and what LeRobot 0.4.4 writes; that version's own reader has read such a data set."""
    info = json.loads((written / "meta" / "info.json").read_text(encoding="utf-8"))
    assert info["codebase_version"] == "v3.0" and info["fps"] == 15 and info["splits"] == {"train": "0:3"}
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 19, 1)
    assert info["features"]["action"]["names"] == ["steering", "throttle", "brake"]
    assert info["features"]["observation.state"]["units"] == ["mph", "m/s"]
    place = {"chunk_index": 0, "file_index": 0}
    rows = pq.read_table(written / info["data_path"].format(**place)).to_pydict()
    assert rows.keys() == {key for key, feature in info["features"].items() if feature["dtype"] != "video"}
    assert rows["observation.state"][0] == pytest.approx([30.19, 30.19 * 0.44704])
    assert rows["episode_index"] == [0] * 8 + [1] * 6 + [2] * 5 and rows["index"] == list(range(19))
    np.testing.assert_allclose(rows["timestamp"], np.array(rows["frame_index"]) / 15, rtol=1e-6)
    episodes = pq.read_table(written / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["length"] == [8, 6, 5] and episodes["dataset_to_index"] == [8, 14, 19]
    np.testing.assert_allclose(episodes[f"videos/{CENTER}/from_timestamp"], [0, 8 / 15, 14 / 15])
    assert pq.read_table(written / "meta/tasks.parquet").to_pandas().loc["Follow the road."].task_index == 0
    for key in (key for key, feature in info["features"].items() if feature["dtype"] == "video"):
        with av.open(str(written / info["video_path"].format(video_key=key, **place))) as film:
            times = [frame.time for frame in film.decode(video=0)]
            assert film.streams.video[0].codec.name == "h264" and (film.streams.video[0].width) == 320
        np.testing.assert_allclose(times, np.arange(19) / 15, atol=1e-4)  # LeRobot's tolerance
    statistics = json.loads((written / "meta" / "stats.json").read_text(encoding="utf-8"))
    np.testing.assert_allclose(statistics["action"]["std"], np.std(rows["action"], axis=0))
    np.testing.assert_allclose(statistics["action"]["q90"], np.quantile(rows["action"], 0.9, axis=0))
    assert np.shape(statistics[CENTER]["mean"]) == (3, 1, 1) and 0.3 < np.mean(statistics[CENTER]["mean"]) < 0.6
    assert episodes["stats/action/max"][2] == pytest.approx(np.max(rows["action"][14:], axis=0))


def test_the_statistics_of_many_frames_take_little_memory():
    frames = np.arange(12_000, dtype=np.uint8)[:, None, None, None].repeat(3, -1).repeat(99, 1)
    tracemalloc.start()
    found = dataset._statistics(frames)
    assert tracemalloc.get_traced_memory()[1] < 5 * dataset.COUNTED * frames[0].size * 8 and found["count"] == [12_000]
    tracemalloc.stop()
    np.testing.assert_allclose(np.ravel(found["mean"]), 0.5, atol=0.01)


def test_a_recording_comes_back_with_the_same_rows(recordings, written, tmp_path, monkeypatch):
    monkeypatch.setattr(program, "installed", {"python -m cloning.browse": "bc browse"})
    folder = tmp_path / "the way back"
    assert converted(written, "--output", folder) == f"{folder}: 19 rows; look at them with `bc browse '{folder}'`\n"
    back, before = checked(folder), [checked(folder).without_copies() for folder in recordings]
    for name in ("steering", "throttle", "brake", "speed", "time"):
        np.testing.assert_array_equal(getattr(back, name), np.concatenate([getattr(each, name) for each in before]))
    at = 0
    for recording in before:
        for row in range(len(recording)):
            for camera in range(3):
                assert back.name(at, camera) == recording.name(row, camera)
                difference = cv2.absdiff(read_frame(back.path(at, camera)), read_frame(recording.path(row, camera)))
                assert difference.mean() < 4, "the film's compression"
            at += 1


def test_no_film_is_so_long_that_lerobot_mistakes_the_times_of_its_frames(recordings, tmp_path, monkeypatch):
    """It asks for them in float32, as they are in the table, and allows for 0.0001 s."""
    rows, starts = np.arange(4500), 4500 * np.arange(10)
    for begin in starts - dataset._film_begins(starts, np.full(10, 4500), 15):
        asked = np.float32(begin / 15 + np.float32(rows / 15).astype(float))
        assert np.abs(asked - np.float32((begin + rows) / 15)).max() < 1e-4
    monkeypatch.setattr(dataset, "FILM_SECONDS", 0.9)
    converted(*recordings, "--output", tmp_path / "set")
    assert len(list((tmp_path / "set/videos" / CENTER).rglob("*.mp4"))) == 2
    converted(tmp_path / "set", "--output", tmp_path / "back")
    back, before = checked(tmp_path / "back"), [checked(folder).without_copies() for folder in recordings]
    frames = [read_frame(each.path(row)) for each in before for row in range(len(each))]
    assert max(cv2.absdiff(read_frame(back.path(at)), frame).mean() for at, frame in enumerate(frames)) < 4


def test_another_cars_data_set_becomes_a_recording_and_what_does_not_fit_is_told(data_set, tmp_path):
    """One camera; steering of another name, unit and sign; no speed in mph; episodes that each begin at 0."""
    known = features(data_set)
    known["action"] |= {"names": {"axes": ["wheel", "gas", "x"]}, "units": None}
    kept = {key: known[key] for key in known if key not in (f"{CENTER[:-6]}left", "observation.state")}
    edit(data_set, features=kept)
    places = data_set / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(places).take([2, 0, 1]), places)  # in any order
    output = tmp_path / "recording"
    command = [data_set, "--output", output]
    assert refused(*command).endswith(f"--camera: {CENTER}, observation.images.right")
    command += ["--camera", CENTER]
    for names, shown in (
        ({"x": 2, "wheel": 0, "gas": 1}, "wheel, action:gas, action:x"),
        ([["wheel", "gas", "x"]], "wheel, action:gas, action:x"),
        (None, "0, action:1, action:2"),
    ):
        edit(data_set, features=kept | {"action": kept["action"] | {"names": names}})
        assert f"--steering: action:{shown}, recorded_at:" in refused(*command)
    edit(data_set, features=kept)
    assert "--steering: action:wheel, action:gas, action:x, recorded_at:" in refused(*command)
    command += ["--steering", "action:wheel", "--full-lock"]
    assert "where 0.2 is the full lock to the right" in refused(*command, 0.2) and not output.exists()
    path = data_set / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.drop_columns(["recorded_at"]), path)
    printed = converted(*command, -0.5)
    for told in ("only one camera", "no speed in mph", "no brake: 0 is written (19 times)"):
        assert told in printed
    recording = checked(output)
    np.testing.assert_allclose(recording.steering, -2 * np.array(table["action"].to_pylist())[:, 0], rtol=1e-6)
    assert list(np.flatnonzero(np.diff(recording.time) > 1)) == [7, 13], "each episode is a drive"
    assert recording.throttle.max() == 1 and recording.speed.max() == 0


def test_the_first_row_of_an_episode_is_found_in_hevc_too(data_set, tmp_path):
    """Each frame is white in other columns."""
    with av.open(data_set / f"videos/{CENTER}/chunk-000/file-000.mp4", "w") as film:
        stream = film.add_stream("libx265", 15, options={"g": "3", "x265-params": "log-level=none"})
        stream.pix_fmt, stream.height, stream.width = "yuv420p", 160, 320
        for row in range(19):
            frame = np.zeros((160, 320, 3), np.uint8)
            frame[:, 16 * row :][:, :16] = 255
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        film.mux(stream.encode(None))
    converted(data_set, "--camera", CENTER, "--output", tmp_path / "recording")
    recording = checked(tmp_path / "recording")
    assert [read_frame(recording.path(row))[80, 8::16, 0].argmax() for row in range(19)] == list(range(19))


def test_a_data_set_of_version_2_with_images_in_its_tables(data_set, tmp_path):
    frames = [render_frame(0.3, 0, np.random.default_rng(row)) for row in range(8)]
    table = pq.read_table(data_set / "data/chunk-000/file-000.parquet").slice(0, 8)
    pngs = [cv2.imencode(".png", cv2.resize(frame, (640, 480))[..., ::-1])[1].tobytes() for frame in frames]
    table = table.append_column("observation.image", [[{"bytes": png, "path": None} for png in pngs]])
    for part in ("data", "videos", "meta/episodes"):
        shutil.rmtree(data_set / part)
    (data_set / "data/chunk-000").mkdir(parents=True)
    pq.write_table(table, data_set / "data/chunk-000/episode_000000.parquet")
    image = {"observation.image": {"dtype": "image", "shape": [480, 640, 3], "names": None}}
    kept = {key: each for key, each in features(data_set).items() if each["dtype"] != "video"} | image
    place = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    edit(data_set, codebase_version="v2.1", total_episodes=1, features=kept, data_path=place)
    printed = converted(data_set, "--output", tmp_path / "recording")
    assert "of images of 640x480 pixels the middle 640x320 are scaled to 320x160 (8 times)" in printed
    recording = checked(tmp_path / "recording")
    assert len(recording) == 8
    assert cv2.absdiff(read_frame(recording.path(0))[80], cv2.resize(frames[0], (320, 240))[120]).mean() < 12


@pytest.fixture
def tub(tmp_path) -> Path:
    """A tub of 12 rows in two catalogs: one row deleted, one that the pilot drove, and one without its image."""
    folder, rng = tmp_path / "tub", np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    for catalog in range(2):
        rows = []
        for index in range(6 * catalog, 6 * catalog + 6):
            name = f"{index}_cam_image_array_.jpg"
            cv2.imwrite(str(folder / "images" / name), cv2.resize(render_frame(0, 0, rng)[..., ::-1], (160, 120)))
            row = {"_index": index, "_timestamp_ms": 1_600_000_000_000 + 50 * index, "cam/image_array": name}
            row |= {"user/angle": index / 10 - 0.5, "user/throttle": 0.3 if index < 10 else -0.2}
            rows.append(json.dumps(row | {"user/mode": "local" if index == 4 else "user"}))
        (folder / f"catalog_{catalog}.catalog").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "images" / "7_cam_image_array_.jpg").unlink()
    catalogs = {"paths": ["catalog_0.catalog", "catalog_1.catalog"], "current_index": 12, "deleted_indexes": [2]}
    lines: list[object] = [["cam/image_array", "user/angle"], ["image_array", "float"], {}, {}, catalogs]
    (folder / "manifest.json").write_text("\n".join(map(json.dumps, lines)) + "\n", encoding="utf-8")
    return folder


@pytest.mark.parametrize("end", [b"\n", b"\r\r\n"], ids=["linux", "windows"])
def test_a_donkeycar_tub_becomes_a_recording(tub, tmp_path, end):
    for file in (tub / "manifest.json", *tub.glob("*.catalog")):
        file.write_bytes(file.read_bytes().replace(b"\n", end))
    if end != b"\n":  # instead of none, an image that is larger than OpenCV reads
        (tub / "images" / "7_cam_image_array_.jpg").write_bytes(b"P6 60000 60000 255 ")
    printed = converted(tub, "--output", tmp_path / "recording")
    for told in ("marked as deleted is left out (1 time)", "local drove is left out (1 time)", "is missing or damaged"):
        assert told in printed
    for told in ("the middle 160x80 are scaled to 320x160 (9 times)", "throttle below 0 is written as brake (2 times)"):
        assert told in printed
    recording = checked(tmp_path / "recording")
    rows = np.array([0, 1, 3, 5, 6, 8, 9, 10, 11])
    np.testing.assert_array_equal(recording.steering, np.float32(rows / 10 - 0.5))
    np.testing.assert_allclose(recording.time, 1.6e9 + rows / 20)
    np.testing.assert_allclose(recording.brake[-2:], 0.2)
    middles = []
    for camera in range(3):
        road = np.ptp(read_frame(recording.path(0, camera))[90].astype(int), axis=1) < 40
        middles.append(road.nonzero()[0].mean())
    assert middles[1] > middles[0] + 10 > middles[2] + 20, "seen from the left, the road lies further to the right"
    assert "gone: no such folder; name a recording, data set" in refused(tub / "gone", "--output", tmp_path / "other")
    (tub / "manifest.json").rename(tub / "record_1.json")
    assert "tub: a tub of version 1; donkeycar's scripts/conv" in refused(tub, "--output", tmp_path / "other")


def test_a_tubs_camera_of_another_name_is_found_or_can_be_named(tub, tmp_path):
    def rename(*cameras):
        for file in (tub / "manifest.json", *tub.glob("*.catalog")):
            file.write_text(file.read_text(encoding="utf-8").replace("cam/image_array", cameras[0]), encoding="utf-8")
        lines = (tub / "manifest.json").read_text(encoding="utf-8").splitlines()
        lines[:2] = json.dumps([*cameras, "user/angle"]), json.dumps(["image_array"] * len(cameras) + ["float"])
        (tub / "manifest.json").write_text("\n".join(lines), encoding="utf-8")

    assert refused(tub, "--output", tmp_path / "a", "--camera", "x").endswith("with --camera: cam/image_array")
    rename("cam/left")
    assert "a: 9 rows" in converted(tub, "--output", tmp_path / "a")
    rename("cam/left", "cam/right")
    assert refused(tub, "--output", tmp_path / "b").endswith("Name it with --camera: cam/left, cam/right")
    assert "b: 9 rows" in converted(tub, "--output", tmp_path / "b", "--camera", "cam/left")


def test_a_tub_of_donkeycars_computer_vision_template_has_the_angle_under_another_name(tub, tmp_path):
    for catalog in tub.glob("*.catalog"):
        text = catalog.read_text(encoding="utf-8").replace("user/angle", "steering").replace("user/thr", "thr")
        catalog.write_text(text, encoding="utf-8")
    assert "no throttle" not in converted(tub, "--output", tmp_path / "recording")
    recording = checked(tmp_path / "recording")
    assert recording.steering[0] == -0.5 and recording.throttle[0] == np.float32(0.3)


def test_of_several_tubs_in_a_folder_one_is_to_be_named(tub, written, tmp_path):
    assert refused(tub.parent, "--output", tmp_path / "recording") == f"{tub.parent}: name one alone: {tub}"
    assert refused(written.parent, "--output", tmp_path / "recording").endswith(f"name one alone: {written}")


def test_why_a_tub_has_no_usable_row_is_told(tub, tmp_path):
    for catalog in tub.glob("*.catalog"):
        catalog.write_text(catalog.read_text(encoding="utf-8").replace('"user"}', r'"\u001b"}'), encoding="utf-8")
    printed, error = run(tub, "--output", tmp_path / "recording")
    assert "no usable row" in error and "a row that the \\x1b drove is left out (10 times)" in printed


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "meta/info.json").write_bytes(b"{"), "not a data set in LeRobot"),
        (lambda folder: folder.joinpath("data/chunk-000/file-000.parquet").write_bytes(POINTER), "`git lfs pull`"),
        (lambda folder: folder.joinpath("data/chunk-000/file-000.parquet").unlink(), "parquet: no such file; copy it"),
        (lambda folder: (folder / "videos" / CENTER / "chunk-000/file-000.mp4").write_bytes(POINTER), "`git lfs pull`"),
        (lambda folder: shutil.rmtree(folder / "videos" / CENTER), "No such file or directory"),
        (lambda folder: edit(folder, features=[]), "not a data set in LeRobot"),
        (lambda folder: edit(folder, fps=0), "not a data set in LeRobot"),
        (lambda folder: edit(folder, fps=5), "no frame for row 7 of episode 0"),
        (lambda folder: edit(folder, fps=60), "no frame for row 1 of episode 0"),
        (lambda folder: edit(folder, features=features(folder) | VAST), "action:999, recorded_at:recorded_at"),
        (lambda folder: edit(folder, video_path="http://127.0.0.1:1/film"), "127.0.0.1:1/film: No such file"),
    ],
    ids=["info", "table", "no table", "film", "no film", "features", "rate", "short film", "gap", "vast", "no file"],
)
def test_a_damaged_data_set_is_reported_and_nothing_is_written(data_set, tmp_path, monkeypatch, damage, message):
    damage(data_set)
    monkeypatch.chdir(data_set)
    assert message in refused(".", "--output", tmp_path / "recording")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lake"]


@pytest.mark.parametrize(("end", "line"), [(b"\n", 7), (b"\r\r\n", 13)])  # the second has an empty line after each
@pytest.mark.parametrize("row", ["{", "[]", "{}", *(IMAGE % angle for angle in ("null", "9" * 400))])
def test_a_damaged_tub_is_reported_with_its_line(tub, tmp_path, row, end, line):
    catalog = tub / "catalog_1.catalog"
    catalog.write_bytes((catalog.read_bytes() + f"{row}\n".encode()).replace(b"\n", end))
    assert f"catalog_1.catalog: line {line}: " in refused(tub, "--output", tmp_path / "recording")
    assert [path.name for path in tmp_path.iterdir()] == ["tub"]


@pytest.mark.parametrize("end", ["{", '{"_index": 12, "user/an', "\0\0"])
def test_a_last_row_that_a_power_failure_cut_short_is_left_out_of_a_tub(tub, tmp_path, end):
    with (tub / "catalog_1.catalog").open("a", encoding="utf-8") as catalog:
        catalog.write(end)
    printed = converted(tub, "--output", tmp_path / "recording")
    assert "tub: a row at the end that is cut short is left out (1 time)" in printed and "recording: 9 rows" in printed


@pytest.mark.parametrize("last", ["3", "[]", '{"paths": 3}', '{"paths": ["catalog_0.catalog"], "deleted_indexes": 3}'])
def test_a_damaged_manifest_of_a_tub_is_reported(tub, tmp_path, last):
    lines = (tub / "manifest.json").read_text(encoding="utf-8").splitlines()
    (tub / "manifest.json").write_text("\n".join([*lines[:4], last]), encoding="utf-8")
    assert "manifest.json: line 5 names no catalogs" in refused(tub, "--output", tmp_path / "recording")
    (tub / "manifest.json").write_text(lines[0], encoding="utf-8")
    assert "manifest.json: line 5 names no catalogs" in refused(tub, "--output", tmp_path / "recording")


def test_rows_without_a_time_or_a_number_are_left_out(data_set, tmp_path):
    path = data_set / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    times, actions = (table[name].to_pylist() for name in ("recorded_at", "action"))
    times[2:5], actions[6] = [None, 1e22, float("nan")], [None, 1.0, 0.0]
    for name, values in (("recorded_at", times), ("action", actions)):
        table = table.set_column(table.column_names.index(name), name, [values])
    pq.write_table(table, path)
    printed = converted(data_set, "--output", tmp_path / "recording")
    assert "time or numbers are not finite is left out (4 times)" in printed
    assert len(checked(tmp_path / "recording")) == 15


def test_rows_with_the_same_time_are_of_one_drive_and_have_images_of_their_own(tmp_path):
    sample = Sample(1700000000.031, [np.zeros((160, 320, 3), np.uint8)], {"steering": 0.0})
    write_recording(iter(60 * [sample]), tmp_path / "one", 1.0, Counter())
    assert np.diff(read_recording(tmp_path / "one").time) == pytest.approx(0.001, abs=1e-6)


def test_images_of_two_sources_without_dates_have_different_names(tmp_path):
    names = list[set[str]]()
    for brightness in (1, 2, 1):
        sample = Sample(0.5, [np.full((160, 320, 3), brightness, np.uint8)], {"steering": 0.0})
        folder = tmp_path / str(len(names))
        write_recording(iter([sample]), folder, 1.0, Counter())
        names.append({path.name for path in (folder / "IMG").iterdir()})
    assert len(names[0]) == 3 and not names[0] & names[1] and names[0] == names[2]


def test_an_image_whose_end_a_power_failure_replaced_by_zeros_is_damaged():
    jpeg = encode(np.random.default_rng(0).integers(256, size=(120, 160, 3), dtype=np.uint8), 95)
    assert decoded(jpeg) is not None and decoded(jpeg[:4096] + bytes(len(jpeg) - 4096)) is None


def test_the_middle_of_an_image_that_is_a_pixel_wide_is_a_pixel(tmp_path):
    sample = Sample(0.0, [np.zeros((160, 1, 3), np.uint8)], {"steering": 0.0})
    assert write_recording(iter([sample]), tmp_path / "one", 1.0, Counter()) == 1


def test_a_recording_without_images_is_left_out(recordings, tmp_path):
    (tmp_path / "bare").mkdir()
    shutil.copy(recordings[0] / "driving_log.csv", tmp_path / "bare")
    printed = converted(recordings[1], tmp_path / "bare", "--output", tmp_path / "set")
    assert "set: 5 frames of 3 cameras in 1 episode" in printed
    assert refused(tmp_path / "bare", "--output", tmp_path / "other").endswith("bare: no usable row is left")


def test_what_exists_is_not_replaced(recordings, written, tub):
    for source in (recordings[0], written, tub):
        assert "tub: exists already; name another folder" in refused(source, "--output", tub)


def test_options_without_an_effect_are_refused(recordings, tub, tmp_path):
    assert refused(tub, "--steering", "angle", "--output", tmp_path / "x").endswith(
        "--steering is of a data set, not of a tub; leave it out"
    )
    told = refused(recordings[0], "--full-lock", 0.5, "--output", tmp_path / "x")
    assert "--full-lock is of a data set or tub, not of a recording" in told and not (tmp_path / "x").exists()


def test_the_environment_for_lerobot(written):
    """Its evaluation steps such environments with actions in float32, and expects these keys."""
    [(track, environments)] = runpy.run_path(str(written / "env.py"))["make_env"](n_envs=1).items()
    drive = environments[0]
    observation, _ = drive.reset(seed=[1], options={"lerobot_new_rollout": True})  # as LeRobot does after 0.4.4
    assert track == "lake" and observation["pixels"]["center"].shape == (1, 160, 320, 3)
    for _ in range(15):
        observation, reward, terminated, _, info = drive.step(np.array([[0, 1, 0]], np.float32))
    speed = observation["agent_pos"][0, 0]
    assert speed == pytest.approx(info["speed"][0]) and speed > 3 and reward[0] > 0 and not terminated[0]
    drive.step(np.array([[0, 0, 1]], np.float32))
    assert drive.step(np.array([[0, 0, 1]], np.float32))[0]["agent_pos"][0, 0] < speed, "it brakes"
    for _ in range(100):
        *_, terminated, _, info = drive.step(np.array([[1, 1, 0]], np.float32))
        if terminated[0]:
            break
    assert info["final_info"]["is_success"].tolist() == [False]
    starts = [drive.reset(seed=[seed])[1]["s"][0] for seed in (1, 2, 1)]
    assert starts[0] == starts[2] != starts[1]
    assert drive.call("task_description") == ("Follow the road.",) and drive.call("_max_episode_steps") == (9000,)
    drive.close()


def test_a_drive_that_was_saved_becomes_a_recording(tmp_path):
    """One frame is lost, and the disk was full in the middle of a row: the next row follows it in its line."""
    saver, rng, drive = FrameSaver(tmp_path / "run1"), np.random.default_rng(0), tmp_path / "run1"
    session, frames = saver.start_session(), [render_frame(0, 0, rng) for _ in range(5)]
    for n, frame in enumerate(frames):
        session.save(encode(frame, 95), (n / 10 - 0.2, 0.25 - n / 10, 9 + n), 100 + n / 20)
    saver.close()
    sorted(drive.glob("*.jpg"))[2].unlink()
    rows = (drive / "driven.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    half = f"{rows[4][:30]}{rows[4]}"
    (drive / "driven.csv").write_text("".join([*rows[:4], half, rows[5], rows[5][:-2]]), encoding="utf-8")
    printed = converted(drive, "--output", tmp_path / "recording")
    for told in ("cut short is left out (1 time)", "missing or damaged is left out (1 time)", "below 0 is written"):
        assert told in printed
    recording, kept = checked(tmp_path / "recording"), np.array([0, 1, 3, 4])
    np.testing.assert_array_equal(recording.steering, np.float32(kept / 10 - 0.2))
    np.testing.assert_array_equal(recording.speed, 9 + kept)
    np.testing.assert_allclose(recording.throttle - recording.brake, 0.25 - kept / 10, atol=1e-6)
    np.testing.assert_allclose(recording.time - recording.time[0], kept / 20, atol=2e-3)
    assert cv2.absdiff(read_frame(recording.path(2)), read_frame(sorted(drive.glob("*.jpg"))[2])).mean() < 2
    (drive / "driven.csv").write_text("name,angle\n", encoding="utf-8")
    assert "driven.csv: line 1: not frame,steering" in refused(drive, "--output", tmp_path / "again")
    (drive / "driven.csv").unlink()
    assert "run1: saved frames without driven.csv, as" in refused(drive, "--output", tmp_path / "again")
