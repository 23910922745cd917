"""The rover's own command line: what works where only rover_lib.onboard is installed.

It is thin: it parses arguments, calls the library and prints.
"""

import contextlib
import functools
import json
import platform
import sys
import traceback
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.columns import align, benchmark_rows, in_words
from rover_lib.onboard.errors import RoverError, of_system, printable
from rover_lib.onboard.kinds import Number, Output, PathTo, Preset, check_output

FILE = click.Path(path_type=Path)
ARTIFACT = PathTo("artifact")
MOST_THREADS = 256  # torch takes any number, and the process crashes where the system has no more
LONG_LIST = 12  # longer lists are for programs, and not printed for people
ALLOWED = click.Choice(["mode", "chunk", "camera", "aspect"])
LOG = Output("flight log", appended=True)
# Options that several commands share:
CAMERA = click.option("--camera", default="0", show_default=True, help="A number, /dev/videoN, csi or a FIFO.")
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
PORT = click.option("--port", default="", help="The Arduino's serial port [default: the only one that is there].")
LOG_DRIVE = click.option("--drive", type=int, default=-1, show_default=True, help="Of FILE: 0 the first, -1 the last.")
POSITIVE = Number(min=0, min_open=True)
LIMITED: dict[str, Any] = {"cls": Preset, "preset": lambda p, _: p["drive"]["throttle_limit"]}
FROM_0, FROM_1 = click.IntRange(min=0), click.IntRange(min=1)


