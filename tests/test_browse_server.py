"""The server of recordings over a real socket: what it tells, what it refuses, and cuts."""

import json
import subprocess
import sys

import numpy as np
import pytest
from browse_process import browsing, placed
from commands import ROOT
from test_excluded import center

from cloning.browse import __main__ as browse
from cloning.recordings.log import read_recording


@pytest.fixture(scope="module")
def served(sample_recording, tmp_path_factory):
    """A server of two recordings, "lake sample" and "spoilt"; they are not to be changed."""
    data = tmp_path_factory.mktemp("served")
    (data / "spoilt").mkdir()
    (data / "spoilt" / "driving_log.csv").write_text("nothing\n", encoding="utf-8")
    (data / "secret.jpg").write_bytes(min((sample_recording / "IMG").iterdir()).read_bytes())
    placed(sample_recording, np.zeros(60))
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


def test_an_analysis_is_tried_again_by_pages_of_this_site(served):
    here = served.recordings()["lake sample"]
    status, data, _ = served.ask(f"{here}/columns/offset", "POST")
    assert status == 200 and json.loads(data)["lane"] == {"state": "ready"}, "what is there stays"
    assert served.ask(f"{here}/columns/steering", "POST")[0] == 404
    assert served.ask(f"{here}/columns/offset", "POST", Origin="http://evil.example")[0] == 403


def test_an_image_that_is_no_frame_is_not_served(linked):
    """A csv may name any file below its IMG/, and that may be a link to anywhere."""
    recording = read_recording(linked)
    for row in range(3):
        recording.path(row).unlink()
    recording.path(0).symlink_to("/etc/passwd")
    recording.path(1).write_bytes(b"GIF89a")
    with browsing(linked) as server:
        here = server.recordings()["lake"]
        for row, words in enumerate(("not a JPEG", "not a JPEG", "No such file")):
            status, data, headers = server.ask(f"{here}/rows/{row}/center.jpg")
            assert status == 409 and words in json.loads(data)["message"] and headers["Cache-Control"] == "no-store"


def test_cuts_over_the_socket(linked):
    """Two pages cut and undo; a wrong request, a changed log and a vanished recording lose nothing."""
    log, names = (linked / "driving_log.csv").read_bytes(), [center(linked, row) for row in range(60)]
    placed(linked, np.zeros(60))
    with browsing(linked) as server:
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
        assert len(read_recording(linked)) == 56
        assert server.ask(f"{here}/cuts", "DELETE", one)[0] == 200
        status, data, _ = server.ask(f"{here}/cuts", "DELETE", one)
        assert status == 409 and "not there any more" in json.loads(data)["message"]
        for wrong, code in (([], 400), ({"first": 1, "last": "b", "reason": ""}, 400), (one | {"more": ""}, 400),
                            (one | {"first": "../x"}, 409), (one | {"last": names[2]}, 409)):  # fmt: skip
            assert server.ask(f"{here}/cuts", "POST", wrong)[0] == code
        text = f'first image,last image,reason\n{names[10]},{names[10]},"crash, hard"\n'
        assert (linked / "excluded.csv").read_text(encoding="utf-8") == text
        (linked / "excluded.csv").write_text(text + "spoilt\n", encoding="utf-8")
        status, data, _ = server.ask(f"{here}/cuts", "POST", one)
        assert status == 409 and "excluded.csv: line 3: 1 fields where 3" in json.loads(data)["message"]
        assert (linked / "excluded.csv").read_text(encoding="utf-8") == text + "spoilt\n"
        (linked / "excluded.csv").write_text(text, encoding="utf-8")
        assert (linked / "driving_log.csv").read_bytes() == log
        (linked / "driving_log.csv").write_bytes(log[log.index(b"\n") + 1 :])
        status, data, _ = server.ask(f"{here}/rows/0/left.jpg?version={version}")
        assert status == 409 and "has changed since this page read it" in json.loads(data)["message"]
        assert server.get(f"{here}/details")["frames"] == 59
        linked.rename(linked.with_name("elsewhere"))
        for path, method in ((f"{here}/details", "GET"), (f"{here}/rows/0", "GET"), (f"{here}/cuts", "POST"),
                             (f"{here}/columns/offset", "POST")):  # fmt: skip
            status, data, _ = server.ask(path, method, one if method == "POST" else None)
            assert status == 409 and "driving_log.csv: No such file" in json.loads(data)["message"]
        assert "No such file" in server.get(f"{here}/overview")["message"]
        assert (linked.with_name("elsewhere") / "excluded.csv").read_text(encoding="utf-8") == text


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
