"""The server of recordings over a real socket: what it tells, what it refuses, and cuts."""

import json
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest
from browse_process import browsing, opened, placed, replayed, written_run
from commands import call_here
from rendered import film_of
from test_excluded import center

from cloning.base.errors import RecordingError
from cloning.browse import __main__ as browse
from cloning.browse.library import Library
from cloning.browse.page import create_app
from cloning.browse.runs import Runs
from cloning.lane.reader import SHIPPED_WEIGHTS
from cloning.recordings.excluded import Cut, add_cuts
from cloning.recordings.images import decode, read_frame
from cloning.recordings.log import read_recording, read_uncut
from cloning.road.overlay import overlay

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def served(sample_recording, model_file, tmp_path_factory):
    """A server of "lake sample", with a replay, of "spoilt", and of a run; they are not to be changed."""
    data = tmp_path_factory.mktemp("served")
    for name in ("spoilt", "run", "empty"):
        (data / name).mkdir()
    (data / "spoilt" / "driving_log.csv").write_text("nothing\n", encoding="utf-8")
    (data / "secret.jpg").write_bytes(min((sample_recording / "IMG").iterdir()).read_bytes())
    (data / "secret.png").write_bytes(PNG)
    placed(sample_recording, np.zeros(60))
    replayed(sample_recording, model_file, 1.0, np.linspace(-0.5, 0.5, 60), [[30, 1.2]])
    pictures = written_run(data / "run", finished=4, images=0).pictures
    (pictures / "training_generator_LRC_5.png").symlink_to("/etc/passwd")
    folders = [data / "empty", data / "run"]
    with browsing(sample_recording, data, "--model", model_file, "--run", *folders) as server:
        yield server


def test_the_server_tells_what_the_reader_tells(served, sample_recording):
    here = served.recordings()["lake sample"]
    recording, details = read_recording(sample_recording), served.answer(f"{here}/details")
    assert details["frames"] == details["rows_read"] == 60 and details["cuts"] == [] and details["rejected"] == 0
    assert served.answer(f"{here}/overview")["outline"] and not {"outline", "path"} & details.keys(), "sent once"
    for name in ("steering", "throttle", "speed"):
        status, data, _ = served.ask(f"{here}/columns/{name}?version={details['version']}")
        assert status == 200
        np.testing.assert_array_equal(np.frombuffer(data, "<f4"), getattr(recording, name))
    assert served.answer(f"{here}/rows/7") == {"line": 8, "images": [recording.name(7, camera) for camera in range(3)]}
    for camera, name in enumerate(("center", "left", "right")):
        status, data, headers = served.ask(f"{here}/rows/7/{name}.jpg")
        assert (status, data) == (200, recording.path(7, camera).read_bytes())
        assert headers["Cache-Control"] == "private, max-age=600" and headers["Content-Type"] == "image/jpeg"
        assert served.ask(f"{here}/rows/7/{name}.jpg", If_None_Match=headers["Etag"])[:2] == (304, b"")
    spoilt = served.answer(f"{served.recordings()['spoilt']}/overview")
    assert "driving_log.csv: line 1: neither a row nor a header" in spoilt["message"] and "frames" not in spoilt


def test_others_are_answered_while_thousands_of_runs_are_looked_at(tmp_path, monkeypatch):
    runs = Runs([tmp_path])
    monkeypatch.setattr(runs, "found", lambda: [threading.get_native_id()])
    monkeypatch.setattr(runs, "run", lambda index: [threading.get_native_id()])
    with closing(Library([], [])) as library:
        client = create_app(library, runs).test_client()
        threads = [client.get(address).get_json() for address in ("/runs", "/runs/0")]  # either waits for the other
    assert [threading.get_native_id()] not in threads


