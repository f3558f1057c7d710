"""driving_log.csv in the nineteen formats met in the wild, and others: read right, repaired or refused."""

import os
import re

import numpy as np
import pytest
from rendered import render_recording

from cloning.base import program
from cloning.base.errors import RecordingError
from cloning.recordings.columns import Finding
from cloning.recordings.log import Recording, find_folders, read_recording

HEADER = "center,left,right,steering,throttle,brake,speed"
CAMERAS = ("center", "left", "right")
NUMBERS = ["-0.0597,0.98,0,30.18", "0,1,0,6.9E-05", "0.25,0,0.5,22.14829", "0.125,0.5,0,15.5"]
VALUES = np.array([row.split(",") for row in NUMBERS], np.float32)
NOTES = ["-", "Lake: turning left", "", "nan"]
SPACED = [row.replace(",", ", ") for row in NUMBERS]


def images(at: int, before: str = "", between: str = ",", cameras: tuple[str, ...] = CAMERAS) -> str:
    return between.join(f"{before}{camera}_2018_07_16_17_11_43_{at:03d}.jpg" for camera in cameras)


def usual(before: str = "", numbers: list[str] = NUMBERS, between: str = ",", first: int = 0) -> list[str]:
    return [f"{images(first + at, before, between)}{between}{row}" for at, row in enumerate(numbers)]


def ordered(order: str, lines: list[str]) -> list[str]:
    """The fields of lines in another order, as digits."""
    return [",".join(line.split(",")[int(at)] for at in order) for line in lines]


def with_commas(line: str) -> str:
    return line.replace(",", ";").replace(".", ",").replace(",jpg", ".jpg")


@pytest.fixture
def log(tmp_path):
    def read(*lines: str, content: bytes | None = None) -> Recording:
        written = ("\n".join(lines) + "\n").encode() if content is None else content
        (tmp_path / "driving_log.csv").write_bytes(written)
        return read_recording(tmp_path)

    return read


def numbers(found: Recording) -> np.ndarray:
    return np.column_stack([found.steering, found.throttle, found.brake, found.speed])


def findings(found: Recording) -> list[tuple[int, Finding]]:
    return [(row.line, row.finding) for row in found.rejected]


# ----------------------------------------------------------------------------------------------------------------------
# What is read


@pytest.mark.parametrize(
    "lines",
    [
        usual("/Users/driver/data/IMG/"),  # 1
        usual("C:\\Users\\driver\\Desktop\\track3\\IMG\\"),  # 2
        usual("/data/IMG/", SPACED, ", "),  # 3
        [HEADER, *usual("IMG/", SPACED, ", ")],  # 4
        [line + "\r" for line in usual("IMG/", between=", ")],  # 5
        ["Center,Left,Right,SteeringAngle,Throttle,Brake,Speed", *usual("IMG/")],  # 6
        ["camera_center, camera_left, camera_right,steering,0,0,speed", *usual("IMG/")],
        [HEADER.replace("throttle,brake", ","), *usual()],
        ["ct_path,lt_path,rt_path,steer,throttle,brake,speed,high_level_control", *[x + ",3" for x in usual("IMG/")]],
        ["Center Image,Left Image,Right Image,Steering Angle,Throttle,Break,Speed", *usual("IMG/")],
        ["img_center,left_img,right_img_path,steer_angle,throttle,brake,speed", *usual("IMG/")],
        [f",{HEADER}", *[f"{at + 17},{line}" for at, line in enumerate(usual("IMG/"))]],  # 7
        usual(),  # 8
        *map(usual, ("./IMG/", "/IMG/", "IMG_Ori\\", "D:\\montravail\\IMG\\IMG\\", "C:\\Users\\Doe, John\\IMG\\")),  # 9
        usual("PK/IMG/"),  # Excel's workbooks begin with these letters
        usual("/home/driver/Behavioral Cloning/data rev/IMG/"),  # 10
        [usual("C:\\IMG\\")[3], *usual("/home/a b/IMG/")[:2], usual("IMG/", SPACED, ", ")[2]],  # 11, out of order
        [line.replace("E-05", "e-05") for line in usual()],  # 19
        ["\ufeff" + usual()[0], *usual()[1:]],
        ['"' + line.replace(",", '", "') + '"' for line in usual()],
        [re.sub("(/D.+?jpg)", r'"\1"', line) for line in usual("/Doe, John/IMG/")],
        ["steering,center,left,right,speed,brake,throttle", *ordered("3012654", usual())],
        ["left,center,right,steering,throttle,brake,speed", *ordered("1023456", usual("IMG/"))],
        [*usual()[:2], HEADER.replace("steering,throttle", "throttle,steering"), *ordered("0124356", usual()[2:])],
        [*usual()[:2], "\ufeffct_path,lt_path,rt_path,throttle,steer,brake,speed", *ordered("0124356", usual()[2:])],
        [HEADER + ",predicted_steering,target_speed", *[line + ",0.9,25" for line in usual()]],
        [HEADER + ",", *[line + "," for line in usual()]],
        ["sep=,", HEADER, *usual()],
        [*usual(), "\x1a", "\xa0", "\x0b"],  # the end of a text file, once
    ],
)
def test_formats_that_are_read_right(log, lines):
    found = log(*lines)
    np.testing.assert_array_equal(numbers(found), VALUES)
    assert [found.name(3, camera) for camera in range(3)] == images(3).split(",")
    assert found.rejected == []
    np.testing.assert_allclose(np.diff(found.time), 0.001, atol=1e-6)


