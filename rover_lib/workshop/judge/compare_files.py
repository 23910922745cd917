"""Compare artifacts from anywhere, each loaded in a confined process only.

report = run_confined(compare_files, reference="policy_fp32.pt", others={"static": "policy_static.pt"}, ...)
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.confined import load_confined
from rover_lib.workshop.judge.camera_use import look
from rover_lib.workshop.judge.compare import fidelity
from rover_lib.workshop.progress import terminal_bar
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Source

SPARE_MB = 4000  # for recordings that are read while policies predict


def compare_files(reference: str, others: dict[str, str], source: dict[str, Any]) -> dict[str, Any]:
    """Return `summaries` by name (see Fidelity.summary), `warnings`, and how many `frames` were held out.

    source: the fields of a Source. Confines this process for good: call it by run_confined().
    """
    p, manifest = params()["calibration"], read_manifest(reference)
    episodes = Source(Path(source["path"]), tuple(source["action_names"]), tuple(source["cameras"]))
    cameras = tuple(camera["name"] for camera in manifest["cameras"])
    if not episodes.cameras and len(cameras) > 1:
        episodes = replace(episodes, cameras=cameras)
    recordings = load_recordings(episodes, manifest["chunk"], p["sync_s"], terminal_bar())
    held_out = split(recordings, p["held_out_share"], p["seed"]).held_out
    paths = {f"file {i}": path for i, path in enumerate((reference, *others.values()))}
    policies, _ = load_confined(paths, threads=usable_cores(), spare_mb=SPARE_MB)
    fp32, *rest = policies.values()
    report = fidelity(fp32, dict(zip(others, rest, strict=True)), held_out, recordings.action_range(), terminal_bar())
    return {
        "summaries": {name: report.summary(name) for name in others},
        "warnings": [*report.warnings(), *look(fp32, report, progress=terminal_bar()).warnings()],
        "frames": len(held_out),
    }
