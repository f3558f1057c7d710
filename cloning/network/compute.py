"""The hardware that computes: device, precision, threads and memory."""

import contextlib
import ctypes
import functools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from threading import Lock
from types import ModuleType
from typing import TypeVar

import torch

from cloning.base.cores import threads as threads  # re-exported
from cloning.base.errors import UserError

Made = TypeVar("Made")
Placed = TypeVar("Placed", bound=torch.nn.Module)
_seeding = Lock()  # torch's generator is that of all threads
DEVICES = ("auto", "cpu", "cuda", "mps")  # cuda: an NVIDIA GPU; mps: Apple's


def is_available(name: str) -> bool:
    """Return whether this machine has a device; name: one of the DEVICES, of which `auto` and `cpu` always exist."""
    if name == "cuda":
        return torch.cuda.is_available()
    if name == "mps":
        return torch.backends.mps.is_available()
    return True


def choose_device(name: str) -> torch.device:
    """Return the device of this name, one of the DEVICES; with several NVIDIA GPUs, the one of this rank.

    auto: a GPU if there is one, else the CPU. Several processes can't share Apple's. Raises UserError if they are to.
    """
    together = int(os.environ.get("WORLD_SIZE", 1)) > 1
    if name == "auto":
        gpus = ("cuda",) if together else ("cuda", "mps")
        name = next((gpu for gpu in gpus if is_available(gpu)), "cpu")
    if name == "mps" and together:
        raise UserError("--device mps: several processes can't share Apple's GPU; start one, without torchrun")
    if name == "cuda":
        name = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
    return torch.device(name)


def placed(network: Placed, device: str | torch.device) -> Placed:
    """Move a network to a device, its weights channels last, which is faster; but Apple's GPU reads those wrongly.

    There PyTorch takes them for contiguous ones (its issue 192212, mended after version 2.13).
    """
    layout = torch.contiguous_format if torch.device(device).type == "mps" else torch.channels_last
    return network.to(device, memory_format=layout)  # type: ignore[call-overload]  # its stubs lack the argument


def choose_precision(device: torch.device) -> torch.dtype:
    """Return bfloat16 if the processor has instructions for it (emulation would be slow), else float32."""
    if device.type == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        vectors = bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
        fast = device.type == "cpu" and (vectors or has_amx())
    return torch.bfloat16 if fast else torch.float32


@functools.cache
def has_amx() -> bool:
    """Return whether the processor multiplies bfloat16 matrices in tiles (Intel's AMX)."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def in_precision(precision: torch.dtype, device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Return the context in which networks compute in this precision; weights and their updates stay float32."""
    # Without a cache of converted weights: no weight is used twice in a pass, and threads would wait for the cache.
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == torch.bfloat16, cache_enabled=False)


def repeatable(device: torch.device) -> None:
    """Make a GPU compute the same numbers for the same seed, as a CPU does."""
    if device.type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        # Filling uninitialised memory costs time and changes no number. torch's stubs lack the attribute.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]


def keep_freed_memory() -> None:
    """Make glibc keep freed blocks instead of returning them to the system: a training step is 8 to 20 % faster.

    All threads share one arena, because those of other threads consist of heaps of 64 MB, which are returned whatever
    the limits: in float32, a batch of 474 images took 60,000 page faults and 8 % more time in three of four runs.
    """
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):
            libc.mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD
            libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD
            libc.mallopt(-8, 1)  # M_ARENA_MAX


def onnx_runtime() -> ModuleType:
    """Return ONNX Runtime, an optional library, which from version 1.29 on reports its use unless told not to.

    Raises ImportError.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    return onnxruntime


def one_thread() -> None:
    """Make torch compute on the calling thread alone, because other threads or processes already occupy the cores."""
    torch.set_num_threads(1)


def seeded(seed: int, make: Callable[[], Made]) -> Made:
    """Return what `make` returns with torch's generator seeded; the caller's goes on as if it had not been used."""
    with _seeding, torch.random.fork_rng([]):
        torch.default_generator.manual_seed(seed)
        return make()


@contextlib.contextmanager
def own_settings() -> Iterator[None]:
    """A context in which what a caller has set in torch changes no weights; afterwards its settings are as before."""
    dtype, count, mode = torch.get_default_dtype(), torch.get_num_threads(), torch.get_deterministic_debug_mode()
    torch.set_default_dtype(torch.float32)
    one_thread()  # at once: after a fork of a caller whose threads have computed, several would wait for ever
    try:
        with (
            torch.inference_mode(False),
            torch.enable_grad(),
            # Not always: each call of torch in it is a function call of Python's more.
            contextlib.nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"),
            torch.autocast("cpu", enabled=False),
            torch.autocast("cuda", enabled=False),
            torch.random.fork_rng([]),
        ):
            yield
    finally:
        torch.set_default_dtype(dtype)
        torch.set_num_threads(count)
        torch.set_deterministic_debug_mode(mode)


class Graphed:
    """A function of tensors that a GPU repeats by itself, because Python starts its kernels more slowly than they run.

    It is recorded as a CUDA graph, for each shape of its arguments in the second call with this shape. Meanwhile no
    other thread may use the GPU, or the recording fails.
    """

    def __init__(self, function: Callable[..., Sequence[torch.Tensor]]):
        """function: does not wait for the GPU, and uses only tensors that stay where they are."""
        self.function = function
        self.recorded: dict[object, tuple[torch.cuda.CUDAGraph, list[torch.Tensor], Sequence[torch.Tensor]] | None] = {}

    def __call__(self, *arguments: torch.Tensor) -> Sequence[torch.Tensor]:
        """Return what the function does."""
        if arguments[0].device.type != "cuda":
            return self.function(*arguments)
        key = tuple((each.shape, each.dtype) for each in arguments)
        if key not in self.recorded:
            self.recorded[key] = None
            return self.function(*arguments)
        if (recorded := self.recorded[key]) is None:
            graph, inputs = torch.cuda.CUDAGraph(), [each.clone() for each in arguments]
            with torch.cuda.graph(graph):
                results = self.function(*inputs)
            recorded = self.recorded[key] = graph, inputs, results
        graph, inputs, results = recorded
        torch._foreach_copy_(inputs, list(arguments))
        graph.replay()
        copies = [torch.empty_like(each) for each in results]
        if copies:
            torch._foreach_copy_(copies, list(results))
        return copies
