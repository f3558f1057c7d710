"""The report of a training run: what it contains, and that it needs nothing else."""

import base64
import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from unittest.mock import patch

import av
import numpy as np
import pytest
from browser import LOOKS, needs_chromium
from commands import PICTURE, call_here, log
from matplotlib.figure import Figure
from PIL import Image
from rendered import render_recording
from test_demo import REPORT as LAP

from cloning.base.errors import UserError
from cloning.base.files import csv_bytes
from cloning.base.film import FilmWriter
from cloning.recordings.format import BINS
from cloning.replay.score import YARDSTICKS
from cloning.report import __main__ as command
from cloning.report.content import Report, in_words
from cloning.report.pictures import epochs_chart, film_uri, picture_uri, steering_chart
from model import ROBUST


def report(*arguments) -> subprocess.CompletedProcess:
    return call_here(command.main, "report", *arguments)


@pytest.fixture(scope="module")
def written(finished, sample_recording, tmp_path_factory):
    """The folder of a run with its report, which replays its own recording and shows the run's losses as a lap.

    The recording is too short to know the drift of; it is 0.5 and 0.7 m here.
    """
    folder = shutil.copytree(finished[1], tmp_path_factory.mktemp("report") / "my run")
    epochs = log(folder)
    for row, drift in zip(epochs, ("0.5", "0.7"), strict=True):
        row["val_drift"] = drift
    (folder / "training_log.csv").write_bytes(csv_bytes([epochs[0], *(row.values() for row in epochs)]))
    lap = Path(shutil.copy(folder / "training_loss.png", folder / "The lake.png"))
    lap.with_suffix(".json").write_text(json.dumps(LAP), encoding="utf-8")
    lap.with_suffix(".mp4").write_bytes(b"film")
    done = report(folder, "--held-out", sample_recording, "--lap", lap, folder / "training_loss.png", "--markdown")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{folder / 'report.html'}: open {(folder / 'report.html').as_uri()} in a browser\n"
    return folder


def test_examples_are_named_by_their_own_steering():
    """Who corrects to the right in a bend to the left was said to be in one to the right."""
    words = ["the driver steers to the left", "the driver hardly steers", "the driver steers to the right"]
    assert [in_words(steering) for steering in (-0.52, -0.03, 0.4)] == words


def test_the_report_contains_the_run(written, finished):
    page = (written / "report.html").read_text(encoding="utf-8")
    text = re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL))
    for title in ("my run", "Data", "Recipe", "Network", "Training", "Driving", "What to do next"):
        assert re.search(rf"<h[12]>[^<]*{title}</h[12]>", page), title
    printed = finished[0]
    layers = printed[printed.index("Layer (type)") : printed.index("Total params")].split()
    assert " ".join(layers) in text, "the table of layers that the run printed"
    assert "The best epoch is 1 : it has the least drift, 0.50 m." in text
    assert "Networks like this one stay on the road" in text
    assert "tells best" in text and "tells best" not in Report(finished[1]).page(), "which knows no drift"
    assert "lake sample 60 0 0 0.1 30.2" in text, "the recording's rows, cuts, unusable rows, minutes and mph"
    assert "leaves out 20 % of the rows with less than 0.02" in text and "throttle below 0.25" in text
    assert "lake sample , which it was trained on, it drives with" in text
    assert f"python drive.py &#39;{written / 'model-best.pt'}&#39;" in text and "my run/robust/model.pt" in text
    for driver in ("the network", *YARDSTICKS.values(), "recovery steering"):
        assert text.count(f" {driver} ") >= 2, f"{driver}, at both limits"
    encoded = re.findall(r'class="dark" src="data:image/svg\+xml;base64,([^"]*)', page)
    charts = [base64.b64decode(each).decode() for each in encoded]
    assert page.count('" hidden>') == len(charts), "without styles, as in a mail, each chart is shown once"
    resampled = re.search(r"([\d,]+) observations after resampling", printed)
    assert "of 60 rows, as driven" in charts[0] and resampled and f"of {resampled[1]} for training" in charts[0]
    named = re.findall(r'(?:src|srcset|href)="([^"]*)"', page)
    assert len(named) >= 3 * 2 + 2 + 6 + 4, "three charts twice, examples, augmentations, drive, laps and a film"
    assert all(address.startswith(("data:image/", "data:video/mp4;base64,ZmlsbQ==")) for address in named)
    assert "The lake : 1138 m at 30 mph, never left the road; 0.07 m from the centre line on average" in text
    assert "//" not in re.sub(r'<style>.*?</style>|"data:[^"]*"', "", page, flags=re.DOTALL), "no outside host"
    assert len(page) < 15e6