class Rover(click.Group):
    """A group of commands in which a bad input ends in one sentence and exit code 1; --debug adds the traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise  # nobody reads any more: click ends without a word
        except (RoverError, OSError, MemoryError, ModuleNotFoundError) as error:
            ours = isinstance(error, ModuleNotFoundError) and (error.name or "").startswith("rover_lib")
            if ctx.params.get("debug") or ours:
                raise
            click.echo(f"rover: {_sentence_of(error)}", err=True)
        ctx.exit(1)


def _sentence_of(error: Exception) -> object:
    if isinstance(error, ModuleNotFoundError):
        return f"this command needs {error.name}; {_how_to_get(error.name)}"
    if isinstance(error, OSError):
        return of_system(error)
    return printable(str(error)) if isinstance(error, RoverError) else "out of memory: end other programs, or use less"


def _how_to_get(module: str | None) -> str:
    extra = "view" if module == "aiohttp" else "workshop"
    if find_spec("rover_lib.workshop") is None:  # a rover's own wheel
        return "provision with -e rover_view=true" if extra == "view" else "it works on a workstation"
    return f"pip install 'rover-policy[{extra}]', or in a checkout: make demo"


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
                click.echo(f"{indent}{printable(key)}")
                lines(inner, indent + "  ")
            else:
                text = f"{inner:.4g}" if isinstance(inner, float) else printable(inner)
                click.echo(f"{indent}{printable(key):<28} {text}")

    lines(value, "")


def _print_versions(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        from rover_lib.onboard.artifact.manifest import PACKAGES
        from rover_lib.onboard.stage import version_of

        click.echo(f"rover {version_of('rover-policy') or 'not installed'}\nPython {platform.python_version()}")
        for engine, package in PACKAGES.items():  # of which none is imported
            version = (version_of(package) or "") if find_spec(package) else "is not installed"
            click.echo(f"engine {engine}: {package} {version}".rstrip())
        ctx.exit()


_FIRST: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False}
VERSION = click.option("--version", **_FIRST, callback=_print_versions, help="Show versions, the engines' too.")


def with_options(*options: Callable) -> Callable[[Callable], Callable]:
    """Make one decorator of several options that more than one command has."""
    return lambda command: functools.reduce(lambda inner, option: option(inner), reversed(options), command)


@click.group("rover", cls=Rover, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
@VERSION
def main(debug: bool) -> None:
    """Drive a car with a learned policy. These commands work on the rover; on a workstation, `rover` has more."""


def notify(text: str) -> None:
    """Tell the human something, on standard error."""
    click.echo(text, err=True)


def ask(text: str) -> None:
    """Ask the human to do something, and wait until Enter says that it is done."""
    click.prompt(text + " Enter", "", show_default=False, err=True)


drive_options = with_options(  # on the rover and in the balloon world
    click.argument("artifact", type=ARTIFACT),
    CAMERA,
    PORT,
    click.option("--hz", type=Number(10, 100), default=30.0, show_default=True, help="Commands a second."),
    click.option("--dry-run", is_flag=True, help="Use no Arduino; only log what would be sent."),
    click.option("--record", type=FILE, help="Write the drive as an episode into this folder."),
    click.option("--record-mb", type=Number(min=1), help="At most this many megabytes in that folder."),
    click.option("--max-seconds", type=POSITIVE, help="Longest duration of the drive."),
    click.option("--ticks", type=FROM_1, help="End after this number of commands."),
    click.option("--throttle-limit", type=Number(0, 1), help="Largest throttle [default: params.yml].", **LIMITED),
    click.option("--threads", type=click.IntRange(1, MOST_THREADS), help="Of the policy [default: all cores but one]."),
    click.option("--log", "log_file", type=LOG, help="Flight log [default: rover/flight.log in your state folder]."),
    click.option("--json", "json_file", type=Output(appended=True), help="Write a summary to this file; - prints it."),
    click.option("--view", type=FILE, help="Socket of the view that shows it [default: that of your `rover view`]."),
    click.option("--service", is_flag=True, help="Run as a systemd service, disarmed until `rover arm-car`."),
)


@main.command(short_help="Drive a car with an artifact.")
@drive_options
@click.pass_context
def drive(ctx: click.Context, **options: Any) -> None:
    """Drive by ARTIFACT: arm the car once camera, plan and Arduino are ready, and stop it after a fault.

    Exit codes: 0 ended as asked (--ticks, --max-seconds, SIGINT, SIGTERM, SIGHUP, SIGQUIT); 1 could not begin;
    2 usage; 3 a fault stopped the car; 4 the human took over. Only another start arms it again; with --service, which
    waits disarmed after each drive, another request does.
    """
    ctx.exit(run_drive(**options))


def run_drive(json_file: Path | None, car: Any = None, **options: Any) -> int:
    """Drive by DriveOptions, print or write the summary, and return the exit code. car: see drive_car()."""
    from rover_lib.onboard.car.host import boottime

    asked_s = boottime()  # before the other imports, which may take seconds
    from rover_lib.onboard.drive.drive import drive_car
    from rover_lib.onboard.drive.loop import Report
    from rover_lib.onboard.drive.session import DriveOptions
    from rover_lib.onboard.errors import DriveFault

    o = DriveOptions(**options, asked_s=asked_s)
    if o.service and o.dry_run:
        raise click.UsageError("--service drives a car: no --dry-run")
    report = Report()
    code = 0
    try:
        drive_car(o, report, car)
    except RoverError as e:
        if not (isinstance(e, DriveFault) or e.kind == "not armed" or report.ticks):
            raise
        notify(f"rover: {e}")
        code = {"not armed": 0, "taken over": 4}.get(e.kind, 3)
    except Exception:  # whatever ended a drive, the summary of what was driven is still written
        if not report.ticks:
            raise
        traceback.print_exc()  # a defect of this program, which has stopped the car too
        code = 3
    if json_file and json_file != Path("-"):
        json_file.write_text(json.dumps(report.summary(), indent=2) + "\n")
    elif json_file:
        show(report.summary(), True)
    else:
        show(in_words(report.summary()), False)
    return code


@main.command("record", short_help="Record a human who drives.")
@click.argument("out_dir", type=FILE)
@CAMERA
@PORT
@click.option("--hz", type=Number(5, 50), default=30.0, show_default=True, help="Controls and frames a second.")
@click.option("--max-seconds", type=POSITIVE, help="Longest duration of an episode.")
@click.option("--label", default="", help='What the episodes show, such as "hit red balloon".')
@click.option("--episodes", type=FROM_1, default=1, show_default=True, help="How many, one after another.")
@click.option("--finish", is_flag=True, help="Only make episodes of what killed recordings have left in OUT_DIR.")
@click.pass_context
def record_human(ctx: click.Context, out_dir: Path, hz: float, finish: bool, **options: Any) -> None:
    """Record a human who drives with the transmitter: episode folders in OUT_DIR, to train and calibrate with.

    Ctrl-C, SIGTERM, SIGHUP and SIGQUIT end an episode, and it is kept. Exit code 1 if a fault ended it; what was
    recorded until then is kept too.
    """
    from rover_lib.onboard.recording.episode import find_killed, finish_killed
    from rover_lib.onboard.recording.recorder import record_episodes

    if finish:
        if not out_dir.is_dir():
            raise RoverError(f"{out_dir}: no such folder", remedy="name the one that was recorded to")
        failed = False
        for part in (parts := find_killed(out_dir)):
            try:
                click.echo(f"finished: {finish_killed(part) or 'nothing recorded'}")
            except RoverError as error:  # the others are finished all the same
                failed = True
                notify(f"rover: {error}")
        if not parts:
            click.echo(f"{out_dir}: nothing to finish")
        ctx.exit(int(failed))
    options |= {"rate_hz": hz, "notify": notify}
    for report in record_episodes(folder=out_dir, **options):
        click.echo(str(report))
    if report.fault:
        ctx.exit(1)


@main.command(short_help="Check all that driving needs; say what to do.")
@click.argument("artifact", type=ARTIFACT, required=False)
@CAMERA
@PORT
@click.option("--hz", type=Number(1, 120), default=30.0, show_default=True, help="Required frames per second.")
@click.option("--receiver", is_flag=True, help="Only test the receiver, with a human at the transmitter.")
@click.pass_context
def doctor(ctx: click.Context, port: str, hz: float, receiver: bool, **asked: Any) -> None:
    """Check all that driving needs (camera, Arduino, ARTIFACT, power, disk), and say what to do.

    Nothing is armed. Exit code 1 if anything that driving needs fails; warnings do not count. With --receiver it asks
    you to steer and to switch the transmitter off: do that once.
    """
    from rover_lib.onboard.car.host import default_log
    from rover_lib.onboard.care import doctor

    if receiver:
        found = doctor.receiver(port, ask)
    else:
        found = doctor.examine(port=port, rate_hz=hz, log_folder=default_log().parent, **asked)
    failed = []
    for check in found:
        click.echo(str(check))
        if check.verdict == "fail":
            failed.append(check.name)
    if failed:
        notify(f"rover: this car would not drive: {', '.join(failed)}")
        ctx.exit(1)


@main.command(short_help="Measure another car's transmitter; write its car.yml.")
@PORT
@click.option("--output", type=FILE, help="The file [default: where the other commands look for car.yml].")
@click.option("--name", default="my car", show_default=True, help="What to call the car.")
@click.option("--field-of-view-deg", type=Number(20, 160), help="The camera's, across [default: the balloon world's].")
@click.option("--wheelbase-m", type=Number(0.03, 3), help="Between the axles [default: the balloon world's].")
@click.option("--force", is_flag=True, help="Replace an existing file.")
def calibrate(port: str, output: Path | None, field_of_view_deg: float | None, force: bool, **more: Any) -> None:
    """Guide a human through steering and throttle, measure the pulses, and write them as car.yml.

    Take the wheels off the ground and unplug the motor first. Ctrl-C leaves everything as it was.
    """
    from rover_lib.onboard.car.calibrate import measure
    from rover_lib.onboard.car.car import Car, default_place, read_car, yaml_of
    from rover_lib.onboard.car.servo_link import LinkError, ServoLink
    from rover_lib.onboard.errors import CarError
    from rover_lib.onboard.stage import atomic_path

    path = output or default_place()
    if path.exists() and not force:
        raise CarError(f"{path}: exists already", remedy="--force replaces it")
    check_output(path, None)
    more = {key: value for key, value in more.items() if value is not None}
    with contextlib.suppress(CarError):  # measured again, its actions must mean what they meant
        more["positive"] = read_car(path).positive
    if field_of_view_deg is not None:
        more["camera"] = {"field_of_view_deg": field_of_view_deg}
    with ServoLink(port, car=Car()) as link:
        car = measure(link, ask, notify=notify, **more)
        # The Arduino has the last one that was tried. If it refuses this one, the next command tells it again.
        with contextlib.suppress(LinkError):
            link.tell(car)
    click.echo(yaml_of(car), nl=False)  # before writing: if that fails, it can be copied from here
    with atomic_path(path) as temporary:
        temporary.write_text(yaml_of(car))
    notify(f"rover: written to {path}")


@main.command(short_help="Say what an artifact is.")
@click.argument("file", type=FILE)
@AS_JSON
def inspect(file: Path, as_json: bool) -> None:
    """Say what the artifact FILE is."""
    show(describe_artifact(file), as_json)


def describe_artifact(file: Path) -> dict[str, Any]:
    """Return what `rover inspect` says of an intact artifact. Raises ArtifactError for any other file."""
    from rover_lib.onboard.artifact.manifest import Artifact

    with Artifact(file) as artifact:
        artifact.prove()
        return {"artifact": {"content_hash": artifact.content_hash, **artifact.manifest}}


@main.command(short_help="Time artifacts on this machine.")
@click.argument("artifacts", type=ARTIFACT, nargs=-1, required=True)
@click.option("--warmup", type=FROM_0, default=10, show_default=True)
@click.option("--iterations", type=FROM_1, default=100, show_default=True)
@click.option("--minutes", type=POSITIVE, help="Instead of --iterations; heat and clock are kept for each 10 s.")
@click.option("--threads", type=click.IntRange(0, MOST_THREADS), default=0, show_default=True, help="0: all cores.")
@click.option("--output", type=Output("benchmark"), help="Write the benchmark to this JSON file, for notebook 05.")
@AS_JSON
def benchmark(artifacts: tuple[Path, ...], threads: int, output: Path | None, as_json: bool, **options: Any) -> None:
    """Time ARTIFACTS on this machine, interleaved, on the frames of their own parity vectors."""
    from rover_lib.onboard.artifact.manifest import content_hash
    from rover_lib.onboard.car.host import usable_cores
    from rover_lib.onboard.care.benchmark import benchmark_artifacts, describe_clock
    from rover_lib.onboard.stage import write_stage

    stems = [path.stem for path in artifacts]
    files = {path.stem if stems.count(path.stem) == 1 else str(path): path for path in artifacts}
    contents = {name.removesuffix(path.suffix) + path.suffix: content_hash(path) for name, path in files.items()}
    metrics = benchmark_artifacts(files, threads or usable_cores(), options)
    if output:
        write_stage(output, "benchmark", params={"threads": threads, **options}, metrics=metrics, inputs=contents)
    if as_json:
        return show(metrics, as_json)
    click.echo("\n".join(align(benchmark_rows(metrics))))
    machine = {key: metrics[key] for key in ("threads", "cores", "temperature_c", "clock_mhz", "throttled")}
    show({k: v for k, v in machine.items() if v is not None}, False)
    if metrics["over_time"]:
        click.echo(describe_clock(metrics["over_time"]))


@main.command("arm-car", short_help="Arm the car; its service then drives at once.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@click.option("--model", default="", help="Content hash of the loaded model, without which the car is not armed.")
@click.option("--max-seconds", type=POSITIVE, help="Longest duration of the drive [default: the service's].")
@click.option("--heartbeat-s", type=POSITIVE, help="End the drive when no --heartbeat comes for this long.")
@click.option("--heartbeat", is_flag=True, help="Only tell the drive that its operator is still there.")
def arm_car(yes: bool, model: str, heartbeat: bool, **limits: Any) -> None:
    """Arm the car, whose service (rover-drive.service) then drives at once. Needs root.

    If it is refused, it says what the Arduino still wants. Moving a stick takes the car back;
    `sudo systemctl restart rover-drive` disarms it.
    """
    from rover_lib.onboard.drive import service

    if heartbeat:
        return click.echo(service.ask_service(ask="heartbeat")["text"])

    def confirm(state: dict[str, Any]) -> None:
        if yes:
            return
        click.echo(f"model {state['model'][:12]}, {state['text']}")
        click.confirm("The car will drive now. Is the way free, and the transmitter in your hand?", abort=True)

    click.echo(service.arm_car(service.Request(**limits), model=model, confirm=confirm))


@main.group(short_help="Manage a rover's models: stage, switch, roll back.")
@click.option("--models", type=FILE, default="/var/lib/rover/models", show_default=True, help="The rover's models.")
@click.option("--chunk", type=FROM_1, default=32, show_default=True, help="Actions in a plan.")
@click.option("--camera", default="cam_front", show_default=True, help="The policy's name for this rover's camera.")
@click.option("--aspect", type=POSITIVE, default=1.78, show_default=True, help="Width of a picture by its height.")
@click.option("--sandboxed", is_flag=True, help="Run parity vectors in the service's sandbox.")
@click.pass_context
def release(ctx: click.Context, models: Path, sandboxed: bool, **expected: Any) -> None:
    """Manage the rover's models, as `rover playbook deploy` does it over a network."""
    from rover_lib.onboard.artifact.acceptance import Expected
    from rover_lib.onboard.care.release import Releases, check_in_sandbox

    ctx.obj = Releases(models, check=check_in_sandbox if sandboxed else None, expected=Expected(**expected))


