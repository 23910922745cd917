"""The command line: help that helps, one sentence for bad input, nothing half-written."""

import errno
import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard import cli as onboard
from rover_lib.onboard.cli import show
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path, read_stage, write_stage


def rover(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


@pytest.mark.parametrize("command", ["benchmark", "drive"])
def test_more_threads_than_any_machine_has_are_refused(command, artifacts):
    """torch would take the number, and crash."""
    result = rover(command, artifacts["static"], "--threads", 100_000)
    assert result.exit_code == 2 and "100000 is not in the range" in result.output


@pytest.mark.parametrize(
    "command",
    [
        [], ["run"], ["report"], ["list"], ["inspect"], ["quantize"], ["compare"], ["distill"], ["finetune"],
        ["export"], ["export-dataset"], ["benchmark"], ["log"], ["doctor"], ["calibrate"], ["world"],
        ["world", "record"], ["world", "train"], ["world", "trial"], ["world", "latency"], ["world", "students"],
        ["world", "learn"], ["wheelhouse"], ["drive"], ["view"], ["record"], ["label"], ["release"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_help(command):
    result = rover(*command, "--help")
    assert result.exit_code == 0 and "Usage" in result.output and len(result.output) > 150


@pytest.mark.parametrize("group", [main, main.commands["world"], main.commands["release"], onboard.main])
def test_commands_are_said_whole_in_80_columns(group):
    lines = CliRunner().invoke(group, ["--help"], terminal_width=80).output.splitlines()[1:]
    assert max(map(len, lines)) <= 80 and not [line for line in lines if line.endswith("...")]


def test_completion_is_of_commands_and_options():
    """What docs/install.md puts into ~/.bashrc asks this."""
    words = {"_ROVER_COMPLETE": "bash_complete", "COMP_CWORD": "1"}
    found = CliRunner().invoke(main, [], prog_name="rover", env=words | {"COMP_WORDS": "rover ins"})
    assert found.output.split() == ["plain,inspect"]
    found = CliRunner().invoke(
        main, [], prog_name="rover", env=words | {"COMP_WORDS": "rover log --d", "COMP_CWORD": "2"}
    )
    assert found.output.split() == ["plain,--drive"]


def test_inspects_each_kind_of_file(artifacts, tiny_file):
    content = json.loads(rover("inspect", artifacts["static"], "--json").output)
    assert content["artifact"]["mode"] == "static" and len(content["artifact"]["content_hash"]) == 64
    content = json.loads(rover("inspect", tiny_file, "--json").output)
    assert content["checkpoint"]["format"] == "trainer"
    assert "parameters_acting" in rover("inspect", tiny_file).output


@pytest.mark.parametrize(
    "args",
    [
        ["inspect", "nothing.pt"],
        ["report", "nothing"],
        ["benchmark", "nothing.pt"],
        ["compare", "nothing.pt", "other.pt", "--episodes", "none"],
        ["quantize", "nothing.pth", "none", "-o", "out.pt"],
        pytest.param(["run", "nothing.pth", "none"], marks=pytest.mark.slow),  # starts a kernel
        ["distill", "nothing.pth", "none", "--size", "320x180", "--name", "fast"],
        ["finetune", "nothing.pth", "none", "--name", "better"],
        ["export", "none", "--onnx"],
        ["export-dataset", "none", "out"],
        ["world", "train", "none", "out.pth"],
        ["world", "trial", "nothing.pt"],
        ["world", "students", "nothing", "none"],
        ["world", "learn", "nothing"],
    ],
    ids=" ".join,
)
def test_bad_input_is_one_sentence(args, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = rover(*args)
    assert result.exit_code == 1
    lines = [line for line in result.output.splitlines() if line]
    assert len(lines) == 1 and lines[0].startswith("rover: "), result.output
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []  # nothing half-written


def test_a_run_ends_with_its_verdict(tmp_path, monkeypatch):
    folder = tmp_path / "runs" / "mine"
    shutil.copytree(Path(__file__).parents[2] / "results" / "demo", folder)
    monkeypatch.setattr("rover_lib.workshop.run.run.run", lambda *args, **options: folder)
    result = rover("run", "best_model.pth", "recordings")
    assert result.exit_code == 0 and "Verdict: deploy policy_static.pt" in result.output
    assert "Next:" in result.output and (folder / "report.html").is_file()
    content = json.loads(rover("report", folder, "--json").output)
    assert content == json.loads((folder / "run.json").read_text())
    line = f"mine             {content['metrics']['headline']}"
    assert rover("list", folder.parent).output.splitlines() == [line]


@pytest.mark.parametrize("error", [RoverError("07_drive.ipynb: no policy"), KeyboardInterrupt()], ids=repr)
def test_a_drive_that_does_not_end_costs_nothing_of_the_last_one(tmp_path, monkeypatch, error):
    file = tmp_path / "drive.json"
    write_stage(file, "drive", params={}, metrics={"of": "before"})

    def execute(*args, **given):
        assert not file.exists()  # so that it is measured again
        raise error

    monkeypatch.setattr("rover_lib.workshop.run.run.execute", execute)
    assert rover("world", "latency", tmp_path).exit_code == 1
    assert read_stage(file, "drive")["metrics"] == {"of": "before"}
    assert list(tmp_path.iterdir()) == [file]


def full():
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("fails", "says"),
    [
        (full, "{}/o.pt: no space left on device; make room on that disk"),
        (Path("/proc/x").mkdir, "/proc/x: no such file or directory; is its name right?"),
        (Path("nothing\x08").read_text, "nothing\\x08: no such file or directory"),
    ],
)
def test_a_systems_error_is_a_sentence_with_its_file(tmp_path, monkeypatch, fails, says):
    monkeypatch.setattr("rover_lib.workshop.run.session.load", lambda *a, **k: write_through(tmp_path / "o.pt", fails))
    monkeypatch.setattr("rover_lib.onboard.kinds.kinds_of", lambda path: ())
    result = CliRunner().invoke(main, ["quantize", "a", "b", "-o", str(tmp_path / "o.pt")])
    assert result.exit_code == 1 and result.output.startswith("rover: " + says.format(tmp_path)), result.output


def write_through(path, fails):
    with atomic_path(path) as temporary:
        temporary.write_text("half")
        fails()


def test_what_a_file_says_cannot_control_the_terminal(capsys):
    show({"labels": ["drive \x1b[31mred"], "layout": "a\nb"}, False)
    assert "drive \\x1b[31mred" in (out := capsys.readouterr().out) and "a\\nb" in out and "\x1b" not in out


def test_a_size_is_width_and_height(tmp_path):
    result = rover("distill", tmp_path, tmp_path, "--size", "320", "--name", "fast")
    assert result.exit_code == 2 and "as in 320x180" in result.output


def test_a_training_that_is_stopped_says_that_it_goes_on(tmp_path, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("rover_learn.train.train", interrupted)
    result = rover("world", "train", tmp_path, tmp_path / "out.pth")
    assert result.exit_code == 130 and "the same command goes on where it was" in result.output


def test_debug_shows_the_traceback(tmp_path):
    result = rover("--debug", "inspect", tmp_path / "nothing.pt")
    assert result.exit_code == 1 and result.exception is not None


def test_benchmark_times_two_artifacts_of_one_name(artifacts, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "rover_lib.onboard.care.benchmark.peak_memory_alone_mb", lambda path, threads: None
    )  # for speed
    files = []
    for run, mode in (("a", "static"), ("b", "mixed")):
        (tmp_path / run).mkdir()
        files.append(shutil.copy(artifacts[mode], tmp_path / run / "policy_static.pt"))
    out = tmp_path / "benchmark-here.json"
    result = rover("benchmark", *files, "--iterations", 2, "--warmup", 0, "--threads", 1, "--output", out, "--json")
    assert result.exit_code == 0, result.output
    for metrics in (json.loads(result.stdout), json.loads(out.read_text())["metrics"]):
        timed = metrics["artifacts"]
        assert {name: v["mode"] for name, v in timed.items()} == {
            "a/policy_static": "static",
            "b/policy_static": "mixed",
        }
        assert (
            metrics["main"] == "a/policy_static"
            and metrics["threads"] == 1
            and all(v["n"] == 2 for v in timed.values())
        )
    assert set(json.loads(out.read_text())["inputs"]) == {"a/policy_static.pt", "b/policy_static.pt"}
    monkeypatch.setattr("os.getloadavg", lambda: (1000.0, 0.0, 0.0))
    result = rover("benchmark", *files, "--iterations", 1, "--warmup", 0, "--threads", 1, "--gates")
    header, first, second, *rest = result.stdout.splitlines()
    assert header.split()[:3] == ["MB", "p50", "ms"] and (first.split()[0], second.split()[0]) == tuple(
        metrics["artifacts"]
    )
    assert "this machine was busy" in result.stderr and any(line.startswith("model_size_mb") for line in rest)
    result = rover("benchmark", files[0], files[0])
    assert result.exit_code == 1 and result.output.strip().endswith("given twice; name each file once")


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Four drives of the expert, through the command line."""
    folder = tmp_path_factory.mktemp("drives")
    result = rover("world", "record", folder / "episodes", "--count", 4, "--seed", 5)
    assert result.exit_code == 0, result.output
    return folder / "episodes"


@pytest.mark.slow
def test_quantizes_and_compares_on_recordings(tiny_file, drives, tmp_path):
    for mode in ("fp32", "static"):
        result = rover("quantize", tiny_file, drives, "-o", tmp_path / f"{mode}.pt", "--mode", mode, "--samples", 8)
        assert result.exit_code == 0, result.output
        assert f"{mode}.pt: {mode}, " in result.output
    block = ("--float-block", "backbone.layer1", "--samples", 8)
    result = rover("quantize", tiny_file, drives, "-o", tmp_path / "mixed.pt", *block)
    assert result.exit_code == 0 and "mixed.pt: mixed, " in result.output
    files = [tmp_path / f"{mode}.pt" for mode in ("fp32", "static", "mixed")]
    result = rover("compare", *files, "--episodes", drives, "--json")
    assert result.exit_code == 0, result.output
    content = json.loads(result.stdout)
    assert set(content) == {"static", "mixed"}
    assert len(content["static"]["steering_mae_per_step_pct"]) == 32
    (tmp_path / "other").mkdir()
    same_name = shutil.copy(tmp_path / "static.pt", tmp_path / "other" / "static.pt")
    plain = rover("compare", *files, same_name, "--episodes", drives)
    assert "steering mean %" in plain.output and "times smaller" in plain.output and "held-out frames" in plain.output
    assert {line.split()[0] for line in plain.output.splitlines()} >= {
        "reference",
        f"{tmp_path.name}/static",
        "other/static",
        "mixed",
    }


@pytest.mark.slow
def test_inspects_recordings_and_drives_a_trial(drives, artifacts):
    content = json.loads(rover("inspect", drives, "--json").output)
    assert content["recordings"]["episodes"] == 4
    result = rover("world", "trial", artifacts["static"], "--worlds", 1, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["trials"] == 1
