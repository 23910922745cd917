"""Run a published network with empty or random weights in the emulated Pi, in section 1.

    network.py ncnn THREADS SIZE:GRAPH             GRAPH is a .param of ncnn's
    network.py executorch THREADS SIZE:PROGRAM     PROGRAM is a .pte; one thread only

SIZE is the side of the square picture that the network takes. Of ExecuTorch the second inference is counted, as it
packs weights in the first; ncnn does so when it loads, and its first inference is like the third.
"""

import ctypes
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from inferences import mark

ROOM = 1 << 16  # numbers that an output may have


def ncnn(graph: str, size: int, threads: int) -> Callable[[], Any]:
    import ncnn

    net, blobs, workspace = ncnn.Net(), ncnn.UnlockedPoolAllocator(), ncnn.PoolAllocator()
    option = net.opt
    option.num_threads, option.blob_allocator, option.workspace_allocator = threads, blobs, workspace
    for allocator in (blobs, workspace):
        allocator.set_size_compare_ratio(0.0)  # as ncnn's own benchmark
    net.opt = option
    if net.load_param(graph) or net.load_model(ncnn.DataReaderFromEmpty()):
        sys.exit(f"error: {graph}: ncnn does not load it")
    picture = ncnn.Mat(size, size, 3)
    picture.fill(0.01)

    def run() -> list[Any]:
        extractor = net.create_extractor()
        extractor.input(net.input_names()[0], picture)
        return [extractor.extract(name) for name in net.output_names()]

    KEPT.append((net, blobs, workspace))  # ncnn aborts if an allocator goes before what it has allocated
    return run


def executorch(program: str, size: int, threads: int) -> Callable[[], Any]:
    import executorch  # only to find its folder, as in peers/guest.py

    library, error = ctypes.CDLL(str(Path(next(iter(executorch.__path__))).parent / "policy.so")), ctypes.c_int()
    library.policy_load.restype = ctypes.c_void_p
    loaded = ctypes.c_void_p(library.policy_load(program.encode(), ctypes.byref(error)))
    picture, out = np.full((1, 3, size, size), 0.01, np.float32), np.zeros(ROOM, np.float32)

    def run() -> None:
        given, result = ctypes.c_void_p(picture.ctypes.data), ctypes.c_void_p(out.ctypes.data)
        if error.value or library.policy_run(loaded, None, 0, given, size, size, result):
            sys.exit(f"error: {program}: ExecuTorch does not run it")

    return run


KEPT: list[Any] = []


def main(runtime: str, threads: str, network: str) -> None:
    size, path = network.split(":", 1)
    run = {"ncnn": ncnn, "executorch": executorch}[runtime](path, int(size), int(threads))
    if runtime == "executorch":
        run()
    mark(True, 1)
    run()
    mark(False, 1)
    os._exit(0)  # without ncnn's destructors, which abort for allocators that outlive their nets


if __name__ == "__main__":
    main(*sys.argv[1:])
