"""Give back the memory that torch holds twice, and what loading leaves behind.

XNNPACK packs the weights of an INT8 convolution when it runs for the first time, and computes with the packed copy from
then on. torch keeps the original as long as the policy lives, for saving it, which nobody does on a rover: 66 MB of the
full policy. Nothing in torch drops it: `setReleaseWeightsWhenPrepacking` does not reach XNNPACK's path.
"""

import ctypes
import mmap
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # only policies that torch runs hold anything twice
    import torch

DONT_NEED = 4  # MADV_DONTNEED of Linux: the pages are the kernel's again, and read as zeros
PACKED = "__torch__.torch.classes.quantized.Conv2dPackedParamsBase"


def give_back_packed_weights(module: "torch.jit.ScriptModule") -> int:
    """Return the pages of the convolutions' original weights to the kernel; how many bytes that were.

    module: frozen, and it has run, so that its weights are packed. It cannot be saved afterwards, and whoever calls
    this must prove that it still predicts what it did. Linear layers keep theirs: dynamic INT8 has other scales with
    each frame. 0 where the system has no madvise.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "madvise"):
        return 0
    given = 0
    for weight in _originals(module.graph):
        start, size = weight.untyped_storage().data_ptr(), weight.untyped_storage().nbytes()
        first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE  # whole pages, none of which anything else lies on
        length = (start + size) // mmap.PAGESIZE * mmap.PAGESIZE - first
        if length > 0 and libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(length), DONT_NEED) == 0:
            given += length
    return given


def give_back_freed() -> None:
    """Return to the kernel what malloc keeps for later: loading and checking an artifact frees tens of MB."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):  # of glibc
        libc.malloc_trim(0)


def _originals(block: Any) -> "Iterator[torch.Tensor]":
    """The weights that packed parameters, constants of a frozen graph, still hold."""
    import torch

    for node in block.nodes():
        if node.kind() == "prim::Constant" and str(node.output().type()) == PACKED:
            yield torch.ops.quantized.conv2d_unpack(node.output().toIValue())[0]
        for inner in node.blocks():
            yield from _originals(inner)
