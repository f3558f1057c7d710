"""Make the film at the top of README.md: a network drives both tracks, and what it looks at is shown in magenta.

    python -m tools.readme_film                     # the network that comes with the project
    python -m tools.readme_film model.pt film.webp  # another one, into another file

Left the car from behind, right what its camera sees: first on the lake, then in the jungle, without and with shadows,
as the stand-in simulator renders them. The film is an animated WebP, which web pages show like a picture.
"""

import io

import cv2
import gymnasium
import numpy as np
import torch
from PIL import Image

import simulator.environment as environment
from cloning.base import program
from cloning.base.arguments import command_line
from cloning.base.errors import UserError
from cloning.base.outputs import check_folders, write_output
from cloning.network.attention import visual_backprop
from cloning.network.network import SHIPPED_MODEL, Network, load_model
from cloning.recordings.format import SAMPLE_RATE
from cloning.road.overlay import overlay
from simulator.scenery.looks import SHADOWED
from tools.command import ROOT

FILM = ROOT / "diagnostic_images" / "report" / "driving.webp"
CLIPS = (("lake", 0), ("jungle", 0), ("jungle", SHADOWED))  # track and look of each, one after the other
STARTS, SECONDS = {"lake": 29, "jungle": 15}, 3  # s from the start of a lap to a bend with shadows; of each clip
EVERY = 2  # frames: 7.5 a second are enough
QUALITY, EFFORT = 35, 6  # of 100; of 6: the film has 0.6 MB
SEES = "what it sees; green: where it steers; magenta: what it looks at"
ROWS, STRIP = 200, 26  # of the pictures, and of the captions above them
WHITE, ABOVE = (255, 255, 255), 18  # of the captions: colour, and row of their letters' feet


def panel(picture: np.ndarray, words: str) -> np.ndarray:
    """Return a picture, uint8 (rows, columns, 3), RGB, with ROWS rows and its caption above it."""
    columns = round(picture.shape[1] * ROWS / picture.shape[0])
    fine = cv2.INTER_CUBIC if picture.shape[0] < ROWS else cv2.INTER_AREA
    strip = np.zeros((STRIP, columns, 3), np.uint8)
    cv2.putText(strip, words, (8, ABOVE), cv2.FONT_HERSHEY_SIMPLEX, 0.45, WHITE, 1, cv2.LINE_AA)
    return np.concatenate([strip, cv2.resize(picture, (columns, ROWS), interpolation=fine)])


def clip(network: Network, track: str, look: int) -> list[np.ndarray]:
    """Drive at 15 mph and return the frames of a clip: uint8 (ROWS + STRIP, columns, 3), RGB."""
    env = gymnasium.make(environment.ID, track=track, look=look, speed=15, render_mode="rgb_array")
    frames: list[np.ndarray] = []
    frame, _ = env.reset(seed=0)
    road = f"the {track}{', in shadow' * (look == SHADOWED)}: a network steers"
    for step in range((STARTS[track] + SECONDS) * SAMPLE_RATE):
        steering, mask = visual_backprop(network, frame)
        if step >= STARTS[track] * SAMPLE_RATE and step % EVERY == 0:
            sees = panel(overlay(frame, steering, mask), SEES)
            frames.append(np.concatenate([panel(np.asarray(env.render()), road), sees], axis=1))
        frame, _, terminated, _, _ = env.step(np.array([steering, 1], np.float32))
        if terminated:
            raise UserError(f"the network leaves the road of the {track} in look {look}; film another one")
    env.close()
    return frames


def main(argv: list[str] | None = None) -> int:
    """Drive the clips and write the film; return the exit status. Raises UserError."""
    parser = command_line("python -m tools.readme_film", __doc__)
    add = parser.add_argument
    add("model", nargs="?", default=SHIPPED_MODEL, help="model file (default: the shipped network)")
    add("film", nargs="?", default=str(FILM), help="WebP to write (default: the one in README.md)")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    check_folders(options.film)
    network = load_model(options.model)
    pictures = [picture for track, look in CLIPS for picture in clip(network, track, look)]
    first, *rest = [Image.fromarray(picture) for picture in pictures]
    film, duration = io.BytesIO(), 1000 * EVERY // SAMPLE_RATE  # ms
    compression = {"quality": QUALITY, "method": EFFORT}
    first.save(film, "WEBP", save_all=True, append_images=rest, duration=duration, loop=0, **compression)
    write_output(options.film, film.getvalue())
    print(f"{options.film}: {1 + len(rest)} frames, {len(film.getvalue()) / 1e6:.1f} MB")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
