"""Run artifacts in torch: TorchScript, whose INT8 operators run in the engine that the manifest names.

XNNPACK packs the weights of an INT8 convolution when it first runs. torch keeps the original, 66 MB of the full-size
policy, and has no way to drop it; so its pages are given back to the kernel.
"""

import ctypes
import mmap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from rover_lib.onboard.artifact.archive import refused
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.errors import ArtifactError

DONT_NEED = 4  # Linux's MADV_DONTNEED: the kernel takes the pages back, and they read as zeros
PACKED = "__torch__.torch.classes.quantized.Conv2dPackedParamsBase"


class TorchEngine:
    """A TorchScript archive. Make it with `load`."""

    def __init__(self, module: torch.jit.ScriptModule):
        self._module = module

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> list[np.ndarray]:
        # TorchScript re-optimises in its second call (0.37 G instructions on a Cortex-A76); the switch is thread-local.
        with torch.inference_mode(), torch.jit.optimized_execution(False):
            y = self._module(torch.from_numpy(state)[None], *(torch.from_numpy(f) for f in frames_rgb))
        return [output.numpy() for output in (y if isinstance(y, tuple) else (y,))]

    def give_back(self) -> bool:
        return give_back_packed_weights(self._module) > 0

    @property
    def threads(self) -> int:
        return torch.get_num_threads()


def load(artifact: Artifact, threads: int | None) -> TorchEngine:
    """Load an artifact. Raises ArtifactError if it was made with another torch, or cannot be loaded."""
    path = artifact.path
    manifest = artifact.manifest
    made_with = str(manifest["versions"].get("torch", "?"))
    here = torch.__version__
    if made_with.split(".")[:2] != here.split(".")[:2]:
        remedy = "make it again where this torch is: rover run CHECKPOINT EPISODES"
        raise ArtifactError(f"{path}: made with torch {made_with}", found=here, remedy=remedy)
    torch.backends.quantized.engine = manifest["engine"]
    if threads:
        torch.set_num_threads(threads)
    try:
        module = torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, UnicodeEncodeError) as e:  # torch cannot open any name
        raise refused(path, f"TorchScript cannot load it ({str(e).splitlines()[0][:200]})") from None
    return TorchEngine(module)


def give_back_packed_weights(module: torch.jit.ScriptModule) -> int:
    """Give the pages of the convolutions' original weights back to the kernel; return the number of bytes freed.

    module: frozen, and has run once, so that its weights are packed. It cannot be saved afterwards, and the caller must
    check that it still predicts the same.
    """
    libc = ctypes.CDLL(None)
    total = 0
    for weight in _originals(module.graph):
        start = weight.untyped_storage().data_ptr()
        size = weight.untyped_storage().nbytes()
        first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE  # only whole pages, because others may share the rest
        length = (start + size) // mmap.PAGESIZE * mmap.PAGESIZE - first
        if length > 0 and libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(length), DONT_NEED) == 0:
            total += length
    return total


def _originals(block: Any) -> Iterator[torch.Tensor]:
    """Yield the original weights, which the packed parameters among a frozen graph's constants still hold."""
    for node in block.nodes():
        if node.kind() == "prim::Constant" and str(node.output().type()) == PACKED:
            yield torch.ops.quantized.conv2d_unpack(node.output().toIValue())[0]
        for inner in node.blocks():
            yield from _originals(inner)
