"""What the page of recordings says, in a real Chromium, where something fails, takes long, or is gone."""

import json
import os
import shutil

import numpy as np
import pytest
from browse_process import LATE, asks_why, at, browsing, placed, replayed, steered, written, written_run
from browser import needs_chromium
from test_excluded import center

from cloning.browse.analyses import Analysis
from cloning.recordings.log import read_recording

pytestmark = needs_chromium


@pytest.fixture
def server(linked):
    """A server of the recording `linked`, as if its lane had been analysed already."""
    placed(linked, np.zeros(60))
    with browsing(linked) as server:
        yield server


def test_what_failed_is_tried_again(linked, page, tmp_path, model_file):
    """The road on the list, what is compared, a model's steering, its replay, and what it looks at."""
    model = shutil.copy(model_file, tmp_path / "one.pt")
    (tmp_path / "torch.py").write_text("raise ImportError('no PyTorch today')", encoding="utf-8")
    with browsing(linked, "--model", model, modules=tmp_path) as server:
        page.open(server.base)
        page.wait("document.querySelector('article button')")
        assert "not known, the analysis failed: ImportError: no PyTorch today" in page.text()
        placed(linked, np.zeros(60))
        page.click("article button")
        page.shows("article", "lake, counter-clockwise")
        page.run(f"location.hash = '{server.hash('lake')}'")
        page.shows("#findings", "one.pt failed: ImportError")
        page.open(f"{server.base}#/compare")
        page.wait("document.querySelector('#table [title^=ImportError]')?.innerText == 'failed'")
        page.click("#compare-all")
        page.shows("#compared", "2 analyses to do")
        page.wait("document.querySelectorAll('#table [title^=ImportError]').length == 3")
        page.wait("!document.querySelector('#compare-all').hidden")
        page.open(f"{server.base}{server.hash('lake')}")
        page.shows("#findings", "one.pt failed: ImportError")
        steered(linked, model)
        page.run("document.querySelector('#findings button').focus()")
        page.press("Enter")
        page.shows("#findings", "Every row could be read as it is.")
        page.press("l")
        page.shows("#replay-list", "Failed: ImportError")
        replayed(linked, model, 1.0, np.zeros(60), [])
        page.click("#replay-list button")
        page.wait("document.querySelector('.replayed')")
        width = "document.querySelector('{}').clientWidth"
        assert page.run(f"{width.format('#view-0')} == {width.format('#center')}"), "a single view fills the row"
        page.press("a")
        page.shows("figure:has(#center)", "cannot show what it looks at")
        page.press("ArrowRight")
        at(page, 1)
        page.press("ArrowLeft")
        asked = f"{server.recordings()['lake']}/rows/0/center/0.png"
        page.until(lambda: page.text() and sum(asked in address for address in page.addresses()) == 2)


def test_the_analysis_that_begins_by_itself_can_be_paused(linked, page, tmp_path):
    (tmp_path / "torch.py").write_text("import time\ntime.sleep(600)", encoding="utf-8")
    with browsing(linked, modules=tmp_path) as server:
        page.open(server.base)
        page.shows("article", "road not known yet: 0 % analysed")
        page.click("#analysing button")
        page.shows("article", "road not known yet: paused")
        page.run(f"location.hash = '{server.hash('lake')}'")
        page.shows("#findings", "lateral offset: paused. Go on")
        page.click("#findings button")
        page.shows("#findings", "lateral offset: 0 % analysed. Pause")


