"""Jobs of a sweep that take no time. They have a module of their own because worker processes import it by name."""

import json
import os
import signal
from dataclasses import dataclass
from pathlib import Path

from rover_learn.sweep import Job

ENV = {"host": "here", "machine": "x", "torch": "2.8", "commit": ""}


def _stage(folder: Path, name: str, stage: str, metrics: dict, **inputs: str) -> None:
    content = {"schema": 1, "stage": stage, "params": {}, "metrics": metrics, "inputs": inputs, "env": ENV}
    (folder / name).write_text(json.dumps(content))


@dataclass(frozen=True)
class Stub:
    """Work that only notes in `log` what it does.

    dies: the seed whose first try kills its worker. fails: the seed for which every try raises ValueError.
    """

    log: Path
    dies: int = -1
    fails: int = -1

    def _say(self, *words: object) -> None:
        with self.log.open("a") as f:
            f.write(" ".join(map(str, words)) + "\n")

    def prepare(self, job: Job, folder: Path) -> None:
        seed = job.params["calibration.seed"]
        if seed == self.fails:
            raise ValueError(f"seed {seed}")
        if seed == self.dies and f"dies {job.name}" not in self.log.read_text():
            self._say("dies", job.name)
            os.kill(os.getpid(), signal.SIGKILL)
        (folder / job.name).mkdir(exist_ok=True)
        mode = {"steering_mae_pct": 0.1, "throttle_mae_pct": 0.2, "steering_vs_recorded_pct": 5.0 + seed}
        mode |= {"throttle_vs_recorded_pct": 1.0, "hits": 3, "trials": 4, "size_mb": 12.0}
        ranges = {"steering": [-1, 1], "throttle": [0, 1]}
        _stage(folder / job.name, "compare.json", "compare", {"modes": {"static": mode}, "action_range": ranges})
        made = {"modes": {"static": {"content_hash": job.name}}}
        _stage(folder / job.name, "quantize.json", "quantize", made)
        self._say("prepared", job.name)

    def benchmark(self, job: Job, folder: Path) -> None:
        from distributed import get_worker

        assert get_worker().state.total_resources == {"timing": 1}
        timed = {"artifacts": {"static": {"latency_p50_ms": 10.0 - job.params["calibration.seed"]}}}
        _stage(folder / job.name, "benchmark-here.json", "benchmark", timed, **{"policy_static.pt": job.name})
        self._say("timed", job.name)
