"""Deploy to a fleet of three emulated Pis while one of them has a read-only disk, and judge what deploy.yml does.

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
    """Run deploy.yml on three rovers while one has a read-only disk, like a dying card; return a row for each case.

    A case has broken (which rover), batches, exit_code, results (the report's words for each rover), models, healthy,
    and good (whether everything is as it must be).
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
    """Return by rover how its result must begin, and which model it must have.

    The rovers before the broken one get the new model; the others keep theirs.
    """
    wanted, failed = {}, False
    for name, model in before.items():
        failed = failed or name == broken
        if failed:
            wanted[name] = ("failed" if name == broken else f"untouched: {broken} failed", model)
        else:
            wanted[name] = ("had it already" if model == new else "deployed", new)
    return wanted


def results_of(output: str) -> dict[str, str]:
    """Return each rover's result in deploy.yml's report."""
    report = output.partition(f"TASK [{REPORT}]")[2].partition("TASK [")[0]
    return {name: json.loads(f'"{result}"') for name, result in re.findall(r'"msg": "([\w.-]+): (.*)"', report)}