def test_the_focus_stays_on_a_recording_while_its_road_is_looked_for(linked, page):
    """Also on its link in a comparison, and on a button of what is found in it."""
    with browsing(linked) as server:
        server.answer("/analyses", "DELETE")
        page.open(server.base)
        page.shows("article", "paused")
        page.run("""n = 0; own = fetch; fetch = async (path, options) => {
            const answer = await own(path, options);
            if (!path.match(/overview|compared|details/)) return answer;
            const lane = {state: 'running', progress: ++n / 1000};
            const models = path.includes('details') ? [] : [{name: 'one.pt', steering: lane, replay: lane}];
            return new Response(JSON.stringify({...await answer.json(), lane, models}));
        }; document.querySelector('article a').focus()""")
        page.shows("article", "1 % analysed")
        assert page.run("document.activeElement.textContent") == "lake"
        page.run("document.querySelector('article input').focus()")
        page.shows("article", "2 % analysed")
        assert page.run("document.activeElement.title") == "Select lake"
        page.run("location.hash = '#/compare'")
        page.shows("#table", "computing")
        page.run("document.querySelector('#table a').focus(); n = 49")
        page.shows("#table", "computing: 5 %")
        assert page.run("document.activeElement.textContent") == "lake"
        page.click("#table a")
        page.shows("#findings", "analysed")
        page.run("document.querySelector('#findings button').focus(); n = 69")
        page.shows("#findings", "7 % analysed")
        assert page.run("document.activeElement.textContent") == "Pause"
        assert (
            page.run("""import('/static/common.js').then(({refill, make}) => {
            refill(tags, [make('button', 'first'), make('button', 'second')]);
            tags.lastChild.focus();
            refill(tags, [make('button', 'first')]);
            return document.activeElement.textContent; })""")
            == "first"
        ), "the last one has been deleted"


def test_a_browser_is_asked_for_a_few_of_thousands_of_recordings_at_a_time(server, page):
    page.open(server.base)
    page.shows("#total", "1 recording")
    page.run("""busy = most = begun = 0; own = fetch; paused = false; fetch = async (path, {method} = {}) => {
        if (path == '/analyses') paused = true;
        else if (!path.startsWith('/recordings')) return own(path);
        if (paused && path.includes('/9/overview')) location.hash = '#/compare';
        begun += method == 'POST';
        most = Math.max(most, ++busy);
        await new Promise(done => setTimeout(done));
        busy -= 1;
        const [, , id] = path.split('/');
        return Response.json(id ? {id, name: id, message: 'spoilt', lane: {state: 'waiting'}}
            : Array.from({length: 200}, (_, id) => ({id, folder: ''})));
    }; 0""")
    for place, shown in (("#/compare", "#table tbody tr"), ("#", "article .bad")):
        page.run(f"most = 0; location.hash = '{place}'")
        page.wait(f"document.querySelectorAll('{shown}').length == 200")
        assert page.run("most") == 6
    page.run("document.querySelector('#analysing button').click()")
    page.wait("!document.querySelector('#comparison').hidden")
    page.run("paused = false; document.querySelector('#compare-all').click(); location.hash = '#'")
    page.shows("#total", "200 recordings")
    page.wait("begun == 200")
    assert page.run("document.querySelectorAll('article').length") == 200, "none of the list that was left"


def test_a_recording_that_was_left_is_forgotten(server, page):
    page.open(server.base)
    listeners = []
    for _ in range(3):
        page.run(f"location.hash = '{server.hash('lake')}'")
        page.wait("document.querySelectorAll('#plots .uplot').length == 4")
        page.drag("#plots .u-over", 0.5, 0.5)
        page.run("location.hash = '#'")
        page.wait("document.querySelector('article .road')")
        page.send("HeapProfiler.collectGarbage")
        listeners.append(page.send("Memory.getDOMCounters")["jsEventListeners"])
    assert listeners[2] - listeners[1] < 20, listeners


