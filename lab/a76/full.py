"""A full-size policy to count, with no checkpoint at hand: real in format, size and ranges, but it cannot drive.

full_run("runs/full")      # some ten minutes; `python -m lab arm runs/full` then counts it
"""

from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage, sha256_of, write_stage
from rover_lib.workshop.act import ACT, multiply_accumulates, parameters_by_block
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.compare import thinned
from rover_lib.workshop.episodes import Sample, choose_calibration
from rover_lib.workshop.quantize import Calibration, Scheme, calibrate, export, quantize
from rover_lib.workshop.session import Opened, load
from rover_lib.world.record import record_episodes
from rover_lib.world.train import make_checkpoint

NOTE = "trained for a few steps only, so that activations have real ranges: this policy does not drive"
STEPS = 24
DRIVES = 16  # two of them choose, two judge: far more than the 50 frames that judge a count
SAMPLES = 64  # calibrate
CURVE_SAMPLES = 8  # calibrate what is only counted: the count does not depend on the ranges
VECTORS = 8  # frames on which an export is checked against its policy
SIZES = ((180, 320),)  # judged, beside the size of training
CURVE = ((320, 576), (288, 512), (240, 432))  # counted only

Progress = Callable[..., Iterable] | None


def full_run(
    run_dir: Path | str,
    *,
    size: str = "full",
    steps: int = STEPS,
    drives: int = DRIVES,
    samples: int = SAMPLES,
    sizes: tuple[tuple[int, int], ...] = SIZES,
    curve: tuple[tuple[int, int], ...] = CURVE,
    progress: Progress = None,
) -> Path:
    """Record drives, train a policy a few steps, and quantize it at several image sizes. Returns run_dir.

    size: 'full' (the user's policy, 360x640), or 'small' to try this out. samples: so many frames calibrate.
    sizes, curve: further image sizes (height, width) in pixels, of the same weights. progress: called like
    tqdm.tqdm(iterable, desc=, total=), or None.

    Leaves what the notebooks leave, as far as counting needs it: episodes, best_model.pth, load.json,
    calibrate.json, calibration.pt, policy_fp32.pt, policy_static.pt and, when all is there, quantize.json; for each of
    `sizes` calibration_<height>x<width>.pt, policy_fp32_<height>x<width>.pt and policy_static_<height>x<width>.pt; for
    each of `curve` only the last. load.json says that this policy does not drive. Recordings and checkpoint come from
    the cache if they were made before. Raises WorldError if run_dir holds another kind of run, and what the steps
    raise.
    """
    run_dir = Path(run_dir).resolve()
    if (run_dir / "load.json").exists() and read_stage(run_dir / "load.json", "load")["metrics"].get("note") != NOTE:
        raise WorldError(f"{run_dir}: holds a run on another checkpoint; name another folder, or move it away first")
    (run_dir / "quantize.json").unlink(missing_ok=True)
    episodes = record_episodes(run_dir / "episodes", drives, progress=progress)
    checkpoint = make_checkpoint(run_dir / "best_model.pth", size, episodes, steps=steps, progress=progress)
    loaded = load(checkpoint, episodes)
    _write_load(run_dir, loaded, episodes)
    seed = params()["calibration"]["seed"]
    chosen, _ = choose_calibration(loaded.parts.calibration, samples, seed)
    few, _ = choose_calibration(loaded.parts.calibration, min(samples, CURVE_SAMPLES), seed)
    vectors = thinned(loaded.parts.choosing, VECTORS)
    ck = loaded.checkpoint
    modes: dict[str, Any] = {}
    for at in curve:
        modes |= _quantized(run_dir, ck.at_size(*at), few, vectors, suffix_of(at), fp32=False, progress=progress)
    for at in sizes:
        modes |= _quantized(run_dir, ck.at_size(*at), chosen, vectors, suffix_of(at), progress=progress)
    modes |= _quantized(run_dir, ck, chosen, vectors, "", progress=progress)
    given = params()["quantization"]
    inputs = {"calibration.pt": sha256_of(run_dir / "calibration.pt"), "checkpoint": ck.sha256}
    write_stage(run_dir / "quantize.json", "quantize", params=given, metrics={"modes": modes}, inputs=inputs)
    return run_dir


def suffix_of(size: tuple[int, int]) -> str:
    """What the files of another image size end in, say _180x320 for (180, 320): height first."""
    return f"_{size[0]}x{size[1]}"


def _write_load(run_dir: Path, loaded: Opened, episodes: Path) -> None:
    """load.json, as notebook 01 writes it."""
    ck = loaded.checkpoint
    model = ACT(ck.config, ck.weights)
    work = {"macs_by_block": multiply_accumulates(model), "parameters_by_block": parameters_by_block(model)}
    metrics = {
        "note": NOTE,
        "checkpoint": ck.report | {"sha256": ck.sha256} | work,
        "recordings": loaded.recordings.summary(),
        "split": loaded.parts.episodes,
    }
    given = {"checkpoint": ck.path, "episodes": episodes}
    inputs = {ck.path.name: ck.sha256} | loaded.recordings.hashes()
    write_stage(run_dir / "load.json", "load", params=given, metrics=metrics, inputs=inputs)


def _quantized(
    run_dir: Path,
    ck: Checkpoint,
    chosen: tuple[Sample, ...],
    vectors: tuple[Sample, ...],
    suffix: str,
    *,
    fp32: bool = True,
    progress: Progress = None,
) -> dict[str, dict[str, Any]]:
    """Calibrate one size and write its artifacts; what quantize.json says of them."""
    p, found = params(), {}
    smooth, v = p["quantization"]["smooth"], p["parity"]
    calibration = calibrate(ck, chosen, smooth=smooth, progress=progress)
    options = {"samples": vectors, "tolerance": v["fp32"], "int8_errors": v["int8_errors"], "vectors": v["vectors"]}
    if fp32:
        calibration.save(run_dir / f"calibration{suffix}.pt")
        if not suffix:
            _write_calibrate(run_dir, ck, calibration, chosen)
        path = run_dir / f"policy_fp32{suffix}.pt"
        found[f"fp32{suffix}"] = {"content_hash": export(ACT(ck.config, ck.weights), ck, path, **options)}
    scheme = Scheme("static", kind=p["quantization"]["scheme"], smooth=smooth)
    policy = quantize(ck, scheme, calibration)
    digest = export(policy, ck, run_dir / f"policy_static{suffix}.pt", calibration=calibration, **options)
    found[f"static{suffix}"] = policy.report | {"scheme": asdict(scheme), "content_hash": digest}
    return found


def _write_calibrate(run_dir: Path, ck: Checkpoint, calibration: Calibration, chosen: tuple[Sample, ...]) -> None:
    """calibrate.json, as notebook 02 writes it: which frames calibrated."""
    metrics = {
        "samples": calibration.samples,
        "seconds_s": calibration.seconds,
        "ranges": calibration.ranges,
        "episodes": sorted({s.episode for s in chosen}),
    }
    inputs = {f"{s.episode}/{s.frame_path.name}": sha256_of(s.frame_path) for s in chosen} | {"checkpoint": ck.sha256}
    given = {"samples": len(chosen), "seed": params()["calibration"]["seed"], "smooth": calibration.smooth}
    write_stage(run_dir / "calibrate.json", "calibrate", params=given, metrics=metrics, inputs=inputs)
