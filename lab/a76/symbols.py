"""Find the functions that the addresses executed by a guest belong to."""

import re
from bisect import bisect_right
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

KERNELS = 30  # how many are named in the report; the rest are summed up
NAME_LENGTH = 140
SYMBOL = re.compile(r"^(\w{16})(?: (\w{16}))? [tTwWi] ([^$@\n]+)", re.M)  # of nm; $x and $d only mark code and data


class Functions:
    """The functions of a 64-bit ELF file, by address."""

    def __init__(self, path: Path):
        self.path = path
        segments = run("readelf", "--segments", "--wide", path, error=RoverError)
        # The address of the first loaded segment. A mapping of the file starts there, which shows where it was put.
        loaded = re.findall(r"^ +LOAD +\w+ 0x(\w+)", segments, re.M)
        self.base = min((int(address, 16) & ~0xFFF for address in loaded), default=0)
        nm = ["nm", "--no-sort", "--defined-only", "--print-size"]
        listing = run(*nm, path, error=RoverError)
        self.complete = bool(listing)  # a stripped file names only the functions that it exports
        matches = SYMBOL.findall(listing or run(*nm, "--dynamic", path, error=RoverError))
        symbols = [(int(at, 16), int(size or "0", 16), name) for at, size, name in matches]
        self._symbols = sorted(symbols, key=lambda symbol: symbol[:2])
        self._at = [at for at, _, _ in self._symbols]

    def function_at(self, address: int) -> str:
        """Return the mangled name of the function at an address of the file, or the file's name if it has no name."""
        i = bisect_right(self._at, address) - 1
        if i >= 0:
            at, size, name = self._symbols[i]
            if self.complete or address < at + size:
                return name
        return f"[{self.path.name}]"


class GuestFunctions:
    """The functions of a guest, by its addresses. maps: the guest's own /proc/self/maps."""

    def __init__(self, maps: str):
        self._mappings = []
        self._lowest: dict[str, int] = {}
        for line in maps.splitlines():
            fields = line.split(None, 5)
            start, end = (int(address, 16) for address in fields[0].split("-"))
            path = fields[5].strip() if len(fields) > 5 else ""
            self._lowest[path] = min(self._lowest.get(path, start), start)
            self._mappings.append((start, end, path))
        self._mappings.sort()
        self._starts = [start for start, _, _ in self._mappings]
        self._files: dict[str, Functions] = {}

    def __getitem__(self, address: int) -> str:
        """Return the mangled name of the function at an address of the guest."""
        i = bisect_right(self._starts, address) - 1
        _, end, path = self._mappings[i] if i >= 0 else (0, 0, "")
        if address >= end or not path.startswith("/"):
            return "[unknown]"
        if path not in self._files:
            self._files[path] = Functions(Path(path))
        file = self._files[path]
        return file.function_at(address - self._lowest[path] + file.base)


def by_kernel(blocks: np.ndarray, functions: Any, at_most: int = KERNELS) -> dict[str, int]:
    """Sum up the executed instructions by function: demangled names, the most instructions first.

    All functions after the first `at_most` are summed up as "other". blocks: an array of core.BLOCK. functions: names
    by address.
    """
    instructions: Counter[str] = Counter()
    for address, entered, count, *_ in blocks.tolist():
        instructions[functions[address]] += entered * count
    mangled = [name for name, _ in instructions.most_common()]
    plain = run("c++filt", "--no-params", error=RoverError, input="\n".join(mangled)).splitlines()
    merged: Counter[str] = Counter()
    for i, (name, demangled) in enumerate(zip(mangled, plain, strict=True)):
        merged[_short(demangled) if i < at_most else "other"] += instructions[name]
    return dict(merged)


def _short(name: str) -> str:
    """Shorten a C++ name, without the wrapper through which torch's element-wise loops are called."""
    name = re.sub(r"^c10::function_ref<.*?>::callback_fn<", "", name)
    return name if len(name) <= NAME_LENGTH else name[: NAME_LENGTH - 3] + "..."
