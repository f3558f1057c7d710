"""Images that are hostile, damaged, turned or no files: refused at the cost of their pixels, with name and reason."""

import io
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import warm
from commands import HERE, ROOT, SHORT, refused, run_here, same, trained, weights
from PIL import Image
from rendered import render_frame

import model
import simulator.__main__ as simulator
from cloning.base.errors import RecordingError
from cloning.network.network import SHIPPED_MODEL
from cloning.recordings import check
from cloning.recordings.check import check_images
from cloning.recordings.columns import Finding, Rejected
from cloning.recordings.images import MAX_BYTES, REMEDY, decode, encode, jpeg_size, read_frame, read_jpeg
from cloning.recordings.log import read_recording
from cloning.replay import command, replay

FRAME = render_frame(0.3, 0, np.random.default_rng(0))
HUGE = b"\xff\xc0\x00\x11\x08\x75\x30\x75\x30\x03\x01\x22\x00\x02\x11\x01\x03\x11\x01"  # a header of 30,000 x 30,000


def jpeg_of(mode="RGB", **options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(FRAME).convert(mode).save(file, "JPEG", **options)
    return file.getvalue()


TURNED = Image.Exif()
TURNED[0x0112] = 6  # an orientation, which the simulator's cameras do not write
PLAIN = jpeg_of()
HEADER = PLAIN.index(b"\xff\xc0")  # where the frame header is
SCAN = PLAIN.index(b"\xff\xda")
MARKERS = [b"\xff\x01", b"\xff\xff", b"\xff", b"\xff\xd0", b"\xff\xd8", b"\xff\xdc\0\4\xff\xff", b"\xff\xcc\0\2", b"\0"]


def inserted(data: bytes, at: int) -> bytes:
    return PLAIN[:at] + data + PLAIN[at:]


# To who takes FF01 for a segment, these three are one, and the frame is small. To who knows that FF01 stands alone, the
# frame is huge, and its small header, which follows, is a comment.
COMMENT = b"\xff\xfe\0\x15"
HIDDEN = [marker + (len(HUGE) + 6).to_bytes(2) + HUGE + COMMENT for marker in (b"\xff\x01", b"\xff\xd0", b"\xff\xd8")]


@pytest.mark.parametrize("piece", [HUGE, *HIDDEN, *(marker + HUGE for marker in MARKERS)])
def test_a_size_cannot_be_hidden_from_the_check(piece):
    for at in (2, HEADER, SCAN):
        with pytest.raises(ValueError, match=r"not a plain JPEG|not a JPEG|pixels where"):
            decode(inserted(piece, at))


def with_scans(count: int) -> bytes:
    """A progressive JPEG whose last scan is repeated."""
    jpeg = jpeg_of(progressive=True)
    last = jpeg.rindex(b"\xff\xda")
    return jpeg[:last] + jpeg[last:-2] * count + jpeg[-2:]


@pytest.mark.parametrize(
    ("jpeg", "reason"),
    [
        (with_scans(25), "not a plain JPEG"),  # each scan costs as much as a frame
        (inserted(b"\xff\xfe\0\2" * 200_000, 2), "more than 100 segments"),
        (jpeg_of("L"), "1 channels of 8 bits where 3 of 8 are expected"),
        (jpeg_of("CMYK"), "4 channels of 8 bits where 3 of 8 are expected"),
        (PLAIN.replace(b"\xff\xc0\0\x11\x08", b"\xff\xc1\0\x11\x0c"), "3 channels of 12 bits"),
        (PLAIN.replace(b"\xff\xc0", b"\xff\xc9"), "not a plain JPEG"),  # arithmetic coding
        (inserted(b"\xff\xfe\xff\xff" + bytes(65533), 2) + bytes(MAX_BYTES), f"larger than {MAX_BYTES} bytes"),
        (PLAIN[: len(PLAIN) // 2] + PLAIN, "not a plain JPEG"),  # one file begun in the middle of another
        (b"\xff\xd8\xff\xd9", "no picture in it"),
        (PLAIN[:HEADER] + PLAIN[SCAN:], "no picture in it"),
        (PLAIN[:SCAN] + b"\xff\xd9", "no picture in it"),
        (PLAIN.replace(b"\xff\xdb", b"\xff\xfe"), "damaged"),  # without quantization tables
        (PLAIN[:-3000] + bytes(512) + PLAIN[-2488:], "damaged: zeros in the middle of it"),
        (cv2.imencode(".png", FRAME)[1].tobytes(), "not a JPEG but a PNG"),
        (b"version https://git-lfs.github.com/spec/v1\noid", "a pointer of Git LFS: run `git lfs pull`"),
    ],
)
def test_what_no_camera_of_the_simulator_writes_is_refused(jpeg, reason):
    with pytest.raises(ValueError, match=reason):
        decode(jpeg)


@pytest.mark.parametrize(
    "jpeg",
    [
        jpeg_of(progressive=True),
        jpeg_of(optimize=True),
        jpeg_of(quality=100, subsampling=0),
        jpeg_of(restart_marker_blocks=5),
        jpeg_of(exif=TURNED),
        inserted(b"\xff\xe1\x00\x40Exif\0\0" + PLAIN[:56], 2),  # a thumbnail
        PLAIN + b"\xff\xd8 another picture",
    ],
)
def test_what_other_encoders_write_is_read_as_they_meant(jpeg):
    expected = np.array(Image.open(io.BytesIO(jpeg))).astype(int)
    assert np.abs(decode(jpeg).astype(int) - expected).mean() < 1


def test_a_jpeg_cut_at_any_byte_is_refused():
    assert jpeg_size(PLAIN) == (160, 320)
    for length in range(0, len(PLAIN) - 1, 97):
        with pytest.raises(ValueError, match=r"empty|cut short|not a JPEG"):
            jpeg_size(PLAIN[:length])


def decode_mutations() -> None:
    """Run in a process whose OpenCV takes no more than 160 x 320 pixels: it must never be asked to take more.

    JPEGs have bytes of the header changed, and markers, huge frame headers and other segments put in between.
    """
    rng, whole = random.Random(0), 0
    pieces = [*MARKERS, *HIDDEN, HUGE, HUGE.replace(b"\xff\xc0", b"\xff\xc2"), PLAIN[HEADER:SCAN]]
    originals = [PLAIN, jpeg_of(progressive=True)]
    for _ in range(1500):
        mutation = bytearray(rng.choice(originals))
        borders = [at for at in range(2, SCAN + 14) if mutation[at] == 0xFF]
        for _ in range(rng.randint(0, 3)):
            mutation[rng.randrange(SCAN + 40)] = rng.choice([0, 1, 0xFF, rng.randrange(256)])
        for _ in range(rng.randint(0, 3)):
            at = rng.choice(borders)
            mutation[at:at] = rng.choice(pieces)
        jpeg = bytes(mutation)
        try:
            assert decode(jpeg).shape == (160, 320, 3)
            whole += 1
        except ValueError as error:
            assert "IMAGE_PIXELS" not in str(error.__cause__), jpeg[: SCAN + 100].hex()
    print(whole)


def test_the_decoder_never_sees_another_size_than_the_check():
    done = subprocess.run(
        [sys.executable, "-c", "import test_images; test_images.decode_mutations()"],
        cwd=Path(__file__).parent,
        env={**os.environ, **HERE, "OPENCV_IO_MAX_IMAGE_PIXELS": str(160 * 320)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100


# ----------------------------------------------------------------------------------------------------------------------
# Files


def test_what_is_no_regular_file_is_not_read(tmp_path):
    (tmp_path / "folder.jpg").mkdir()
    with pytest.raises(ValueError, match=r"Is a directory|Permission denied"):
        read_jpeg(tmp_path / "folder.jpg")
    with pytest.raises(ValueError, match="No such file"):
        read_jpeg(tmp_path / "gone.jpg")
    with open(tmp_path / "huge.jpg", "wb") as file:
        file.truncate(1 << 33)
    assert len(read_jpeg(tmp_path / "huge.jpg")) == MAX_BYTES + 1
    with pytest.raises(RecordingError, match=r"huge\.jpg: not a JPEG; put the right JPEG"):
        read_frame(tmp_path / "huge.jpg")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes or devices among files")
def test_rows_of_links_pipes_and_folders_are_left_out(copied):
    images = sorted((copied / "IMG").glob("center*"))[:5]
    for image in images:
        image.unlink()
    images[0].symlink_to(copied / "nowhere")
    images[1].symlink_to(images[1].name)  # to itself
    images[2].symlink_to("/dev/zero")
    images[3].mkdir()
    os.mkfifo(images[4])
    found = check_images(read_recording(copied))
    assert len(found) == 55
    missing, unusable = Finding.IMAGE_MISSING, Finding.IMAGE_UNUSABLE
    reasons = ["missing; its link leads nowhere: copy the image instead, or delete the row"] * 2
    reasons += [f"{why}; {REMEDY}" for why in ("not a regular file", "Is a directory", "not a regular file")]
    assert [row.finding for row in found.rejected] == [missing, missing, unusable, unusable, unusable]
    assert [row.detail for row in found.rejected] == [
        f"IMG/{image.name}: {reason}" for image, reason in zip(images, reasons, strict=True)
    ]


def test_images_are_checked_named_and_left_out(copied, monkeypatch):
    images = sorted((copied / "IMG").glob("center*"))
    whole = images[4].read_bytes()
    images[1].unlink()
    damaged = {
        2: (b"", "empty"),
        3: (whole[: len(whole) // 2], "cut short"),
        4: (whole[:-2000] + bytes(2000), "cut short"),  # what a crash leaves: the end is zeros
        5: (b"not an image", "not a JPEG"),
        6: (encode(np.zeros((480, 640, 3), np.uint8), 75), "640x480 pixels where 320x160 are expected"),
    }
    for at, (jpeg, _) in damaged.items():
        images[at].write_bytes(jpeg)
    left, right = (
        images[at].with_name(images[at].name.replace("center", side)) for at, side in ((7, "left"), (8, "right"))
    )
    copies = {left: images[7], right: Path(str(right).replace("right", "left")), images[9]: images[0]}
    for copy, original in copies.items():
        copy.write_bytes(original.read_bytes())
    images[12].write_bytes(images[10].read_bytes())  # as where a frame was lost
    given = read_recording(copied)
    found = check_images(given)
    assert len(given) == 60 and given.rejected == [], "not changed"
    expected = [Rejected(2, Finding.IMAGE_MISSING, f"IMG/{images[1].name}: missing; {REMEDY}")]
    for at, (_, reason) in damaged.items():
        detail = f"IMG/{images[at].name}: {reason}; {REMEDY}"
        expected.append(Rejected(at + 1, Finding.IMAGE_UNUSABLE, detail))
    for line, (copy, original) in enumerate(copies.items(), 8):
        detail = f"IMG/{copy.name}: the same picture as {original.name}; {REMEDY}"
        expected.append(Rejected(line, Finding.IMAGE_UNUSABLE, detail))
    assert found.rejected == expected
    assert set(found.lines) == set(range(1, 61)) - set(range(2, 11))
    looked_at = Mock(side_effect=decode)
    monkeypatch.setattr(check, "decode", looked_at)
    again = check_images(read_recording(copied))
    read_again = {jpeg for (jpeg,), _ in looked_at.call_args_list}
    assert read_again == {jpeg for jpeg, _ in damaged.values()}, "unchanged images are not decoded again"
    np.testing.assert_array_equal(again.digests, found.digests)


def test_ctrl_c_does_not_wait_for_all_images_and_loses_none_that_was_checked(copied, monkeypatch):
    read, at_once = Mock(side_effect=read_jpeg), check.IMAGES_AT_ONCE
    monkeypatch.setattr(check, "read_jpeg", read)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("cloning.base.progress.Bar.update", Mock(side_effect=[*[None] * at_once, KeyboardInterrupt]))
        check_images(read_recording(copied), threads=1)
    assert read.call_count <= 2 * at_once < 180
    read.reset_mock()
    assert len(check_images(read_recording(copied))) == 60 and read.call_count == 180 - at_once


def upper_case_endings(folder: Path) -> None:
    for image in list((folder / "IMG").iterdir()):
        image.rename(image.with_suffix(".JPG"))


def nest(folder: Path) -> None:
    """Give each camera a folder of its own."""
    for image in list(folder.iterdir()):
        camera = folder / image.name.split("_")[0]
        camera.mkdir(exist_ok=True)
        image.rename(camera / image.name)


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (lambda folder: (folder / "IMG").rename(folder / "img"), "move the images from {0}/img to {0}/IMG"),
        (lambda folder: nest(folder / "IMG"), "move the images from {0}/IMG/center to {0}/IMG"),
        (upper_case_endings, "rename center_2018_07_16_17_11_43_067.JPG, which differs in upper and lower case"),
        (lambda folder: shutil.rmtree(folder / "IMG"), "there is no folder IMG: copy it beside driving_log.csv"),
    ],
)
def test_the_cause_of_missing_images_is_named(copied, tmp_path, change, remedy, capsys):
    if (copied / "img").exists():
        pytest.skip("this file system ignores case")
    change(copied)
    first = f"{copied / 'driving_log.csv'}: line 1: left out: IMG/center_2018_07_16_17_11_43_067.jpg: missing; "
    first += remedy.format(copied)
    for options in ((), ("--robust",)):
        done = run_here(copied, *options, "--output", tmp_path / "model.pt")
        assert done.returncode == 2 and first in done.stdout
        assert "0 of 60 rows are left, at least 5 are needed: most can't be used, see above" in done.stderr
    with pytest.raises(RecordingError, match=r"driving_log\.csv: no usable row is left to replay"):
        replay.load_recording(copied)
    assert first in capsys.readouterr().out


def test_a_log_among_its_images_is_to_be_moved_up(copied):
    (copied / "driving_log.csv").rename(copied / "IMG" / "driving_log.csv")
    told = check_images(read_recording(copied / "IMG")).rejected[0].detail
    assert told.endswith(f"missing; move driving_log.csv from {copied}/IMG to the folder above")


def test_a_name_that_the_terminal_cannot_show_is_printed_as_escapes(copied, tmp_path):
    log = copied / "driving_log.csv"
    log.write_bytes(log.read_bytes().replace(b"_2018", b"_\xff018", 18))
    command = [sys.executable, ROOT / "model.py", copied, "--throttle-threshold", "2"]
    done = warm.run(command, cwd=tmp_path, capture_output=True, timeout=300)
    assert b"--throttle-threshold drops" in done.stderr
    assert rb"line 1: left out: IMG/center_\udcff018_07_16_17_11_43_067.jpg: missing" in done.stdout
    assert rb"and 1 more of this kind" in done.stdout


def cut(image: Path) -> None:
    image.write_bytes(image.read_bytes()[:3000])


@pytest.mark.parametrize(("change", "reason"), [(Path.unlink, "No such file or directory"), (cut, "cut short")])
def test_an_image_that_changes_while_it_is_replayed_is_named(copied, monkeypatch, capsys, change, reason):
    def lines_then_change(recording, by_lane):
        lines = replay.reference_lines(recording, by_lane)
        change(recording.path(30))
        return lines

    monkeypatch.setattr(command, "reference_lines", lines_then_change)
    assert simulator.main(["replay", str(copied), "--model", str(SHIPPED_MODEL), "--reference", "human"]) == 2
    name = sorted((copied / "IMG").glob("left*"))[30].name.replace("left", "center")
    assert capsys.readouterr().err == (
        f"python: {copied / 'IMG' / name}: {reason}; put the right JPEG in its place, or delete the row\n"
    )


def test_an_image_that_changes_during_training_is_named_and_can_be_restored(copied, finished, tmp_path, monkeypatch):
    images, split = {path: path.read_bytes() for path in (copied / "IMG").iterdir()}, model.split

    def cut_then_split(*arguments):
        for image in images:
            cut(image)
        return split(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(model, "split", cut_then_split)
        told = refused(copied, *SHORT, "--output", tmp_path / "model.pt")
    assert ".jpg: cut short" in told and str(copied / "IMG") in told and "Restore it and continue with --resume" in told
    for image, jpeg in images.items():
        image.write_bytes(jpeg)
    trained(*SHORT, "--output", tmp_path / "model.pt", "--resume")
    assert same(weights(tmp_path / "model.pt"), weights(finished[1] / "model.pt"))


# ----------------------------------------------------------------------------------------------------------------------
# The cache of checked images


@pytest.fixture
def checked(copied) -> tuple[Path, Path, Path]:
    """A recording that was checked before its image 7 was replaced by a bad one of the same size and time.

    Returns its folder, its cache, and the bad image.
    """
    recording = check_images(read_recording(copied))
    image = copied / "IMG" / os.fsdecode(recording.names[7])
    state = image.stat()
    image.write_bytes(bytes(state.st_size))
    os.utime(image, ns=(state.st_atime_ns, state.st_mtime_ns))
    (cache,) = Path(os.environ["XDG_CACHE_HOME"]).rglob("*.npz")
    return copied, cache, image


def rewritten(cache: Path, **columns) -> None:
    with np.load(cache) as file:
        columns = {**file, **columns}
    np.savez(cache, **{name: column for name, column in columns.items() if column is not None})


def as_folder(cache: Path, images: np.ndarray) -> None:
    cache.unlink()
    cache.mkdir()


@pytest.mark.parametrize(
    "damage",
    [
        lambda cache, images: rewritten(cache, rules=None),
        lambda cache, images: rewritten(cache, rules=check.RULES - 1),
        lambda cache, images: rewritten(cache, images=None),
        lambda cache, images: rewritten(cache, images=images[:0]),
        lambda cache, images: rewritten(cache, images=images["name"]),
        lambda cache, images: rewritten(cache, images=images.astype(object)),
        lambda cache, images: cache.write_bytes(b"no cache"),
        lambda cache, images: cache.write_bytes(cache.read_bytes()[:-100]),
        as_folder,
    ],
)
def test_a_cache_that_this_version_has_not_written_is_not_believed(checked, damage, capsys):
    folder, cache, image = checked
    assert len(check_images(read_recording(folder))) == 60, "what this version has written is believed"
    with np.load(cache) as file:
        damage(cache, file["images"])
    (row,) = check_images(read_recording(folder)).rejected
    assert row.detail == f"IMG/{image.name}: not a JPEG; put the right JPEG in its place, or delete the row"
    assert f"{cache}: unreadable" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="Windows always knows a home")
def test_where_no_home_is_known_the_cache_is_a_temporary_one(linked, tmp_path, monkeypatch, capsys):
    """As in a container that runs as a user without a name."""
    for name in ("XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert len(check_images(read_recording(linked))) == 60
    assert list((tmp_path / "behavioral-cloning").glob("*.npz")) and not capsys.readouterr().out


def test_no_damage_to_the_cache_makes_a_changed_image_usable(checked):
    folder, cache, image = checked
    image.write_bytes(b"changed")
    whole, rng = cache.read_bytes(), random.Random(0)
    for _ in range(30):
        damaged = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        cache.write_bytes(damaged[: rng.choice([len(damaged), rng.randrange(len(damaged))])])
        recording = check_images(read_recording(folder))
        assert len(recording) == 59 and not any(recording.digests[7:8])
