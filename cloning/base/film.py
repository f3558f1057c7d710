"""Write films: H.264 in mp4 files that are either complete or absent."""

import contextlib
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from cloning.base.errors import OutputError
from cloning.base.files import written_whole

if TYPE_CHECKING:
    from av.video.stream import VideoStream


MAX_FRAME_GAP = 1.0  # s: a longer gap between two frames is a pause, which does not count for the rate
MAX_RATE = 240.0  # frames/s that a film is given from its frames' times


def frame_rate(times: Sequence[float], otherwise: float) -> Fraction:
    """Return frames per second, 1..240, from the frames' times in seconds without pauses.

    It is the mean, not the median, because frames arrive in bunches of two or three. otherwise: the rate if no time
    passes between the frames, as with a single one.
    """
    gaps = [gap for before, after in pairwise(times) if 0 <= (gap := after - before) < MAX_FRAME_GAP]
    rate = min(MAX_RATE, max(1.0, len(gaps) / sum(gaps))) if sum(gaps) else otherwise
    return Fraction(rate).limit_denominator(1000)


class FilmWriter:
    """Writes an mp4 film: H.264 in yuv420p, which browsers and desktop players show.

    PyAV's wheel contains FFmpeg's libraries with x264, so there is no program to install. Use one writer from one
    thread only. As a context, it finishes the film at its end. After an error the unfinished film is deleted at once.
    """

    def __init__(
        self,
        path: str | Path,
        rate: Fraction | int,
        quality: int = 18,
        max_bits: int | None = None,
        key_frames: int | None = None,
    ):
        """Open the film; it appears at `path` when it is closed.

        rate: frames per second; quality: x264's crf, 0..51, lower is better; max_bits: bits/s above which the quality
        is lowered, or None; key_frames: one at least after so many frames, and none is made from later ones, so that
        programs can cut the film; x264's 250 if None. Raises OSError.
        """
        import av  # slow to import, and not needed without a film

        self.path, self.rate, self.av = Path(path), rate, av
        # The preset "medium" takes three times as long, and its films of frames with an overlay are as large.
        self.options = {"crf": str(quality), "preset": "veryfast"}
        if max_bits:
            self.options |= {"maxrate": str(max_bits), "bufsize": str(2 * max_bits)}
        if key_frames:
            self.options |= {"g": str(key_frames), "bf": "0"}
        self.stream: VideoStream | None = None
        self.frames = 0
        self._renaming = contextlib.ExitStack()  # renames the temporary file when it is closed
        self.temporary = self._renaming.enter_context(written_whole(path))
        try:
            self.temporary.touch()  # PyAV opens the file only for the first frame
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error
        self.container = av.open(str(self.temporary), "w", format="mp4", options={"movflags": "faststart"})

    def add(self, frame: np.ndarray, is_key: bool = False) -> None:
        """Append a frame, uint8 (rows, columns, 3), RGB, of the first frame's size. Raises OSError.

        is_key: make it a key frame, where the film can be cut.
        """
        # Drop an odd last row or column: yuv420p stores colour at half the resolution.
        frame = np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
        with self._discarded_on_error():
            if self.stream is None:
                self.stream = self.container.add_stream("libx264", self.rate, options=self.options)
                self.stream.pix_fmt, self.stream.height, self.stream.width = "yuv420p", *frame.shape[:2]
            frames = [self.av.VideoFrame.from_ndarray(frame, "rgb24")]
            if is_key:
                frames[0].pict_type = self.av.video.frame.PictureType.I
            # Ctrl-C between the two calls would lose what the first returns, and a film is black without its beginning.
            any(map(self.container.mux, map(self.stream.encode, frames)))
        self.frames += 1

    def close(self) -> None:
        """Finish the film and move it to its path; write no film if there is no frame. Raises OSError."""
        if self.stream is None or not self.frames:  # Ctrl-C may have come between the stream and its first frame
            self.discard()
            return
        with self._discarded_on_error():
            self.container.mux(self.stream.encode(None))
            self.container.close()
        self._renaming.close()

    def discard(self) -> None:
        """Delete the unfinished film; a finished one stays."""
        with contextlib.suppress(OSError, self.av.FFmpegError):  # the disk may be too full for the end of the file
            self.container.close()
        # So the first error is told: on Windows a file that is open can't be deleted, and FFmpeg leaves one open whose
        # first bytes it could not write.
        with contextlib.suppress(RuntimeError), self._renaming:
            raise RuntimeError("discarded")  # deletes the temporary file, if that can be done

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        try:
            if error is None:
                self.close()
        finally:
            self.discard()  # also if Ctrl-C comes while it is finished

    @contextlib.contextmanager
    def _discarded_on_error(self) -> Iterator[None]:
        try:
            yield
        except (OSError, self.av.FFmpegError) as error:
            self.discard()
            raise OSError(error.errno, error.strerror, str(self.path)) from error


class DriveFilm:
    """A film of a drive that never interrupts the drive: `close` raises the error if a frame could not be written."""

    def __init__(self, path: str, rate: Fraction | int, quality: int, max_bits: int | None = None):
        """Open the film; rate, quality, max_bits: of `FilmWriter`. Raises OutputError."""
        self.path = path
        self.error: OSError | None = None
        try:
            self.writer = FilmWriter(path, rate, quality, max_bits)
        except OSError as error:
            raise OutputError(
                f"{path}: {error.strerror}; name another file, in a folder that can be written"
            ) from error

    def add(self, frame: np.ndarray) -> None:
        """Append a frame, uint8 (rows, columns, 3), RGB; do nothing after an error."""
        if self.error is None:
            try:
                self.writer.add(frame)
            except OSError as error:
                self.error = error

    def close(self) -> None:
        """Finish the film. Raises OutputError if it could not be written; no file is left in that case."""
        try:
            if self.error:
                raise self.error
            self.writer.close()
        except OSError as error:
            remedy = "free some disk space, or leave out the film"
            raise OutputError(f"{self.path}: {error.strerror}; no film was written: {remedy}") from error
