"""The page of recordings in a real Chromium, with the keyboard alone and on every screen."""

import shutil

import numpy as np
import pytest
from browse_process import LATE, asks_why, at, browsing, placed, replayed, steered, written_run
from browser import LOOKS, decoded, needs_chromium
from rendered import render_recording
from test_excluded import center

from cloning.browse import analyse
from cloning.browse.analyses import LANE, stamp, write_result
from cloning.recordings.check import check_images
from cloning.recordings.log import read_recording
from cloning.road.overlay import draw_path

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def models(model_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return [shutil.copy(model_file, folder / name) for name in ("one.pt", "two.pt")]


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


def test_a_recording_is_watched_and_cut_with_the_keyboard_alone(linked, page):
    placed(linked, np.select([np.arange(60) == 44, np.arange(60) == 8], [-2.5, 1.0]))
    with browsing(linked) as server:
        page.open(server.base)
        page.wait("document.querySelector('article .road')")
        assert page.box("article .road img")[2] == pytest.approx(2 * page.box("article .road img")[3], abs=1)
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
        assert page.text("h1 [role=status]") == "/ lake", "a screen reader tells what is open"
        assert page.run("getComputedStyle(document.querySelector('#replaying')).display") == "none", "without a model"
        for key, shift, row in (("ArrowRight", False, 1), ("ArrowRight", True, 16), ("ArrowLeft", True, 1),
                                ("End", False, 59), ("f", False, 44), ("f", False, 8), ("Home", False, 0),
                                ("PageDown", False, 59), ("PageUp", False, 0), ("F", True, 44)):  # fmt: skip
            page.press(key, shift=shift)
            at(page, row)
        captions = "[...document.querySelectorAll('#plots figcaption')].map(each => each.textContent)"
        page.wait(f"{captions}[3].includes(' m')")  # the offset has an answer of its own, which may come last
        shown = page.run(captions)
        recording = read_recording(linked)
        assert f"{recording.steering[44]:.3f}" in shown[0] and "30.2 mph" in shown[2] and "-2.50 m" in shown[3]
        page.until(lambda: page.difference("left", recording.path(44, 1).read_bytes()) < 3)
        page.press("?", "Escape", "i", "ArrowLeft", "ArrowLeft", "o")
        page.shows("#said", "Marked 3 frames")
        asks_why(page, "x")
        page.run(LATE % "/details")
        page.wait("late.go")
        page.press(*"off", "Enter")
        page.shows("#cuts", "3 frames: off")
        page.run("shown = []; new MutationObserver(() => shown.push(cuts.innerText)).observe(cuts, {childList: true})")
        page.run("late.go()")
        page.wait("late.asked > 2")
        assert page.run("shown") == [], "an answer from before the cut is not shown"
        header, cuts = "first image,last image,reason\n", linked / "excluded.csv"
        assert cuts.read_text(encoding="utf-8") == f"{header}{center(linked, 42)},{center(linked, 44)},off\n"
        assert page.run("document.querySelector('#stretches i').style.left") == "70%"
        page.press("z")
        page.shows("#cuts", "None")
        assert cuts.read_text(encoding="utf-8") == header
        at(page, 42)
        asks_why(page, "o", "ArrowRight", "i", "x")
        page.press(*"bend")
        page.run("document.querySelector('#reason [value=tags]').click()")
        page.shows("#tags", "2 frames: bend")
        tags = f"first image,last image,tag\n{center(linked, 42)},{center(linked, 43)},bend\n"
        assert (linked / "tags.csv").read_text(encoding="utf-8") == tags and len(read_recording(linked)) == 60
        assert page.run("document.querySelector('#stretches i.tag').style.left") == "70%"
        page.press("ArrowLeft")
        at(page, 42)
        page.run("seen = []; new MutationObserver(() => seen.push(play.innerText)).observe(play, {childList: true})")
        page.press(" ")
        page.wait("seen.join() == 'Pause,Play'")  # 1.1 s later, which a busy machine may miss
        at(page, 59)
        page.press("Home")
        hidden = "play.click(); for (const until = performance.now() + 2000; performance.now() < until;);"
        page.run(f"{hidden} new Promise(requestAnimationFrame).then(() => play.click())")
        assert int(page.run("scrub.value")) < 20, "the seconds in which nothing was drawn are not skipped"
        assert page.complaints() == []
        assert all(address.startswith((server.base, "data:")) for address in page.addresses()), "no outside host"


def test_a_replay_is_watched_with_the_keyboard_alone(served, page, sample_recording):
    """Two models beside the human: what their cars see, where they were set back, and what one looks at."""
    here = served.recordings()["lake sample"]
    page.open(f"{served.base}{served.hash('lake sample')}/0")
    at(page, 0)
    top = page.run("plots.getBoundingClientRect().top")
    page.press("l")
    page.wait("document.querySelectorAll('#replay-list .interventions').length == 2")
    assert page.run("plots.getBoundingClientRect().top") == top, "the curves stay where they are"
    assert "the lane's centre or driver's path" in page.text("#plots")
    for words in ("one.pt at 1 m", "two.pt at 1 m", "90.0 %", "mean 0.25 m", "1.20 m to the right"):
        assert words in page.text()
    for key, row in (("n", 29), ("n", 39), ("n", 49), ("N", 39)):
        page.press(key, shift=key == "N")
        at(page, row)
    page.run("document.querySelector('#replay-list .unknown button').click()")
    at(page, 7)
    page.shows("#said", "the lane is not known in 5 frames: not driven")
    page.run("document.querySelectorAll('#replay-list .interventions button')[1].click()")
    at(page, 49)
    page.shows("#said", "one.pt was 1.10 m to the left")
    page.press("N", shift=True)
    captions = "[...document.querySelectorAll('.replayed figcaption')].map(each => each.textContent).join()"
    page.wait(f"{captions} == '0.16 m right: one.pt,0.16 m left: two.pt'")
    seen = served.ask(f"{here}/rows/39/replay-0-1.jpg")[1]
    page.until(lambda: page.difference("view-0", seen) < 3)
    centre = read_recording(sample_recording).path(39).read_bytes()
    page.until(lambda: page.difference("center", centre) < 3)
    page.press("a")
    page.shows("figure:has(#center)", "computing what it looks at")
    assert page.run(f"fetch('{here}/rows/39/center/0.png').then(answer => answer.status)") == 200
    page.until(lambda: page.difference("center", centre) > 6)
    page.press("a", "a")
    page.until(lambda: page.difference("center", centre) < 3)
    page.press("l")
    page.shows("#replay-list", "at 2.5 m")
    page.press("l")
    page.wait("document.querySelector('#replays').hidden && !document.querySelector('.replayed')")
    assert "driver's path" not in page.text("#plots")
    assert page.complaints() == []


def now(page, code: str):
    """Evaluate JavaScript about what a recording's page shows."""
    return page.run(f"import('/static/state.js').then(({{page: {{open}}}}) => open.{code})")


CONTROLS = """[...document.querySelectorAll(':is(#comparison th a, button, select, input, summary)')]
    .filter(each => each.offsetHeight && (!document.querySelector('dialog[open]') || each.closest('dialog')))"""


def test_what_one_works_with_is_on_one_screen(served, page, sample_recording):
    """The answer to a key, and all curves with their scales, on a screen with small pixels, too."""
    page.look(1280, 768, scale=2)
    page.open(f"{served.base}{served.hash('lake sample')}/20?limit=1&paths=0")
    page.wait("document.querySelectorAll('.replayed').length == 2")
    needed = "[...document.querySelectorAll('#said, #driven, #where, #scrub, #condition, #plots, #cameras')]"
    assert page.text("#driven") == "one.pt: 90.0 % autonomy, two.pt: 90.0 % autonomy"
    assert max(page.run(f"{needed}.map(each => each.getBoundingClientRect().bottom)")) <= 768
    example = "condition.value = condition.placeholder, condition.scrollWidth <= condition.clientWidth"
    assert page.run(example), "all of a condition is read"
    assert now(page, "plots.plots[3].axes[1]._splits") == [0, -1, 1, -2.5, 2.5], "metres from the lane's centre"
    limit = """document.querySelector('#plots figure:last-child canvas').getContext('2d').getImageData(0, 0, 4000, 999)
        .data.filter((red, at, data) => at % 4 == 0 && red > 150 && data[at + 1] < 75).length"""
    assert page.run(limit) > 500, "dashed lines, though the grid lies over them"
    page.run("import('/static/state.js').then(({page: {open}}) => open.plots.setZoom(40, 59))")
    assert page.fits(), "with the row outside of what the curves show"
    page.press("0")
    assert -0.6 < now(page, "plots.plots[0].scales.y.min") < -0.2, "the steering's own scale"
    assert "one.pt driving 0." in page.text("#plots"), "how the replayed car is steered"
    recording = read_recording(sample_recording)
    frame = recording.path(20).read_bytes()
    page.until(lambda: page.difference("center", frame) < 0.1)
    page.press("p")
    drawn = decoded(frame)
    draw_path(drawn, float(recording.steering[20]), (204, 102, 0))  # BGR of the human's curve
    path = np.abs(drawn.astype(int) - decoded(frame)).max(axis=2) > 60
    page.until(lambda: np.abs(page.canvas("center").astype(int) - drawn)[path].mean() < 40)
    page.send("Emulation.setEmulatedMedia", features=[{"name": "forced-colors", "value": "active"}])
    colour = "getComputedStyle(document.querySelector(each)).backgroundColor"
    colours = page.run(f"['#paths', '#plots i', '#strip'].map(each => {colour})")
    assert colours == [*["rgb(0, 102, 204)"] * 2, "rgb(221, 221, 221)"], "with the system's forced colours, too"
    page.look(390, 844)
    page.wait("innerWidth == 390")
    assert page.run("document.querySelector('#where').getBoundingClientRect().bottom") <= 844
    page.look(320, 844)
    page.wait("innerWidth == 320 && document.documentElement.scrollWidth <= innerWidth")


def test_frames_are_found_cut_together_and_exported(linked, page):
    """By a condition and on the histogram; undoing outlives the page, whose address has all that it shows."""
    placed(linked, np.where(np.arange(60) > 40, 1.5004, 0.0))
    recording = read_recording(linked)
    with browsing(linked) as server:
        page.open(f"{server.base}{server.hash('lake')}/0?find=offset > 1&speed=4&of=offset")
        page.shows("#matches", "19 frames in 1 stretch")
        page.wait("location.hash.includes('of=offset') && of.value == 'offset'")
        page.drag("#histogram .u-over", 0.9, 1.05)
        page.wait("condition.value.endsWith(' <= offset <= 1.51') && matches.innerText.startsWith('19 frames')")
        page.run("of.value = 'steering'; of.onchange()")
        page.wait("!location.hash.includes('of=')")
        page.press("g")
        at(page, 41)
        page.press("/")
        page.run("document.execCommand('selectAll')")
        page.send("Input.insertText", text="(steering > 0.2) or (steering < ")
        assert page.run("document.querySelector('#cut-matches').disabled"), "those of the condition before"
        page.shows("#matches", "not complete")
        wanted = int((np.abs(recording.steering) > 0.2).sum())
        page.send("Input.insertText", text="-0.2)")
        written = page.run("condition.value")
        page.press("Escape")
        page.wait("document.activeElement == document.body")
        assert page.run("condition.value") == written != "", "its matches stay, too"
        page.press("e")
        page.shows("#selection", f"what matches: {wanted} frames")
        page.press("Escape")
        page.shows("#matches", f"{wanted} frames in ")
        page.run("document.activeElement.blur()")
        page.drag("#histogram .u-over", 0.8, 0.99)
        page.shows("#matches", "frame")
        low, high = (float(part) for part in now(page, "condition").split(" and ")[1].split(" <= steering <= "))
        found = (np.abs(recording.steering) > 0.2) & (recording.steering >= low) & (recording.steering <= high)
        page.shows("#matches", f"{found.sum()} frames in ")
        page.run("localStorage.setItem('cuts-others', 'x'.repeat(5 * 2 ** 20 - 11))")  # which is full then
        page.click("#cut-matches")
        page.wait("document.querySelector('#reason[open]')")
        page.press("Enter")
        page.shows("#said", "Undo takes it back")
        assert len(read_recording(linked)) == 60 - found.sum()
        page.shows("#matches", "no frame")
        page.press("e")
        page.shows("#said", "Nothing to export: what matches has no frames")
        page.run("import('/static/state.js').then(({note}) => { home.click(); note() })")
        page.wait("document.querySelector('article h2 a')")
        page.click("article h2 a")
        at(page, 0)
        page.press("z")
        page.shows("#cuts", "None")
        assert len(read_recording(linked)) == 60
        page.press("End")
        page.press("i", *["ArrowLeft"] * 9, "o", ">", "b", " ")
        page.wait("['mark=50-59', 'speed=2', 'loop=1'].every(part => location.hash.includes(part))")
        page.shows("#play", "Pause")
        rows: set[int] = set()
        page.until(lambda: rows.add(now(page, "row")) or {50, 59} <= rows)  # type: ignore[func-returns-value]
        assert min(rows) == 50, "it plays the marked stretch again and again"
        page.press("e")
        page.shows("#selection", "the marked stretch: 10 frames")
        page.run("document.querySelector('#export-name').value = 'end'")
        page.click("#export button[value=recording]")
        page.shows("#said", "Written")
        written = read_recording(linked.with_name("end"))
        assert len(written) == 10 and (written.steering == recording.steering[50:]).all()
        assert written.path(0).samefile(recording.path(50))
        assert [entry for entry in page.complaints() if "condition=" not in entry] == []


def test_curves_are_zoomed_with_wheel_window_and_fingers(served, page):
    page.open(f"{served.base}{served.hash('lake sample')}/30")
    at(page, 30)
    assert page.run("document.querySelector('#window').hidden && document.querySelector('#whole').hidden")
    page.drag("#plots .u-over", 0.25, 0.75)
    page.wait("!document.querySelector('#window').hidden")
    low, high = now(page, "plots.zoom")
    assert (low, high) == (pytest.approx(14.75, abs=1), pytest.approx(44.25, abs=1))
    page.shows("#zoomed", "The curves show 0:01.0 to 0:02.9")
    clock = "import('/static/common.js').then(({clock}) => [0.04, 59.94, 59.96, 3599.96].map(clock).join())"
    assert page.run(clock) == "0:00.0,0:59.9,1:00.0,60:00.0"
    page.wheel("#plots .u-over", -200)
    page.until(lambda: now(page, "plots.zoom[1]") < high - 3)
    first = now(page, "plots.zoom[0]")
    page.drag("#window", 0.5, 0.8)
    page.until(lambda: now(page, "plots.zoom[0]") > first + 3)
    page.wait("location.hash.includes('zoom=')")
    page.open(page.run("location.href"))
    at(page, 30)
    assert not page.run("document.querySelector('#window').hidden"), "it is in the address"
    page.press("0")
    page.wait("document.querySelector('#window').hidden")
    page.press("i", "ArrowRight", "ArrowRight", "o")
    page.drag("#stretches .mark b:last-child", 0.5, 20)
    page.until(lambda: now(page, "marks.last") > 35)
    assert now(page, "marks.first") == 30
    page.swipe("#plots .u-over", (0.4, 0.2), (0.6, 0.8))
    low, high = now(page, "plots.zoom")
    assert high - low == pytest.approx(59 / 3, rel=0.1), "two fingers"
    page.swipe("#histogram .u-over", (0.5, 0.9))
    page.shows("#matches", "frames in ")
    page.swipe("#histogram .u-over", (0.1, 0.4), last="touchCancel")
    page.wait("document.querySelector('#histogram .u-select').style.width == '0px'")
    page.drag("#strip", 0.25, 0.25, button="right")
    assert now(page, "plots.zoom") == [low, high], "a menu is asked for"
    page.run("document.querySelector('#plots').dispatchEvent(new PointerEvent('pointerdown', {button: 2}))")
    assert not now(page, "plots.held"), "the curves are drawn again, though no release was heard of"
    assert page.complaints() == []


def test_recordings_are_searched_sorted_and_compared(served, page, linked, models, sample_recording, tmp_path):
    """A recording of one frame, one without images and one that cannot be read beside a whole one."""
    placed(linked, np.linspace(0, 1.5, 60))
    render_recording(tmp_path / "data/one", rows=1)
    for name in ("gone", "spoilt"):
        (tmp_path / "data" / name / "IMG").mkdir(parents=True)
    log = (linked / "driving_log.csv").read_text(encoding="utf-8")
    (tmp_path / "data/gone/driving_log.csv").write_text(log, encoding="utf-8")
    gone = check_images(read_recording(tmp_path / "data/gone"), show_progress=False)
    write_result(gone.folder, LANE, stamp(gone.folder, LANE), analyse.lane(gone))  # else it takes seconds
    (tmp_path / "data/spoilt/driving_log.csv").write_text("x" * 300, encoding="utf-8")
    with browsing(linked.parent, "--run", tmp_path) as server:
        page.look(320, 844)  # 1280 px at 400 %
        page.open(server.base)
        page.shows("#total", "4 recordings, 121 frames")
        page.shows("#runs", "no training run in this folder yet")
        page.run("own = history.replaceState; history.replaceState = () => { throw new Error('too many') }; 0")
        page.run("document.querySelector('#query').oninput()")  # as the answers do, which change no address
        page.run("history.replaceState = own; 0")
        page.wait("document.querySelector('article img').naturalWidth == 320")
        assert any("center.jpg?version=" in each for each in page.addresses()), "of this log, not of one before it"
        page.until(lambda: "60 rows refused" in page.text("#cards") and "IndexError" not in page.text(), 90)
        assert page.fits() and page.barriers() == [], "an error with a long word"
        shown = "[...document.querySelectorAll('#cards article:not([hidden]) h2')].map(each => each.textContent).join()"
        assert page.run(shown) == "gone,lake,one,spoilt"
        assert " 0 rows" not in page.text("#cards").replace("\n", " "), "what is zero is not told"
        searches = [("counter-clockwise", "name", "lake"), ("frames > 50 minutes>0", "offset", "lake,gone")]
        searches += [("", "findings", "spoilt,gone,lake,one"), ("refused>0", "name", "gone")]
        for query, sort, names in searches:
            page.run(f"document.querySelector('#sort').value = '{sort}'")
            page.run(f"document.querySelector('#query').value = '{query}'; document.querySelector('#query').oninput()")
            assert page.run(shown) == names
        assert page.run("location.hash") == "#?find=refused%3E0"
        page.click("#cards article:not([hidden]) h2 a")
        page.shows("#where", "frame 1 of 60")
        page.press("Escape")
        page.wait(f"location.hash == '#?find=refused%3E0' && {shown} == 'gone'")
        page.wait("document.activeElement.textContent == 'gone'")
        page.open(f"{server.base}#?select={server.hash('spoilt')[2:]}")  # which cannot be exported
        page.shows("#total", "4 recordings, 121 frames")
        for name in ("lake", "one"):
            page.click(f"[aria-label='Select {name}']")
        page.wait("location.hash.includes('select=')")
        page.click("#merge")
        page.shows("#selection", "2 recordings as one: 61 frames")
        named = "document.getElementById(each.getAttribute('aria-labelledby'))?.textContent.split(' ')[0]"
        assert page.run(f"[...document.querySelectorAll('dialog')].map(each => {named}).join()") == "Cut,Export,Keys"
        assert page.barriers() == []
        page.run("document.querySelector('#export-name').value = 'both'")
        page.click("#export [value=recording]")
        page.shows("#merged", "both. The list has it. one is put 1 day later")
        page.shows("#total", "5 recordings, 182 frames")
        assert len(read_recording(linked.with_name("both"))) == 61
        page.run(f"location.hash = '{server.hash('lake')}/0?mark=0-0'")
        page.wait("document.querySelector('#stretches .mark')")
        asks_why(page, "x")
        page.run(f"location.hash = '{server.hash('one')}/0?mark=0-0'")
        page.shows("#where", "frame 1 of 1")
        page.wait("document.querySelector('#stretches .mark')")
        assert not page.run("document.querySelector('#reason').open"), "it would cut this recording"
        assert now(page, "plots.plots[3].axes[0]._splits.length") == 1, "no axis of a hundred NaN:NaN"
        (tmp_path / "data/one/driving_log.csv").write_text((log.splitlines()[0] + "\n") * 2, encoding="utf-8")
        page.shows("#notice", "press R to read it again")
        page.wait("!location.hash.includes('mark')")
        assert not page.run("document.querySelector('#stretches .mark')"), "it was of other rows"
        page.press("r")
        page.shows("#where", "frame 1 of 2")
        assert page.run("document.querySelector('#notice').hidden")
    page.look(1280, 900)
    page.open(f"{served.base}#/compare?limit=1")
    page.wait("document.querySelectorAll('#table td').length > 5")
    difference = 0.1 - read_recording(sample_recording).steering
    page.run("document.querySelector('#table a').textContent = 'lake_'.repeat(40)")
    assert page.box("#table td")[0] < 600, "the figures are beside a long name, not below it"
    for words in ("one.pt", "two.pt", "90.0 %", "0.25 m", f"{np.sqrt(np.mean(difference**2)):.3f}", "lake"):
        assert words in page.text("#table")


@pytest.mark.parametrize("width, dark", LOOKS)
def test_the_pages_fit_every_screen_and_bar_nobody(served, page, width, dark):
    """And every control has a tooltip, and is large enough for a thumb."""
    page.look(width, 900, dark)
    page.open(served.base)
    for hash, key, condition in (
        ("#", "", "document.querySelector('article .road')"),
        ("#/run/0?smooth=0.9", "", "document.querySelector('#losses .smoothed')"),
        ("#/compare", "", "document.querySelector('#table td')"),
        (f"{served.hash('lake sample')}/5", "", "document.querySelector('#where').textContent.includes('frame 6 of')"),
        ("", "l", "document.querySelectorAll('.replayed').length == 2"),
        ("", "?", "document.querySelector('#help[open]')"),
    ):
        if key:
            page.press(key)
        else:
            page.run(f"location.hash = '{hash}'")
        page.wait(condition)
        page.check_look(width, dark)
        text = "map(each => `${each.tagName} ${each.id} ${each.textContent}`)"
        assert page.run(f"{CONTROLS}.filter(each => !each.title && !each.matches('a')).{text}") == []
        assert width > 600 or page.run(f"{CONTROLS}.filter(each => each.offsetHeight < 44).{text}") == []
    names = "document.querySelectorAll('#title, #attention button, #plots figcaption > span')"
    page.run(f"{names}.forEach(each => each.textContent = 'a_long_name_'.repeat(9))")
    assert page.fits() and page.run("(({scrollWidth: all, clientWidth: room}) => all <= room)(window['help-button'])")
