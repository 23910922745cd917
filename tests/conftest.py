"""What many tests share: one tiny policy, its calibration and its artifacts, and the demo's run."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# LeRobot takes ten seconds to import, and `policies` needs it: here inside of the fixtures that have a policy.

# In a container there may be nobody but root.
os.environ.setdefault("ROVER_AS_ROOT", "1")
# How long an example takes is the machine's affair: another program's turn is no failure.
settings.register_profile("shared machine", deadline=None)
settings.load_profile("shared machine")


def pytest_collection_modifyitems(items):
    """What drives by the demo's policy starts processes that import torch: none of it is quick."""
    for item in items:
        if "demo_run" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Tests are small: threads would only wait for each other."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def tiny_policy():
    from policies import TINY, lerobot_policy

    return lerobot_policy(**TINY)


@pytest.fixture(scope="session")
def full_policy():
    """Of the user's size: 84 million parameters."""
    from policies import FULL, lerobot_policy

    return lerobot_policy(**FULL)


@pytest.fixture(scope="session")
def tiny_file(tiny_policy, tmp_path_factory) -> Path:
    import torch
    from policies import trainer_content

    path = tmp_path_factory.mktemp("checkpoint") / "best_model.pth"
    torch.save(trainer_content(tiny_policy), path)
    return path


@pytest.fixture(scope="session")
def tiny(tiny_file):
    from rover_lib.workshop.checkpoint import load_checkpoint

    return load_checkpoint(tiny_file)


@pytest.fixture(scope="session")
def calibration(tiny):
    from policies import memory_samples

    from rover_lib.workshop.observe import calibrate

    return calibrate(tiny, memory_samples(12))


@pytest.fixture(scope="session")
def artifacts(tiny, calibration, tmp_path_factory) -> dict[str, Path]:
    """One artifact per mode of the tiny policy."""
    from policies import memory_samples

    from rover_lib.workshop.act import ACT
    from rover_lib.workshop.export import export
    from rover_lib.workshop.quantize import quantize
    from rover_lib.workshop.scheme import Scheme

    folder = tmp_path_factory.mktemp("artifacts")
    samples = memory_samples(4, seed=1)
    paths = {"fp32": folder / "policy_fp32.pt"}
    export(ACT(tiny.config, tiny.weights), tiny, paths["fp32"], samples=samples)
    for mode, scheme in {
        "dynamic": Scheme("dynamic"),
        "static": Scheme("static"),
        "mixed": Scheme("mixed", float_blocks=("backbone.stem", "decoder.1.feed_forward")),
    }.items():
        paths[mode] = folder / f"policy_{mode}.pt"
        export(quantize(tiny, scheme, calibration), tiny, paths[mode], samples=samples, calibration=calibration)
    return paths


@pytest.fixture(scope="session")
def demo_run() -> Path:
    """The folder of the demo's run, which `make test` makes before it calls pytest.

    Without it tests skip, so that pytest by hand does not begin with minutes of training.
    """
    folder = Path(__file__).parents[1] / "runs" / "demo"
    if not (folder / "compare.json").exists():
        pytest.skip("runs/demo is not there: run make demo, or make test, which does")
    return folder
