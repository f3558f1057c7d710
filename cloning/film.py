"""Films: H.264 in an mp4 file, whole or not there."""

from fractions import Fraction
from pathlib import Path

import numpy as np


class FilmWriter:
    """An mp4 film being written: H.264 in yuv420p, which browsers and desktop players play.

    PyAV's wheel brings FFmpeg's libraries with x264: no program to install, and the film is finished or an error.
    """

    def __init__(self, path: Path, rate: Fraction | int, quality: int = 18, preset: str = "medium"):
        """rate: frames a second; quality: x264's crf, less is better; preset: x264's. Raises OSError."""
        import av  # large, and needed only here

        self.path, self.rate, self.av = Path(path), rate, av
        self.options = {"crf": str(quality), "preset": preset}
        self.beside = self.path.with_name(f".{self.path.name}.part")
        self.beside.touch()  # PyAV itself opens the file only for the first frame
        self.container = av.open(str(self.beside), "w", format="mp4", options={"movflags": "faststart"})
        self.stream = None

    def add(self, frame: np.ndarray) -> None:
        """A frame, uint8 (rows, columns, 3), RGB, of the first one's size."""
        # yuv420p halves the colour's resolution, so both sides are even
        frame = np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
        if self.stream is None:
            self.stream = self.container.add_stream("libx264", self.rate, options=self.options)
            self.stream.pix_fmt, self.stream.height, self.stream.width = "yuv420p", *frame.shape[:2]
        self.container.mux(self.stream.encode(self.av.VideoFrame.from_ndarray(frame, "rgb24")))

    def close(self) -> None:
        """Put the finished film in its place; without a frame there is none."""
        if self.stream:
            self.container.mux(self.stream.encode(None))
        self.container.close()
        if self.stream:
            self.beside.replace(self.path)
        self.discard()

    def discard(self) -> None:
        """Leave no film."""
        self.beside.unlink(missing_ok=True)