@release.command(short_help="Make a release of an artifact without using it.")
@click.argument("source", type=ARTIFACT)
@click.option("--sha256", help="The SHA-256 that the artifact must have.")
@click.option("--origin", help="Where it came from, for `status` [default: this host and path].")
@click.option("--allow", multiple=True, type=ALLOWED, help="Accept an artifact that differs in this.")
@click.pass_obj
def stage(releases: Any, source: Path, **options: Any) -> None:
    """Make a release of the artifact SOURCE. The release in use stays in use."""
    show(vars(releases.stage(source, **options)), True)


@release.command(short_help="Verify that a release computes what it should.")
@click.argument("name", default="current")
@click.pass_obj
def verify(releases: Any, name: str) -> None:
    """Verify that a release is complete and computes here what it should, by checksums and parity vectors."""
    releases.check(name)
    click.echo(f"{name}: verified")


@release.command(short_help="Use a release from now on.")
@click.argument("name")
@click.pass_obj
def switch(releases: Any, name: str) -> None:
    """Use the release NAME from now on. It is verified before and after; if that fails, the old one is used again."""
    show({"name": name, "changed": releases.switch(name)}, True)


@release.command(short_help="Go back to the release before the one in use.")
@click.pass_obj
def rollback(releases: Any) -> None:
    """Go back to the newest earlier release that can be verified."""
    show({"name": releases.rollback(), "changed": True}, True)