@pytest.mark.parametrize(
    "lines, repair",
    [
        (usual(numbers=[row.replace(".", ",") for row in NUMBERS]), "decimal commas"),  # 12
        (usual(numbers=[f"{row},{note}" for row, note in zip(NUMBERS, NOTES, strict=True)]), "extra columns"),  # 13
        ([line.replace(",", "\t") for line in usual()], "tab-separated"),  # 15
        (["sep=;", with_commas(HEADER), *map(with_commas, usual())], "decimal commas"),  # as Excel writes it
        (usual(numbers=['"' + row.replace(",", '","').replace(".", ",") + '"' for row in NUMBERS]), "decimal commas"),
        ([HEADER.replace("throttle,brake", "0,"), *usual()], "header lacks names"),
    ],
)
def test_formats_that_are_repaired_and_reported(log, lines, repair):
    found = log(*lines)
    np.testing.assert_array_equal(numbers(found), VALUES)
    assert any(name.startswith(repair) for name in found.repairs) and found.rejected == []


def test_other_encodings_and_a_line_without_an_end(log, tmp_path):
    (tmp_path / "._driving_log.csv").write_bytes(b"\x00\x05\x16\x07")  # beside the real one: not looked at
    for encoding in ("utf-16", "utf-8-sig"):
        found = log(content="\n".join(usual()).encode(encoding))
        np.testing.assert_array_equal(numbers(found), VALUES)
        assert found.repairs == {"the file ends within this line: its last number may be cut short": [1, 4]}


def test_a_recording_without_time_stamps_keeps_the_file_order(log):
    rows = [f"center_{at}.jpg,left_{at}.jpg,right_{at}.jpg,0.{at},1,0,9" for at in range(6)]
    found = log(*[rows[at] for at in (3, 1, 2)])
    np.testing.assert_array_equal(found.steering, np.array([0.3, 0.1, 0.2], np.float32))
    np.testing.assert_allclose(np.diff(found.time), 1 / 15)
    copied = log(*[rows[at] for at in (1, 2, 3, 4, 4, 2, 3, 5)])
    np.testing.assert_allclose(np.diff(copied.time), np.array([0, 0, 0, 0, 2, 0, 2]) + 1 / 15)
    assert copied.repairs["a copy of other rows begins or ends here: taken for the start of another drive"] == [2, 6]
    many = [line.replace("43_", f"{second}_") for second in range(10, 60) for line in usual(first=100)]
    assert log(*many).repairs == {}
    old, new = (line.replace("07_16_17_11_43", "12_31_23_59_59") for line in usual()[:2])
    new_year = log(old, new.replace("2018_12_31_23_59_59", "2019_01_01_00_00_00"))
    np.testing.assert_allclose(np.diff(new_year.time), 1.001, atol=1e-6)
    for wrong in ("2018_13_16", "2018_02_29", "2018_07_00"):
        found = log(*many, *usual()[:1], usual()[1].replace("2018_07_16", wrong))
        np.testing.assert_array_equal(found.lines, np.arange(1, 203))
        ((repair, told),) = found.repairs.items()
        assert repair.startswith("no time in the image's name") and told == [1, 202]


