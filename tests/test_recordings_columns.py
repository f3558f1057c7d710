"""What the columns of a log mean is decided by evidence that must agree; where it doesn't, rows are left out."""

import numpy as np
import pytest

from cloning.base.errors import RecordingError
from cloning.recordings.columns import Shape, UnclearColumns, by_camera, camera_of, check_numbers, check_places, number
from cloning.recordings.log import read_recording

HEADER = "center,left,right,steering,throttle,brake,speed"
NUMBERS = ["-0.25,0.5,0,9.5", "0,1,0,30.19", "0.75,0,0.5,20.25", "0.125,0.5,0,15.5"]
VALUES = [[float(value) for value in row.split(",")] for row in NUMBERS]


def images(at, cameras=("center", "left", "right")):
    return ",".join(f"IMG/{camera}_2018_07_16_17_11_43_{at:03d}.jpg" for camera in cameras)


def usual(numbers=NUMBERS, first=0):
    return [f"{images(first + at)},{row}" for at, row in enumerate(numbers)]


def swapped(first=0):
    """Rows with throttle before steering."""
    rows = (row.split(",") for row in NUMBERS)
    return [f"{images(first + at)},{t},{s},{b},{v}" for at, (s, t, b, v) in enumerate(rows)]


@pytest.fixture
def log(tmp_path):
    def read(*lines, content=None):
        path = tmp_path / "driving_log.csv"
        path.write_bytes(("\n".join(lines) + "\n").encode() if content is None else content)
        return read_recording(tmp_path)

    return read


def numbers(found):
    return np.column_stack([found.steering, found.throttle, found.brake, found.speed])


def test_images_in_another_order_are_known_by_their_names(log):
    cameras = ("left", "center", "right")
    found = log(*[f"{images(at, cameras)},{row}" for at, row in enumerate(NUMBERS)])
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert [found.name(1, camera).split("_")[0] for camera in range(3)] == ["center", "left", "right"]
    assert found.repairs == {"images in another order; ordered by the cameras in their names": [4, 1]}


@pytest.mark.parametrize(
    "cameras, why",
    [
        (("center", "left", "left"), "one image for two cameras"),
        (("center", "left", "other"), "not one image each"),
        (("left", "center", "right"), "not in the header's order"),
    ],
)
def test_images_that_contradict_their_columns_are_left_out(log, cameras, why):
    found = log(HEADER, *usual(), f"{images(9, cameras)},0.1,1,0,9")
    ((line, kind, detail),) = found.rejected
    assert line == 6 and len(found) == 4
    assert why in kind + detail


def test_rows_below_a_header_of_another_order_and_length_are_left_out(log):
    with pytest.raises(RecordingError, match="line 2: 7 fields below a header that names 8 in another order"):
        log("center,left,right,throttle,steering,brake,speed,note", *usual())
    found = log("center,left,right,throttle,steering,brake,speed,note", *usual(), swapped(9)[0] + ",good")
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES[:1]))


def test_a_header_within_the_file_counts_for_the_rows_below_it(log):
    found = log(HEADER, *usual(), HEADER.replace("steering,throttle", "throttle,steering"), *swapped(10))
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES * 2))
    assert found.rejected == []


def test_a_header_within_a_large_block_of_plain_lines(log):
    many = [line for at in range(300) for line in usual(first=4 * at)]
    found = log(*many, HEADER.replace("steering,throttle", "throttle,steering") + ",note", swapped(1300)[0] + ",x")
    assert len(found) == 1201 and found.rejected == []
    np.testing.assert_array_equal(numbers(found)[-1], np.float32(VALUES[0]))
    with pytest.raises(RecordingError, match="line 1201: neither a row nor a header with center and steering"):
        log(*many, "left,right,throttle,brake,speed,x,y,z", *swapped(1300))


@pytest.mark.parametrize("extra", ["0.5", "1", "-0.1", "0"])
@pytest.mark.parametrize("place", range(5))
def test_an_unnamed_column_is_never_taken_for_another(log, extra, place):
    rows = [row.split(",") for row in NUMBERS]
    lines = [",".join([images(at), *row[:place], extra, *row[place:]]) for at, row in enumerate(rows)]
    with pytest.raises(RecordingError, match=r"5 numbers where 4 are expected, .* name the columns"):
        log(*lines)
    names = [*HEADER.split(",")]
    names.insert(3 + place, "lap")
    np.testing.assert_array_equal(numbers(log(",".join(names), *lines)), np.float32(VALUES))


