"""`rover export --hailo`, which finds it by an entry point of pyproject.toml."""

from pathlib import Path

import click

from rover_lib.workshop.progress import terminal_bar


def export_kit(run_dir: Path, out: Path, samples: int) -> None:
    """Write the kit of a run, and say how far off INT8 is in another engine. Raises RoverError as write_kit does."""
    from rover_hailo.kit import write_kit
    from rover_lib.workshop.run.session import open_run

    report = write_kit(open_run(run_dir, terminal_bar()), out, samples=samples, progress=terminal_bar())
    for name, network in report["networks"].items():
        errors = ", ".join(f"{action} {error:.3g}" for action, error in network["stand_in_actions"].items())
        click.echo(f"{name}: {network['gmac']:.2f} GMAC; in ONNX Runtime's INT8, actions differ by at most {errors}")
    click.echo(f"{out}: KIT.md says what is in it; next, where Hailo's compiler is: sh compile_hailo8.sh backbone")