def test_a_header_within_a_long_file(log):
    many = [line for at in range(300) for line in usual(first=4 * at)]
    swapped = ordered("0124356", usual(first=1300))
    found = log(*many, HEADER.replace("steering,throttle", "throttle,steering") + ",note", swapped[0] + ",x")
    assert len(found) == 1201 and found.rejected == []
    np.testing.assert_array_equal(numbers(found)[-1], VALUES[0])
    with pytest.raises(RecordingError, match=r"line 1201: .* names center never, steering never"):
        log(*many, "left,right,throttle,brake,speed,x,y,z", *swapped)


# ----------------------------------------------------------------------------------------------------------------------
# Rows that are left out and reported


@pytest.mark.parametrize(
    "bad, finding, words",
    [
        (f"{images(9)},0,0.38,0,19647", Finding.OUT_OF_RANGE, "(has its decimal point been lost, or"),  # 14
        ("=======", Finding.MERGE_CONFLICT, "merge"),  # 16
        ("<<<<<<< HEAD", Finding.MERGE_CONFLICT, "merge"),
        ("IMG/center_x.jpg, 0.0", Finding.NOT_A_ROW, "1 image name where center, left, right belong; delete"),  # 18
        (f"{images(9)},1.2,0,0,9", Finding.OUT_OF_RANGE, "steering 1.2 is not in -1..1"),  # 19
        *((f"{images(9)},{bad},0,0,9", Finding.NOT_A_NUMBER, f"'{bad},0,0,9'") for bad in ("nan", "1_0", "1e", "")),
        (f"{images(9)},1,175494E-38,0,0", Finding.NOT_A_NUMBER, "1,175494E-38"),  # three with a decimal comma
        (f"{images(9)},0,05,0,0", Finding.NOT_A_NUMBER, "0,05"),
        *((f"{images(9)},0,0,0,{bad}", Finding.NOT_A_NUMBER, bad) for bad in ("True", "inf", "1.2.3", "\u0661")),
        (f"{images(9)},0.1,0.2", Finding.NOT_A_NUMBER, "0.1,0.2"),
        ("\0\0\0\0", Finding.NOT_A_ROW, "cut off"),
        ("a" * 200_000, Finding.NOT_A_ROW, "200000 characters"),
        ('"' + "a," * 9000, Finding.NOT_A_ROW, "0 image names"),
        (f"{images(9, cameras=('center', 'left', 'left'))},0,1,0,9", Finding.CAMERAS, "not of the right camera; d"),
        (f"{images(9, cameras=('left', 'center', 'right'))},0,1,0,9", Finding.CAMERAS, "not of the center camera; d"),
        (images(9).replace("left_2018", "left_2019") + ",0,1,0,9", Finding.CAMERAS, "are of different times"),
        (images(9).replace("jpg", "PNG") + ",0,1,0,9", Finding.CAMERAS, "PNG: not a JPEG; convert the images"),
        (images(9).replace("_", "_" + "1" * 300) + ",0,1,0,9", Finding.CAMERAS, "not understood as an image of the"),
        (f"{images(9)},0.5,1,0,9,0.5", Finding.COLUMNS, "5 numbers where 4 are expected"),  # 13
        (f"{images(8)},0,1,0,9.5{images(9)},0,1,0,9", Finding.COLUMNS, "two rows in one line; put a line break"),
        (f"{images(9)},0.5,1,0,9,Lake v1.2", Finding.COLUMNS, "name the columns in a header line above the rows"),
        (f"{images(9)},-0,05,0,5,0,9,25", Finding.COLUMNS, "in 1 way, but the file also has decimal points"),
        (f"17,{images(9)},0,1,0,9", Finding.NOT_A_ROW, "3 image names where center, left, right belong"),
    ],
)
def test_rows_that_are_left_out_and_reported(log, bad, finding, words):
    for above in ([], [HEADER]):
        found = log(*above, *usual()[:2], bad, *usual()[2:])
        np.testing.assert_array_equal(numbers(found), VALUES)
        assert findings(found) == [(len(above) + 3, finding)] and words in found.rejected[0].detail