def test_what_is_wrong_or_gone_is_told_and_shown_again_once_it_is_mended(server, linked, page):
    cuts, elsewhere = linked / "excluded.csv", linked.with_name("elsewhere")
    cuts.write_text("spoilt\n", encoding="utf-8")
    page.open(server.base)
    page.shows("article .bad", "excluded.csv: line 1")
    once = "if (!path.includes('/overview')) return own(path); fetch = own; failed = true; throw new Error('gone')"
    page.run(f"failed = false; own = fetch; fetch = async path => {{ {once}; }}; 0")
    page.wait("failed")
    page.wait("document.querySelector('#notice').hidden")
    cuts.unlink()
    page.wait("document.querySelector('article .road')")
    page.run("own = fetch; fetch = () => { fetch = own; throw new Error('gone'); }; 0")
    page.shows("#notice", "does not answer")
    page.wait("document.querySelector('#notice').hidden && document.querySelector('article .road')")
    cuts.write_text("spoilt\n", encoding="utf-8")
    page.run(f"location.hash = '{server.hash('lake')}/7'")
    page.shows("#notice", "excluded.csv: line 1")
    assert page.run("document.querySelector('#recording').hidden")
    cuts.unlink()
    at(page, 7)
    page.run("own = fetch; fetch = async path => { if (path.match(/rows.\\d+.v/)) throw path; return own(path); }; 0")
    asks_why(page, "i", "o", "x")
    page.press("Enter")
    page.shows("#notice", "does not answer")
    page.run("fetch = own; 0")
    page.wait("document.querySelector('#notice').hidden")
    linked.rename(elsewhere)
    page.shows("#notice", "driving_log.csv: No such file")
    page.press("End")
    page.shows("figure:has(#center)", "driving_log.csv: No such file")
    elsewhere.rename(linked)
    page.wait("document.querySelector('#notice').hidden")
    page.wait("document.querySelector('#center').parentNode.textContent.trim() == 'Centre'")
    at(page, 59)


def test_an_undo_that_fails_can_be_tried_again_and_what_another_tab_cuts_is_shown_and_undone(server, linked, page):
    """The one before a cut that was deleted elsewhere is undone. A browser tells a tab what another one changes."""
    file, header = linked / "excluded.csv", "first image,last image,reason\n"
    cuts = [f"{center(linked, row)},{center(linked, row)},off\n" for row in (0, 1)]
    page.open(f"{server.base}{server.hash('lake')}")
    for row in range(2):
        at(page, row)
        asks_why(page, *"iox")
        page.run("document.querySelector('#reason-text').value = 'off'")
        page.press("Enter")
        page.wait(f"document.querySelectorAll('#cuts button').length == {2 * row + 2}")
        page.press("ArrowRight")
    assert file.read_text(encoding="utf-8") == header + "".join(cuts)
    file.unlink()
    file.mkdir()
    page.press("z")
    page.shows("#notice", "not a regular file")
    file.rmdir()
    file.write_text(header + "".join(cuts), encoding="utf-8")
    for keys, buttons in (("zz", 0), ("yy", 4)):
        page.press(*keys)
        page.wait(f"document.querySelectorAll('#cuts button').length == {buttons}")
    assert file.read_text(encoding="utf-8") == header + "".join(cuts)
    file.write_text(header + cuts[0], encoding="utf-8")
    page.press("z")
    page.shows("#notice", "it was deleted elsewhere")
    page.press("z")
    page.shows("#cuts", "None")
    assert file.read_text(encoding="utf-8") == header and page.run("document.querySelector('#notice').hidden")
    page.run("element = document.querySelector('#condition'); element.value = 'speed >= 0'; element.oninput()")
    page.wait("document.querySelector('#matches').textContent.includes('frames')")
    left = int(page.run("document.querySelector('#matches').textContent").split()[0])
    cut = {"first": center(linked, 0), "last": center(linked, 1), "reason": "off"}
    file.write_text(f"{','.join(cut.values())}\n", encoding="utf-8")
    key = f"cuts-{server.hash('lake').removeprefix('#/')}"
    kept = {"done": [{"kind": "cuts", "method": "DELETE", "cuts": [cut]}], "undone": []}
    page.run(f"localStorage.setItem('{key}', JSON.stringify({json.dumps(kept)}))")
    page.run(f"dispatchEvent(new StorageEvent('storage', {{key: '{key}'}}))")
    page.shows("#cuts", "2 frames: off")
    page.shows("#matches", f"{left - 2} frames")
    page.press("z")
    page.shows("#cuts", "None")
    page.shows("#matches", f"{left} frames")