def test_replays_and_runs_over_the_socket(served, sample_recording):
    here = served.recordings()["lake sample"]
    shown = served.answer(f"{here}/details?limit=1")["replays"][0]
    assert shown["where"] == [[29, 1.2]] and shown["autonomy_percent"] == 90
    status, data, _ = served.ask(f"{here}/columns/replay-0-1")
    assert status == 200 and np.frombuffer(data, "<f4")[-1] == 0.5
    status, data, headers = served.ask(f"{here}/rows/59/replay-0-1.jpg")
    recorded = read_frame(read_recording(sample_recording).path(59))
    assert status == 200 and headers["Content-Type"] == "image/jpeg"
    assert np.abs(decode(data).astype(int) - recorded).mean() > 1, "moved half a metre to the right"
    assert served.answer(f"{here}/details?limit=2.5")["replays"][0]["state"] == "none"
    assert served.answer(f"{here}/columns/offset", "POST")["lane"]["state"] == "ready", "what is there stays"
    empty, found = served.answer("/runs")
    assert "no training run in this folder yet" in empty["message"]
    assert found["id"] == 1 and found["state"] == "finished" and "pictures" not in found
    assert served.answer("/runs/1")["pictures"] == [0, 1200]
    status, data, headers = served.ask("/runs/1/training_generator_LRC_0.png")
    assert (status, data, headers["Content-Type"]) == (200, PNG, "image/png")
    status, data, headers = served.ask("/runs/1/training_generator_LRC_5.png")
    assert status == 409 and "not a PNG" in json.loads(data)["message"] and headers["Cache-Control"] == "no-store"


def test_a_film_and_a_new_recording_of_a_selection(linked, tmp_path):
    placed(linked, np.zeros(60))
    add_cuts(linked, Cut(center(linked, 0), center(linked, 4), "off"))
    with browsing(linked) as server:
        here = server.recordings()["lake"]
        version = server.answer(f"{here}/details")["version"]
        export = f"{here}/export?version={version}"
        status, data, headers = server.ask(f"{here}/film.mp4?version={version}", "POST", {"rows": "0-10,20-25"})
        assert status == 200 and headers["Content-Type"] == "video/mp4"
        (tmp_path / "film.mp4").write_bytes(data)
        _, frames = film_of(tmp_path / "film.mp4")
        assert len(frames) == 10 and frames[0].shape == (320, 640, 3), "without the five that are cut"
        recording = read_uncut(linked)
        wanted = overlay(read_frame(recording.path(20)), float(recording.steering[20]))[..., ::-1]
        assert np.abs(frames[5].astype(int) - wanted).mean() < 12
        made = server.answer(export, "POST", {"rows": "0-10,50-60", "name": "part"})
        assert len(read_recording(made["folder"])) == 15
        assert server.answer(f"/recordings/{made['id']}/overview")["frames"] == 15, "the list has it"
        body = {"rows": "0-60", "name": "two", "others": made["id"]}
        made = server.answer(export, "POST", body)
        assert made["notes"] == ["part is put 1 day later, after another drive"]
        assert len(read_recording(made["folder"])) == 70, "without what is cut"
        assert server.ask(export, "POST", body | {"others": "gone"})[0] == 404
        for name, words in (("part", "exists already"), ("../part", "not the name of a folder"), (".", "not the name")):
            server.refuses(words, export, "POST", {"rows": "0-9", "name": name})
        film = f"{here}/film.mp4?version={version}"
        assert server.ask(film, "POST", {"rows": "0-5"})[0] == 409, "all of it is cut"
        assert server.ask(f"{here}/export", "POST", {"rows": "0-9", "name": "other"})[0] == 409, "of no version"
        for rows in ("", "1", "a-b", "0-15-30", "1-" + "9" * 10, "1" + 8 * "-111111111" + "x"):
            assert server.ask(film, "POST", {"rows": rows})[0] == 400
        assert sorted(path.name for path in linked.parent.iterdir()) == ["lake", "part", "two"]


def test_no_page_of_another_site_is_answered(served, sample_recording):
    """As by drive.py, whose tests have all the headers."""
    here, other = f"{served.recordings()['lake sample']}/cuts", {"Origin": "http://evil.example"}
    cut = {"first": center(sample_recording, 1), "last": center(sample_recording, 2), "reason": ""}
    assert served.ask("/recordings", **other)[0] == served.ask(here, "POST", [cut], **other)[0] == 403
    assert not (sample_recording / "excluded.csv").exists()


