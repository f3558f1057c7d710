"""Make the film at the top of README.md: a network drives both tracks, and what it looks at is shown in magenta.

python -m tools.readme_film                     # the network that comes with the project
python -m tools.readme_film model.pt film.webp  # another one, into another file

Left the lake, right the jungle, each first without and then with shadows, as the stand-in simulator renders them. The
film is an animated WebP, which web pages show like a picture.
"""

import io

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("readme_film")

import cv2
import gymnasium
import numpy as np
import torch
from PIL import Image

import simulator.environment as environment
from cloning.base.errors import UserError
from cloning.base.outputs import check_folders, write_output
from cloning.network.attention import visual_backprop
from cloning.network.network import SHIPPED_MODEL, Network, load_model
from cloning.recordings.format import SAMPLE_RATE
from cloning.road.overlay import overlay
from simulator.scenery.looks import SHADOWED
from tools.command import ROOT, command_line, run_tool

FILM = ROOT / "diagnostic_images" / "report" / "driving.webp"
TRACKS = ("lake", "jungle")
LOOKS = {0: "", SHADOWED: ", in shadow"}  # the looks, in their order, and what the label says of them
STARTS, SECONDS = {"lake": 29, "jungle": 15}, 4  # s from the start of a lap to a bend with shadows; of each clip
EVERY = 2  # frames: 7.5 a second are enough
QUALITY, EFFORT = 60, 4  # of 100; of 6: the film has 0.6 MB
WHITE = (255, 255, 255)


def clip(network: Network, track: str, look: int) -> list[np.ndarray]:
    """Drive at 15 mph and return the frames of a clip with the overlay: uint8 (160, 320, 3), RGB."""
    env = gymnasium.make(environment.ID, track=track, look=look, speed=15)
    frames: list[np.ndarray] = []
    frame, _ = env.reset(seed=0)
    for step in range((STARTS[track] + SECONDS) * SAMPLE_RATE):
        steering, mask = visual_backprop(network, frame)
        if step >= STARTS[track] * SAMPLE_RATE and step % EVERY == 0:
            picture = np.ascontiguousarray(overlay(frame, steering, mask)[::2, ::2])
            cv2.putText(picture, track + LOOKS[look], (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, WHITE, 1, cv2.LINE_AA)
            frames.append(picture)
        frame, _, terminated, _, _ = env.step(np.array([steering, 1], np.float32))
        if terminated:
            raise UserError(f"the network leaves the road of the {track} in look {look}; film another one")
    env.close()
    return frames


def main(argv: list[str] | None = None) -> int:
    """Drive the clips and write the film; return the exit status. Raises UserError."""
    parser = command_line("readme_film", __doc__)
    add = parser.add_argument
    add("model", nargs="?", default=SHIPPED_MODEL, help="model file (default: the shipped network)")
    add("film", nargs="?", default=str(FILM), help="WebP to write (default: the one in README.md)")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    check_folders(options.film)
    network = load_model(options.model)
    clips = [np.concatenate([clip(network, track, look) for look in LOOKS]) for track in TRACKS]
    first, *rest = [Image.fromarray(picture) for picture in np.concatenate(clips, axis=2)]
    film, duration = io.BytesIO(), 1000 * EVERY // SAMPLE_RATE  # ms
    compression = {"quality": QUALITY, "method": EFFORT}
    first.save(film, "WEBP", save_all=True, append_images=rest, duration=duration, loop=0, **compression)
    write_output(options.film, film.getvalue())
    print(f"{options.film}: {1 + len(rest)} frames, {len(film.getvalue()) / 1e6:.1f} MB")
    return program.DONE


if __name__ == "__main__":
    run_tool("readme_film", main)
