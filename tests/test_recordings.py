"""driving_log.csv in the nineteen shapes met in the wild, and IMG/ with everything that goes wrong in it."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import render_recording

from cloning.base.errors import RecordingError
from cloning.recordings.check import check_images
from cloning.recordings.images import decode, jpeg_size
from cloning.recordings.log import find_folders, read_recording

STAMPS = ["2018_07_16_17_11_43_382", "2018_07_16_17_11_43_453", "2018_07_16_17_11_43_524"]


def row(stamp, rest, before="", between=",", cameras=("center", "left", "right")):
    return between.join(f"{before}{camera}_{stamp}.jpg" for camera in cameras) + between + rest


def log(tmp_path, *lines, end="\n", encoding="utf-8"):
    (tmp_path / "driving_log.csv").write_bytes((end.join(lines) + end).encode(encoding))
    return read_recording(tmp_path)


WINDOWS = "C:\\Users\\driver\\Desktop\\track3\\IMG\\"
EXPECTED = [(-0.0597, 0.98, 0, 30.18), (0, 1, 0, 6.9e-05), (0.25, 0.3, 0, 22.14829)]
PLAIN = ["-0.0597,0.98,0,30.18", "0,1,0,6.9E-05", "0.25,0.3,0,22.14829"]
SPACED = [numbers.replace(",", ", ") for numbers in PLAIN]


def numbers(found):
    return np.column_stack([found.steering, found.throttle, found.brake, found.speed])


def lines(before="", numbers=PLAIN, between=","):
    return [row(stamp, rest, before, between) for stamp, rest in zip(STAMPS, numbers, strict=True)]


@pytest.mark.parametrize(
    "text",
    [
        lines("/Users/driver/data/IMG/"),  # 1
        lines(WINDOWS),  # 2
        lines("/data/IMG/", SPACED, ", "),  # 3
        ["center,left,right,steering,throttle,brake,speed", *lines("IMG/", SPACED, ", ")],  # 4
        [line + "\r" for line in lines("IMG/", between=", ")],  # 5
        ["Center,Left,Right,SteeringAngle,Throttle,Brake,Speed", *lines("IMG/")],  # 6
        ["camera_center, camera_left, camera_right,steering,0,0,speed", *lines("IMG/")],
        ["ct_path,lt_path,rt_path,steer,throttle,brake,speed,high_level_control", *[x + ",3" for x in lines("IMG/")]],
        [
            ",center,left,right,steering,throttle,brake,speed",
            *[f"{i + 17},{x}" for i, x in enumerate(lines("IMG/"))],
        ],  # 7
        lines(),  # 8
        lines("./IMG/"),
        lines("/IMG/"),
        lines("IMG_Ori\\"),
        lines("D:\\montravail\\IMG\\IMG\\"),  # 9
        lines("/home/driver/Behavioral Cloning/data rev/IMG/"),  # 10
        [lines(WINDOWS)[2], lines("/home/a b/IMG/")[0], lines("IMG/", SPACED, ", ")[1]],  # 11: mixed, out of date order
        lines("C:\\Users\\Doe, John\\IMG\\"),
        [x.replace("E-05", "e-05") for x in lines()],
        ["\ufeff" + lines()[0], *lines()[1:]],
        ['"' + x.replace(",", '","') + '"' for x in lines()],
        [
            "steering,center,left,right,speed,brake,throttle",
            *[",".join([r[3], *r[:3], r[6], r[5], r[4]]) for r in (x.split(",") for x in lines("IMG/"))],
        ],
    ],
)
def test_formats_that_are_read_correctly(tmp_path, text):
    found = log(tmp_path, *text)
    np.testing.assert_allclose(numbers(found), EXPECTED, rtol=1e-6)
    names = [os.fsdecode(found.names[i]) for i in found.images[1]]
    assert names == [f"{camera}_{STAMPS[1]}.jpg" for camera in ("center", "left", "right")]
    assert not found.rejected
    np.testing.assert_allclose(np.diff(found.time), 0.071, atol=1e-4)


@pytest.mark.parametrize(
    "text, kind",
    [
        (lines(numbers=["-0,0597,0,98,0,30,18", "0,1,0,6,9E-05", "0,25,0,3,0,22,14829"]), "decimal commas"),  # 12
        (
            lines(numbers=["-0.0597,0.98,0,30.18,-", "0,1,0,6.9E-05", "0.25,0.3,0,22.14829,Lake: turning left"]),
            "extra columns ignored",
        ),  # 13
        ([x.replace(",", "\t") for x in lines()], "tab-separated"),  # 15
        ([x.replace(",", ";").replace(".", ",").replace(",jpg", ".jpg") for x in lines()], "decimal commas"),
    ],
)
def test_formats_that_are_repaired_and_reported(tmp_path, text, kind):
    found = log(tmp_path, *text)
    np.testing.assert_allclose(numbers(found), EXPECTED, rtol=1e-6)
    assert found.repairs[kind][1] == 1
    assert not found.rejected


def test_the_facts_own_decimal_commas(tmp_path):
    found = log(tmp_path, *lines(numbers=["-0,004694836,1,0,30,19023", "0,1,0,30,19", "0,0,1,0,5"]))
    np.testing.assert_allclose(numbers(found), [(-0.004694836, 1, 0, 30.19023), (0, 1, 0, 30.19)], rtol=1e-6)
    line, kind, detail = found.rejected[0]  # 0 | 0,1 | 0 | 5 or 0 | 0 | 1 | 0,5: never guessed
    assert (line, kind) == (3, "ambiguous columns")
    assert "2 ways" in detail


@pytest.mark.parametrize(
    "bad, words",
    [
        (row(STAMPS[1], "0,0.38,0,19647"), "speed 19647"),  # 14
        ("=======", "merge"),
        ("<<<<<<< HEAD", "merge"),  # 16
        ("IMG/center_x.jpg, 0.0", "1 image name"),  # 18
        (row(STAMPS[1], "1.2,0,0,9"), "steering 1.2"),
        (row(STAMPS[1], "nan,0,0,9"), "nan,0,0,9"),  # 19
        (row(STAMPS[1], "0.1,left,0,9"), "0.1,left"),
        (row(STAMPS[1], "0.1,0.2"), "2 numbers"),
        ("\0\0\0\0", "cut off"),
        (row(STAMPS[1], ",1,0,9"), ",1,0,9"),
        (row(STAMPS[1], "0,inf,0,9"), "0,inf,0,9"),
    ],
)
def test_rows_that_are_left_out_and_reported(tmp_path, bad, words):
    found = log(tmp_path, lines()[0], bad, lines()[2])
    np.testing.assert_allclose(numbers(found), [EXPECTED[0], EXPECTED[2]], rtol=1e-6)
    ((line, _, detail),) = found.rejected
    assert line == 2
    assert words in detail


@pytest.mark.parametrize(
    "content, words",
    [
        (b"PK\x03\x04rest", "Excel"),
        (b"\x00\x05\x16\x07rest", "AppleDouble"),
        (b"", "no usable row"),
        (b"IMG/center_x.jpg, 0.0\n", "1 image name"),
        (b"some words\n", "neither a row nor a header"),
        (b"center,left,right,throttle,brake,speed\n", "steering"),
    ],
)
def test_files_that_are_refused(tmp_path, content, words):
    path = tmp_path / "driving_log.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=words) as error:
        read_recording(tmp_path)
    assert str(path) in str(error.value)


def test_utf_16_and_no_newline_at_the_end(tmp_path):
    (tmp_path / "driving_log.csv").write_bytes("\n".join(lines()).encode("utf-16"))
    np.testing.assert_allclose(numbers(read_recording(tmp_path)), EXPECTED, rtol=1e-6)


def test_apple_double_beside_the_real_one_is_not_looked_at(tmp_path):
    (tmp_path / "._driving_log.csv").write_bytes(b"\x00\x05\x16\x07")
    assert len(log(tmp_path, *lines())) == 3


def test_images_are_checked_named_and_left_out(copied):
    images = sorted((copied / "IMG").glob("center*"))
    whole = images[4].read_bytes()
    images[1].unlink()
    images[2].write_bytes(b"")
    images[3].write_bytes(whole[: len(whole) // 2])
    images[4].write_bytes(whole[:-2000] + bytes(2000))  # what a crash leaves: the end is zeros
    images[5].write_bytes(b"not an image")
    cv2.imwrite(str(images[6]), np.zeros((480, 640, 3), np.uint8))
    found = read_recording(copied)
    check_images(found)
    assert {(line, kind) for line, kind, _ in found.rejected} == {
        (2, "image missing"),
        (3, "image empty"),
        (4, "image cut short"),
        (5, "image cut short"),
        (6, "image not a JPEG"),
        (7, "image 640x480 pixels where 320x160 are expected"),
    }
    assert all(f"IMG/{images[line - 1].name}" in detail for line, _, detail in found.rejected)
    assert len(found) == 60 - 6
    assert set(found.lines) == set(range(1, 61)) - set(range(2, 8))


def test_unchanged_images_are_not_looked_at_again(copied, monkeypatch):
    first = read_recording(copied)
    check_images(first)
    looked_at = []
    monkeypatch.setattr("cloning.recordings.check.decode", lambda jpeg: looked_at.append(jpeg) or decode(jpeg))
    changed = copied / "IMG" / os.fsdecode(first.names[7])
    changed.write_bytes(changed.read_bytes()[:100])
    again = read_recording(copied)
    check_images(again)
    assert looked_at == [changed.read_bytes()]
    assert len(again) == len(first) - 1
    np.testing.assert_array_equal(np.delete(again.digests, 7), np.delete(first.digests, 7))


def test_a_damaged_cache_is_told_and_replaced(copied, capsys):
    check_images(read_recording(copied))
    (cache,) = Path(os.environ["XDG_CACHE_HOME"]).rglob("*.npz")
    whole = cache.read_bytes()
    cache.write_bytes(whole[:-200])
    recording = read_recording(copied)
    check_images(recording)
    assert len(recording) == 60 and "unreadable" in capsys.readouterr().out
    assert cache.read_bytes() == whole


def test_size_from_the_header_and_cut_at_every_byte(sample_recording):
    jpeg = next((sample_recording / "IMG").iterdir()).read_bytes()
    assert jpeg_size(jpeg) == (160, 320)
    for length in range(0, len(jpeg) - 1, 97):
        with pytest.raises(ValueError, match=r"empty|cut short|not a JPEG"):
            jpeg_size(jpeg[:length])


def test_colour_is_rgb(tmp_path):
    frame = np.zeros((160, 320, 3), np.uint8)
    frame[..., 0] = 255  # OpenCV writes BGR: a blue frame
    assert decode(cv2.imencode(".jpg", frame)[1].tobytes())[80, 160].argmax() == 2


def test_a_recording_without_time_stamps_keeps_the_file_order(tmp_path):
    text = [f"a{i}.jpg,b{i}.jpg,c{i}.jpg,0.{i},1,0,9" for i in (3, 1, 2)]
    found = log(tmp_path, *text)
    np.testing.assert_allclose(found.steering, [0.3, 0.1, 0.2], rtol=1e-6)
    np.testing.assert_allclose(np.diff(found.time), 1 / 15)


def test_the_sample_recording_is_whole(tmp_path):
    found = read_recording(render_recording(tmp_path / "a b", rows=3))
    check_images(found)
    assert (found.rows_read, len(found), found.rejected, found.repairs) == (3, 3, [], {})


def test_folders_are_found_below_links_and_each_once(tmp_path):
    for name in ("disk/lake", "disk/more/jungle", "data/own"):
        render_recording(tmp_path / name, rows=1)
    data = tmp_path / "data"
    try:
        (data / "disk").symlink_to(tmp_path / "disk")
        (data / "own" / "up").symlink_to(data)
    except OSError:
        pytest.skip("Windows lets only privileged users make symbolic links")
    found = find_folders([str(data), str(tmp_path / "disk" / "lake")])
    assert [folder.relative_to(data).as_posix() for folder in found] == ["disk/lake", "disk/more/jungle", "own"]
    with pytest.raises(RecordingError, match="no such folder"):
        find_folders([str(tmp_path / "nowhere")])
