"""Give memory back to the kernel: weights that torch holds twice, and what malloc keeps after loading.

XNNPACK packs the weights of an INT8 convolution when it first runs. torch keeps the original, 66 MB of the full-size
policy, and has no way to drop it.
"""

import ctypes
import mmap
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # imported only for types: other engines hold nothing twice
    import torch

DONT_NEED = 4  # Linux's MADV_DONTNEED: the kernel takes the pages back, and they read as zeros
PACKED = "__torch__.torch.classes.quantized.Conv2dPackedParamsBase"


def give_back_packed_weights(module: "torch.jit.ScriptModule") -> int:
    """Give the pages of the convolutions' original weights back to the kernel; return the number of bytes freed.

    module: frozen, and has run once, so that its weights are packed. It cannot be saved afterwards, and the caller must
    check that it still predicts the same.
    """
    libc, given = ctypes.CDLL(None), 0
    for weight in _originals(module.graph):
        start, size = weight.untyped_storage().data_ptr(), weight.untyped_storage().nbytes()
        first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE  # only whole pages, because others may share the rest
        length = (start + size) // mmap.PAGESIZE * mmap.PAGESIZE - first
        if length > 0 and libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(length), DONT_NEED) == 0:
            given += length
    return given


def give_back_freed() -> None:
    """Give the kernel the memory that malloc keeps for later. After loading an artifact, that is tens of MB."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):  # glibc has it
        libc.malloc_trim(0)


def _originals(block: Any) -> "Iterator[torch.Tensor]":
    """Yield the original weights, which the packed parameters among a frozen graph's constants still hold."""
    import torch

    for node in block.nodes():
        if node.kind() == "prim::Constant" and str(node.output().type()) == PACKED:
            yield torch.ops.quantized.conv2d_unpack(node.output().toIValue())[0]
        for inner in node.blocks():
            yield from _originals(inner)