@pytest.mark.parametrize("extra", ["good", "Lake: turning left", "1500000.5", "-3.5", "nan"])
def test_an_unnamed_column_that_is_none_of_the_four_is_ignored(log, extra):
    found = log(*[f"{line},{extra}" for line in usual()])
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert found.repairs == {"extra columns ignored": [4, 1]}


@pytest.mark.parametrize("last", ['"1",', "'1'", "1%", '"0,5",', "6.9E-05"])
def test_a_number_with_something_clinging_to_it_is_no_word(log, last):
    with pytest.raises(RecordingError, match="5 numbers where 4 are expected"):
        log(*[f"{images(at).replace(',', ';')};0;0;0;0;{last}" for at in range(11)])


def test_decimal_commas_in_a_file_with_points_are_left_out(log):
    commas = ["1,234E-05,1,0,30,19", "0,1,0,30,19", "-0,05,0,5,0,9,25"]
    found = log(*usual(), *usual(commas, first=10))
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert [(line, kind) for line, kind, _ in found.rejected] == [(at, "ambiguous columns") for at in (5, 6, 7)]
    assert "the file also has decimal points" in found.rejected[0][2]


@pytest.mark.parametrize("text", ["0_1", "1_0", "\u0661", "0x1", "nan", "inf", "1e", "", "True", "1.2.3", "- 1"])
def test_only_digits_are_numbers(log, text):
    assert np.isnan(number(text))
    found = log(*usual(), f"{images(9)},{text},1,0,9.5")
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert [(line, kind) for line, kind, _ in found.rejected] == [(5, "not a number")]


@pytest.mark.parametrize("text, value", [("1", 1), ("-.5", -0.5), ("5.", 5), ("+6.9E-05", 6.9e-5), ("1e3", 1000)])
def test_numbers_as_programs_write_them(text, value):
    assert number(text) == value


def test_swapped_columns_without_a_header_are_refused(log):
    with pytest.raises(RecordingError, match=r"line 1: throttle is -0.25 in line 1 .* name the columns in a header"):
        log(*swapped())
    found = log(*usual(), HEADER, *swapped(10))  # below their own header the first ones are certain
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert len(found.rejected) == 4


@pytest.mark.parametrize(
    "line, why",
    [
        ("{images},0.5,0.5,0.5,9.5", "the brake is pressed with the throttle"),
        (
            "{images},0.5,0,1,20.5",
            "the brake is pressed more than the throttle, and the car is not seen to slow down in line 1:",
        ),
        ("{images},0.5,1.5,0,9.5", "throttle is 1.5"),
        ("{images},0.5,1,0,-9.5", "speed is -9.5"),
    ],
)
def test_pedals_and_speeds_that_the_simulator_never_writes(log, line, why):
    with pytest.raises(RecordingError, match=why):
        log(*[line.format(images=images(at)) for at in range(9)])


def test_steering_in_degrees_is_refused(log):
    degrees = [f"{angle},0.5,0,9.5" for angle in (-12.5, 0.5, 3.25, 25)]
    with pytest.raises(RecordingError, match="is this column steering, and in the simulator's unit"):
        log(*usual(degrees))
    with pytest.raises(RecordingError, match=r"line 1: the header's 'steering \(deg\)' has another unit"):
        log(HEADER.replace("steering", "steering (deg)"), *usual())


def test_a_single_wrong_angle_costs_its_row_only(log):
    found = log(*usual(), f"{images(9)},1.2,1,0,9.5")
    assert len(found) == 4
    assert [(line, kind) for line, kind, _ in found.rejected] == [(5, "steering out of range")]


def test_two_rows_of_one_image_with_different_steering_are_left_out(log):
    found = log(*usual(), f"{images(1)},0.5,1,0,30.19", usual()[2])
    np.testing.assert_array_equal(found.lines, [1, 3, 6, 4])  # an exact copy contradicts nothing
    assert [(line, kind) for line, kind, _ in found.rejected] == [
        (2, "one image, two angles"),
        (5, "one image, two angles"),
    ]


