"""The command line, thin: it parses, calls the library and prints. On the Pi only the onboard commands work."""

import json
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.errors import RoverError

FILE = click.Path(path_type=Path)
LONG_LIST = 12  # longer ones are for programs
# Of every command that works with the car:
CAMERA = click.option(
    "--camera", default="0", show_default=True, help="Number, /dev/videoN, video, folder or FIFO of JPEGs."
)
PORT = click.option("--port", default="/dev/ttyUSB0", show_default=True, help="The Arduino's.")


class Rover(click.Group):
    """A bad input ends in one sentence and exit code 1; --debug adds the traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except RoverError as e:
            if ctx.params.get("debug"):
                raise
            click.echo(f"rover: {e}", err=True)
        except ModuleNotFoundError as e:
            if ctx.params.get("debug") or (e.name or "").startswith("rover_lib"):
                raise
            click.echo(
                f"rover: this command needs {e.name}, which only a workstation has: make demo sets one up", err=True
            )
        except (OSError, MemoryError) as e:
            if ctx.params.get("debug") or isinstance(
                e, BrokenPipeError
            ):  # click ends quietly when `head` has seen enough
                raise
            click.echo(f"rover: {type(e).__name__}: {e}", err=True)
        ctx.exit(1)


def progress() -> Callable[..., Any]:
    """A progress bar where someone watches; plain silence in a log."""
    from functools import partial

    from tqdm import tqdm

    return partial(tqdm, disable=not sys.stderr.isatty(), leave=False)


def show(value: Any, as_json: bool) -> None:
    """Print a nested dict for people, or as JSON."""
    from rover_lib.onboard.stage import plain

    value = plain(value)
    if as_json:
        click.echo(json.dumps(value, indent=2))
        return

    def lines(v: Any, indent: str) -> None:
        for key, inner in v.items() if isinstance(v, dict) else enumerate(v):
            if isinstance(inner, list) and len(inner) > LONG_LIST:
                click.echo(f"{indent}{key:<28} {len(inner)} values, see --json")
            elif isinstance(inner, (dict, list)) and inner:
                click.echo(f"{indent}{key}")
                lines(inner, indent + "  ")
            else:
                text = f"{inner:.4g}" if isinstance(inner, float) else inner
                click.echo(f"{indent}{key:<28} {text}")

    lines(value, "")


@click.group(cls=Rover, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
@click.version_option(package_name="rover-policy")
def main(debug: bool) -> None:
    """Put a learned driving policy on a small computer.

    A checkpoint (LeRobot ACT) and recordings go in; an INT8 artifact that a Raspberry Pi can run, an honest comparison
    with the original and a benchmark come out. Start with `make demo`, or with `rover run` on your own files.
    """


@main.command()
@click.argument("checkpoint", type=FILE)
@click.argument("episodes", type=FILE)
@click.option("--name", default="mine", show_default=True, help="The run's folder: <runs-dir>/<name>/.")
@click.option("--runs-dir", type=FILE, default="runs", show_default=True)
@click.option("--samples", type=click.IntRange(min=1), help="Calibration samples [default: params.yml].")
@click.option("--worlds", type=click.IntRange(min=0), default=0, show_default=True, help="Balloon worlds to drive in.")
@click.option("--iterations", type=click.IntRange(min=1), help="Timed inferences per mode [default: params.yml].")
def run(checkpoint: Path, episodes: Path, **options: Any) -> None:
    """Load, calibrate, quantize, compare and benchmark CHECKPOINT with the recordings in EPISODES.

    Executes the five notebooks; reports, artifacts, figures and the executed notebooks are left in the run's folder.
    """
    from rover_lib.workshop.run import run as run_notebooks

    chosen = {k: v for k, v in options.items() if v is not None}
    folder = run_notebooks(checkpoint, episodes, progress=progress(), **chosen)
    click.echo(f"done: {folder}")


@main.command()
@click.argument("file", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def inspect(file: Path, as_json: bool) -> None:
    """Say what FILE is: an artifact, a checkpoint, or a folder of recordings."""
    import zipfile

    from rover_lib.onboard.artifact import check_integrity, content_hash, read_manifest

    if file.is_file() and zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as z:
            scripted = any("/code/" in name for name in z.namelist())
        if scripted:
            check_integrity(file)
            return show({"artifact": {"content_hash": content_hash(file), **read_manifest(file)}}, as_json)
    if file.is_dir() and not (file / "config.json").exists():
        from rover_lib.workshop.episodes import load_recordings

        return show({"recordings": load_recordings(file, progress=progress()).summary()}, as_json)
    from rover_lib.workshop.checkpoint import load_checkpoint

    checkpoint = load_checkpoint(file)
    return show({"checkpoint": {"sha256": checkpoint.sha256, **checkpoint.report}}, as_json)


@main.command()
@click.argument("checkpoint", type=FILE)
@click.argument("episodes", type=FILE)
@click.option("-o", "--output", type=FILE, required=True, help="The artifact to write.")
@click.option("--mode", type=click.Choice(["fp32", "dynamic", "static"]), default="static", show_default=True)
@click.option("--kind", type=click.Choice(["symmetric", "affine"]), default="symmetric", show_default=True)
@click.option(
    "--observer", type=click.Choice(["histogram", "minmax", "percentile"]), default="histogram", show_default=True
)
@click.option("--float-block", "float_blocks", multiple=True, help="A block to leave in float; makes static mixed.")
@click.option("--samples", type=click.IntRange(min=1), help="Calibration samples [default: params.yml].")
def quantize(checkpoint: Path, episodes: Path, output: Path, mode: str, samples: int | None, **how: Any) -> None:
    """Quantize CHECKPOINT, calibrated on the recordings in EPISODES, to one artifact.

    `rover run` does this for all modes, chooses the observer and the blocks by measurement, and compares.
    """
    from rover_lib.onboard.params import params
    from rover_lib.workshop import quantize as q
    from rover_lib.workshop.act import ACT
    from rover_lib.workshop.checkpoint import load_checkpoint
    from rover_lib.workshop.episodes import choose_calibration, load_recordings, split

    p = params()
    how_many, seed = samples or p["calibration"]["samples"], p["calibration"]["seed"]
    ck = load_checkpoint(checkpoint)
    recordings = load_recordings(episodes, ck.config.chunk, p["calibration"]["sync_s"], progress())
    parts = split(recordings, p["calibration"]["held_out_share"], seed)
    chosen, note = choose_calibration(parts.calibration, how_many, seed)
    if note:
        click.echo(f"rover: note: {note}", err=True)
    vectors = parts.choosing[:: max(1, len(parts.choosing) // 16)] or chosen[:16]
    options = {"samples": vectors, "tolerance": p["parity"]["fp32"], "int8_errors": p["parity"]["int8_errors"]}
    if mode == "fp32":
        digest = q.export(ACT(ck.config, ck.weights), ck, output, **options)
    else:
        mode = "mixed" if mode == "static" and how["float_blocks"] else mode
        smooth = p["quantization"]["smooth"]
        scheme = q.Scheme(mode, smooth=smooth, percentile=p["quantization"]["percentile"], **how)
        calibration = q.calibrate(ck, chosen, smooth=smooth, progress=progress())
        quantized = q.quantize(ck, scheme, calibration)
        for warning in quantized.report["warnings"]:
            click.echo(f"rover: warning: {warning}", err=True)
        digest = q.export(quantized, ck, output, calibration=calibration, **options)
    click.echo(f"{output}: {mode}, {output.stat().st_size / 1e6:.1f} MB, content {digest[:16]}")


@main.command()
@click.argument("reference", type=FILE)
@click.argument("artifacts", type=FILE, nargs=-1, required=True)
@click.option("--episodes", type=FILE, required=True, help="Recordings; their held-out part judges.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def compare(reference: Path, artifacts: tuple[Path, ...], episodes: Path, as_json: bool) -> None:
    """Compare ARTIFACTS with REFERENCE (the FP32 artifact) on recorded frames.

    Errors are shares of the recorded range and microseconds of servo pulse.
    """
    from rover_lib.onboard.params import params
    from rover_lib.onboard.policy import load_policy
    from rover_lib.workshop import compare as c
    from rover_lib.workshop.episodes import load_recordings, split

    p = params()["calibration"]
    fp32 = load_policy(reference)
    recordings = load_recordings(episodes, fp32.chunk, p["sync_s"], progress())
    held_out = split(recordings, p["held_out_share"], p["seed"]).held_out
    others = {a.stem.removeprefix("policy_"): load_policy(a) for a in artifacts}
    report = c.fidelity(fp32, others, held_out, recordings.action_range(), progress())
    show({name: report.summary(name) for name in others}, as_json)


@main.command()
@click.argument("artifacts", type=FILE, nargs=-1, required=True)
@click.option("--warmup", type=click.IntRange(min=0), default=10, show_default=True)
@click.option("--iterations", type=click.IntRange(min=1), default=100, show_default=True)
@click.option("--threads", type=click.IntRange(min=0), default=0, show_default=True, help="0: all cores.")
@click.option("--duration", type=float, help="Soak for so many seconds instead, with a time series.")
@click.option("--output", type=FILE, help="Write benchmark JSON there, for notebook 05.")
@click.option("--gates", is_flag=True, help="Hold the first artifact against the original's gates in params.yml.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def benchmark(
    artifacts: tuple[Path, ...],
    warmup: int,
    iterations: int,
    threads: int,
    duration: float | None,
    output: Path | None,
    gates: bool,
    as_json: bool,
) -> None:
    """Time ARTIFACTS on this machine, interleaved, on the frames of their own parity vectors.

    The first artifact's figures stand at the top level. Needs nothing but the artifact: this is what runs on the Pi.
    """
    from rover_lib.onboard.artifact import content_hash, read_parity
    from rover_lib.onboard.benchmark import benchmark as measure
    from rover_lib.onboard.benchmark import check_gates
    from rover_lib.onboard.params import params
    from rover_lib.onboard.policy import load_policy
    from rover_lib.onboard.stage import write_stage

    policies = {a.stem: load_policy(a) for a in artifacts}
    vectors = read_parity(artifacts[0])
    first = policies[artifacts[0].stem]
    frames = [
        {c: vectors[f"frame_{c}"][i][:, :, ::-1] for c in first.cameras} for i in range(len(vectors["state"]))
    ]  # stored as RGB; a camera gives BGR
    options = {"warmup": warmup, "iterations": iterations, "threads": threads, "duration_s": duration}
    metrics = measure(policies, frames, vectors["state"][0], **options, memory_alone=True)
    if output:
        write_stage(
            output, "benchmark", params=options, metrics=metrics, inputs={a.name: content_hash(a) for a in artifacts}
        )
    if gates:
        metrics["gates"] = check_gates(metrics, params()["gates"]["original"])
    show(metrics, as_json)


@main.command()
@click.argument("run_dir", type=FILE)
@click.option(
    "--frames", type=click.IntRange(min=3), default=50, show_default=True, help="Held-out frames to judge with."
)
@click.option("--jobs", type=click.IntRange(min=1), help="Artifacts at a time [default: all cores].")
@click.option("--peers", is_flag=True, help="Count ONNX Runtime, ExecuTorch and others beside them.")
@click.option("--details", is_flag=True, help="Count the static policy part by part too, and what else was tried.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def arm(run_dir: Path, frames: int, jobs: int | None, peers: bool, details: bool, as_json: bool) -> None:
    """Count the instructions that the artifacts of RUN_DIR execute on an emulated Cortex-A76.

    A count, never a time. Leaves arm.json and the executed notebook 06 in RUN_DIR, and says which gates of params.yml
    hold. Needs Debian 12 with qemu-user and gcc, which are installed when you are root.
    """
    from rover_lib.onboard.stage import read_stage
    from rover_lib.workshop.arm import count_run, table
    from rover_lib.workshop.run import execute

    count_run(run_dir, frames=frames, jobs=jobs, progress=progress())
    if peers:
        from rover_lib.workshop.peers import count_peers

        count_peers(run_dir, jobs=jobs, progress=progress())
    if details:
        from rover_lib.workshop.parts import count_parts
        from rover_lib.workshop.tries import count_tries

        count_parts(run_dir, progress=progress())
        count_tries(run_dir, progress=progress())
    execute("06_arm", run_dir)
    content = read_stage(run_dir / "arm.json", "arm")
    click.echo(json.dumps(content, indent=2) if as_json else table(content))


@main.group()
def world() -> None:
    """The balloon world: record an expert, train a policy, drive it."""


@world.command()
@click.argument("out_dir", type=FILE)
@click.option("--count", type=click.IntRange(min=1), default=80, show_default=True, help="Episodes.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
def record(out_dir: Path, count: int, seed: int) -> None:
    """Record COUNT drives of the expert to OUT_DIR, in the format of the real car's recorder."""
    from rover_lib.playground.record import record_episodes

    click.echo(f"recorded: {record_episodes(out_dir, count, seed, progress())}")


