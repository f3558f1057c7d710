"""Export a model to ONNX, which other programs and languages can run, and check the result with ONNX Runtime.

    pip install onnx onnxscript onnxruntime
    python -m cloning.network.export model.pt model.onnx

The file takes `frames`, uint8 (n, 160, 320, 3), RGB, as the simulator sends them, and returns `steering`, float32 (n,),
-1..1, positive to the right; values outside must be clipped, as drive.py does. Cropping, brightening and scaling are
part of it. ONNX Runtime 1.14 (2023) or later runs it, and so does OpenCV (tried: 4.14 and 5.0).
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("export")

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cloning.base.arguments import command_line
from cloning.base.errors import ModelError, UserError
from cloning.base.files import written_whole
from cloning.base.frame import FRAME
from cloning.base.outputs import check_folders
from cloning.network.compute import one_thread, onnx_runtime
from cloning.network.network import Network, load_model

OPSET, IR = 18, 8  # of ONNX's operators and of its files: both are of ONNX 1.13
TOLERANCE = 1e-5  # of the steering


def export(network: Network, path: Path) -> None:
    """Write a network as an ONNX file, after checking it.

    Raises UserError without the libraries for it, ModelError if the file steers differently, OSError.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  # torch's exporter needs it, and says so less clearly

        onnxruntime = onnx_runtime()
    except ImportError as error:
        raise UserError(f"{error}; pip install onnx onnxscript onnxruntime") from None
    frames = check_frames()
    shapes = ({0: torch.export.Dim("n", min=1)},)
    names = {"input_names": ["frames"], "output_names": ["steering"]}
    exported = onnx_program(network, torch.from_numpy(frames[:2]), **names, dynamic_shapes=shapes)
    with torch.inference_mode():
        expected = network(torch.from_numpy(frames)).numpy()
    with written_whole(path) as temporary:
        exported.save(temporary)
        model = temporary.read_bytes()  # a name that is no text, these libraries refuse
        onnx.checker.check_model(model, full_check=True)
        (steering,) = onnxruntime.InferenceSession(model).run(["steering"], {"frames": frames})
        worst = float(np.abs(steering - expected).max())
        if not worst <= TOLERANCE:
            raise ModelError(f"{path}: its steering differs by {worst:.1e} from the model's; nothing was written")


def onnx_program(network: nn.Module, images: torch.Tensor, **options: Any) -> torch.onnx.ONNXProgram:
    """Return a network as an ONNX program, quietly; images: an example of its input; options: more of torch's.

    It does not tell, as torch would, which lines of which files on this machine its nodes are from.
    """
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it reports its steps as warnings
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch 2.13 warns of its own code
        exported = torch.onnx.export(network, (images,), dynamo=True, opset_version=OPSET, verbose=False, **options)
    assert exported, "torch returns the program with dynamo=True"
    exported.model.ir_version = IR
    for node in exported.model.graph.all_nodes():
        node.metadata_props.clear()
    return exported


def check_frames() -> np.ndarray:
    """Return frames to compare with, from dark to bright, smooth and noisy: uint8 (16, 160, 320, 3)."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0 : FRAME[0], 0 : FRAME[1]].astype(float)
    frames = []
    for brightness in np.linspace(0, 1, 16):
        waves = [np.sin(rows * rng.uniform(0, 0.2) + columns * rng.uniform(0, 0.2)) for _ in range(FRAME[2])]
        frames.append(255 * brightness * (0.75 + 0.25 * np.stack(waves, axis=-1)) + rng.normal(0, 8, FRAME))
    return np.clip(frames, 0, 255).astype(np.uint8)


def main() -> int:
    """Export a model and print what the file contains; return the exit status."""
    parser = command_line("python -m cloning.network.export", __doc__)
    parser.add_argument("model", type=Path, help="model file to read")
    parser.add_argument("output", type=Path, help="ONNX file to write")
    arguments = parser.parse_args()
    one_thread()  # as drive.py does
    check_folders(str(arguments.output), read=[arguments.model])
    export(load_model(arguments.model), arguments.output)
    print(f"{arguments.output}: opset {OPSET}, frames uint8 (n, 160, 320, 3) RGB -> steering float32 (n,)")
    print(f"the same steering as {arguments.model} to {TOLERANCE:g}, compared with ONNX Runtime")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