def test_a_recording_is_shown_though_a_model_is_trained_anew_meanwhile(linked, page, tmp_path, model_file):
    model = shutil.copy(model_file, tmp_path / "one.pt")
    (tmp_path / "torch.py").write_text("import time\ntime.sleep(600)", encoding="utf-8")
    placed(linked, np.zeros(60))
    steered(linked, model)
    with browsing(linked, "--model", model, modules=tmp_path) as server:
        page.open(server.base)
        page.wait("document.querySelector('article .road')")
        page.run(LATE % "/details")
        page.run(f"location.hash = '{server.hash('lake')}/7?find=model1 < 0'")
        page.wait("late.go")
        os.utime(model, (0, 0))
        page.run("late.go()")
        at(page, 7)
        page.shows("#findings", "one.pt: 0 % analysed")
        page.shows("#matches", "the analysis that tells this column is not done")
        written(linked, Analysis("steering", str(model)), {"steering": np.full(60, -0.3)})
        page.shows("#plots", "one.pt -0.300")
        page.shows("#matches", "60 frames in 1 stretch")
        os.utime(model, (1, 1))
        page.shows("#plots", "one.pt not known")
        written(linked, Analysis("steering", str(model)), {"steering": np.full(60, 0.2)})
        page.shows("#plots", "one.pt 0.200")
        page.shows("#matches", "no frame")


def test_an_address_whose_parts_are_gone_shows_the_rest(linked, page, tmp_path, model_file):
    """Limits, models, runs and recordings that an earlier server had."""
    placed(linked, np.zeros(60))
    written_run(tmp_path, finished=1, images=500)
    (tmp_path / "torch.py").write_text("import time\ntime.sleep(600)", encoding="utf-8")
    with browsing(linked, "--model", model_file, "--run", tmp_path, modules=tmp_path) as server:
        here = server.hash("lake")
        page.open(f"{server.base}{here}/7?limit=7&look=3&mark=x-9")
        at(page, 7)
        page.wait(f"location.hash == '{here}/7'")
        page.run(f"location.hash = '{here}/1.4?mark=9-5&zoom=30-50&look=length'")
        page.wait(f"location.hash == '{here}/1?zoom=30-50&mark=5-9'")
        page.run(f"location.hash = '{here}/-1?zoom=x-5'")
        page.wait(f"location.hash == '{here}/0'")
        assert page.complaints() == []
        page.run("location.hash = '#/run/0?with=0,3'")
        page.wait("document.querySelectorAll('#losses .uplot').length")
        page.run(f"location.hash = '#/compare?limit=7&ids=gone,{here[2:]}'")
        page.shows("#table", "lake")
        page.shows("#notice", "Not here, of the recordings in this address: 1")
        page.click("#compare-all")
        page.shows("#compared", "2 analyses to do")
        page.shows("#table", "computing: 0 %")
        page.run("own = fetch; fetch = () => { fetch = own; throw new Error('gone'); }; 0")
        page.shows("#notice", "does not answer")
        page.wait("document.querySelector('#notice').hidden")


def test_a_frame_that_is_late_is_shown_though_it_was_freed_meanwhile(server, linked, page):
    """As while many others are loaded; an error there would stop all frames in the end."""
    page.open(f"{server.base}{server.hash('lake')}/0")
    at(page, 0)
    page.wait("document.querySelector('#center').parentNode.textContent.trim() == 'Centre'")
    page.run(LATE % "/rows/1/left")
    page.press("ArrowRight")
    page.wait("late.go")
    page.run("import('/static/state.js').then(({page: {open: {frames}}}) => frames.forget(1))")
    page.run("new Promise(done => setTimeout(done, 2000)).then(late.go)")
    frame = read_recording(linked).path(1, 1).read_bytes()
    page.until(lambda: page.difference("left", frame) < 3, 20)
    assert page.complaints() == []


def test_a_comparison_leads_to_what_is_chosen_there(server, page):
    """Not to what an earlier one with the same figures did, and without a model to no replays."""
    page.open(f"{server.base}#/compare?ids={server.hash('lake')[2:]}")
    page.shows("#table", "lake")
    page.run("location.hash = '#'")
    page.wait("!document.querySelector('#list').hidden")
    page.run("location.hash = '#/compare'")
    page.wait("!document.querySelector('#comparison').hidden")
    page.click("#comparing button:last-child")
    page.wait("location.hash == '#/compare?limit=2.5'")
    page.wait("document.querySelector('#table a').hash.endsWith('?limit=2.5')")
    page.click("#table a")
    at(page, 0)
    page.wait("location.hash.endsWith('/0')")
    assert page.run("document.querySelector('#replays').hidden")


