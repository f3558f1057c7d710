"""excluded.csv: which rows a cut leaves out, what every reader says of it, and that cuts are never lost."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from commands import TINY, python, trained

from cloning.base.errors import RecordingError
from cloning.browse.library import Library
from cloning.recordings import excluded
from cloning.recordings.excluded import MAX_REASON, Cut, add_cuts, delete_cuts, one_line, read_cuts
from cloning.recordings.log import print_findings, read_recording, read_uncut
from cloning.replay.replay import load_recording

HEADER = "first image,last image,reason\n"


def center(recording: Path, row: int) -> str:
    """The centre image of a row, from the log itself."""
    line = (recording / "driving_log.csv").read_text(encoding="utf-8").splitlines()[row]
    return line.split(",")[0].rpartition("/")[2]


def exclude(recording: Path, *stretches: tuple[int, int, str]) -> Path:
    lines = [f"{center(recording, first)},{center(recording, last)},{reason}\n" for first, last, reason in stretches]
    (recording / "excluded.csv").write_text(HEADER + "".join(lines), encoding="utf-8")
    return recording


def test_a_cut_leaves_out_its_rows_and_no_others(linked):
    whole = read_recording(linked)
    left = read_recording(exclude(linked, (10, 19, "off the road"), (15, 24, "overlaps"), (59, 59, "")))
    kept = [*range(10), *range(25, 59)]
    np.testing.assert_array_equal(left.lines, whole.lines[kept])
    np.testing.assert_array_equal(left.steering, whole.steering[kept])
    assert [rows for _, rows in left.cuts] == [10, 5, 1], "no row is counted twice"
    assert len(read_uncut(linked)) == 60 and left.rows_read == 60 and left.rejected == []


def test_copies_of_a_cut_row_are_cut_with_it(linked):
    log = linked / "driving_log.csv"
    lines = log.read_text(encoding="utf-8").splitlines(keepends=True)
    log.write_text("".join(lines[:5] + lines[2:4] + lines[5:] + lines[2:4]), encoding="utf-8")
    left = read_recording(exclude(linked, (2, 2, "")))
    assert len(left) == 61 and left.cuts[0][1] == 3
    names = {left.name(row) for row in range(len(left))}
    assert center(linked, 2) not in names and center(linked, 3) in names


def test_without_time_stamps_a_stretch_ends_at_the_next_row_with_its_last_image(tmp_path):
    """Copies at the end of a log, as oversampling makes them, do not stretch a cut to there."""
    order = [0, 1, 2, 3, 4, 5, 3, 0]
    rows = "".join(f"center{n}.jpg,left{n}.jpg,right{n}.jpg,0.{n + 1},0.5,0,20\n" for n in order)
    (tmp_path / "driving_log.csv").write_text(rows, encoding="utf-8")
    (tmp_path / "excluded.csv").write_text("center2.jpg,center3.jpg,\n", encoding="utf-8")
    left = read_recording(tmp_path)
    assert [left.name(row) for row in range(len(left))] == [f"center{n}.jpg" for n in (0, 1, 4, 5, 0)]


def test_every_command_honours_and_counts_cuts(copied, capsys):
    exclude(copied, (10, 19, "off the \x1b[2Jroad"), (30, 30, ""))
    print_findings(read_recording(copied))
    first, last = center(copied, 10), center(copied, 19)
    file = copied / "excluded.csv"
    printed = [
        f"{file}: line 2: 10 rows are left out, from {first} to {last}: off the \\x1b[2Jroad",
        f"{file}: line 3: 1 row is left out, from {center(copied, 30)} to {center(copied, 30)}: no reason given",
    ]
    assert capsys.readouterr().out.splitlines() == printed
    told = trained(copied, *TINY, "--output", copied.parent / "model.pt", "--strict")
    assert all(line in told for line in printed)
    row = next(line for line in told.splitlines() if line.startswith("total"))
    assert row.split() == ["total", "60", "11", "0", "5", "44"], "read, excluded, unusable, little throttle, kept"
    assert len(load_recording(copied)) == 49 and printed[0] in capsys.readouterr().out, "replays too"


@pytest.mark.parametrize(
    "text, words",
    [
        ("center_1.jpg,{b},\n", "line 2: center_1.jpg is not the centre image of a usable row"),
        ("{b},nowhere.jpg,\n", "line 2: nowhere.jpg is not"),
        ("{b},{a},\n", "line 2: {a} comes before {b} in the recording; exchange the two"),
        ("{a},{b}\n", "line 2: 2 fields where 3 are expected: first image,last image,reason"),
        ("{a};{b};off\n", "line 2: 1 fields"),
        ("\n{a},{b},off, and on\n", "line 3: 4 fields .* put a reason that has commas in double quotes"),
        ('{a},{b},"off\n', "line 2: unexpected end of data; a line is first image,last image,reason"),
        ("{left},{b},\n", "line 2: {left} is not the centre image"),
    ],
)
def test_a_wrong_line_is_named_with_the_remedy(linked, text, words):
    names = {"a": center(linked, 3), "b": center(linked, 7), "left": center(linked, 3).replace("center", "left")}
    (linked / "excluded.csv").write_text(HEADER + text.format(**names), encoding="utf-8")
    with pytest.raises(RecordingError, match=words.format(**names)) as error:
        read_recording(linked)
    assert str(error.value).startswith(str(linked / "excluded.csv"))
    before = (linked / "excluded.csv").read_bytes()
    if "fields" in words or "end of data" in words:
        with pytest.raises(RecordingError):
            add_cuts(linked, Cut(names["a"], names["b"], "more"))
    assert (linked / "excluded.csv").read_bytes() == before


def test_a_tag_of_rows_that_are_gone_is_named_in_its_own_file(linked):
    (linked / "tags.csv").write_text("first image,last image,tag\nnone.jpg,none.jpg,bend\n", encoding="utf-8")
    with closing(Library([linked], [])) as shown, pytest.raises(RecordingError, match=r"tags\.csv: line 2: none\.jpg"):
        shown[next(iter(shown.recordings))].details()


def test_a_file_that_is_no_text_and_one_that_leaves_nothing(linked):
    exclude(linked, (0, 59, "all"))
    with pytest.raises(RecordingError, match=r"excluded.csv: leaves out every row of driving_log.csv; delete a line"):
        read_recording(linked)
    (linked / "excluded.csv").write_text(HEADER, encoding="utf-16")
    with pytest.raises(RecordingError, match=r"excluded.csv: line 1: not a text in UTF-8; save it as CSV in UTF-8"):
        read_recording(linked)
    (linked / "excluded.csv").unlink()
    (linked / "excluded.csv").mkdir()
    with pytest.raises(RecordingError, match=r"excluded.csv: not a regular file; make it a readable file"):
        read_recording(linked)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes among files")
def test_a_named_pipe_is_refused_and_not_waited_for(linked):
    (linked / "driving_log.csv").unlink()
    os.mkfifo(linked / "driving_log.csv")
    with pytest.raises(RecordingError, match=r"driving_log\.csv: not a regular file; "):
        read_recording(linked)


@pytest.mark.parametrize(
    "form",
    [
        "{a},{b},off",
        "\ufefffirst image,last image,reason\r\n{a},{b},off\r\n\r\n",
        "First Image, Last Image, Reason\n /data/IMG/{a} , C:\\IMG\\{b}, off \n",
    ],
)
def test_hand_written_forms_are_understood(linked, form):
    a, b = center(linked, 3), center(linked, 7)
    (linked / "excluded.csv").write_bytes(form.format(a=a, b=b).encode())
    assert [cut.row() for cut in read_cuts(linked)] == [(a, b, "off")]
    assert len(read_recording(linked)) == 55
    add_cuts(linked, Cut(b, b, "more"))
    delete_cuts(linked, Cut(b, b, "more"))
    assert (linked / "excluded.csv").read_bytes().rstrip() == form.format(a=a, b=b).encode().rstrip(), "as it was"


def test_adding_and_deleting_keep_all_other_lines(linked):
    log = (linked / "driving_log.csv").read_bytes()
    cuts = [Cut(center(linked, n), center(linked, n + 1), reason) for n, reason in ((1, 'a "b", c'), (5, ""), (9, "ü"))]
    for cut in cuts:
        add_cuts(linked, cut)
        add_cuts(linked, cut)  # a second time it changes nothing
    assert [cut.row() for cut in read_cuts(linked)] == [cut.row() for cut in cuts]
    with open(linked / "excluded.csv", "a", encoding="utf-8") as file:
        file.write(",".join(cuts[1].row()) + "\n")  # by hand; what is undone is no longer cut
    delete_cuts(linked, cuts[1])
    assert [cut.row() for cut in read_cuts(linked)] == [cuts[0].row(), cuts[2].row()]
    with pytest.raises(RecordingError, match="is not there any more; it was deleted elsewhere"):
        delete_cuts(linked, cuts[1])
    assert (linked / "driving_log.csv").read_bytes() == log


ADD = """
import sys
from pathlib import Path
from cloning.recordings.excluded import Cut, add_cuts
for n in range(20):
    add_cuts(Path(sys.argv[1]), Cut("a.jpg", "b.jpg", f"{sys.argv[2]} {n}"))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no lock here")