def test_the_titles_of_the_histograms_stay_in_their_places():
    titles = "of {:,} rows, as driven", "of {:,} for training, resampled"
    with patch.object(Figure, "savefig", autospec=True, side_effect=Figure.savefig) as saved:
        steering_chart(dict.fromkeys(titles, np.full(BINS, 2500)))
    figure = saved.call_args_list[0].args[0]
    left, right = (axes.title.get_window_extent() for axes in figure.axes)
    assert left.x0 > 0 and left.x1 < right.x0 and right.x1 < figure.bbox.x1


def test_the_only_epoch_is_a_whole_number():
    run = {"history": [{"epoch": 1, "val_drift": 0.5}], "best": {"epoch": 1}, "trail": []}
    chart = base64.b64decode(epochs_chart(run, {"val_drift": "drift"}, "m").light.partition(",")[2]).decode()
    assert ">1</text>" in chart and ">0.98</text>" not in chart


def test_a_long_film_is_made_small(tmp_path):
    film, noise = tmp_path / "lap.mp4", np.random.default_rng(0).integers(0, 256, (41, 180, 320, 3), np.uint8)
    writer = FilmWriter(film, 10)
    for frame in noise:
        writer.add(frame)
    writer.close()
    assert base64.b64decode(film_uri(film, 10**7).partition(",")[2]) == film.read_bytes()
    most = film.stat().st_size // 10
    small = base64.b64decode(film_uri(film, most).partition(",")[2])
    with av.open(io.BytesIO(small)) as opened:
        assert (opened.streams.video[0].frames, opened.streams.video[0].average_rate) == (21, 5)
    assert 0.5 * most < len(small) < 1.3 * most
    film.write_bytes(film.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"lap.mp4: not a whole film"):
        film_uri(film, 10)


def test_the_report_is_written_as_markdown(written):
    text = (written / "report.md").read_text(encoding="utf-8")
    assert text.startswith("# A network that learned to drive: my run")
    assert "## Training" in text and "data:" not in text
    assert re.search(r"^\| .*lake sample \| 60 \| 0 \| 0 \|", text, re.MULTILINE)
    assert re.search(r"^\| the network \| -?[\d.]+ % \|", text, re.MULTILINE)
    assert re.search(r"\| limit 1 m \|.*\n\| the network", text)  # no second head in one table
    pictures = re.findall(r"!\[[^]]+\]\((report/\d+\.(?:jpg|png|svg))\)", text)
    assert len(pictures) == len([*(written / "report").iterdir()]) >= 3 + 6 + 2 + 3
    assert all((written / picture).stat().st_size for picture in pictures)


def test_names_are_names_in_markdown_too(tmp_path):
    cells = "<table><tr><th>a|b</th><td>1</td></tr></table>"
    command.write_markdown(f"<main><h1>&lt;b&gt;</h1>{cells}<code>a|b</code></main>", tmp_path / "report.md")
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert r"# \<b\>" in text and r"| a\|b | 1 |" in text and "`a|b`" in text