@world.command()
@click.argument("episodes", type=FILE)
@click.argument("output", type=FILE)
@click.option("--size", type=click.Choice(["small", "full"]), default="small", show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--steps", type=click.IntRange(min=1), help="Optimiser steps [default: the recipe's].")
@click.option("--device", type=click.Choice(["cpu", "cuda"]), help="[default: cuda where there is one]")
def train(episodes: Path, output: Path, **options: Any) -> None:
    """Train LeRobot's ACT on EPISODES and write the checkpoint OUTPUT, in the format of the user's trainer.

    `full` is the policy of the real car; on a CPU give it a few --steps, which do not make it drive.
    """
    from rover_lib.playground.train import train as train_policy

    click.echo(f"trained: {train_policy(episodes, output, progress=progress(), **options)}")


@main.command()
@click.argument("artifact", type=FILE, required=False)
@CAMERA
@PORT
@click.option("--hz", type=click.FloatRange(10, 100), default=30.0, show_default=True, help="Commands a second.")
@click.option("--dry-run", is_flag=True, help="No Arduino, no motor: logs what would be sent.")
@click.option("--record", type=FILE, help="Write the drive as an episode into this folder.")
@click.option("--record-mb", type=click.FloatRange(min=1), help="All in that folder take at most so much.")
@click.option("--max-seconds", type=click.FloatRange(min=0, min_open=True), help="End after so many.")
@click.option("--ticks", type=click.IntRange(min=1), help="End after so many commands.")
@click.option("--throttle-limit", type=click.FloatRange(0, 1), help="[default: params.yml; with --replay: none]")
@click.option("--blend-ticks", type=click.IntRange(min=0), help="Of a fresh plan taking over [default: params.yml].")
@click.option("--ensemble", type=float, help="LeRobot's temporal ensembling with this coefficient, say 0.01.")
@click.option("--threads", type=click.IntRange(min=1), help="The policy's [default: all cores but one].")
@click.option("--log", "log_file", type=FILE, help="Flight log [default: rover/flight.log in the user's state folder].")
@click.option(
    "--json", "json_file", type=click.File("w", lazy=True), help="Write what the drive was there; - prints it."
)
@click.option("--replay", type=FILE, help="Send this episode's pulses; no policy, no camera.")
@click.option("--service", is_flag=True, help="As a systemd service: disarmed until `rover arm-car`.")
@click.option("--world", "in_world", is_flag=True, help="The balloon world instead of a car, in real time.")
@click.option("--firmware", is_flag=True, help="With --world: the real firmware on an emulated Arduino.")
@click.option("--latency-ms", type=click.FloatRange(min=0), default=0, help="With --world: a plan takes so long.")
@click.option("--seed", type=click.IntRange(min=0), default=10_000, show_default=True, help="With --world: its first.")
@click.option("--in-thread", is_flag=True, help="With --world: the policy in a thread of the loop's, to compare.")
@click.pass_context
def drive(ctx: click.Context, artifact: Path | None, replay: Path | None, json_file: Any, **options: Any) -> None:
    """Drive ARTIFACT: arms the car once camera, plan and Arduino are ready, and stops it whatever fails.

    Exit codes: 0 ended as asked (--ticks, --max-seconds, end of --replay, SIGINT, SIGTERM, SIGHUP); 1 could not begin;
    2 usage; 3 a fault stopped the car; 4 the human took over. Nothing arms it again but another start.
    """
    from rover_lib.onboard.drive import Report
    from rover_lib.onboard.errors import DriveFault, TakenOver
    from rover_lib.onboard.service import NotArmed

    if bool(artifact) == bool(replay):
        raise click.UsageError("give an ARTIFACT, or --replay EPISODE")
    if options["service"] and (replay or options["dry_run"]):
        raise click.UsageError("--service drives a car by an artifact: no --replay, no --dry-run")
    if options["record_mb"] and not options["record"]:
        raise click.UsageError("--record-mb belongs to --record")
    if not options["in_world"] and (options["firmware"] or options["latency_ms"] or options["in_thread"]):
        raise click.UsageError("--firmware, --latency-ms and --in-thread belong to --world")
    report, more, code = Report(), {}, 0
    try:
        _drive(artifact, replay, report, more, **options)
    except NotArmed as e:
        click.echo(f"rover: {e}", err=True)
    except (DriveFault, TakenOver) as e:
        click.echo(f"rover: {e}", err=True)
        code = 4 if isinstance(e, TakenOver) else 3
    except Exception:  # whatever ended a drive, the summary of what was driven is still written
        if not report.ticks:
            raise
        traceback.print_exc()  # a defect of this program, which has stopped the car too
        code = 3
    result = {**report.summary(), **more}
    if json_file:
        json_file.write(json.dumps(result, indent=2) + "\n")
    else:
        show(result, False)
    ctx.exit(code)


def _drive(
    artifact: Path | None,
    replay: Path | None,
    report: Any,
    more: dict[str, Any],
    *,
    camera: str,
    port: str,
    hz: float,
    dry_run: bool,
    record: Path | None,
    record_mb: float | None,
    throttle_limit: float | None,
    blend_ticks: int | None,
    ensemble: float | None,
    threads: int | None,
    log_file: Path | None,
    in_world: bool,
    firmware: bool,
    latency_ms: float,
    seed: int,
    in_thread: bool,
    service: bool,
    **ends: Any,
) -> None:
    """The drive command's devices, opened in order and closed in reverse; more: what a world adds to the report."""
    import logging
    import threading
    from contextlib import ExitStack

    from rover_lib.onboard import drive as d
    from rover_lib.onboard import watch as w
    from rover_lib.onboard.camera import Camera
    from rover_lib.onboard.host import default_log
    from rover_lib.onboard.params import params
    from rover_lib.onboard.pilot import ReplayPilot
    from rover_lib.onboard.plan import Settings
    from rover_lib.onboard.recording import read_controls
    from rover_lib.onboard.service import Service
    from rover_lib.onboard.servo_link import ServoLink
    from rover_lib.onboard.telemetry import FlightLog, StatusLine

    p = params()
    settings = Settings.of(p["drive"], throttle_limit=throttle_limit, blend_ticks=blend_ticks, ensemble=ensemble)
    controls = read_controls(replay) if replay else None
    stop = threading.Event()
    with ExitStack() as stack:
        header = {"artifact": str(artifact or replay), "hz": hz, **vars(settings)}
        status = stack.enter_context(StatusLine(lambda: report.status, sys.stderr))
        logging.basicConfig(level=logging.INFO, format="rover: %(message)s", handlers=[status.handler], force=True)
        limits = {"max_bytes": int(p["flight_log"]["max_mb"] * 1e6), "keep": p["flight_log"]["keep"]}
        path = log_file or default_log()
        unended = w.unended(path)
        log = stack.enter_context(FlightLog(path, header=header, **limits))
        if unended:
            log.event(unended, level=logging.WARNING)
        stack.enter_context(w.ended_by_signals(stop, log))
        stack.enter_context(w.ended_if_hung(report, log))
        if in_world:
            from rover_lib.playground.car import VirtualCar

            car = stack.enter_context(VirtualCar(seed=seed, firmware=firmware))
            camera, port = car.camera, car.port
            stack.callback(lambda: more.update(hits=(r := car.report()).hits, trials=r.trials, camera_late=r.late))
        wait = stack.enter_context(Service(report, stop, log.event)).wait if service else d.at_once
        link = None if dry_run else stack.enter_context(ServoLink(port))
        common = {"rate_hz": hz, "log": log, "stop": stop, "report": report, **ends}
        if controls:
            limit = 1.0 if throttle_limit is None else throttle_limit
            with w.going_first(log):
                d.drive(ReplayPilot(controls, throttle_limit=limit), link, watch=w.Troubles(report, link), **common)
            return
        frames = stack.enter_context(Camera(camera))
        recording = {"record": record, "record_mb": record_mb}
        how = {"threads": threads, "in_thread": in_thread, "latency_s": latency_ms / 1e3}
        d.drive_artifact(artifact, frames, link, settings=settings, wait=wait, **recording, **how, **common)


@main.command("record")
@click.argument("out_dir", type=FILE)
@CAMERA
@PORT
@click.option(
    "--hz", type=click.FloatRange(5, 50), default=30.0, show_default=True, help="Controls and frames a second."
)
@click.option("--max-seconds", type=click.FloatRange(min=0, min_open=True), help="End an episode after so many.")
@click.option("--label", default="", help='What is done, say "hit red balloon".')
@click.option("--episodes", type=click.IntRange(min=1), default=1, show_default=True, help="One after another.")
@click.pass_context
def record_human(ctx: click.Context, out_dir: Path, hz: float, **options: Any) -> None:
    """Record a human who drives with the transmitter: episode folders in OUT_DIR, to train and calibrate with.

    Ctrl-C, SIGTERM and SIGHUP end an episode, and it is kept. Exit code 1 if a fault ended it; what was recorded until
    then is kept too.
    """
    from rover_lib.onboard.recorder import record_episodes

    fault = None
    for report in record_episodes(
        folder=out_dir, rate_hz=hz, status=sys.stderr, say=lambda text: click.echo(text, err=True), **options
    ):
        click.echo(str(report))
        fault = report.fault
    ctx.exit(1 if fault else 0)


@main.command()
@click.argument("file", type=FILE)
@click.option("-o", "--output", type=FILE, help="The figure to write [default: FILE.png].")
@click.option(
    "--drive", type=int, default=-1, show_default=True, help="Which of FILE's drives: 0 the first, -1 the last."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON; draw only with -o.")
def log(file: Path, output: Path | None, drive: int, as_json: bool) -> None:
    """Sum up the flight log FILE of `rover drive`, and draw it.

    Missed ticks, jitter, ages and latencies of plans, who drove, temperature, and what happened. Older parts of the
    same log (FILE.1, FILE.2, ...) are read with it. The figure needs a workstation, the summary does not.
    """
    from rover_lib.onboard.stage import atomic_path
    from rover_lib.onboard.telemetry import read_log

    flight = read_log(file, drive)
    summary = flight.summary()
    if as_json:
        show(summary, as_json)
    else:
        show({k: v for k, v in summary.items() if k != "events"}, as_json)
        for event in flight.events:
            click.echo(f"{event.t_s:9.2f} s  {event}")
    if output or not as_json:
        from rover_lib.workshop.flight import flight_figure

        output = output or file.with_name(f"{file.name}.png")
        figure = flight_figure(flight)
        with atomic_path(output) as temporary:
            figure.savefig(temporary)
        click.echo(f"drawn: {output}", err=as_json)


@main.command()
@click.argument("artifact", type=FILE, required=False)
@CAMERA
@PORT
@click.option("--hz", type=click.FloatRange(1, 120), default=30.0, show_default=True, help="Frames a second wanted.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_context
def doctor(ctx: click.Context, artifact: Path | None, camera: str, port: str, hz: float, as_json: bool) -> None:
    """Look at all that driving needs: camera, Arduino, ARTIFACT, power, disk. Say what to do.

    Nothing is armed and no servo is moved, but opening the port resets the Arduino. Exit code 1 if anything fails that
    driving cannot do without; warnings do not count.
    """
    from rover_lib.onboard.doctor import examine
    from rover_lib.onboard.host import default_log

    checks = []
    for check in examine(artifact, camera=camera, port=port, rate_hz=hz, log_folder=default_log().parent):
        checks.append(check)
        if not as_json:
            click.echo(str(check))
    failed = [c.name for c in checks if c.verdict == "fail"]
    if as_json:
        show({"drives": not failed, "checks": [vars(c) for c in checks]}, as_json)
    elif failed:
        click.echo(f"rover: this car would not drive: {', '.join(failed)}", err=True)
    ctx.exit(1 if failed else 0)


@main.command()
@click.argument("output", type=FILE, required=False)
@click.option("--only", metavar="NAME", multiple=True, help="Only this row, 'fuzz' or 'bytes'; several times for more.")
@click.pass_context
def faults(ctx: click.Context, output: Path | None, only: tuple[str, ...]) -> None:
    """Break what can break while the car drives, and see on the pins of an emulated Arduino whether it stops.

    About 6 minutes for all. With OUTPUT, the rows are left there as JSON. Exit code 1 if anything is not as expected.
    Needs Debian's packages for the Arduino's firmware and simavr, see README.
    """
    from rover_lib.playground.faults import run_faults

    outcome = run_faults(only, say=click.echo)
    if output:
        outcome.write(output)
    show(outcome.summary, False)
    for sentence in outcome.wrong:
        click.echo(f"rover: {sentence}", err=True)
    ctx.exit(1 if outcome.wrong else 0)


@main.group()
def pi() -> None:
    """Emulated Pis: the playbooks, the service and its faults on real Debian arm64 systems. Needs root, and Debian."""


def _end_pi(ctx: click.Context, wrong: list[str], output: Path) -> None:
    for sentence in wrong:
        click.echo(f"rover: {sentence}", err=True)
    click.echo(f"{'not as expected' if wrong else 'as expected'}: {output}")
    ctx.exit(1 if wrong else 0)


@pi.command("fast")
@click.argument("output", type=FILE, default="runs/pi-fast.json")
@click.option("--demo", type=FILE, default="runs/demo", show_default=True, help="A run, whose artifacts are deployed.")
@click.option("--faults/--no-faults", default=True, help="Leave out a deployment's faults and the fleet.")
@click.pass_context
def pi_fast(ctx: click.Context, output: Path, demo: Path, faults: bool) -> None:
    """Run every playbook on an emulated Pi in a container, and prove from within what they promise.

    Real systemd and sshd, aarch64 programs, the real firmware on an emulated Arduino. OUTPUT is JSON, what the
    playbooks said is beside it; exit code 1 if anything is not as expected.
    """
    from rover_lib.emulated.fast import run_fast

    outcome = run_fast(output, demo, faults=faults, say=click.echo)
    for gate in outcome.metrics.get("gates", []):
        click.echo(f"{'ok  ' if gate['holds'] else 'FAIL'}  {gate['gate']}: {gate['wanted']}")
    _end_pi(ctx, outcome.wrong, output)


@pi.command("whole")
@click.argument("output", type=FILE, default="runs/pi.json")
@click.option("--artifact", type=FILE, default="runs/demo/policy_static.pt", show_default=True, help="To deploy.")
@click.option("--recordings", type=FILE, default="runs/demo/episodes", show_default=True, help="What the camera shows.")
@click.option("--fresh", is_flag=True, help="Provision anew, even if the cache has a card that was provisioned so.")
@click.pass_context
def pi_whole(ctx: click.Context, output: Path, **options: Any) -> None:
    """Provision, deploy and drive a whole emulated Pi, and hold each servo pulse against its command.

    QEMU's Cortex-A76 with kernel, camera and USB; the real firmware on an emulated Arduino. Cables are pulled while
    it drives. OUTPUT is JSON; exit code 1 if anything is not as expected, the machine's console is beside it then.
    """
    from rover_lib.emulated.whole import run_whole

    outcome = run_whole(output, **options, say=click.echo)
    _end_pi(ctx, outcome.wrong, output)


@main.command("arm-car")
@click.option("--yes", is_flag=True, help="Do not ask.")
def arm_car(yes: bool) -> None:
    """Arm the car whose service waits for it (rover-drive.service): it drives at once. Needs root.

    The Arduino refuses without the transmitter, and unless its throttle stick is at rest. Moving a stick takes the car
    back; `sudo systemctl restart rover-drive` stops and disarms it.
    """
    from rover_lib.onboard.service import arm_car as arm

    if not yes:
        click.confirm("The car will drive now. Is the way free, and the transmitter in your hand?", abort=True)
    click.echo(arm())


@main.group()
@click.option("--models", type=FILE, default="/var/lib/rover/models", show_default=True, help="The rover's models.")
@click.option("--chunk", type=click.IntRange(min=1), default=32, show_default=True, help="Actions of a plan.")
@click.option("--camera", default="cam_front", show_default=True, help="The policy's name for this rover's camera.")
@click.option("--aspect", type=float, default=1.78, show_default=True, help="Of its pictures, width to height.")
@click.option("--sandboxed", is_flag=True, help="Run parity vectors in the service's sandbox.")
@click.pass_context
def release(ctx: click.Context, models: Path, chunk: int, camera: str, aspect: float, sandboxed: bool) -> None:
    """Models on the rover: staged, proven, used; what is in use changes at once or not at all.

    `ansible-playbook ansible/deploy.yml` does all of it over a network.
    """
    from rover_lib.onboard import release as r

    expected = r.Expected(chunk=chunk, camera=camera, aspect=aspect)
    ctx.obj = r.Releases(models, check=r.sandboxed if sandboxed else None, expected=expected)


ALLOW = click.option(
    "--allow", multiple=True, type=click.Choice(["mode", "chunk", "camera"]), help="Take one that differs in this."
)


@release.command()
@click.argument("artifact", type=FILE)
@click.argument("folder", type=FILE)
@ALLOW
@click.pass_obj
def pack(releases: Any, artifact: Path, folder: Path, allow: tuple[str, ...]) -> None:
    """Cut ARTIFACT into parts that travel one by one, in FOLDER. Refuses what the rover would refuse."""
    from rover_lib.onboard.release import pack as pack_parts

    show(pack_parts(artifact, folder, releases.expected, allow), True)


@release.command()
@click.argument("source", type=FILE)
@click.option("--sha256", help="What the artifact's must be.")
@ALLOW
@click.pass_obj
def stage(releases: Any, source: Path, sha256: str | None, allow: tuple[str, ...]) -> None:
    """Make a release of SOURCE, an artifact or what `pack` wrote. What is in use stays in use."""
    show(vars(releases.stage(source, sha256=sha256, allow=allow)), True)


@release.command()
@click.argument("name", default="current")
@click.pass_obj
def verify(releases: Any, name: str) -> None:
    """Prove that a release is whole and computes here what it should: checksums and parity vectors."""
    releases.verify(name)
    click.echo(f"{name}: whole, and computes what it should")


@release.command()
@click.argument("name")
@click.pass_obj
def switch(releases: Any, name: str) -> None:
    """Use the release NAME from now on: proven before and after, and back by itself if that fails."""
    show({"name": name, "changed": releases.switch(name)}, True)


@release.command()
@click.pass_obj
def rollback(releases: Any) -> None:
    """Use the release before the one in use, the newest that can be proven."""
    show({"name": releases.rollback(), "changed": True}, True)


@release.command()
@click.option("--keep", type=click.IntRange(min=1), default=3, show_default=True)
@click.pass_obj
def prune(releases: Any, keep: int) -> None:
    """Remove all but the releases used last; never the one in use."""
    gone = releases.prune(keep)
    show({"removed": gone, "changed": bool(gone)}, True)


@release.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with the machine's and the service's state.")
@click.pass_obj
def status(releases: Any, as_json: bool) -> None:
    """What is in use, whether it is whole, what else is there. Exit code 1 if what is in use is not whole."""
    found = releases.status()
    if as_json:
        import socket

        from rover_lib.onboard.host import Host, default_log
        from rover_lib.onboard.service import ServiceError, state_of

        try:
            found["service"] = state_of()
        except ServiceError as e:
            found["service"] = {"installed": False, "active": "unknown", "state": "", "text": str(e)}
        log = next((p for p in (Path("/var/lib/rover-drive/flight.log"), default_log()) if p.exists()), None)
        found |= {"rover": socket.gethostname(), **Host().reading(), "last_drive_s": log and log.stat().st_mtime}
        return show(found, True)
    for r in found["releases"]:
        mark = "*" if r["current"] else " "
        click.echo(f"{mark} {r['name'][:12]}  {r['mode']:<7} {r['megabytes']:6.1f} MB  {r['wrong'] or r['origin']}")
    if not found["healthy"]:
        raise RoverError(found["trouble"])


@main.command()
@click.argument("folder", type=FILE, default="wheels")
@click.option("--python", "pythons", multiple=True, help="A Pi's Python [default: 3.11 and 3.13].")
@click.option("--only-rover", is_flag=True, help="Only rover_lib's own wheel: Pis with internet fetch the others.")
def wheelhouse(folder: Path, pythons: tuple[str, ...], only_rover: bool) -> None:
    """Put all that a Pi installs into FOLDER, for a rover without internet (154 MB for each Python)."""
    from rover_lib.workshop.wheelhouse import PYTHONS, make

    show(vars(make(folder, pythons=pythons or PYTHONS, only_rover=only_rover)), True)


@main.command("leave-out")
@click.argument("run_dir", type=FILE)
@click.option("--frames", type=click.IntRange(min=1), default=100, show_default=True, help="Held-out frames.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def leave_out(run_dir: Path, frames: int, as_json: bool) -> None:
    """Report what each layer and head of RUN_DIR's policy costs, and what leaving it out does to the actions.

    A report only, in float: nothing is left out of any artifact. Leaves leave_out.json in RUN_DIR.
    """
    from rover_lib.workshop.ablation import report, table

    content = report(run_dir, frames, progress())
    click.echo(json.dumps(content, indent=2) if as_json else table(content))


@world.command()
@click.argument("run_dir", type=FILE)
@click.option("--samples", type=click.IntRange(min=1), default=64, show_default=True, help="Calibration samples.")
@click.option("--steps", type=click.IntRange(min=1), default=24, show_default=True, help="Training steps.")
def full(run_dir: Path, **options: Any) -> None:
    """Make a policy of the real car's size in RUN_DIR, and artifacts of it at several image sizes, for `rover arm`.

    Real in format, size and ranges, but trained for a few steps only: it does not drive.
    """
    from rover_lib.playground.full import NOTE, full_run

    click.echo(f"made: {full_run(run_dir, progress=progress(), **options)} ({NOTE})")


@world.command()
@click.argument("artifact", type=FILE)
@click.option("--worlds", type=click.IntRange(min=1), default=40, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=10_000, show_default=True, help="Of the first world.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def trial(artifact: Path, worlds: int, seed: int, as_json: bool) -> None:
    """Drive ARTIFACT through worlds that it has never seen, and count the balloons it hits."""
    from rover_lib.onboard.policy import load_policy
    from rover_lib.playground.trial import run_trials

    report = run_trials(load_policy(artifact), worlds, seed, progress=progress())
    low, high = report.wilson
    result = {"hits": report.hits, "trials": report.trials, "wilson_low": low, "wilson_high": high}
    show(result, as_json)


@world.command("latency")
@click.argument("run_dir", type=FILE)
@click.option("--worlds", type=click.IntRange(min=1), default=40, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def world_latency(run_dir: Path, worlds: int, as_json: bool) -> None:
    """Drive RUN_DIR's static policy with late plans, by the car's loop in virtual time, and count the balloons it hits.

    Leaves drive.json and the executed notebook 07 in RUN_DIR, and says whether the gate of params.yml holds.
    """
    from rover_lib.onboard.stage import read_stage
    from rover_lib.playground.latency import table
    from rover_lib.workshop.run import execute

    (run_dir / "drive.json").unlink(missing_ok=True)  # measured by another version, perhaps
    execute("07_drive", run_dir, worlds=worlds)
    content = read_stage(run_dir / "drive.json", "drive")
    click.echo(json.dumps(content, indent=2) if as_json else table(content))


if __name__ == "__main__":
    main()
