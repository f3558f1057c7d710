"""pandas and the tolerant reader read the same rows: each plain line is read by either, with the same result."""

import random

import numpy as np
import pytest

from cloning.base.errors import RecordingError
from cloning.recordings import log, plain
from cloning.recordings.frames import FrameCache
from cloning.recordings.log import read_recording

FOLDERS = [b"/Users/driver/data/IMG/", b"IMG/", b" IMG/", b"C:\\Users\\Doe\\IMG\\", b"", b" ", b"a b/", b"./IMG/ "]
FOLDERS += [b"/home/Jos\xc3\xa9/", b"/home/Jos\xe9/IMG/", b"\xc2\xa0", b"\xef\xbb\xbf", b'"IMG"/', b"\x1c", b"\x0b/"]
SUFFIXES = [b".jpg"] * 30 + [
    b".JPG",
    b".jpeg",
    b".JpG",
    b".jpg ",
    b".jpg\xa0",
    b".jpg\xc2\xa0",
    b".png",
    b"\xc3\xa9.jpg",
]
ODD_NUMBERS = [
    "1_0",
    "+0.5",
    ".5",
    "5.",
    "1e400",
    "1e-400",
    "0x1",
    "nan",
    "inf",
    "-Infinity",
    "1,5",
    "1E+00",
    "1e",
    "0.1.2",
    "--",
    "\u0660",
    "\uff11",
    "True",
    "1d0",
    "1.2",
    "-2",
    "-0",
    "0,5",
    "1e-2",
    "19647",
    "00.5",
    "-",
    "+",
    "e5",
    "1L",
    "0.5f",
    "1%",
    "4.9406564584124654e-324",
    "1e-46",
    "0.1000000014901161193847656250",
]
ODD_NUMBERS += ["", " ", "0.5 ", " 0.5", "1 2", "\u00a00.5", "0.5\x1c", "\x0b0.5", "0.5\0", "\t0.5", '"0.5"']
ODD_LINES = [
    b"",
    b" ",
    b",,,,,,",
    b"\0\0\0",
    b"=======",
    b"<<<<<<< HEAD,a,b,c,d,e,f",
    b"center,left,right,steering,throttle,brake,speed",
    b"IMG/center_x.jpg, 0.0",
    b"some words",
    b'"a.jpg","b.jpg","c.jpg","0.1","1","0","9.5"',
    b'"a,1.jpg",b.jpg,c.jpg,0.1,1,0,9.5',
    b"a.jpg\tb.jpg\tc.jpg\t0.1\t1\t0\t9",
    b"a.jpg;b.jpg;c.jpg;0,1;1;0;9",
    b"a.jpg,b.jpg,c.jpg,-0,0597,0,98,0,30,18",
    b"a.jpg,b.jpg,c.jpg,0,1,0,6,9E-05",
    b"a.jpg,b.jpg,c.jpg,0.5,1,0,9.5,Lake: turning left",
    b"17,a.jpg,b.jpg,c.jpg,0.5,1,9.5",
    b"0.5,1,0,9.5,a.jpg,b.jpg,c.jpg",
    b"C:\\Doe, John\\a.jpg,C:\\Doe, John\\b.jpg,C:\\Doe, John\\c.jpg,0.5,1,0,9",
]
HEADERS = [
    b"Center,Left,Right,SteeringAngle,Throttle,Brake,Speed",
    b"center,left,right,steering,throttle,brake,speed,note",
    b"steering,center,left,right,speed,brake,throttle",
]


def random_number(chance: random.Random, least: float, greatest: float, odd: float) -> bytes:
    if chance.random() < odd:
        return chance.choice(ODD_NUMBERS).encode()
    number = f"{chance.uniform(least, greatest):.{chance.choice([1, 4, 7, 9, 17, 30])}{chance.choice('gfE')}}"
    return chance.choice([number, number, "0", "1"]).encode()


def random_log(chance: random.Random) -> bytes:
    """A csv of plain lines in which odd ones are rare, frequent or missing; so are decimal points and headers."""
    odd, pointless = chance.choice([0, 0.002, 0.1]), chance.random() < 0.1
    folders = chance.choices(FOLDERS[:8], k=2) if chance.random() < 0.8 else FOLDERS
    folders = folders + FOLDERS if odd else folders
    suffixes = SUFFIXES if odd else SUFFIXES[:1]
    ends = chance.choice([[b"\n"], [b"\r\n"], [b"\r"], [b"\n"] * 9 + [b"\r\n", b"\r", b"\r\r\n"]])
    lines = [chance.choice(HEADERS)] if chance.random() < 0.3 else []
    for row in range(chance.randrange(1, 80)):
        if chance.random() < odd:
            lines.append(chance.choice(ODD_LINES))
            continue
        folder = chance.choice(folders)
        stamp = b"_2018_07_%02d_17_11_%02d_382" % (chance.randrange(1, 29), row % 60)
        if chance.random() < 0.02:
            stamp = b"%d" % row
        fields = [folder + camera + stamp + chance.choice(suffixes) for camera in (b"center", b"left", b"right")]
        fields += [random_number(chance, least, 1, odd / 3) for least in (-1, 0)]
        fields += [chance.choice([b"0", b"0.0", b"0E+00"]), random_number(chance, 0, 30, odd / 3)]
        if pointless:
            fields[3:] = [b"0", b"1", b"0", b"9"]
        lines.append(chance.choice([b",", b",", b", "]).join(fields))
    text = b"".join(line + chance.choice(ends) for line in lines)
    return chance.choice([b"", b"", b"\xef\xbb\xbf"]) + chance.choice([text, text.rstrip(b"\r\n")])


