"""A fleet of three emulated Pis of which one's disk can be read only: what deploy.yml makes of it.

result = fleet(pi.layers, {"static": Path("policy_static.pt"), "mixed": Path("policy_mixed.pt")})
"""

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.pi.deployment_bench import DeploymentBench, give_first_model, in_parallel, rovers

Say = Callable[[str], None]
REPORT = "Show each result"  # the task of deploy.yml
NAMES = ("canary", "second", "third")
ONE_BY_ONE = [1, 1, 1]  # batches


def fleet(layers: Sequence[Path], artifacts: Mapping[str, Path], *, say: Say = lambda text: None) -> dict[str, Any]:
    """deploy.yml on three rovers of which one's disk can be read only, as that of a dying card: a row for each case.

    Each: broken, exit_code, results (what the report says of each), models, healthy, good (it is as it must be).
    """
    cases = []
    with rovers(NAMES, layers, artifacts) as benches:
        give_first_model(benches)
        for broken, batches in (("canary", None), ("second", ONE_BY_ONE), ("", None)):
            started = time.monotonic()
            case = _case(benches, broken, batches)
            cases.append({**case, "seconds": round(time.monotonic() - started, 1)})
            say(f"fleet, {broken or 'nobody'} broken: {case['results']}, {'good' if case['good'] else 'NOT GOOD'}")
    return {"rovers": len(NAMES), "cases": cases, "good": all(case["good"] for case in cases)}


def _case(benches: Sequence[DeploymentBench], broken: str, batches: list[int] | None) -> dict[str, Any]:
    new = list(benches[0].artifacts)[1]
    before = {bench.pi.name: bench.mode_in_use()[0] for bench in benches}
    for bench in benches:
        if bench.pi.name == broken:
            bench.make_read_only()
    variables: dict[str, Any] = {"rover_batches": batches} if batches else {}
    artifact = str(benches[0].artifacts[new])
    others = [bench.network for bench in benches[1:]]
    play = benches[0].play("deploy", others=others, rover_artifact=artifact, **variables)
    healthy = in_parallel(DeploymentBench.healthy, benches)
    models = {bench.pi.name: bench.mode_in_use()[0] for bench in benches}
    for bench in benches:
        bench.clean()
    results = results_of(play.output)
    wanted = wanted_of(broken, before, new)
    good = (
        all(healthy)
        and set(results) == set(NAMES)
        and all(results[n].startswith(start) and models[n] == model for n, (start, model) in wanted.items())
        and (play.code != 0) == bool(broken)
    )
    return {
        "broken": broken,
        "batches": batches or [1, "100%"],
        "exit_code": play.code,
        "results": results,
        "models": models,
        "healthy": dict(zip(NAMES, healthy, strict=True)),
        "good": good,
    }


def wanted_of(broken: str, before: Mapping[str, str], new: str) -> dict[str, tuple[str, str]]:
    """What the report must begin with, and the model, by rover: all before the broken one get the new model."""
    wanted, failed = {}, False
    for name, model in before.items():
        failed = failed or name == broken
        if failed:
            wanted[name] = ("failed" if name == broken else f"untouched: {broken} failed", model)
        else:
            wanted[name] = ("had it already" if model == new else "deployed", new)
    return wanted


def results_of(output: str) -> dict[str, str]:
    """The result that deploy.yml's report has for each rover."""
    report = output.partition(f"TASK [{REPORT}]")[2].partition("TASK [")[0]
    return {name: json.loads(f'"{result}"') for name, result in re.findall(r'"msg": "([\w.-]+): (.*)"', report)}