def test_a_row_that_may_be_cut_within_its_speed_is_told(log):
    found = log(content="\n".join([*usual()[:3], usual()[3][:-2]]).encode())
    assert len(found) == 4 and found.speed[3] == 15
    assert found.repairs == {"the file ends within this line: its last number may be cut short": [1, 4]}
    assert log(*usual()).repairs == {}


def test_odd_bytes_end_no_training(log):
    rows = "\n".join(usual()) + "\n"
    for content in (
        rows.encode("utf-16") + b"\x00",  # an odd number of bytes
        rows.encode() + b"a" * 200_000 + b"\n",
        rows.encode() + b'"' + b"a," * 9000 + b"\n",
        rows.encode() + b'"\n',
    ):
        found = log(content=content)
        np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
        assert [kind for _, kind, _ in found.rejected] == ["not a row"]
    with pytest.raises(RecordingError, match="a line of more than"):
        log(content=rows.encode() + bytes(4 << 20))


def test_cameras_in_names():
    assert camera_of("center_2018_left.jpg") == "center"
    assert camera_of("cam-Left-7.jpg") == "left"
    assert camera_of("my_centre_1.jpg") == "center"
    assert [camera_of(name) for name in ("1.jpg", "upright_1.jpg", "my_left_right.jpg")] == [None] * 3
    assert by_camera(["1.jpg", "2.jpg", "3.jpg"]) == ["1.jpg", "2.jpg", "3.jpg"]


def test_checks_of_shapes():
    check_places(Shape(None, 7, (0, 1, 2), [1], [("a", "b", "c")], [["0", "1", "0", "9"]]))
    with pytest.raises(UnclearColumns, match="and 7 in line 2"):
        check_places(Shape(None, 8, (0, 1, 2), [1, 2], [("a", "b", "c")] * 2, [["0", "1", "0", "9", x] for x in "-7"]))
    rows = np.tile([0.5, 1.0, 0.0, 9.0], (300, 1))
    check_numbers(np.arange(300), rows, is_named=False)
    rows[:2, 0] = 1.5
    check_numbers(np.arange(300), rows, is_named=False)  # less than a hundredth
    rows[:9, 0] = 1.5
    with pytest.raises(UnclearColumns, match="9 of 300"):
        check_numbers(np.arange(300), rows, is_named=True)


def test_decimal_commas_beside_an_unnamed_column_are_left_out(log):
    rows = ["0,3333333,0,0,0,0", "1,0,0,0,1", "1,333333,0,0,0,0"]  # a lap before steering, throttle, brake and speed
    with pytest.raises(
        RecordingError, match="line 2: '1,0,0,0,1' may be four numbers with decimal commas, but not those in line 1;"
    ):
        log(*usual(rows))


def test_a_header_in_other_words_within_the_file_is_refused(log):
    rows = [line.replace(",-0.25", ",0.25") for line in swapped(10)]  # never steers left: the numbers show nothing
    with pytest.raises(RecordingError, match="line 5: neither a row nor a header with center and steering"):
        log(*usual(), "mitte,links,rechts,gas,lenkung,bremse,tempo", *rows)
    with pytest.raises(RecordingError, match="steering and steering_filtered both mean steering; rename"):
        log(HEADER + ",steering_filtered", *[line + ",0.5" for line in usual()])
    with pytest.raises(RecordingError, match="'throttle %' has another unit"):
        log(HEADER.replace("throttle", "throttle %"), *usual())


def with_commas(line):
    return line.replace(",", ";").replace(".", ",").replace(",jpg", ".jpg")