def test_half_of_a_number_with_a_decimal_comma_is_left_out(log):
    """Beside rows of three numbers, 1,5E-05 makes four; in a row with a decimal point, 5E-05 is one.

    If the column lap is empty, the halves of 30,19 make a row as long as the header.
    """
    rows = [f"{images(n)},0,1,0,9" for n in range(3)]
    found = log(*rows, f"{images(9)},1,5E-05,0,0")
    assert findings(found) == [(4, Finding.COLUMNS)] and len(found) == 3
    assert "'1,5E-05,0,0' may be fewer numbers" in found.rejected[0].detail
    found = log(*rows, f"{images(9)},0,5E-05,0,9.5")
    assert findings(found) == [] and found.throttle[3] == np.float32(5e-5)
    found = log(HEADER + ",lap", *(f"{row}," for row in rows), f"{images(9)},0,1,0,30,19,", f"{images(8)},0,1,0,9.5,3,")
    assert findings(found) == [(5, Finding.COLUMNS)] and len(found) == 4


def test_decimal_commas_of_four_numbers_may_be_three_that_all_have_one(log):
    """0,3 | 0,0 | 30,19 without the steering, as Python writes numbers; a row of five parts shows that it is not so."""
    with pytest.raises(RecordingError, match="or in each row three, all with one"):
        log(*usual(numbers=["0,3,0,0,30,1875", "0,3,0,0,30,19"]))
    found = log(*usual(numbers=["0,3,0,0,30,1875", "0,1,0,30,19"]))
    np.testing.assert_array_equal(numbers(found), np.array([(0.3, 0, 0, 30.1875), (0, 1, 0, 30.19)], np.float32))


def test_decimal_commas_are_none_where_no_digits_are_surely_a_fraction(log):
    """0 | 1 | 0 | 30,19, or five columns."""
    with pytest.raises(RecordingError, match=r"line 1: '0,1,0,30,19' may be .* in 1 way, or more columns; write"):
        log(*usual(numbers=["0,1,0,30,19", "0,1,0,29,5"]))


def test_decimal_commas_of_a_car_that_stands_still(log):
    """An exponent has one digit before its point: 8,888892E-05 is no speed of 888892E-05 after a brake of 0,8."""
    found = log(*usual(numbers=["0,25,1,0,9,5625", "0,0,0,8,888892E-05"]))
    np.testing.assert_array_equal(numbers(found), np.array([(0.25, 1, 0, 9.5625), (0, 0, 0, 8.888892e-05)], np.float32))


def test_decimal_commas_that_can_be_read_in_two_ways_are_left_out(log):
    found = log(*usual(numbers=["-0,004694836,1,0,30,19023", "0,1,0,30,19", "0,0,1,0,5"]))
    wanted = np.array([(-0.004694836, 1, 0, 30.19023), (0, 1, 0, 30.19)], np.float32)
    np.testing.assert_array_equal(numbers(found), wanted)
    assert findings(found) == [(3, Finding.COLUMNS)]  # 0 | 0,1 | 0 | 5 or 0 | 0 | 1 | 0,5
    assert "four numbers with decimal commas in 2 ways" in found.rejected[0].detail
    for row in ('"0","100001","0","0","0"', "0,100001,0,0,0,"):  # a counter, perhaps before an empty column
        with pytest.raises(RecordingError, match="line 1: 5 numbers where 4 are expected"):
            log(*usual(numbers=[row] * 3))
    rows = ["0,3333333,0,0,0,0", "1,0,0,0,1", "1,333333,0,0,0,0"]  # a lap before steering, throttle, brake and speed
    with pytest.raises(RecordingError, match=r"line 1: .* in 0 ways, but not those in line 1; write decimal points"):
        log(*usual(numbers=rows))


def test_rows_of_another_length_than_their_header(log):
    other = "center,left,right,throttle,steering,brake,speed,note"
    found = log(other, *usual(), ordered("0124356", usual(first=9))[0] + ",good")
    np.testing.assert_array_equal(numbers(found), VALUES[:1])
    assert findings(found) == [(line, Finding.COLUMNS) for line in range(2, 6)]
    assert "7 fields below a header that names 8 in another order" in found.rejected[0].detail
    found = log(HEADER + ",note,lap", *usual(), f"{images(9)},1,0,0,0,0")  # no value is taken for another's
    np.testing.assert_array_equal(numbers(found), VALUES)
    assert findings(found) == [(6, Finding.COLUMNS)]


def test_two_rows_of_one_image_with_different_steering_are_left_out(log):
    found = log(*usual(), f"{images(1)},0.5,1,0,30.19", usual()[2])
    np.testing.assert_array_equal(found.lines, [1, 3, 6, 4])  # an exact copy contradicts nothing
    assert findings(found) == [(2, Finding.CONTRADICTION), (5, Finding.CONTRADICTION)]