def test_nothing_but_rows_cameras_columns_and_pictures_is_served(served):
    here = served.recordings()["lake sample"]
    of_the_recording = (
        *("rows/60/left.jpg", "rows/-1/left.jpg", "rows/0/back.jpg", "rows/9999999999999999999", "rows/0/center/1.png"),
        *("rows/0/../../secret.jpg", "rows/0/..%2f..%2f..%2fsecret.jpg", "rows/0/secret/0.png"),
        *("rows/0/replay-0-x.jpg", "columns/model-1", "columns/model-%C2%B2", "columns/names", "columns/__class__"),
        *("columns/replay-1-1", "columns/replay-0-7", "details?limit=1.7", "../../etc/passwd", "%2e%2e/%2e%2e/etc"),
    )  # fmt: skip
    others = (
        *("/recordings/..%2f..%2fetc/rows/0", "/static/..%2f__main__.py", "/static/../page.py", "/runs/2"),
        *("/runs/1/..%2f..%2fsecret.png", "/runs/1/../../secret.png", "/runs/1/training_log.csv"),
        *("/runs/1/training_generator_LRC_x.png", "/runs/1/training_generator_LRC_6.png"),
    )  # fmt: skip
    for path in (*(f"{here}/{each}" for each in of_the_recording), *others):
        status, data, _ = served.ask(path)
        assert status == 404 and b"root:" not in data and b"JFIF" not in data, path
    for path in ("columns/steering", "replays/3"):
        assert served.ask(f"{here}/{path}", "POST")[0] == 404


def test_an_image_that_is_no_frame_is_not_served(linked):
    """A csv may name any file below its IMG/, and that may be a link to anywhere."""
    recording = read_recording(linked)
    for row in range(3):
        recording.path(row).unlink()
    recording.path(0).symlink_to("/etc/passwd")
    recording.path(1).write_bytes(b"GIF89a")
    with opened(linked) as shown:
        for row, words in enumerate(("not a JPEG", "not a JPEG", "No such file")):
            with pytest.raises(RecordingError, match=words):
                shown.jpeg(row, "center")


def test_requests_that_are_none_leave_few_lines_in_the_log(sample_recording, tmp_path):
    with open(tmp_path / "log", "w") as log, browsing(sample_recording, stderr=log) as server:
        for _ in range(100):
            with socket.create_connection(("127.0.0.1", server.port), 10) as client:
                client.sendall(b"G\r\n\r\n")
                client.recv(10)
    times = ("", " (10 times so far)", " (100 times so far)")
    assert (tmp_path / "log").read_text().splitlines() == [f"browse: a request can't be read{each}" for each in times]


def test_cuts_over_the_socket(linked):
    """Two pages cut and undo; a wrong request, a changed log and a vanished recording lose nothing."""
    log, names = (linked / "driving_log.csv").read_bytes(), [center(linked, row) for row in range(60)]
    placed(linked, np.zeros(60))
    cuts = linked / "excluded.csv"
    with browsing(linked) as server:
        here = server.recordings()["lake"]
        version = server.answer(f"{here}/details")["version"]
        one = {"first": names[3], "last": names[5], "reason": "off"}
        two = {"first": names[10], "last": names[10], "reason": "crash, hard"}
        assert server.ask(f"{here}/cuts", "POST", [one])[0] == 200
        details = server.answer(f"{here}/cuts", "POST", [two])
        assert details["cut_frames"] == 4 and details["changed"] == [two | {"line": 0}]
        assert [(cut["reason"], cut["frames"], cut["stretches"]) for cut in details["cuts"]] == [
            ("off", 3, [[3, 6]]),
            ("crash, hard", 1, [[10, 11]]),
        ]
        assert len(read_recording(linked)) == 56
        assert server.ask(f"{here}/tags", "POST", [one, two])[0] == 200
        assert server.answer(f"{here}/tags", "POST", [one, two])["changed"] == [], "so that undo takes none back"
        assert server.ask(f"{here}/tags", "DELETE", [one])[0] == 200
        assert [tag["reason"] for tag in server.answer(f"{here}/details")["tags"]] == ["crash, hard"]
        assert server.answer(f"{here}/overview")["tags"] == ["crash, hard"], "by which the list is searched"
        server.refuses("is not there any more", f"{here}/cuts", "DELETE", [one | {"reason": "other"}], status=410)
        details = server.answer(f"{here}/cuts", "DELETE", [one, one | {"reason": "other"}])
        assert details["cut_frames"] == 1, "what was deleted elsewhere keeps no other one"
        assert [cut["reason"] for cut in details["changed"]] == ["off"]
        server.refuses("not there any more", f"{here}/cuts", "DELETE", [one], status=410)
        wrongs: tuple[object, ...] = ([], one, [1], [{"first": 1, "last": "b", "reason": ""}], [one | {"more": ""}])
        for wrong in wrongs:
            assert server.ask(f"{here}/cuts", "POST", wrong)[0] == 400
        status, data, _ = server.ask(f"{here}/cuts", "POST", json.dumps([one | {"reason": "\ud800"}]).encode())
        assert status == 400 and b"Cuts are a list of JSON objects" in data
        many = [{"first": name, "last": name, "reason": f"{n:0100}"} for n in range(30) for name in names[20:60]]
        assert len(server.answer(f"{here}/tags", "POST", many)["changed"]) == 1200
        assert len(server.answer(f"{here}/tags", "DELETE", many)["changed"]) == 1200
        for path in ("cuts", "export"):
            status, data, _ = server.ask(f"{here}/{path}", "POST", b"[" * 100_000)
            assert status == 400 and b"nested too deeply" in data
        server.refuses("is not the centre image", f"{here}/cuts", "POST", [two, one | {"first": "../x"}])
        text = f'first image,last image,reason\n{names[10]},{names[10]},"crash, hard"\n'
        assert cuts.read_text(encoding="utf-8") == text
        assert (linked / "driving_log.csv").read_bytes() == log
        (linked / "driving_log.csv").write_bytes(log[log.index(b"\n") + 1 :])
        server.refuses("has changed since this page read it", f"{here}/rows/0/left.jpg?version={version}")
        assert server.answer(f"{here}/details")["frames"] == 59
        linked.rename(linked.with_name("elsewhere"))
        gone = "driving_log.csv: No such file"
        server.refuses(gone, f"{here}/cuts", "POST", [one])
        server.refuses(gone, f"{here}/columns/offset", "POST")
        assert gone in server.answer(f"{here}/overview")["message"]
        assert (linked.with_name("elsewhere") / "excluded.csv").read_text(encoding="utf-8") == text