def test_a_recording_is_cut_though_the_browser_stores_nothing(server, page):
    denied = "Object.defineProperty(window, 'localStorage', {get() { throw new DOMException('', 'SecurityError'); }})"
    script = page.send("Page.addScriptToEvaluateOnNewDocument", source=denied)
    page.open(f"{server.base}{server.hash('lake')}/7?mark=5-9")
    at(page, 7)
    asks_why(page, "x")
    page.press("Enter")
    page.shows("#said", "Undo takes it back")
    page.press("z")
    page.shows("#cuts", "None")
    page.send("Page.removeScriptToEvaluateOnNewDocument", **script)


def test_nothing_of_a_recording_stays_on_the_page_of_the_next_one(linked, page, tmp_path, model_file):
    """Neither Pause, nor a condition that was typed at the last moment, nor the names of columns."""
    models = [shutil.copy(model_file, tmp_path / name) for name in ("one.pt", "two.pt")]
    other = shutil.copytree(linked, linked.with_name("other"))
    placed(linked, np.zeros(60))
    for model in models:
        steered(other, model)
    names = "[...document.querySelectorAll('#of option')].map(each => each.text).join()"
    with browsing(linked, other, "--model", *models) as server:
        server.answer("/analyses", "DELETE")
        page.open(f"{server.base}{server.hash('lake')}/0")
        page.wait(f"{names} == 'steering,throttle,speed,offset,label'")
        page.press(" ")
        assert page.text("#play") == "Pause"
        page.run("own = setTimeout; setTimeout = (action, ms) => { late = action; setTimeout = own; }; 0")
        page.run("condition.value = 'speed > 1'; condition.oninput()")
        page.run(f"location.hash = '{server.hash('other')}/7'")
        at(page, 7)
        page.wait(f"{names} == 'steering,throttle,speed,model1,model2'")
        assert page.text("#play") == "Play"
        page.run("late()")
        assert page.run("condition.value") == ""


def test_runs_of_as_many_epochs_as_there_may_be_are_drawn(page, tmp_path):
    for name in "ab":
        written_run(tmp_path / name, 20000, images=0, epochs=20000, losses=[0.1] * 20000, drifts=[0.1] * 20000)
    with browsing("--run", tmp_path / "a", tmp_path / "b") as server:
        page.open(f"{server.base}#/run/0?with=1&smooth=0.5")
        page.wait("document.querySelectorAll('#losses canvas').length == 2")


def test_a_late_answer_does_not_take_the_place_of_a_newer_one(server, page):
    """Of what matched before a cut; and of a comparison before its analyses were begun."""
    page.open(f"{server.base}{server.hash('lake')}/7?find=speed > 0&mark=5-9")
    page.shows("#matches", "60 frames")
    page.run(LATE % "/matches")
    page.run("filter.querySelector('input').oninput()")
    page.wait("late.go")
    asks_why(page, "x")
    page.press("Enter")
    page.shows("#matches", "55 frames")
    page.run("late.go(); new Promise(done => setTimeout(done, 3000))")
    assert page.text("#matches") == "55 frames in 2 stretches"
    page.open(server.base)
    page.shows("#total", "1 recording")
    page.run("""late = {}; own = fetch; fetch = async (path, options) => {
        if (!path.includes('/compared')) return own(path, options);
        const isBegun = options.method == 'POST', steering = {state: isBegun ? 'waiting' : 'none'};
        if (!isBegun && !late.go) await new Promise(go => late.go = go);
        const recording = await (await own(path)).json();
        const models = [{name: 'one.pt', error: null, steering, replay: steering}];
        return new Response(JSON.stringify({...recording, models}));
    }; location.hash = '#/compare'""")
    page.wait("late.go")
    page.click("#compare-all")
    page.shows("#compared", "2 analyses to do")
    page.run("fetch = () => new Promise(() => {}); late.go(); new Promise(done => setTimeout(done, 3000))")
    assert page.text("#compared") == "2 analyses to do"