# ----------------------------------------------------------------------------------------------------------------------
# Logs that are refused


@pytest.mark.parametrize(
    "content, words",
    [
        (b"PK\x03\x04rest", "line 1: an Excel workbook"),  # 17
        (b"version https://git-lfs.github.com/spec/v1\noid", "line 1: a pointer of Git LFS: run `git lfs pull`"),
        (b"\x00\x05\x16\x07rest", r"line 1: a macOS resource file \(AppleDouble\)"),
        ("\n".join(usual()).encode("utf-16-le"), "line 1: UTF-16 without a byte-order mark; save it as CSV in UTF-8"),
        ("\n".join(usual()).encode("utf-16-be"), "line 1: UTF-16 without a byte-order mark"),
        (b"", "nothing was recorded; delete the folder .*, or record again"),
        (HEADER.encode() + b"\n\n", "nothing was recorded; delete the folder .*, or record again"),
        (b'"\n', "line 1: neither a row nor a header"),
        (b"<!DOCTYPE html>\n", r"line 1: neither .*: '<!DOCTYPE html>' names none \(is it the right file\?\); correct"),
        ("\n".join(usual()).encode() + bytes(4 << 20), "line 4: longer than any row: not a csv"),
    ],
)
def test_files_that_are_no_logs(log, tmp_path, content, words):
    with pytest.raises(RecordingError, match=words) as error:
        log(content=content)
    assert str(error.value).startswith(f"{tmp_path / 'driving_log.csv'}: ")


@pytest.mark.parametrize(
    "name, written",
    [
        *(("steering", each) for each in ("predicted_steering", "steering_ccw", "steering/4", "steering (deg)")),
        ("steering", "angle_of_car"),
        ("throttle", "throttle %"),
        ("speed", "speed (metres/second)"),
        ("speed", "0"),
        ("center", "mitte"),
        ("left", "leftcam2"),
    ],
)
def test_a_header_is_understood_by_whole_names_only(log, name, written):
    line = HEADER.replace(name, written)
    unknown = "" if written == "0" else f"not understood: '{re.escape(written)}'"
    for rest in ("", ",lap", ",human"):
        words = rf"line 1: .* names {name} never.*{unknown}.*{HEADER}, in their order"
        with pytest.raises(RecordingError, match=words):
            log(line + rest, *[row + rest for row in usual()])
    with pytest.raises(RecordingError, match=rf"driving_log.csv: line 5: .* names {name} never"):
        log(*usual(), line, *usual(first=10))
    with pytest.raises(RecordingError, match="names steering twice"):
        log(HEADER + ",angle", *[row + ",0.5" for row in usual()])


FORMS = ("img{Camera}_{at}", "{letter}_{at}", "IMG/{camera}/{at}", "{stamp}_{camera}", "a_{camera}_{stamp}", "{at}")


@pytest.mark.parametrize("form", [*FORMS, "{camera}_left_{at}"])
@pytest.mark.parametrize("header", [[], [HEADER]])
def test_cameras_are_understood_by_whole_names_only(log, form, header):
    fields = {"stamp": "2018_07_16_17_11_43_382", "at": 1}
    names = [form.format(camera=name, Camera=name.title(), letter=name[0].upper(), **fields) for name in CAMERAS]
    row = ",".join(f"{name}.jpg" for name in names) + ",0,1,0,9"
    with pytest.raises(RecordingError, match=r"line \d: .*\.jpg: not understood as an image of the .* rename it, here"):
        log(*header, row)


@pytest.mark.parametrize("extra", ["0.5", "1", "-0.1", "0", "1500000.5", "1%", "'1'", "30 mph"])
@pytest.mark.parametrize("column", range(5))
def test_an_unnamed_column_is_never_taken_for_another(log, extra, column):
    fields = [row.split(",") for row in NUMBERS]
    lines = [",".join([images(at), *row[:column], extra, *row[column:]]) for at, row in enumerate(fields)]
    with pytest.raises(RecordingError, match=r"line 1: .*5 numbers where 4 are expected.* name the columns"):
        log(*lines)
    names = HEADER.split(",")
    names.insert(3 + column, "lap")
    np.testing.assert_array_equal(numbers(log(",".join(names), *lines)), VALUES)