def contents(folder) -> list:
    """Everything in a recording, to be compared for equality; or the error."""
    try:
        recording = read_recording(folder)
    except RecordingError as error:
        return [str(error)]
    values = [value for value in vars(recording).values() if not isinstance(value, np.ndarray | FrameCache)]
    arrays = [value for value in vars(recording).values() if isinstance(value, np.ndarray)]
    return [*values, *((array.dtype, array.shape, array.tobytes()) for array in arrays), list(recording.repairs)]


def nothing_is_plain(block, starts, first_line):
    none = plain.PlainRows(np.empty((0, 3), "S1"), np.empty((0, 4)), np.empty(0, np.int32))
    return np.zeros(len(starts) - 1, bool), none


@pytest.mark.parametrize("seed", range(4))
def test_pandas_reads_what_the_tolerant_reader_reads(tmp_path, monkeypatch, seed):
    by_pandas = 0
    read_plain = plain.read_plain

    def counted(*arguments):
        nonlocal by_pandas
        is_plain, rows = read_plain(*arguments)
        by_pandas += len(rows.lines)
        assert is_plain.sum() == len(rows.lines)
        return is_plain, rows

    monkeypatch.setattr(log, "read_plain", counted)
    rows = 0
    for number in range(100):
        chance = random.Random(1000 * seed + number)
        text = random_log(chance)
        (tmp_path / "driving_log.csv").write_bytes(text)
        monkeypatch.setattr(plain, "BLOCK", chance.choice([1, 150, 1000, 1 << 21]))
        found = contents(tmp_path)
        with monkeypatch.context() as alone:
            alone.setattr(log, "read_plain", nothing_is_plain)
            before = by_pandas
            expected = contents(tmp_path)
            assert by_pandas == before
        assert found == expected, text
        rows += text.count(b".jpg") // 3
    assert by_pandas > 1000, f"of about {rows} rows"


CAMERAS = ("center", "left", "right")


@pytest.mark.parametrize("folder", ["C:\\Users\\driver\\IMG\\", "/Users/Jos\u00e9/IMG/", " IMG/", ""])
def test_the_tolerant_reader_takes_no_plain_line_once_a_decimal_point_was_seen(tmp_path, monkeypatch, folder):
    taken = []
    read_line = log.TolerantReader.read_line
    monkeypatch.setattr(
        log.TolerantReader, "read_line", lambda self, line, text: taken.append(line) or read_line(self, line, text)
    )
    numbers = ["0,1,0,0", "0,1,0,0.5", "0.25, 1, 0, 9", "0,1,0,9,note", "-0.5,0.75,0,1E-05"]
    lines = [",".join([*(f"{folder}{camera}_{at}.jpg" for camera in CAMERAS), row]) for at, row in enumerate(numbers)]
    (tmp_path / "driving_log.csv").write_text("".join(line + "\n" for line in lines), encoding="utf-8")
    recording = read_recording(tmp_path)
    assert taken == [1, 2, 4]
    np.testing.assert_array_equal(recording.lines, [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(recording.steering, np.float32([0, 0, 0.25, 0, -0.5]))
    np.testing.assert_array_equal(recording.speed, np.float32([0, 0.5, 9, 9, 1e-5]))
    assert recording.name(4, 1) == "left_4.jpg"
    assert recording.repairs == {"extra columns ignored": [1, 4]}


@pytest.mark.parametrize("word", ["True", "false", "1_0", "1e", "", "nan", "0x1", "--1", "1 2"])
@pytest.mark.parametrize("column", range(4))
def test_words_are_no_numbers_even_if_a_whole_column_has_them(tmp_path, word, column):
    numbers = ["0.5", "1", "0", "9"]
    images = "center_1.jpg,left_1.jpg,right_1.jpg"
    plain_line = f"{images},{','.join(numbers)}"
    numbers[column] = word
    text = plain_line + f"\n{images},{','.join(numbers)}" * 3
    (tmp_path / "driving_log.csv").write_text(text, encoding="utf-8")
    recording = read_recording(tmp_path)
    np.testing.assert_array_equal(recording.lines, [1])
    assert len(recording.rejected) == 3
