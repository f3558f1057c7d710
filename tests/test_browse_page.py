"""The page of recordings in a real Chromium, with the keyboard alone and on every screen."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from browse_process import browsing, placed, replayed, steered, written_run
from browser import CHROMIUM, chromium
from test_excluded import center

from cloning.recordings.log import read_recording


@pytest.fixture(scope="module")
def served(sample_recording, model_file, tmp_path_factory):
    """A recording, replayed by two models, and a training run."""
    placed(sample_recording, np.zeros(60))
    run = tmp_path_factory.mktemp("run")
    models = [run / "one.pt", run / "two.pt"]
    for model in models:
        model.write_bytes(model_file.read_bytes())
        steered(sample_recording, model)
        replayed(sample_recording, model, 1.0, np.linspace(-0.5, 0.5, 60), [[30, 1.2], [50, -1.1]])
    written_run(run, finished=1, images=500)
    with browsing(sample_recording, "--model", *models, "--run", run) as server:
        yield server


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_a_recording_is_watched_and_cut_with_the_keyboard_alone(linked, page):
    offset = np.where(np.arange(60) == 44, -2.5, 0)
    placed(linked, offset)
    names = [center(linked, row) for row in range(60)]
    with browsing(linked) as server:
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

        assert page.run("getComputedStyle(document.querySelector('#replaying')).display") == "none", "without a model"
        for key, shift, row in (("ArrowRight", False, 1), ("ArrowRight", True, 16), ("ArrowLeft", True, 1),
                                ("End", False, 59), ("f", False, 44), ("Home", False, 0), ("PageDown", False, 59),
                                ("PageUp", False, 0), ("F", True, 44)):  # fmt: skip
            page.press(key, shift)
            at(row)
        shown = page.run("[...document.querySelectorAll('#plots figcaption')].map(each => each.textContent)")
        steering = read_recording(linked).steering[44]
        assert f"{steering:.3f}" in shown[0] and "30.2 mph" in shown[2] and "-2.50 m" in shown[3]
        left = read_recording(linked).path(44, 1)
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
        assert (linked / "excluded.csv").read_text(encoding="utf-8") == text
        assert page.run("document.querySelector('#strip i').style.left") == "70%"
        page.press("z")
        page.wait("document.querySelector('#cuts').textContent.startsWith('None')")
        assert (linked / "excluded.csv").read_text(encoding="utf-8") == "first image,last image,reason\n"
        at(42)
        page.press(" ")
        page.wait("document.querySelector('#play').textContent == 'Pause'")
        page.wait("document.querySelector('#where').textContent.endsWith('frame 60 of 60')")
        page.wait("document.querySelector('#play').textContent == 'Play'")
        (linked / "driving_log.csv").unlink()
        page.press("r")
        page.wait("document.querySelector('#notice').textContent.includes('driving_log.csv: No such file')")
        assert [entry for entry in page.complaints() if "409" not in entry] == []
        assert all(address.startswith((server.base, "data:")) for address in page.addresses()), "no outside host"


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_a_replay_is_watched_with_the_keyboard_alone(linked, page, model_file):
    """Two models beside the human: what their cars see, where they were set back, and what one looks at."""
    placed(linked, np.zeros(60))
    other = model_file.with_name("other.pt")
    other.write_bytes(model_file.read_bytes())
    offset = np.linspace(-0.5, 0.5, 60)
    replayed(linked, model_file, 1.0, offset, [[30, 1.2], [50, -1.1]])
    replayed(linked, other, 1.0, -offset, [[40, -1.3]])
    with browsing(linked, "--model", model_file, other) as server:
        page.look(1280, 800)
        page.open(f"{server.base}{server.hash('lake')}/0")
        page.wait("document.querySelector('#where')?.textContent.endsWith('frame 1 of 60')")
        page.press("l")
        page.wait("document.querySelectorAll('#replay-list .where').length == 2")
        for words in ("model.pt at 1 m", "other.pt at 1 m", "90.0 %", "mean 0.25 m", "1.20 m to the right"):
            assert words in page.text()
        for key, row in (("n", 30), ("n", 40), ("n", 50), ("N", 40)):
            page.press(key, key == "N")
            page.wait(f"document.querySelector('#where').textContent.endsWith('frame {row + 1} of 60')")
        page.run("document.querySelectorAll('#replay-list .where button')[1].click()")
        page.wait("document.querySelector('#where').textContent.endsWith('frame 51 of 60')")
        page.wait("document.querySelector('#said').textContent.includes('model.pt was 1.10 m to the left')")
        page.press("N", shift=True)
        captions = "[...document.querySelectorAll('.replayed figcaption')].map(each => each.textContent).join()"
        page.wait(f"{captions} == 'model.pt at 1 m: 0.18 m to the right,other.pt at 1 m: 0.18 m to the left'")
        seen = server.ask(f"{server.recordings()['lake']}/rows/40/replay-0-1.jpg")[1]
        view = model_file.with_name("view.jpg")
        view.write_bytes(seen)
        page.until(lambda: difference(page, "view-0", view) < 3)
        centre = read_recording(linked).path(40)
        page.until(lambda: difference(page, "center", centre) < 3)
        here = server.recordings()["lake"]
        page.press("a")
        assert page.run(f"fetch('{here}/rows/40/center/0.png').then(answer => answer.status)") == 200
        page.until(lambda: difference(page, "center", centre) > 6)
        page.press("a")
        page.press("a")
        page.until(lambda: difference(page, "center", centre) < 3)
        page.press("l")
        page.wait("document.querySelector('#replay-list').textContent.includes('at 2.5 m')")
        page.press("l")
        page.wait("document.querySelector('#replays').hidden && !document.querySelector('.replayed')")
        assert page.complaints() == []


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_a_training_run_refreshes_itself(tmp_path, page):
    files = written_run(tmp_path, finished=1, images=500)
    picture = cv2.imencode(".png", np.zeros((40, 60, 3), np.uint8))[1].tobytes()
    for path in files.pictures.iterdir():
        path.write_bytes(picture)
    with browsing("--run", tmp_path) as server:
        page.look(390, 844)
        page.open(server.base)
        page.wait("document.querySelector('#runs')?.textContent.includes('stopped or killed in epoch 2 of 4')")
        page.run("document.querySelector('#runs a').click()")
        page.wait("document.querySelector('#losses .uplot')")
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
        which = "document.querySelector('#run-which').textContent"
        page.wait(f"{which}.startsWith('after 1,200 observations')")
        page.press("ArrowLeft")
        page.wait(f"{which}.startsWith('after 0 observations')")
        page.run("document.querySelector('#run-read summary').focus()")
        page.press("Enter")
        page.wait("document.querySelector('#run-read').open")
        assert "It reads 1 recording\nlake" in page.text()
        page.wait("document.querySelector('#run-pictures img').naturalWidth == 60")
        files.progress.write_text(
            files.progress.read_text(encoding="utf-8").replace('"finished": 1', '"finished": 4'), encoding="utf-8"
        )
        page.wait("document.querySelector('#run-figures').textContent.includes('finished: 4 epochs')")
        assert page.run("document.querySelector('#run-bar').value") == 1
        assert page.run("document.querySelector('#run-read').open"), "after it has refreshed itself"
        assert page.complaints() == []


def difference(page, camera: str, path: Path) -> float:
    """The mean difference between a camera's canvas and an image file, in grey levels."""
    pixels = page.run(
        f"[...document.querySelector('#{camera}').getContext('2d').getImageData(0, 0, 320, 160).data].join()"
    )
    shown = np.array(pixels.split(","), np.uint8).reshape(160, 320, 4)[..., :3]
    return float(np.abs(shown.astype(int) - cv2.imread(str(path))[..., ::-1]).mean())