@pytest.mark.parametrize(
    "rows, why",
    [
        (["0.98,-0.25,0,9.5", "0.5,0.25,0,9.5"], "line 1: throttle is -0.25 here, and not in 0..1 in 1 of 2 rows"),
        (["0.5,1.5,0,9.5"], "line 1: throttle is 1.5 here"),
        (["0.5,1,0,-9.5"], "line 1: speed is -9.5 here"),
        (["-12.5,0.5,0,9", "0.5,0.5,0,9", "25,0.5,0,9"], "line 1: steering is -12.5 here, and not in -1..1 in 2 of 3"),
        (["0,1,0,9", "0,1,0,48.58", "0,1,0,48.58"], "line 2: speed is 48.58 here, and not in 0..32 in 2 of 3"),  # km/h
        (["0,1,0,9", "0.5,0.5,0.5,9.5"], "line 2: the brake is pressed with the throttle: are they other columns"),
        (["0.1,0.5,0,9", "0.1,0,1,30.2"], "line 2: the brake is pressed more than the throttle"),
    ],
)
def test_numbers_that_show_other_columns_or_units(log, rows, why):
    with pytest.raises(RecordingError, match=rf"driving_log.csv: {why}.*{HEADER}, in their order"):
        log(*usual(numbers=rows))
    if "brake" in why or "speed is 48.58" in why:  # which a header settles
        assert len(log(HEADER, *usual(numbers=rows))) == len(rows)
        with pytest.raises(RecordingError, match=r"line \d: (the brake is pressed|speed is 48.58)"):
            log(HEADER.replace("throttle,brake", "0,0"), *usual(numbers=rows))


def test_a_speed_that_the_simulator_never_writes_is_left_out_or_told(log):
    assert findings(log(*usual(), f"{images(9)},0,1,0,48.58")) == [(5, Finding.OUT_OF_RANGE)]
    told = "speed above 32, which the simulator's car never reaches, is taken for mph"  # or are they km/h?
    assert log(HEADER, *usual(), f"{images(9)},0,1,0,48.58").repairs == {told: [1, 6]}


def test_a_header_in_other_words_within_the_file_is_refused(log):
    words = "line 5: neither a row nor a header, .* not understood: 'mitte', 'links'"
    with pytest.raises(RecordingError, match=words):
        log(*usual(), "mitte,links,rechts,gas,lenkung,bremse,tempo", *usual(first=10))


# ----------------------------------------------------------------------------------------------------------------------
# Folders


def test_folders_are_found_below_links_and_each_once(tmp_path):
    for name in ("disk/lake", "disk/more/jungle", "data/own"):
        render_recording(tmp_path / name, rows=1)
    data, own = tmp_path / "data", render_recording(tmp_path / "data" / "own" / "below", rows=1)
    assert find_folders([own.parent]) == [own.parent, own] and find_folders([own.parent], exact=True) == [own.parent]
    try:
        for name in ("twin", "disk", *"uvwxyz"):  # of which the first counts, however the disk lists them
            (data / name).symlink_to(tmp_path / "disk")
        (data / "own" / "up").symlink_to(data)
    except OSError:
        pytest.skip("Windows lets only privileged users make symbolic links")
    found = find_folders([str(data), str(tmp_path / "disk" / "lake")])
    names = [folder.relative_to(data).as_posix() for folder in found]
    assert names == ["disk/lake", "disk/more/jungle", "own", "own/below"]
    with pytest.raises(RecordingError, match="no such folder"):
        find_folders([str(tmp_path / "nowhere")])
    with pytest.raises(RecordingError, match="no such file; name the folder of a recording"):
        read_recording(tmp_path / "nowhere")
    with pytest.raises(
        RecordingError, match=r"driving_log\.csv: a file; name the folder .* unpacked if it is an archive"
    ):
        find_folders([str(data / "own" / "driving_log.csv")])


def test_a_folder_that_cannot_be_read_is_named(tmp_path, monkeypatch, capsys):
    for name in ("jungle", "lake"):
        render_recording(tmp_path / name, rows=1)
    listed, locked = os.scandir, str(tmp_path / "lake")

    def scandir(folder):
        if folder == locked:
            raise PermissionError(13, "Permission denied", folder)
        return listed(folder)

    monkeypatch.setattr(os, "scandir", scandir)
    assert find_folders([str(tmp_path)]) == [tmp_path / "jungle"]
    assert capsys.readouterr().err == f"{program.name}: {locked}: Permission denied; left out with what is in it\n"