@release.command(short_help="Remove all but the latest releases.")
@click.option("--keep", type=FROM_1, default=3, show_default=True)
@click.pass_obj
def prune(releases: Any, keep: int) -> None:
    """Remove all releases but those used last; never the one in use."""
    removed = releases.prune(keep)
    show({"removed": removed, "changed": bool(removed)}, True)


@release.command(short_help="Show the release in use, and whether it is intact.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with the machine's and the service's state.")
@click.pass_obj
def status(releases: Any, as_json: bool) -> None:
    """Show the release in use, whether it is intact, and the others. Exit code 1 if the one in use is damaged."""
    report = releases.status()
    if as_json:
        import socket

        from rover_lib.onboard.car.host import Host, default_log
        from rover_lib.onboard.drive.service import state_of

        try:
            report["service"] = state_of()
        except RoverError as e:
            report["service"] = {"installed": False, "active": "unknown", "state": "", "text": str(e)}
        log = next((p for p in (Path("/var/lib/rover-drive/flight.log"), default_log()) if p.exists()), None)
        report |= {"rover": socket.gethostname(), **Host().reading(), "last_drive_s": log and log.stat().st_mtime}
        return show(report, True)
    for r in report["releases"]:
        mark = "*" if r["current"] else " "
        click.echo(f"{mark} {r['name'][:12]}  {r['mode']:<7} {r['megabytes']:6.1f} MB  {r['wrong'] or r['origin']}")
    if not report["healthy"]:
        raise RoverError(report["trouble"])


