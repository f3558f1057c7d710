"""The recordings in the browser: figures, looks, the server over a socket, and the page in a real Chromium."""

import http.client
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, chromium
from conftest import HERE, ROOT
from test_excluded import center

from cloning.browse import __main__ as browse
from cloning.browse import estimate, looks, summary
from cloning.browse.library import Library
from cloning.browse.looks import LANE, Result, read_result, stamp, write_result
from cloning.errors import RecordingError
from cloning.lane.place import Localisation
from cloning.pilot.network import load_model, steer
from cloning.recordings.images import read_frame
from cloning.recordings.log import read_recording
from cloning.road.track import Track

# ----------------------------------------------------------------------------------------------------------------------
# Figures


def test_seconds_driven_leave_out_breaks():
    time = np.array([100.0, 100.1, 100.2, 7300.0, 7300.1])
    np.testing.assert_allclose(summary.driven_seconds(time), [0, 0.1, 0.2, 0.2 + 1 / 15, 0.3 + 1 / 15], atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_largest_places_by_brute_force(seed):
    """The largest value that is left, and then no other within the distance, again and again."""
    rng = np.random.default_rng(seed)
    values = np.round(rng.normal(size=200), 1)
    values[rng.random(200) < 0.3] = np.nan
    left, wanted = {row for row in range(200) if not np.isnan(values[row]) and values[row]}, []
    while left and len(wanted) < 5:
        best = max(left, key=lambda row: (abs(values[row]), -row))
        wanted.append(best)
        left = {row for row in left if abs(row - best) >= 12}
    assert summary.largest(values, 5, 12) == sorted(wanted)


def test_places_with_the_steering_at_its_stop():
    steering = np.array([1, 1, 0.5, -1, 1, 0, -0.9, -1, -1, 0], np.float32)
    assert summary.at_stop(steering) == [0, 3, 4, 7]
    assert summary.at_stop(np.zeros(3)) == [] and summary.largest(np.full(3, np.nan)) == []


def test_places_are_those_that_are_not_cut():
    steering = np.zeros(90, np.float32)
    steering[[5, 70]] = 1, -1
    offset, models = np.linspace(0, 3, 90, dtype=np.float32), [np.full(90, 0.1), np.full(90, np.nan)]
    nothing_cut = summary.places(steering, offset, models, np.zeros(90, bool))
    assert nothing_cut == {"stop": [5, 70], "offset": [29, 59, 89], "difference": [5, 35, 70]}
    cut = summary.places(steering, offset, models, np.arange(90) >= 60)
    assert cut == {"stop": [5], "offset": [29, 59], "difference": [5, 35]}
    assert summary.places(steering, None, [], np.zeros(90, bool)) == {"stop": [5, 70]}


def test_figures_are_those_of_the_rows_that_are_not_cut(sample_recording):
    recording = read_recording(sample_recording)
    is_cut = np.arange(60) < 30
    found = summary.figures(recording, is_cut)
    wanted, _ = np.histogram(recording.steering[30:], 41, (-1, 1))
    assert found["histogram"] == wanted.tolist() and (found["frames"], found["cut_frames"]) == (60, 30)
    assert found["seconds"] == pytest.approx(59 * 0.067, abs=0.01)
    assert found["zeros"] == np.mean(recording.steering[30:] == 0)
    assert found["speed"] == pytest.approx([30.19] * 3)
    assert summary.figures(recording, np.ones(60, bool))["speed"] is None


def test_the_road_and_the_path_on_the_map(sample_recording, monkeypatch):
    """Rows placed on the lake at known places get these coordinates; what is not placed has none."""
    recording, track = read_recording(sample_recording), Track("lake", "cw")
    s = np.linspace(100, 120, 40)
    placed = Localisation(track, np.stack([s, np.full(40, 1.5), np.zeros(40)], axis=1), 0.0)
    monkeypatch.setattr("cloning.lane.place.localise_all", lambda *_: [(slice(10, 50), placed)])
    monkeypatch.setattr(estimate, "detect_centres", lambda part: np.zeros((len(part), 3, 5), np.float32))
    result = estimate.lane(recording)
    x, y = (result.column(name, recording.images[:, 0]) for name in "xy")
    for row, at in ((10, 100.0), (49, 120.0)):
        found = track.locate(float(x[row]), float(y[row]))
        assert found == pytest.approx((at, 1.5), abs=0.02)
    assert np.isnan(x[:10]).all() and np.isnan(y[50:]).all()
    road = summary.road_of(result, recording.images[:, 0])
    assert road["roads"] == [["lake", "cw"]] and len(road["path"]) == 1 and len(road["path"][0]) == 40
    assert road["path"][0][0] == pytest.approx([x[10], y[10]], abs=0.06)


# ----------------------------------------------------------------------------------------------------------------------
# Looks


def test_a_models_steering_is_that_of_drive_py(sample_recording, model_file):
    recording = read_recording(sample_recording)
    result = estimate.steering(recording, str(model_file))
    network = load_model(model_file)
    wanted = [float(steer(network, read_frame(recording.path(row)))) for row in (0, 31, 59)]
    np.testing.assert_allclose(result.column("steering", recording.images[:, 0])[[0, 31, 59]], wanted, atol=1e-6)


def test_a_result_is_kept_until_the_recording_changes(logged):
    images = np.array([2, 0], np.int32)
    result = Result(images, {"offset": np.array([0.5, np.nan], np.float32)}, {"roads": []})
    assert read_result(logged, LANE) is None
    write_result(logged, LANE, stamp(logged, LANE), result)
    found = read_result(logged, LANE)
    np.testing.assert_array_equal(found.column("offset", np.array([0, 1, 2, 2])), [np.nan, np.nan, 0.5, 0.5])
    time.sleep(0.02)  # longer than a tick of the file system's clock
    (logged / "driving_log.csv").touch()
    assert read_result(logged, LANE) is None
    shutil.rmtree(logged)
    with pytest.raises(RecordingError, match=r"driving_log.csv: No such file .*put it back"):
        read_result(logged, LANE)


def ended(library: Library, folder: Path, look: str) -> list[dict]:
    """The states of a look until it is done or has failed, without repetitions."""
    states, end = [library.looks.state(folder, look)], time.monotonic() + 60
    while states[-1]["state"] in ("waiting", "running"):
        assert time.monotonic() < end, states
        time.sleep(0.005)
        if (state := library.looks.state(folder, look)) != states[-1]:
            states.append(state)
    return states


def test_the_open_recording_goes_first_and_then_the_smallest(sample_recording, tmp_path, monkeypatch):
    folders = []
    for name, copies in (("large", 3), ("middle", 2), ("small", 1), ("open", 4)):
        (tmp_path / name / "IMG").mkdir(parents=True)
        text = (sample_recording / "driving_log.csv").read_text(encoding="utf-8")
        (tmp_path / name / "driving_log.csv").write_text(text * copies, encoding="utf-8")
        folders.append(tmp_path / name)
    code = f"import sys; open({str(tmp_path / 'order')!r}, 'a').write(sys.argv[1] + '\\n'); sys.exit('no')"
    monkeypatch.setattr(looks, "COMMAND", (sys.executable, "-c", code))
    library = Library(folders, [])
    try:
        with library.looks.changed:  # until all of them wait
            for folder in folders:
                library.looks.state(folder, LANE)
            library.looks.hurry(folders[3])
        for folder in folders:
            assert ended(library, folder, LANE)[-1]["state"] == "failed"
    finally:
        library.looks.close()
    order = [Path(line).name for line in (tmp_path / "order").read_text(encoding="utf-8").splitlines()]
    assert order == ["open", "small", "middle", "large"]


def test_a_look_tells_how_far_it_is_and_why_it_failed(logged, monkeypatch):
    code = (
        "import sys, time; print('progress 0.5', flush=True); time.sleep(0.5); sys.exit('details\\nestimate: no model')"
    )
    monkeypatch.setattr(looks, "COMMAND", (sys.executable, "-c", code))
    library = Library([logged], [])
    try:
        states = ended(library, logged, LANE)
        assert states[0] == {"state": "waiting"} and {"state": "running", "progress": 0.5} in states
        assert states[-1] == {"state": "failed", "message": "estimate: no model"}
        time.sleep(0.02)  # longer than a tick of the file system's clock
        (logged / "driving_log.csv").touch()
        assert library.looks.state(logged, LANE)["state"] == "waiting", "tried again once the recording has changed"
    finally:
        library.looks.close()
    assert library.looks.process is None


# ----------------------------------------------------------------------------------------------------------------------
# The server


class Browse:
    """A server of recordings, in a process of its own."""

    def __init__(self, *arguments):
        command = [sys.executable, "-m", "cloning.browse", *map(str, arguments), "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **HERE})
        self.said = self.process.stdout.readline()
        self.port = int(re.search(r"http://127.0.0.1:(\d+)/", self.said)[1])
        self.base = f"http://127.0.0.1:{self.port}/"

    def ask(self, path: str, method: str = "GET", body: object = None, **headers) -> tuple[int, bytes, dict]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        data = None if body is None else json.dumps(body)
        headers = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, data, {"Content-Type": "application/json", **headers})
        answer = connection.getresponse()
        try:
            return answer.status, answer.read(), dict(answer.headers)
        finally:
            connection.close()

    def get(self, path: str) -> object:
        status, data, _ = self.ask(path)
        assert status == 200, data
        return json.loads(data)

    def recordings(self) -> dict[str, str]:
        """Where each recording is, by its folder's name."""
        return {Path(each["folder"]).name: f"/recordings/{each['id']}" for each in self.get("/recordings")}


@contextmanager
def browsing(*arguments):
    server = Browse(*arguments)
    try:
        yield server
    finally:
        server.process.send_signal(signal.SIGINT)
        assert server.process.wait(30) == 0
        server.process.stdout.close()


@pytest.fixture
def logged(sample_recording, tmp_path) -> Path:
    """A recording of 60 rows whose images are links, which a test may change."""
    folder = tmp_path / "data" / "lake"
    (folder / "IMG").mkdir(parents=True)
    shutil.copy(sample_recording / "driving_log.csv", folder)
    for image in (sample_recording / "IMG").iterdir():
        os.link(image, folder / "IMG" / image.name)
    return folder


@pytest.fixture(scope="module")
def served(sample_recording, tmp_path_factory):
    """A server of two recordings, "lake sample" and "spoilt"; they are not to be changed."""
    data = tmp_path_factory.mktemp("served")
    (data / "spoilt").mkdir()
    (data / "spoilt" / "driving_log.csv").write_text("nothing\n", encoding="utf-8")
    (data / "secret.jpg").write_bytes(min((sample_recording / "IMG").iterdir()).read_bytes())
    with browsing(sample_recording, data) as server:
        yield server


def test_the_server_tells_what_the_reader_tells(served, sample_recording):
    here = served.recordings()["lake sample"]
    recording, details = read_recording(sample_recording), served.get(f"{here}/details")
    assert details["frames"] == details["rows_read"] == 60 and details["cuts"] == [] and details["rejected"] == 0
    for name in ("steering", "throttle", "speed"):
        status, data, _ = served.ask(f"{here}/columns/{name}?version={details['version']}")
        assert status == 200
        np.testing.assert_array_equal(np.frombuffer(data, "<f4"), getattr(recording, name))
    assert served.get(f"{here}/rows/7") == {"line": 8, "images": [recording.name(7, camera) for camera in range(3)]}
    for camera, name in enumerate(("center", "left", "right")):
        status, data, headers = served.ask(f"{here}/rows/7/{name}.jpg")
        assert (status, data) == (200, recording.path(7, camera).read_bytes())
        assert headers["Cache-Control"] == "private, max-age=600" and headers["Content-Type"] == "image/jpeg"
        assert served.ask(f"{here}/rows/7/{name}.jpg", If_None_Match=headers["Etag"])[:2] == (304, b"")
    spoilt = served.get(f"{served.recordings()['spoilt']}/overview")
    assert "driving_log.csv: line 1: neither a row nor a header" in spoilt["message"] and "frames" not in spoilt


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example"},
        {"Host": "localhost.evil.example:80"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
def test_no_page_of_another_site_is_answered(served, sample_recording, headers):
    here = served.recordings()["lake sample"]
    cut = {"first": center(sample_recording, 1), "last": center(sample_recording, 2), "reason": ""}
    for method, path in (("GET", "/recordings"), ("GET", f"{here}/rows/0/left.jpg"), ("POST", f"{here}/cuts")):
        assert served.ask(path, method, cut if method == "POST" else None, **headers)[0] == 403
    assert not (sample_recording / "excluded.csv").exists()


@pytest.mark.parametrize(
    "path",
    [
        "rows/60/left.jpg",
        "rows/-1/left.jpg",
        "rows/0/back.jpg",
        "rows/0/../../secret.jpg",
        "rows/0/..%2f..%2f..%2fsecret.jpg",
        "columns/model-0",
        "columns/model-²",
        "columns/names",
        "columns/__class__",
        "../../etc/passwd",
        "%2e%2e/%2e%2e/etc/passwd",
        "rows/99999999999999999999999",
    ],
)
def test_nothing_but_rows_cameras_and_columns_is_served(served, path):
    status, data, _ = served.ask(f"{served.recordings()['lake sample']}/{path}".replace("²", "%C2%B2"))
    assert status == 404 and b"root:" not in data and b"JFIF" not in data
    assert served.ask("/recordings/..%2f..%2fetc/rows/0")[0] == 404
    assert served.ask("/static/..%2f__main__.py")[0] == served.ask("/static/../page.py")[0] == 404


def test_an_image_that_is_no_frame_is_not_served(logged):
    """A csv may name any file below its IMG/, and that may be a link to anywhere."""
    recording = read_recording(logged)
    for row in range(3):
        recording.path(row).unlink()
    recording.path(0).symlink_to("/etc/passwd")
    recording.path(1).write_bytes(b"GIF89a")
    with browsing(logged) as server:
        here = server.recordings()["lake"]
        for row, words in enumerate(("not a JPEG", "not a JPEG", "No such file")):
            status, data, headers = server.ask(f"{here}/rows/{row}/center.jpg")
            assert status == 409 and words in json.loads(data)["message"] and headers["Cache-Control"] == "no-store"


def test_cuts_over_the_socket(logged):
    """Two pages cut and undo; a wrong request, a changed log and a vanished recording lose nothing."""
    log, names = (logged / "driving_log.csv").read_bytes(), [center(logged, row) for row in range(60)]
    with browsing(logged) as server:
        here = server.recordings()["lake"]
        version = server.get(f"{here}/details")["version"]
        one = {"first": names[3], "last": names[5], "reason": "off"}
        two = {"first": names[10], "last": names[10], "reason": "crash, hard"}
        assert server.ask(f"{here}/cuts", "POST", one)[0] == 200
        status, data, _ = server.ask(f"{here}/cuts", "POST", two)
        details = json.loads(data)
        assert status == 200 and details["cut_frames"] == 4 and details["changed"] == two | {"line": 0}
        assert [(cut["reason"], cut["frames"], cut["stretches"]) for cut in details["cuts"]] == [
            ("off", 3, [[3, 6]]),
            ("crash, hard", 1, [[10, 11]]),
        ]
        assert len(read_recording(logged)) == 56
        assert server.ask(f"{here}/cuts", "DELETE", one)[0] == 200
        status, data, _ = server.ask(f"{here}/cuts", "DELETE", one)
        assert status == 409 and "not there any more" in json.loads(data)["message"]
        for wrong, code in (([], 400), ({"first": 1, "last": "b", "reason": ""}, 400), (one | {"more": ""}, 400),
                            (one | {"first": "../x"}, 409), (one | {"last": names[2]}, 409)):  # fmt: skip
            assert server.ask(f"{here}/cuts", "POST", wrong)[0] == code
        text = f'first image,last image,reason\n{names[10]},{names[10]},"crash, hard"\n'
        assert (logged / "excluded.csv").read_text(encoding="utf-8") == text
        (logged / "excluded.csv").write_text(text + "spoilt\n", encoding="utf-8")
        status, data, _ = server.ask(f"{here}/cuts", "POST", one)
        assert status == 409 and "excluded.csv: line 3: 1 fields where 3" in json.loads(data)["message"]
        assert (logged / "excluded.csv").read_text(encoding="utf-8") == text + "spoilt\n"
        (logged / "excluded.csv").write_text(text, encoding="utf-8")
        assert (logged / "driving_log.csv").read_bytes() == log
        (logged / "driving_log.csv").write_bytes(log[log.index(b"\n") + 1 :])
        status, data, _ = server.ask(f"{here}/rows/0/left.jpg?version={version}")
        assert status == 409 and "has changed since this page read it" in json.loads(data)["message"]
        assert server.get(f"{here}/details")["frames"] == 59
        logged.rename(logged.with_name("elsewhere"))
        for path, method in ((f"{here}/details", "GET"), (f"{here}/rows/0", "GET"), (f"{here}/cuts", "POST")):
            status, data, _ = server.ask(path, method, one if method == "POST" else None)
            assert status == 409 and "driving_log.csv: No such file" in json.loads(data)["message"]
        assert "No such file" in server.get(f"{here}/overview")["message"]
        assert (logged.with_name("elsewhere") / "excluded.csv").read_text(encoding="utf-8") == text


def test_torch_is_not_imported_to_serve():
    code = "import cloning.browse.__main__, sys; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "False\n"


def test_the_command_refuses_what_it_cannot_show(sample_recording, tmp_path, monkeypatch, capsys):
    for arguments, words in (
        ([tmp_path], f"{tmp_path}: no driving_log.csv in or below it"),
        ([sample_recording, "--model", tmp_path / "m.pt"], f"{tmp_path / 'm.pt'}: no such model file"),
    ):
        monkeypatch.setattr(sys, "argv", ["browse", *map(str, arguments), "--port", "0"])
        assert browse.main() == 2 and capsys.readouterr().err.startswith(f"browse: {words}")


# ----------------------------------------------------------------------------------------------------------------------
# The page


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


def placed(folder: Path, offset: np.ndarray) -> None:
    """As if the lane of a recording had been looked at already; offset: float (n,), m."""
    recording, track = read_recording(folder), Track("lake")
    points = track.points[100 : 100 + len(recording), :2].astype(np.float32)
    columns = {"offset": offset.astype(np.float32), "x": points[:, 0], "y": points[:, 1], "road": np.zeros(len(offset))}
    found = {"name": "lake", "direction": "ccw", "outline": track.points[:, :2].tolist()}
    about = {"roads": [found], "longest": 60, "unusable": 0, "first_unusable": []}
    write_result(folder, LANE, stamp(folder, LANE), Result(recording.images[:, 0], columns, about))


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_a_recording_is_watched_and_cut_with_the_keyboard_alone(logged, page):
    offset = np.where(np.arange(60) == 44, -2.5, 0)
    placed(logged, offset)
    names = [center(logged, row) for row in range(60)]
    with browsing(logged) as server:
        page.look(1280, 800)
        page.open(server.base)
        page.wait("document.querySelector('article dl')")
        text = page.text()
        for words in ("60, 0.1 minutes", "lake, counter-clockwise", "30.2 mph", "1 recording, 60 frames"):
            assert words in text
        assert page.run("document.querySelectorAll('article svg .path').length") == 1
        page.press("Tab")
        page.wait("document.activeElement.id == 'home'")
        page.press("Tab")
        page.press("Tab")
        page.press("Enter")
        page.wait("document.querySelectorAll('#plots .uplot').length == 4")
        page.wait("document.querySelector('#where').textContent.endsWith('frame 1 of 60')")

        def at(row: int) -> None:
            page.wait(f"document.querySelector('#where').textContent.endsWith('frame {row + 1} of 60')")

        for key, shift, row in (("ArrowRight", False, 1), ("ArrowRight", True, 16), ("ArrowLeft", True, 1),
                                ("End", False, 59), ("f", False, 44), ("Home", False, 0), ("PageDown", False, 59),
                                ("PageUp", False, 0), ("F", True, 44)):  # fmt: skip
            page.press(key, shift)
            at(row)
        shown = page.run("[...document.querySelectorAll('#plots figcaption')].map(each => each.textContent)")
        steering = read_recording(logged).steering[44]
        assert f"{steering:.3f}" in shown[0] and "30.2 mph" in shown[2] and "-2.50 m" in shown[3]
        left = read_recording(logged).path(44, 1)
        page.until(lambda: difference(page, "left", left) < 3)
        for key in "?", "Escape", "i", "ArrowLeft", "ArrowLeft", "o":
            page.press(key)
        page.wait("document.querySelector('#said').textContent.startsWith('Marked 3 frames')")
        page.press("x")
        page.wait("document.querySelector('#reason[open]')")
        for key in "off":
            page.press(key)
        page.press("Enter")
        page.wait("document.querySelector('#cuts').textContent.includes('3 frames: off')")
        text = f"first image,last image,reason\n{names[42]},{names[44]},off\n"
        assert (logged / "excluded.csv").read_text(encoding="utf-8") == text
        assert page.run("document.querySelector('#strip i').style.left") == "70%"
        page.press("z")
        page.wait("document.querySelector('#cuts').textContent.startsWith('None')")
        assert (logged / "excluded.csv").read_text(encoding="utf-8") == "first image,last image,reason\n"
        at(42)
        page.press(" ")
        page.wait("document.querySelector('#play').textContent == 'Pause'")
        page.wait("document.querySelector('#where').textContent.endsWith('frame 60 of 60')")
        page.wait("document.querySelector('#play').textContent == 'Play'")
        (logged / "driving_log.csv").unlink()
        page.press("r")
        page.wait("document.querySelector('#notice').textContent.includes('driving_log.csv: No such file')")
        assert [entry for entry in page.complaints() if "409" not in entry] == []
        assert all(address.startswith((server.base, "data:")) for address in page.addresses()[1:]), "no outside host"


def difference(page, camera: str, path: Path) -> float:
    """The mean difference between a camera's canvas and an image file, in grey levels."""
    pixels = page.run(
        f"[...document.querySelector('#{camera}').getContext('2d').getImageData(0, 0, 320, 160).data].join()"
    )
    shown = np.array(pixels.split(","), np.uint8).reshape(160, 320, 4)[..., :3]
    return float(np.abs(shown.astype(int) - cv2.imread(str(path))[..., ::-1]).mean())


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
@pytest.mark.parametrize("width, height, dark", [(390, 844, True), (1280, 800, False), (1920, 1080, True)])
def test_the_page_fits_every_screen(served, page, width, height, dark):
    page.look(width, height, dark)
    page.open("about:blank")
    page.open(served.base)
    page.wait("document.querySelectorAll('article dl, article .bad').length == 2")
    fits = "document.documentElement.scrollWidth <= innerWidth"
    assert page.run(fits)
    page.run(f"location.hash = '{served.recordings()['lake sample'].replace('recordings/', '#/').lstrip('/')}/5'")
    page.wait("document.querySelector('#where').textContent.endsWith('frame 6 of 60')")
    assert page.run(fits)
    ink, paper = page.run("[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]")
    level = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in (ink, paper)]
    assert (level[0] > level[1]) == dark and abs(level[0] - level[1]) > 400