def test_a_recipe_of_ones_own_is_not_called_the_students(finished, tmp_path):
    shutil.copytree(finished[1], run := tmp_path / "run")
    saved = json.loads((run / "training_arguments.json").read_bytes())
    saved["recipe"]["augmentations"].append("noisy")
    (run / "training_arguments.json").write_text(json.dumps(saved), encoding="utf-8")
    page = Report(run).page()
    assert "own augmentations: noisy" in page and "student" not in page


def test_what_is_missing_is_told_in_a_sentence(written, tmp_path):
    missing = "no training run in this folder yet"
    file = (written / "training_log.csv", "a file; name the folder that")
    for folder, words in ((tmp_path, missing), (tmp_path / "none", missing), file):
        done = report(folder)
        assert done.returncode == 2 and done.stderr.startswith(f"report: {folder}: {words}") and not done.stdout
    copy = shutil.copytree(written, tmp_path / "copy")
    (copy / "report.html").unlink()
    done = report(copy, "--lap", copy / "training_log.csv")
    whole = "not a whole picture, such as a PNG or a JPEG; make it again"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (200, 200, 3), np.uint8)).save(tmp_path / "damaged.png")
    data = bytearray((tmp_path / "damaged.png").read_bytes())
    second = data.index(b"IDAT", data.index(b"IDAT") + 1)
    data[second : second + 4] = b"\0\0\0\0"  # for which Pillow raises SyntaxError
    (tmp_path / "damaged.png").write_bytes(data)
    with pytest.raises(UserError, match=whole):
        picture_uri(tmp_path / "damaged.png")
    assert done.returncode == 2 and done.stderr == f"report: {copy}/training_log.csv: {whole}\n"
    (copy / "The lake.json").write_text("{}", encoding="utf-8")
    done = report(copy, "--lap", copy / "The lake.png")
    assert done.returncode == 2 and f"{copy}/The lake.json: not a report of `simulator drive`" in done.stderr
    arguments = (copy / "training_arguments.json").read_bytes()
    other = json.loads(arguments)
    del other["recipe"]["flip"]
    (copy / "training_arguments.json").write_text(json.dumps(other), encoding="utf-8")
    done = report(copy)
    assert done.returncode == 2 and "'flip'" in done.stderr, "a run of another version"
    assert done.stderr.endswith("train again with this one\n")
    (copy / "training_arguments.json").write_bytes(arguments)
    (copy / "model.pt").unlink()
    (copy / "model-best.pt").unlink()
    done = report(copy)
    assert done.returncode == 2 and f"{copy / 'model.pt'}: no such file" in done.stderr
    assert not (copy / "report.html").exists()


def test_what_cannot_be_shown_is_named_and_recordings_of_the_same_name_are_told_apart(
    written, sample_recording, tmp_path
):
    """One is gone, one spoilt, and one has lost most of its images; a picture of the training is damaged."""
    copy, lossy = shutil.copytree(written, tmp_path / "copy"), tmp_path / "other" / sample_recording.name
    shutil.copytree(sample_recording, lossy)
    for image in sorted((lossy / "IMG").glob("center*"))[10:]:
        image.unlink()
    (lossy.with_name("a spoilt one")).mkdir()
    (lossy.with_name("a spoilt one") / "driving_log.csv").write_text("x", encoding="utf-8")
    arguments = (copy / "training_arguments.json").read_text(encoding="utf-8")
    recordings = json.dumps(["gone/<lake>", str(lossy.parent), str(sample_recording)])
    moved = re.sub(r'"recordings": \[[^]]*\]', f'"recordings": {recordings}', arguments)
    (copy / "training_arguments.json").write_text(moved, encoding="utf-8")
    damaged = sorted((copy / "diagnostic_images").glob("training_generator_*"))[0]
    damaged.write_bytes(damaged.read_bytes()[:100])
    assert not (done := report(copy, "--held-out", lossy)).returncode, done.stderr
    page = (copy / "report.html").read_text(encoding="utf-8")
    assert "other/lake sample: no two seconds of driving without a break to replay" in page
    assert "Not shown: gone/&lt;lake&gt;: no such folder" in page and "No recording was held out" in page
    assert "a spoilt one/driving_log.csv: line 1: neither a row nor a header" in page
    assert f"{damaged.name}: not a whole picture" in page
    assert ">other/lake sample</th><td>10</td><td>0</td><td>50</td>" in page, "rows, cut, unusable"
    assert f">{sample_recording.parent.name}/lake sample</th><td>60</td>" in page


