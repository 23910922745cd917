"""Fixtures that many tests share: a tiny policy, its calibration, its artifacts, and the demo's run."""

import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

# nbformat checks notebooks with jsonschema, which compiles the grammar of this package if it is installed. That would
# take 2 s in each process, and no test needs it.
sys.modules["rfc3987_syntax"] = None  # type: ignore[assignment]
# In a container, root may be the only user.
os.environ.setdefault("ROVER_AS_ROOT", "1")
# No deadline for hypothesis's examples: one that waits for another program's turn has not failed.
settings.register_profile("shared machine", deadline=None)
settings.load_profile("shared machine")
# Before anything imports datasets, whose tables would stay in the user's cache.
TABLES = tempfile.TemporaryDirectory(prefix="rover-tables-")
os.environ["HF_DATASETS_CACHE"] = TABLES.name
USERS_CACHE = os.environ.get("ROVER_CACHE", "")  # empty is as unset
LEFT_MB = 150
_give_back_from = [0.0]  # megabytes held, above which a test's end frees what is left


def pytest_collection_modifyitems(items):
    """Mark the tests that use the demo's run as slow: driving with its policy starts processes that import torch."""
    for item in items:
        if "demo_run" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    """A cache of this process's own, so that the tests neither find nor leave anything in the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def users_cache():
    """The user's cache instead, as for make count: to fetch and unpack an emulated Pi takes a minute."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", USERS_CACHE)
        yield


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Let torch use one thread: the tests are so small that several would only wait for each other."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def set_params(tmp_path_factory):
    """A function that lets a params.yml of this text hold until the module's tests have ended."""
    path = tmp_path_factory.mktemp("params") / "params.yml"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_PARAMS", str(path))
        yield path.write_text


def resident_mb() -> float:
    """Return the memory that this process holds at present."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.fixture(autouse=True)
def _give_back():
    """Free what a test has left, once that is LEFT_MB.

    A quantized policy's graph and module refer to each other, 70 MB of them, and Python's collector counts objects, not
    megabytes: without this a process that runs several files grows to 6 GB.
    """
    yield
    if resident_mb() > _give_back_from[0]:
        from rover_lib.workshop.int8.quantize import forget_graphs

        forget_graphs()
        _give_back_from[0] = resident_mb() + LEFT_MB


@pytest.fixture(scope="session")
def made_once(tmp_path_factory) -> Callable[[str, Callable[[Path], None]], Path]:
    """made_once(name, make) returns a folder that make(folder) filled once for all processes of this run of pytest."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder(name: str, make: Callable[[Path], None]) -> Path:
        made = shared / name
        with FileLock(f"{made}.lock"):
            if not made.exists():
                making = Path(f"{made}.making")
                making.mkdir(exist_ok=True)
                make(making)
                making.rename(made)
        return made

    return folder


@pytest.fixture(scope="session")
def tiny_policy():
    from tests.helpers.policies import TINY, lerobot_policy

    return lerobot_policy(**TINY)


@pytest.fixture(scope="session")
def tiny_file(made_once, request) -> Path:
    def make(folder: Path) -> None:
        import torch

        from tests.helpers.policies import trainer_content

        torch.save(trainer_content(request.getfixturevalue("tiny_policy")), folder / "best_model.pth")

    return made_once("checkpoint", make) / "best_model.pth"


@pytest.fixture(scope="session")
def tiny(tiny_file):
    from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint

    return load_checkpoint(tiny_file)


@pytest.fixture(scope="session")
def calibration(tiny):
    from rover_lib.workshop.int8.observe import calibrate
    from tests.helpers.policies import memory_samples

    return calibrate(tiny, memory_samples(12))


@pytest.fixture(scope="session")
def thin(tiny):
    """The tiny policy with a sixteenth of the channels inside its backbone's blocks, and its calibration.

    Hundreds of tests write, hash and load its artifacts, which have a tenth of the tiny policy's megabytes.
    """
    from rover_lib.workshop.int8.observe import calibrate
    from tests.helpers.policies import memory_samples, with_few_channels

    policy = replace(tiny, weights=with_few_channels(tiny.weights, 16))
    return policy, calibrate(policy, memory_samples(12))


@pytest.fixture(scope="session")
def artifacts(made_once, request) -> dict[str, Path]:
    """One artifact of the thin policy per mode."""

    def make(folder: Path) -> None:
        from rover_lib.workshop.act import ACT
        from rover_lib.workshop.int8.export import Exporter
        from rover_lib.workshop.int8.quantize import quantize
        from rover_lib.workshop.int8.scheme import Scheme
        from tests.helpers.policies import memory_samples

        thin, calibration = request.getfixturevalue("thin")
        exporter = Exporter(thin, memory_samples(4, seed=1))
        exporter.export(ACT(thin.config, thin.weights), folder / "policy_fp32.pt")
        mixed = Scheme("mixed", float_blocks=("backbone.stem", "decoder.1.feed_forward"))
        for scheme in (Scheme("dynamic"), Scheme("static"), mixed):
            exporter.export(quantize(thin, scheme, calibration), folder / f"policy_{scheme.mode}.pt", calibration)
        static = quantize(thin, Scheme("static"), calibration)
        exporter.export(static, folder / "policy_static.onnx.zip", calibration)

    folder = made_once("artifacts", make)
    return {mode: folder / f"policy_{mode}.pt" for mode in ("fp32", "dynamic", "static", "mixed")}


@pytest.fixture(scope="session")
def onnx_static(artifacts) -> Path:
    """The same policy as `artifacts["static"]`, exported for ONNX Runtime."""
    return artifacts["static"].with_name("policy_static.onnx.zip")


@pytest.fixture(scope="session")
def demo_run() -> Path:
    """The folder of the demo's run, which `make test` makes before it calls pytest.

    Tests that need it are skipped if it is missing, so that calling pytest by hand does not start minutes of training.
    """
    folder = Path(__file__).parents[1] / "runs" / "demo"
    if not (folder / "compare.json").exists():
        pytest.skip("runs/demo is not there: run make demo, or make test, which does")
    return folder
