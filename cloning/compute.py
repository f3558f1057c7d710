"""Where and how the arithmetic of training is done: device, precision, threads, and a batch in pieces."""

import ctypes
import os
import sys

import torch

from cloning.cores import threads as threads  # re-exported


def choose_device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    if name == "cuda":
        name = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
    return torch.device(name)


def choose_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where the processor multiplies it by itself (elsewhere it is emulated, and slow), else float32."""
    if device.type == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        has = torch.cpu.get_capabilities()
        fast = device.type == "cpu" and (has.get("avx512_bf16", False) or has.get("amx_bf16", False))
    return torch.bfloat16 if fast else torch.float32


def in_precision(precision: torch.dtype, device: torch.device):
    """The context in which the network multiplies in this precision; weights and their updates stay float32."""
    # No weight is used twice in a pass, so that keeping their casts would only tie the pool's threads together.
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == torch.bfloat16, cache_enabled=False)


def repeatable(device: torch.device) -> None:
    """Have a GPU, too, give the same numbers for the same seed, as a CPU does."""
    if device.type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.utils.deterministic.fill_uninitialized_memory = False  # a check that costs time, not a need


def keep_freed_memory() -> None:
    """Have glibc keep freed blocks instead of returning them and faulting them in again: a step is 8 to 20 % faster."""
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):
            libc.mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD
            libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD


def one_thread() -> None:
    """Have this thread compute by itself: the pool's threads, one to a core, leave no core that could help it."""
    torch.set_num_threads(1)