LOOKS = [(width, dark) for width in (390, 1280, 2200) for dark in (False, True)]


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
@pytest.mark.parametrize("width, dark", LOOKS)
def test_the_pages_fit_every_screen_and_bar_nobody(served, page, width, dark):
    page.look(width, 900, dark)
    page.open(served.base)
    page.wait("document.querySelector('article dl')")
    ink, paper = page.run("[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]")
    level = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in (ink, paper)]
    assert (level[0] > level[1]) == dark and abs(level[0] - level[1]) > 400

    def check() -> None:
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
        assert page.barriers() == []

    check()
    page.run("location.hash = '#/run/0'")
    page.wait("document.querySelector('#losses .uplot')")
    check()
    page.run(f"location.hash = '{served.hash('lake sample')}/5'")
    page.wait("document.querySelector('#where').textContent.endsWith('frame 6 of 60')")
    check()
    page.press("l")
    page.wait("document.querySelectorAll('.replayed').length == 2")
    check()
    page.press("?")
    page.wait("document.querySelector('#help[open]')")
    check()


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_the_focus_stays_on_a_button_of_what_is_shown_anew(served, page):
    page.open(served.base)
    page.wait("document.querySelector('article dl')")
    focused = """import('/static/common.js').then(({make, renew}) => {
      const place = document.body.appendChild(document.createElement('div'));
      const show = name => renew(place, name, () => [make('button', 'Go'), make('button', name)]);
      show('Stop: 3 %');
      place.lastChild.focus();
      show('Stop: 4 %');
      return document.activeElement.textContent;
    })"""
    assert page.run(focused) == "Stop: 4 %"


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_what_failed_is_tried_again(linked, page, tmp_path, model_file):
    """The road on the list, a model's steering, its replay, and what it looks at."""
    (tmp_path / "torch.py").write_text("raise ImportError('no PyTorch today')", encoding="utf-8")
    with browsing(linked, "--model", model_file, modules=tmp_path) as server:
        page.look(1280, 900)
        page.open(server.base)
        page.wait("document.querySelector('article button')")
        assert "not known, the analysis failed: ImportError: no PyTorch today" in page.text()
        placed(linked, np.zeros(60))
        page.run("document.querySelector('article button').click()")
        page.wait("document.querySelector('article dl').textContent.includes('lake, counter-clockwise')")
        page.run(f"location.hash = '{server.hash('lake')}'")
        page.wait("document.querySelector('#findings').textContent.includes('model.pt failed: ImportError')")
        steered(linked, model_file)
        page.run("document.querySelector('#findings button').focus()")
        page.press("Enter")
        page.wait("document.querySelector('#findings').textContent == 'Every row could be read as it is.'")
        page.press("l")
        page.wait("document.querySelector('#replay-list').textContent.includes('Failed: ImportError')")
        replayed(linked, model_file, 1.0, np.zeros(60), [])
        page.run("document.querySelector('#replay-list button').click()")
        page.wait("document.querySelector('.replayed')")
        page.press("a")
        caption = "document.querySelector('#center').parentNode.lastElementChild.textContent"
        page.wait(f"{caption}.includes('cannot show what it looks at')")
        page.press("ArrowRight")
        page.wait("document.querySelector('#where').textContent.endsWith('frame 2 of 60')")
        page.press("ArrowLeft")
        asked = f"{server.recordings()['lake']}/rows/0/center/0.png"
        page.until(lambda: page.text() and sum(asked in address for address in page.addresses()) == 2)


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_what_is_wrong_or_gone_is_told_and_shown_again_once_it_is_mended(linked, page):
    placed(linked, np.zeros(60))
    cuts, elsewhere = linked / "excluded.csv", linked.with_name("elsewhere")
    cuts.write_text("spoilt\n", encoding="utf-8")
    notice, where = "document.querySelector('#notice').textContent", "document.querySelector('#where').textContent"
    with browsing(linked) as server:
        page.look(1280, 900)
        page.open(server.base)
        page.wait("document.querySelector('article .bad')?.textContent.includes('excluded.csv: line 1')")
        cuts.unlink()
        page.wait("document.querySelector('article dl')")
        cuts.write_text("spoilt\n", encoding="utf-8")
        page.run(f"location.hash = '{server.hash('lake')}/7'")
        page.wait(f"{notice}.includes('excluded.csv: line 1') && document.querySelector('#recording').hidden")
        cuts.unlink()
        page.wait(f"!{notice} && {where}.endsWith('frame 8 of 60')")
        linked.rename(elsewhere)
        page.wait(f"{notice}.includes('driving_log.csv: No such file')")
        page.press("End")
        caption = "document.querySelector('#center').parentNode.lastElementChild.textContent"
        page.wait(f"{caption}.includes('driving_log.csv: No such file')")
        elsewhere.rename(linked)
        page.wait(f"!{notice} && {caption} == 'Centre' && {where}.endsWith('frame 60 of 60')")
