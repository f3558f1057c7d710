"""Export a model to ONNX, which other programs and languages can run, and check the result with ONNX Runtime.

    pip install -r requirements-export.txt
    python -m cloning.network.export model.pt model.onnx

The file takes `frames`, uint8 (n, 160, 320, 3), RGB, as the simulator sends them, and returns `steering`, float32 (n,),
-1..1, positive to the right; values outside must be clipped, as drive.py does. Cropping and scaling are part of it.
"""

import argparse
import logging
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("export")

import numpy as np
import torch

from cloning.base.errors import ModelError, UserError
from cloning.base.files import written_whole
from cloning.base.frame import FRAME
from cloning.base.outputs import check_folders
from cloning.network.network import Network, load_model

try:
    import onnx
    import onnxruntime
    import onnxscript  # noqa: F401  # torch's exporter needs it, and says so less clearly
except ImportError as error:
    sys.exit(program.failed("export", UserError(f"{error}; pip install -r requirements-export.txt")))

OPSET = 20  # of ONNX's operators; ONNX Runtime knows it since 1.17 (2024)
TOLERANCE = 1e-5  # of the steering
ROUNDS = 30  # of timing


def export(network: Network, path: Path) -> None:
    """Write a network as an ONNX file, after checking it. Raises ModelError if it steers differently, OSError."""
    example = (torch.from_numpy(check_frames()[:2]),)
    any_number = torch.export.Dim("n", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it reports its steps as warnings
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch 2.13 warns of its own code
        exported = torch.onnx.export(
            network,
            example,
            dynamo=True,
            input_names=["frames"],
            output_names=["steering"],
            dynamic_shapes=({0: any_number},),
            opset_version=OPSET,
            verbose=False,
        )
    assert exported, "torch returns the program with dynamo=True"
    with written_whole(path) as temporary:
        exported.save(temporary)
        onnx.checker.check_model(temporary, full_check=True)
        worst = difference(network, onnxruntime.InferenceSession(temporary), check_frames())
        if not worst <= TOLERANCE:
            raise ModelError(f"{path}: its steering differs by {worst:.1e} from the model's; nothing was written")


def check_frames() -> np.ndarray:
    """Return frames to compare with, from dark to bright, smooth and noisy: uint8 (16, 160, 320, 3)."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0 : FRAME[0], 0 : FRAME[1]].astype(float)
    frames = []
    for brightness in np.linspace(0, 1, 16):
        waves = [np.sin(rows * rng.uniform(0, 0.2) + columns * rng.uniform(0, 0.2)) for _ in range(FRAME[2])]
        frames.append(255 * brightness * (0.75 + 0.25 * np.stack(waves, axis=-1)) + rng.normal(0, 8, FRAME))
    return np.clip(frames, 0, 255).astype(np.uint8)


def difference(network: Network, session: onnxruntime.InferenceSession, frames: np.ndarray) -> float:
    """Return the largest difference in steering between network and ONNX file; frames: uint8 (n, 160, 320, 3)."""
    with torch.inference_mode():
        expected = network(torch.from_numpy(frames)).numpy()
    (steering,) = session.run(["steering"], {"frames": frames})
    return float(np.abs(steering - expected).max())


def milliseconds(call: Callable[[], object]) -> float:
    """Return the median duration of a call, in ms."""
    durations = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        call()
        durations.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(durations))


def main() -> int:
    """Export a model and print what the file contains; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m cloning.network.export",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, help="model file to read")
    parser.add_argument("output", type=Path, help="ONNX file to write")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # as drive.py does
    try:
        check_folders(str(arguments.output))
        network = load_model(arguments.model)
        export(network, arguments.output)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(arguments.output, options)
    except (UserError, OSError) as error:
        return program.failed("export", error)
    frame = check_frames()[:1]
    with torch.inference_mode():
        by_torch = milliseconds(lambda: network(torch.from_numpy(frame)))
    by_onnx = milliseconds(lambda: session.run(None, {"frames": frame}))
    print(f"{arguments.output}: opset {OPSET}, frames uint8 (n, 160, 320, 3) RGB -> steering float32 (n,)")
    print(f"the same steering as {arguments.model} to {TOLERANCE:g}")
    print(f"one frame on one core: ONNX Runtime {by_onnx:.1f} ms, PyTorch {by_torch:.1f} ms")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
