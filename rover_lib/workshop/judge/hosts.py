"""Compare benchmarks of several machines: this one's, and those that ansible/benchmark.yml fetched.

benchmarks = read_benchmarks("runs/demo", "runs/rovers")
print(benchmarks.table())
"""

import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rover_lib.onboard.columns import number
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.installed import SHIPPED
from rover_lib.workshop.notebook_table import Table

THIS = "this machine"  # instead of the host's name, which a committed figure need not show
NO_ROVER = "no rover's benchmark is here; rover playbook benchmark fetches them"
CLOCK = SHIPPED / "results" / "clock" / "clock.json"  # its program: commit 545214c


@dataclass(frozen=True)
class Benchmarks:
    """by_host: contents of benchmark-<host>.json by host, this machine first. unusable: a sentence for each bad file.

    modes: {sha256: mode} of the run's artifacts.
    """

    by_host: dict[str, dict[str, Any]]
    unusable: list[str]
    modes: dict[str, str]

    def table(self) -> Table:
        """A row for each host and artifact, with notes below. A dash means that the host has no such sensor.

        A rover's artifacts are named by their mode, one that is not byte for byte the run's "static, another".
        """
        header = ("host", "artifact", "p50 ms", "p95 ms", "p99 ms", "n", "C, most", "MHz, least", "throttled")
        rows = []
        for host, b in self.by_host.items():
            m = b["metrics"]
            state = (number(m.get("temperature_c")), number(m.get("clock_mhz"), ".0f"), m.get("throttled") or "-")
            for name, v in m["artifacts"].items():
                times = [f"{v[f'latency_{p}_ms']:.1f}" for p in ("p50", "p95", "p99")]
                if b is not self.by_host.get(THIS):  # on a rover the file in use is always called policy.pt
                    name = self.modes.get(b["inputs"].get(f"{name}.pt"), f"{v['mode'] or name}, another")
                rows.append((host, name, *times, str(v["n"]), *state))
                host = ""
                state = ("", "", "")  # shown only once for each host
        notes = [f"left out: {sentence}" for sentence in self.unusable]
        if not self.by_host.keys() - {THIS}:
            notes.insert(0, NO_ROVER)
        return Table(header, rows, notes=notes)


def read_benchmarks(run_dir: Path | str, fetched: Path | str) -> Benchmarks:
    """Read all benchmark-<host>.json of a run's folder, and of the folder where Ansible puts those of the rovers."""
    by_host: dict[str, dict[str, Any]] = {}
    unusable: list[str] = []
    for folder in (Path(run_dir), Path(fetched)):
        for path in sorted(folder.glob("benchmark-*.json")):
            try:
                content = read_stage(path, "benchmark")
                if content["metrics"].get("main") not in content["metrics"].get("artifacts", ()):
                    raise RoverError(f"{path}: no figures of a benchmark in it", remedy="fetch it again")
            except RoverError as error:
                unusable.append(str(error).replace(str(path), path.name))
                continue
            here = folder == Path(run_dir) and content["env"]["host"] == socket.gethostname()
            by_host[THIS if here else path.stem.removeprefix("benchmark-")] = content
    ours = by_host.get(THIS, {"inputs": {}})["inputs"]
    modes = {sha256: Path(file).stem.removeprefix("policy_") for file, sha256 in ours.items()}
    return Benchmarks({h: by_host[h] for h in sorted(by_host, key=lambda h: (h != THIS, h))}, unusable, modes)


def benchmark_of(run_dir: Path | str, made: Mapping[str, Mapping[str, Any]]) -> Path | None:
    """Return the benchmark of a run's own artifacts, preferably of this machine. made: quantize.json's modes."""
    paths = sorted(Path(run_dir).glob("benchmark-*.json"))
    for path in sorted(paths, key=lambda p: p.stem != f"benchmark-{socket.gethostname()}"):
        if is_of(read_stage(path, "benchmark")["inputs"], made):
            return path
    return None


def is_of(inputs: Mapping[str, str], made: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether a stage's inputs are some of a run's artifacts, and no others. made: quantize.json's modes."""
    ours = {f"policy_{mode}.pt": entry["content_hash"] for mode, entry in made.items()}
    named = {file: digest for file, digest in inputs.items() if file in ours}
    return bool(named) and all(ours[file] == digest for file, digest in named.items())
