"""Write a kit's calibration set, and the observations for the compiler's emulator, as arrays with channels last."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.lib.format import open_memmap

from rover_hailo.int8_estimate import session_of
from rover_hailo.networks import Splits
from rover_lib.workshop.act import inputs_of
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.recordings.episodes import Sample


def write_calibration(splits: Splits, samples: Sequence[Sample], folder: Path, progress: Progress) -> None:
    """Write calibration_<input>.npy: frames, normalised states, and `backbone`'s features, (n, ...) each."""
    session = session_of(splits.front.model)
    arrays: dict[str, np.memmap] = {}
    for i, sample in enumerate(progress(samples, desc="calibration set")):
        state, *frames = inputs_of(sample, splits.config)
        values = {"state": splits.normalised_state(state)}
        values |= {f"frame_{c}": f.numpy() for c, f in zip(splits.config.cameras, frames, strict=True)}
        values |= splits.features(session.run(None, splits.pictures(frames)))
        for name, value in values.items():
            if name not in arrays:
                shape = (len(samples), *value.shape)
                path = folder / f"calibration_{name}.npy"
                arrays[name] = open_memmap(path, mode="w+", dtype=value.dtype, shape=shape)
            arrays[name][i] = value
    for array in arrays.values():
        array.flush()


def write_expected(splits: Splits, judged: Exporter, folder: Path) -> None:
    """Write expected_<network>.npz: the parity vectors' observations and a network's FP32 answers, (n, ...) each."""
    inputs = [judged.inputs[i] for i in judged.stored]
    frames = {
        f"frame_{camera}": np.stack([x[1 + c].numpy() for x in inputs])
        for c, camera in enumerate(splits.config.cameras)
    }
    session = session_of(splits.front.model)
    seen = [splits.features(session.run(None, splits.pictures(f))) for _, *f in inputs]
    save_arrays(folder / "expected_backbone.npz", frames | {n: np.stack([x[n] for x in seen]) for n in seen[0]})
    session = session_of(splits.whole.model)
    actions = np.concatenate([session.run(None, splits.whole_inputs(s, f))[0] for s, *f in inputs])
    states = np.stack([splits.normalised_state(s) for s, *_ in inputs])
    save_arrays(folder / "expected_whole.npz", {"state": states, **frames, "actions": actions})


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez_compressed(path, allow_pickle=False, **arrays)