@pytest.mark.parametrize(
    "lines",
    [
        ["sep=;", with_commas(HEADER), *map(with_commas, usual())],  # as Excel writes it
        ["sep=,", HEADER, *usual()],
        ['"' + line.replace(",", '", "') + '"' for line in usual()],
        [f'{images(at)},"' + row.replace(",", '","').replace(".", ",") + '"' for at, row in enumerate(NUMBERS)],
        [f"{with_commas(images(at))};{with_commas(row)}".replace("IMG/", "a, b/") for at, row in enumerate(NUMBERS)],
        [
            with_commas("steering,throttle,brake,speed,center,left,right"),
            *[with_commas(f"{row},{images(at)}") for at, row in enumerate(NUMBERS)],
        ],
        [HEADER, *[line + "," for line in usual()]],
        [*usual()[:2], "\ufeffct_path,lt_path,rt_path,throttle,steer,brake,speed", *swapped()[2:]],  # two files joined
        [*usual()[:2], *["\ufeff" + line.replace("IMG/", "") for line in usual()[2:]]],
        [*usual(), "\x1a", "\xa0", "\x0b"],  # the end of a text file, once
    ],
)
def test_rows_that_other_programs_write(log, lines):
    found = log(*lines)
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert found.rejected == []
    assert [found.name(3, camera) for camera in range(3)] == [name[4:] for name in images(3).split(",")]


def test_decimal_commas_beside_a_note_with_a_point_are_left_out(log):
    with pytest.raises(RecordingError, match=r"line 2: '0,1,0,30,19023,Lake v1.2' are not four numbers"):
        log(*usual(["-0,05,0,5,0,9,25,Lake v1.2", "0,1,0,30,19023,Lake v1.2"]))


@pytest.mark.parametrize("speeds, numbers", [((20.5, 18, 15.5, 12), "0,0,1"), ((0, 1.5, 4, 6), "0.1,0,0.5")])
def test_short_recordings_of_braking_and_of_driving_backwards_are_kept(log, speeds, numbers):
    found = log(*[f"{images(at)},{numbers},{speed}" for at, speed in enumerate(speeds)])
    assert len(found) == 4
    kind = "the brake is pressed more than the throttle, as in braking or driving backwards"
    assert found.repairs == {kind: [4, 1]}


def test_exchanged_pedals_are_refused_where_the_car_keeps_its_speed(log):
    speeds = [30.19, 30.2, 30.1, 30.1, 29, 30, 30.2]
    with pytest.raises(RecordingError, match=r"the car is not seen to slow down in line 1: .* name the columns"):
        log(*[f"{images(at)},0.1,0,1,{speed}" for at, speed in enumerate(speeds)])


def test_images_of_different_times_are_left_out(log):
    sorted_alone = [line.replace("left_2018_07_16_17_11_43_002", "left_2018_07_16_17_11_43_001") for line in usual()]
    found = log(*sorted_alone)
    np.testing.assert_array_equal(found.lines, [1, 2, 4])
    ((line, kind, detail),) = found.rejected
    assert (line, kind) == (3, "images of different times") and "has a column been sorted or moved by itself?" in detail


def test_names_that_no_file_can_have_are_left_out(log):
    long = images(9).replace("center_", "center_" + "a" * 300)
    found = log(*usual(), f"{long},0.1,1,0,9")
    assert [(line, kind) for line, kind, _ in found.rejected] == [(5, "name too long")]
    assert found.names.dtype.itemsize < 50  # else one row would make the memory for all names grow


def test_only_names_without_letters_are_taken_to_be_at_their_usual_places(log):
    found = log("center,left,right,steering,0,,speed", *usual())
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert found.repairs == {"header lacks names; usual places taken": [1, 1]}
    with pytest.raises(RecordingError, match="line 1: the header lacks throttle; add"):
        log(HEADER.replace("throttle", "lap"), *usual())


def test_a_value_below_the_comma_at_a_headers_end_is_not_read(log):
    found = log(HEADER + ",", *[line + "," for line in usual()], f"{images(9)},1,0,0,0,0")
    np.testing.assert_array_equal(numbers(found), np.float32(VALUES))
    assert [(line, kind) for line, kind, _ in found.rejected] == [(6, "columns unclear")]


def test_a_brake_in_a_single_fast_row_may_be_the_throttle(log):
    with pytest.raises(RecordingError, match="the car is not seen to slow down in line 1: are they other columns"):
        log(f"{images(0)},0,0,0.5,16")
    assert len(log(f"{images(0)},0,0,0.5,9")) == 1  # such as driving backwards
