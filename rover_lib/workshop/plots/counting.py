"""What `lab.a76.plots` draws in notebook 06: instructions counted on an emulated Cortex-A76."""

import re
from collections.abc import Mapping
from typing import Any


def whole_size(metrics: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the artifacts at the image size of training, by mode, and other engines' peers, most instructions first.

    A peer that only counts one of the artifacts again is left out. metrics: those of arm.json.
    """
    ours = {stem.removeprefix("policy_"): m for stem, m in metrics["artifacts"].items()}
    ours = {mode: m for mode, m in ours.items() if not re.search(r"_\d+x\d+$", mode)}
    counted = ours | {name: m for name, m in metrics.get("peers", {}).items() if "artifact" not in m}
    return dict(sorted(counted.items(), key=lambda item: -item[1]["instructions_g"]))