view_options = with_options(  # on the rover and on a workstation
    click.option("--web-port", type=click.IntRange(0, 65535), default=8470, show_default=True, help="0: any free one."),
    click.option("--interface", default="", help="A network that may open it too, such as wlan0 [default: none]."),
    click.option("--token-file", type=FILE, help="File with the token of the URL [default: a new token, printed]."),
    click.option("--feed", type=FILE, help="Socket to which drives connect [default: that of your `rover drive`]."),
    click.option("--drive-user", help="Another user whose drives are shown, besides yours."),
)


@main.command(short_help="Show a drive in the browser, with a stop button.")
@view_options
def view(**options: Any) -> None:
    """Show the drive of this machine in a browser: its picture, its plan, what the pins do. A drive may come and go.

    Whoever has the page's URL can stop the car, and nothing else; without --interface, only from this machine.
    """
    open_view(**options)


def open_view(
    web_port: int,
    interface: str,
    token_file: Path | None,
    feed: Path | None,
    drive_user: str | None,
    opened: Callable[[str], object] = lambda url: None,
    shown: Any = None,
) -> None:
    """Serve the view until SIGINT or SIGTERM. opened: called with its URL. shown: a Simulation to show, not drives."""
    import asyncio
    import secrets

    from rover_lib.onboard.car.host import default_view
    from rover_lib.onboard.view.server import Address, View, read_token

    token = read_token(token_file) if token_file else secrets.token_urlsafe(16)
    place = None
    of_simulation = {}
    if not shown:
        place = feed or default_view()
    else:
        of_simulation = {"car": shown.car, "ask": shown.ask, "script": shown.script}
    view = View(Address(web_port, interface), token, place, drive_user=drive_user, **of_simulation)

    def tell(url: str) -> None:
        # The journal may have other readers than the token's file.
        click.echo(url.replace(token, "...") if token_file else url)
        sys.stdout.flush()
        if not token_file:  # which a service has
            notify("open this address in a browser; Ctrl-C ends")
        opened(url)

    asyncio.run(view.run(tell, shown and shown.show))


@main.command(short_help="Summarize a flight log.")
@click.argument("file", type=PathTo("flight log"))
@LOG_DRIVE
@AS_JSON
def log(file: Path, drive: int, as_json: bool) -> None:
    """Summarize the flight log FILE of `rover drive`, with its older parts (FILE.1, ...)."""
    sum_up(file, drive, as_json)


def sum_up(file: Path, drive: int, as_json: bool) -> Any:
    """Print what a flight log says of one of its drives, and return that drive, a telemetry.Flight."""
    from rover_lib.onboard.drive.flight_log import read_log

    flight = read_log(file, drive)
    summary = flight.summary()
    if as_json:
        show(summary, as_json)
        return flight
    show(in_words({k: v for k, v in summary.items() if k != "events"}), as_json)
    for event in flight.events:
        click.echo(f"{event.t_s:9.2f} s  {event.text}")
    return flight


if __name__ == "__main__":
    main()