def test_a_recording_is_said_to_be_held_out_only_if_all_that_the_network_learned_from_is_known(
    written, sample_recording, tmp_path, monkeypatch
):
    monkeypatch.setattr("cloning.report.content.LIMITS", (1.0,))  # half of the drives
    monkeypatch.setattr("cloning.report.content.ModelDriver", lambda _: lambda frame: frame.human_steering)
    monkeypatch.setattr("cloning.report.content.plot", lambda *_: PICTURE)
    copy, same = (shutil.copytree(each, tmp_path / each.name) for each in (written, sample_recording))
    other = render_recording(tmp_path / "other", rows=40, seed=1)
    arguments = json.loads((copy / "training_arguments.json").read_bytes())
    unsure = "it may have been trained on"
    for run, words in ({}, "was held out"), ({"from_model": "a.pt"}, unsure), ({"recordings": ["moved"]}, unsure):
        (copy / "training_arguments.json").write_text(json.dumps(arguments | run), encoding="utf-8")
        found = Report(copy)
        found.replay([other])
        assert [each["which"] for each in found.replays] == [words]
    found = Report(written)
    found.replay([same])
    assert [each["which"] for each in found.replays] == ["it was trained on"], "as a copy of it was"


def test_images_of_robust_are_not_said_to_be_the_recorded_and_the_mirrored_ones(written, tmp_path):
    copy = shutil.copytree(written, tmp_path / "run")
    arguments = json.loads((copy / "training_arguments.json").read_bytes())
    (copy / "training_arguments.json").write_text(json.dumps(arguments | {"robust": True, "recipe": ROBUST.saved()}))
    text = " ".join(Report(copy).page().split())
    assert "Of each observation there are one such image, another one (90 % of them), one that is 0.4" in text


def test_the_report_is_of_the_network_whose_figures_it_has(written, tmp_path):
    """The last run of the folder, which may have written another file than model.pt."""
    copy = shutil.copytree(written, tmp_path / "run")
    for name in ("model", "model-best"):
        (copy / f"{name}.pt").rename(copy / f"{name.replace('model', 'robust')}.pt")
    arguments = json.loads((copy / "training_arguments.json").read_bytes())
    arguments["recipe"]["epochs"] += 1  # as if it had been stopped
    (copy / "training_arguments.json").write_text(json.dumps(arguments | {"output": str(copy / "robust.pt")}))
    found = Report(copy)
    assert f"python model.py --resume --output {copy / 'robust.pt'}" in dict(found.next_steps()).values()
    assert found.model == copy / "robust-best.pt"
    assert not any(str(copy / "model.pt") in command for _, command in found.next_steps())


@needs_chromium
def test_the_page_fits_every_screen_bars_nobody_and_asks_for_nothing(written, page):
    printed = set[int]()
    for width, dark in LOOKS:
        page.look(width, 900, dark)
        page.open((written / "report.html").as_uri())
        page.wait("document.readyState == 'complete'")
        page.run("document.querySelector('main b').textContent = '/a_long_name'.repeat(20)")
        page.check_look(width, dark)
        assert page.complaints() == []
        assert page.run("[...document.images].every(image => image.naturalWidth > 100)")
        assert all(address.startswith(("file:", "data:")) for address in page.addresses())
        printed.add(len(page.send("Page.printToPDF")["data"]))
    assert len(printed) == 1, "in dark ink, whatever the system's colours"