def test_a_recording_that_is_new_is_in_the_list_and_others_are_answered_while_its_long_log_is_read(linked, tmp_path):
    long = linked.with_name("long")
    rows = [f"center_{n}.jpg,left_{n}.jpg,right_{n}.jpg,0,1,0,9\n" for n in range(100_000)]
    with browsing(linked.parent) as server, ThreadPoolExecutor() as pool:
        assert list(server.recordings()) == ["lake"]
        long.mkdir()
        (long / "driving_log.csv").write_text("".join(rows), encoding="utf-8")
        here, answered = server.recordings(), 0
        assert list(here) == ["lake", "long"]
        server.answer(f"{here['lake']}/rows/0")  # reads it
        reading = pool.submit(server.ask, f"{here['long']}/columns/throttle")
        while not reading.done():
            answered += server.ask(f"{here['lake']}/rows/0/center.jpg")[0] == 200
        status, data, _ = reading.result()
        assert status == 200 and np.array_equal(np.frombuffer(data, "<f4"), np.ones(100_000))
        assert answered > 3, "one may be answered before it is read"
        for folder in (linked, long):
            folder.rename(tmp_path / folder.name)
        assert list(server.recordings()) == ["lake", "long"], "what is gone is told in its card"


def test_the_command_refuses_what_it_cannot_show(sample_recording, tmp_path):
    (tmp_path / "run1").mkdir()
    (tmp_path / "run1/driven.csv").touch()
    makes = f"python -m cloning.lerobot {tmp_path}/run1 --output {tmp_path}/run1-recording"
    for arguments, words in (
        ([tmp_path / "run1"], f"{tmp_path}/run1: what drive.py saved; `{makes}` makes a recording of it"),
        ([tmp_path], f"{tmp_path}: no driving_log.csv in or below it. Record some: in the simulator (training mode"),
        ([sample_recording, "--model", tmp_path / "m.pt"], f"{tmp_path / 'm.pt'}: no such model file"),
        ([sample_recording, "--model", SHIPPED_WEIGHTS], f"{SHIPPED_WEIGHTS}: not a model of this project that steers"),
    ):
        done = call_here(browse.main, "browse", *arguments, "--port", 0)
        assert done.returncode == 2 and done.stderr.startswith(f"browse: {words}")
        assert "python -m simulator record data/lake" in done.stderr or "model" in words or "run1" in words
