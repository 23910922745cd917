"""Find the functions that the addresses executed by a guest belong to."""

import re
from bisect import bisect_right
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from elftools.elf.elffile import ELFFile

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

KERNELS = 30  # how many are named in the report; the rest are summed up
NAME_LENGTH = 140
# Symbols are read with numpy: it reads the 778,000 of libtorch_cpu.so in 0.3 s, pyelftools in 40 s, one by one.
SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("at", "<u8"), ("size", "<u8")]
)
FUNCTIONS = (0, 2, 10)  # symbol types none (assembly), function, indirect function


class Functions:
    """The functions of a 64-bit ELF file, by address."""

    def __init__(self, path: Path):
        self.path = path
        with path.open("rb") as file:
            elf = ELFFile(file)
            # The address of the first loaded segment. A mapping of the file starts there, which shows where it was put.
            self.base = min((s["p_vaddr"] & ~0xFFF for s in elf.iter_segments("PT_LOAD")), default=0)
            whole = elf.get_section_by_name(".symtab")
            self.complete = whole is not None  # a stripped file names only the functions that it exports
            table = whole or elf.get_section_by_name(".dynsym")
            symbols: Any = np.frombuffer(table.data() if table else b"", SYMBOL)
            self._names = elf.get_section(table["sh_link"]).data() if table else b"\0"
        symbols = symbols[np.isin(symbols["info"] & 15, FUNCTIONS) & (symbols["section"] > 0) & (symbols["at"] > 0)]
        first = np.frombuffer(self._names, "u1")[symbols["name"]]
        symbols = symbols[(first != ord("$")) & (first != 0)]  # $x, $d only mark code and data
        self._symbols = symbols[np.lexsort((symbols["size"], symbols["at"]))]
        self._at = self._symbols["at"].tolist()

    def function_at(self, address: int) -> str:
        """Return the mangled name of the function at an address of the file, or the file's name if it has no name."""
        i = bisect_right(self._at, address) - 1
        if i >= 0:
            symbol = self._symbols[i]
            if self.complete or address < int(symbol["at"]) + int(symbol["size"]):
                start = int(symbol["name"])
                return self._names[start : self._names.index(b"\0", start)].decode(errors="replace")
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


def by_kernel(blocks: np.ndarray, functions: Any, at_most: int = KERNELS) -> dict[str, tuple[int, int]]:
    """Sum up the executed (instructions, SDOT) by function: demangled names, the most instructions first.

    All functions after the first `at_most` are summed up as "other". blocks: an array of core.BLOCK. functions: names
    by address. For a library that was stripped of names, blocks with an SDOT are listed apart from the rest.
    """
    instructions: Counter[str] = Counter()
    sdots: Counter[str] = Counter()
    for address, entered, count, _, sdot, _ in blocks.tolist():
        name = functions[address]
        if name.startswith("[") and sdot:
            name = f"{name} loops with SDOT"
        instructions[name] += entered * count
        sdots[name] += entered * sdot
    mangled = [name for name, _ in instructions.most_common()]
    plain = run("c++filt", "--no-params", error=RoverError, input="\n".join(mangled)).splitlines()
    merged: dict[str, tuple[int, int]] = {}
    for i, (name, demangled) in enumerate(zip(mangled, plain, strict=True)):
        short = _short(demangled) if i < at_most else "other"
        before = merged.get(short, (0, 0))
        merged[short] = before[0] + instructions[name], before[1] + sdots[name]
    return merged


def _short(name: str) -> str:
    """Shorten a C++ name, without the wrapper through which torch's element-wise loops are called."""
    name = re.sub(r"^c10::function_ref<.*?>::callback_fn<", "", name)
    return name if len(name) <= NAME_LENGTH else name[: NAME_LENGTH - 3] + "..."
