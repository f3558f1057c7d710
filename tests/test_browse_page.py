"""The page of recordings in a real Chromium, with the keyboard alone and on every screen."""

import cv2
import numpy as np
import pytest
from browse_process import browsing, placed, replayed, steered, written_run
from browser import LOOKS, chromium, needs_chromium
from test_excluded import center

from cloning.recordings.log import read_recording

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def models(model_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for name in ("one.pt", "two.pt"):
        (folder / name).write_bytes(model_file.read_bytes())
    return [folder / "one.pt", folder / "two.pt"]


@pytest.fixture(scope="module")
def served(sample_recording, models, tmp_path_factory):
    """A recording, replayed by two models, and a training run."""
    placed(sample_recording, np.zeros(60))
    run, offset = tmp_path_factory.mktemp("run"), np.linspace(-0.5, 0.5, 60)
    for model in models:
        steered(sample_recording, model)
    replayed(sample_recording, models[0], 1.0, offset, [[30, 1.2], [50, -1.1]])
    replayed(sample_recording, models[1], 1.0, -offset, [[40, -1.3]])
    written_run(run, finished=1, images=500)
    with browsing(sample_recording, "--model", *models, "--run", run) as server:
        yield server


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        page.look(1280, 900)
        yield page


def at(page, row: int) -> None:
    """Wait until the page shows a row."""
    page.shows("#where", f"frame {row + 1} of 60")


def test_a_recording_is_watched_and_cut_with_the_keyboard_alone(linked, page):
    placed(linked, np.where(np.arange(60) == 44, -2.5, 0))
    with browsing(linked) as server:
        page.open(server.base)
        page.wait("document.querySelector('article .road')")
        for words in ("0.1 minutes, 60 frames", "lake, counter-clockwise", "30.2 mph", "1 recording, 60 frames"):
            assert words in page.text()
        assert page.run("document.querySelectorAll('article svg .path').length") == 1
        page.press("Tab")
        page.wait("document.activeElement.id == 'home'")
        while not page.run("document.activeElement.matches('article h2 a')"):
            page.press("Tab")
        page.press("Enter")
        page.wait("document.querySelectorAll('#plots .uplot').length == 4")
        at(page, 0)
        assert page.run("getComputedStyle(document.querySelector('#replaying')).display") == "none", "without a model"
        for key, shift, row in (("ArrowRight", False, 1), ("ArrowRight", True, 16), ("ArrowLeft", True, 1),
                                ("End", False, 59), ("f", False, 44), ("Home", False, 0), ("PageDown", False, 59),
                                ("PageUp", False, 0), ("F", True, 44)):  # fmt: skip
            page.press(key, shift)
            at(page, row)
        shown = page.run("[...document.querySelectorAll('#plots figcaption')].map(each => each.textContent)")
        recording = read_recording(linked)
        assert f"{recording.steering[44]:.3f}" in shown[0] and "30.2 mph" in shown[2] and "-2.50 m" in shown[3]
        page.until(lambda: page.difference("left", recording.path(44, 1).read_bytes()) < 3)
        for key in "?", "Escape", "i", "ArrowLeft", "ArrowLeft", "o":
            page.press(key)
        page.shows("#said", "Marked 3 frames")
        page.press("x")
        page.wait("document.querySelector('#reason[open]')")
        for key in (*"off", "Enter"):
            page.press(key)
        page.shows("#cuts", "3 frames: off")
        header, cuts = "first image,last image,reason\n", linked / "excluded.csv"
        assert cuts.read_text(encoding="utf-8") == f"{header}{center(linked, 42)},{center(linked, 44)},off\n"
        assert page.run("document.querySelector('#stretches i').style.left") == "70%"
        page.press("z")
        page.shows("#cuts", "None")
        assert cuts.read_text(encoding="utf-8") == header
        at(page, 42)
        page.press(" ")
        page.shows("#play", "Pause")
        at(page, 59)
        page.shows("#play", "Play")
        (linked / "driving_log.csv").unlink()
        page.press("r")
        page.shows("#notice", "driving_log.csv: No such file")
        assert [entry for entry in page.complaints() if "409" not in entry] == []
        assert all(address.startswith((server.base, "data:")) for address in page.addresses()), "no outside host"


def test_a_replay_is_watched_with_the_keyboard_alone(served, page, sample_recording):
    """Two models beside the human: what their cars see, where they were set back, and what one looks at."""
    here = served.recordings()["lake sample"]
    page.open(f"{served.base}{served.hash('lake sample')}/0")
    at(page, 0)
    page.press("l")
    page.wait("document.querySelectorAll('#replay-list .where').length == 2")
    for words in ("one.pt at 1 m", "two.pt at 1 m", "90.0 %", "mean 0.25 m", "1.20 m to the right"):
        assert words in page.text()
    for key, row in (("n", 29), ("n", 39), ("n", 49), ("N", 39)):
        page.press(key, key == "N")
        at(page, row)
    page.run("document.querySelectorAll('#replay-list .where button')[1].click()")
    at(page, 49)
    page.shows("#said", "one.pt was 1.10 m to the left")
    page.press("N", shift=True)
    captions = "[...document.querySelectorAll('.replayed figcaption')].map(each => each.textContent).join()"
    page.wait(f"{captions} == 'one.pt at 1 m: 0.16 m to the right,two.pt at 1 m: 0.16 m to the left'")
    seen = served.ask(f"{here}/rows/39/replay-0-1.jpg")[1]
    page.until(lambda: page.difference("view-0", seen) < 3)
    centre = read_recording(sample_recording).path(39).read_bytes()
    page.until(lambda: page.difference("center", centre) < 3)
    page.press("a")
    assert page.run(f"fetch('{here}/rows/39/center/0.png').then(answer => answer.status)") == 200
    page.until(lambda: page.difference("center", centre) > 6)
    page.press("a")
    page.press("a")
    page.until(lambda: page.difference("center", centre) < 3)
    page.press("l")
    page.shows("#replay-list", "at 2.5 m")
    page.press("l")
    page.wait("document.querySelector('#replays').hidden && !document.querySelector('.replayed')")
    assert page.complaints() == []


def test_a_training_run_refreshes_itself(tmp_path, page):
    files = written_run(tmp_path, finished=1, images=500)
    for path in files.pictures.iterdir():
        cv2.imwrite(str(path), np.zeros((1, 1), np.uint8))
    with browsing("--run", tmp_path) as server:
        page.open(server.base)
        page.shows("#runs", "stopped or killed in epoch 2 of 4")
        page.click("#runs a")
        page.wait("document.querySelector('#losses .uplot')")
        assert page.run("document.title").startswith("stopped: ")
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
        assert page.run("document.querySelector('#run-bar').value") == 1
        assert page.run("document.querySelector('#run-read').open"), "after it has refreshed itself"
        assert page.complaints() == []


@pytest.mark.parametrize("width, dark", LOOKS)
def test_the_pages_fit_every_screen_and_bar_nobody(served, page, width, dark):
    page.look(width, 900, dark)
    page.open(served.base)
    for hash, key, condition in (
        ("#", "", "document.querySelector('article .road')"),
        ("#/run/0", "", "document.querySelector('#losses .uplot')"),
        (f"{served.hash('lake sample')}/5", "", "document.querySelector('#where').textContent.includes('frame 6 of')"),
        ("", "l", "document.querySelectorAll('.replayed').length == 2"),
        ("", "?", "document.querySelector('#help[open]')"),
    ):
        if key:
            page.press(key)
        else:
            page.run(f"location.hash = '{hash}'")
        page.wait(condition)
        assert page.fits() and page.has_colours(dark) and page.barriers() == []


def test_the_focus_stays_on_a_button_of_what_is_shown_anew(served, page):
    page.open(served.base)
    page.wait("document.querySelector('article .road')")
    focused = """import('/static/common.js').then(({make, renew}) => {
      const holder = document.body.appendChild(document.createElement('div'));
      const show = name => renew(holder, name, () => [make('button', 'Go'), make('button', name)]);
      show('Stop: 3 %');
      holder.lastChild.focus();
      show('Stop: 4 %');
      return document.activeElement.textContent;
    })"""
    assert page.run(focused) == "Stop: 4 %"


def test_what_failed_is_tried_again(linked, page, tmp_path, models):
    """The road on the list, a model's steering, its replay, and what it looks at."""
    (tmp_path / "torch.py").write_text("raise ImportError('no PyTorch today')", encoding="utf-8")
    with browsing(linked, "--model", models[0], modules=tmp_path) as server:
        page.look(1280, 900)
        page.open(server.base)
        page.wait("document.querySelector('article button')")
        assert "not known, the analysis failed: ImportError: no PyTorch today" in page.text()
        placed(linked, np.zeros(60))
        page.click("article button")
        page.shows("article", "lake, counter-clockwise")
        page.run(f"location.hash = '{server.hash('lake')}'")
        page.shows("#findings", "one.pt failed: ImportError")
        steered(linked, models[0])
        page.run("document.querySelector('#findings button').focus()")
        page.press("Enter")
        page.shows("#findings", "Every row could be read as it is.")
        page.press("l")
        page.shows("#replay-list", "Failed: ImportError")
        replayed(linked, models[0], 1.0, np.zeros(60), [])
        page.click("#replay-list button")
        page.wait("document.querySelector('.replayed')")
        page.press("a")
        page.shows("figure:has(#center)", "cannot show what it looks at")
        page.press("ArrowRight")
        at(page, 1)
        page.press("ArrowLeft")
        asked = f"{server.recordings()['lake']}/rows/0/center/0.png"
        page.until(lambda: page.text() and sum(asked in address for address in page.addresses()) == 2)


def test_what_is_wrong_or_gone_is_told_and_shown_again_once_it_is_mended(linked, page):
    placed(linked, np.zeros(60))
    cuts, elsewhere = linked / "excluded.csv", linked.with_name("elsewhere")
    cuts.write_text("spoilt\n", encoding="utf-8")
    with browsing(linked) as server:
        page.open(server.base)
        page.shows("article .bad", "excluded.csv: line 1")
        cuts.unlink()
        page.wait("document.querySelector('article .road')")
        cuts.write_text("spoilt\n", encoding="utf-8")
        page.run(f"location.hash = '{server.hash('lake')}/7'")
        page.shows("#notice", "excluded.csv: line 1")
        assert page.run("document.querySelector('#recording').hidden")
        cuts.unlink()
        at(page, 7)
        linked.rename(elsewhere)
        page.shows("#notice", "driving_log.csv: No such file")
        page.press("End")
        page.shows("figure:has(#center)", "driving_log.csv: No such file")
        elsewhere.rename(linked)
        page.wait("document.querySelector('#notice').hidden")
        page.wait("document.querySelector('#center').parentNode.textContent.trim() == 'Centre'")
        at(page, 59)