def test_programs_that_cut_at_the_same_time_lose_nothing(linked):
    def add(name: str) -> None:
        python("-c", ADD, linked, name).check_returncode()

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(add, "xyz"))
    reasons = [cut.reason for cut in read_cuts(linked)]
    assert sorted(reasons) == sorted(f"{name} {n}" for name in "xyz" for n in range(20))
    assert sorted(path.name for path in linked.iterdir()) == ["IMG", "driving_log.csv", "excluded.csv"]


def test_a_reason_is_one_line():
    assert one_line(" off\r\nthe\troad\0 ") == "off the road"
    assert one_line("x" * 1000) == "x" * 1000 and len(one_line("x" * 20_000)) == MAX_REASON


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no lock here")
def test_the_log_is_locked_as_nfs_asks_for_and_a_program_that_keeps_it_is_told(linked, monkeypatch):
    import fcntl

    monkeypatch.setattr(excluded, "PATIENCE", 0.1)
    with open(linked / "driving_log.csv", "rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(RecordingError, match=r"driving_log\.csv: another program is changing its cuts; try again"):
            add_cuts(linked, Cut(center(linked, 0), center(linked, 1), ""))
    taken = []
    monkeypatch.setattr(fcntl, "flock", lambda file, _: taken.append(file.writable()))
    add_cuts(linked, Cut(center(linked, 0), center(linked, 1), ""))
    assert taken == [True]
