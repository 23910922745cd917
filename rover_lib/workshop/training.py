"""What training a policy on recordings shares, whoever trains: frames, batches, the loss, and going on after a kill.

    with Resumable(folder) as saved:
        for _ in saved.steps("backbone", 200, rng, model=model, optimizer=optimizer, scheduler=scheduler):
            saved.losses["backbone"].append(descend(loss_of(model), model, optimizer, scheduler))

Ended at any moment and started again, this gives the same weights to the last bit as if it had never been ended.
"""

import fcntl
import math
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.preprocess import normalise, prepare_frame
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.episodes import Sample
from rover_lib.workshop.progress import Progress, silent

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

IMAGE, STATE, ACTION, IS_PAD = "observation.images.cam_front", "observation.state", "action", "action_is_pad"
DROPOUT = 0.1  # LeRobot's default
KL_WEIGHT = 10.0
WEIGHT_DECAY = 1e-4
BETAS = (0.9, 0.999)
GRAD_CLIP = 1.0
SWAPPED_STATES = 0.5  # the share of samples that get another's state, so that it does not give the action away
STANDING_THROTTLE = 0.01  # below it the car stands, which no frame shows: these states are never swapped
SAVE_EVERY_S = 60.0
SAVING_SHARE = 0.05  # of the time at most goes into saving, however slow the disk


class Pictures:
    """Samples' frames at one size, read from their files when asked for: memory does not grow with recordings."""

    def __init__(self, samples: tuple[Sample, ...], height: int, width: int):
        self.samples, self.height, self.width = samples, height, width

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, rows: np.ndarray | slice) -> np.ndarray:
        """(n, height, width, 3) uint8 RGB. Raises EpisodeError for a picture that is gone or damaged."""
        chosen = np.arange(len(self.samples))[rows]
        return np.stack([prepare_frame(self.samples[i].frame_bgr(), self.height, self.width) for i in chosen])


@dataclass
class Frames:
    """Samples aligned by row.

    images: (n, height, width, 3) uint8 RGB, in memory or read when asked for. states: (n, 2) and chunks:
    (n, chunk, 2) float32. is_pad: (n, chunk) bool, true where the drive had ended.
    """

    images: np.ndarray | Pictures
    states: np.ndarray
    chunks: np.ndarray
    is_pad: np.ndarray

    def __len__(self) -> int:
        return len(self.images)


def frames_of(samples: tuple[Sample, ...], height: int, width: int) -> Frames:
    """Samples with their frames at that size, read from disk whenever they are asked for."""
    return Frames(
        Pictures(samples, height, width),
        np.stack([s.state for s in samples]).astype(np.float32),
        np.stack([s.chunk for s in samples]).astype(np.float32),
        np.stack([s.is_pad for s in samples]),
    )


def in_memory(frames: Frames, desc: str, progress: Progress = silent) -> Frames:
    """The same with all images read: for small ones, of which a step takes less time than reading them."""
    rows = progress(range(len(frames)), desc=desc, total=len(frames))
    images = np.concatenate([frames.images[row : row + 1] for row in rows])
    return Frames(images, frames.states, frames.chunks, frames.is_pad)


class RowFile:
    """Arrays of one shape on disk, appended and read by row: features and tokens that would not fit into memory.

    A part of a training's state, as a module is: it has the rows that were saved with it, and those appended since.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: type = np.float32):
        self.path, self.shape, self.dtype = path, shape, np.dtype(dtype)
        self.row_bytes = math.prod(shape) * self.dtype.itemsize
        self._rows = 0  # whatever a process that was killed may have left in the file
        self._file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+b", buffering=0)

    def __len__(self) -> int:
        return self._rows

    def append(self, rows: np.ndarray | Tensor) -> None:
        """rows: (n, *shape)."""
        array = np.ascontiguousarray(rows, self.dtype)
        if array.shape[1:] != self.shape:
            raise TrainingError(f"{self.path.name}: its rows are of another shape", found=array.shape[1:])
        self._file.seek(self._rows * self.row_bytes)
        data = array.data.cast("B")
        while data:
            data = data[self._file.write(data) :]
        self._rows += len(array)

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        """(n, *shape) of these rows. Read, not mapped: mapped pages would count as this process's memory."""
        chosen = np.empty((len(rows), *self.shape), self.dtype)
        for i, row in enumerate(rows):
            data = os.pread(self._file.fileno(), self.row_bytes, int(row) * self.row_bytes)
            chosen[i] = np.frombuffer(data, self.dtype).reshape(self.shape)
        return chosen

    def state_dict(self) -> dict[str, Any]:
        os.fsync(self._file.fileno())
        return {"rows": len(self)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        there = self.path.stat().st_size // self.row_bytes
        if there < state["rows"]:
            found = f"{there} of {state['rows']}"
            raise TrainingError(f"{self.path}: rows are missing", found=found, remedy="remove its folder")
        self._rows = state["rows"]


class Stateful(Protocol):
    """What a training consists of: modules, optimisers, schedulers, files of rows."""

    def state_dict(self) -> Any: ...

    def load_state_dict(self, state: Any) -> Any: ...


class Resumable:
    """A training in phases that goes on where it was, after Ctrl-C, kill -9 or a power cut at any moment.

    folder: holds a file per phase; remove it when the training's result is safe. Only one process at a time may train
    in it. work: what all steps cost together, in the unit of `steps`' cost, for one bar over all phases, to be set
    before the first; without it each phase has its own. every_s: between two saves, more where saving is slow.
    losses: what the steps put there, by phase; saved with them.
    """

    def __init__(
        self,
        folder: Path,
        progress: Progress = silent,
        work: int = 0,
        every_s: float = SAVE_EVERY_S,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.folder, self.every_s, self.clock = folder, every_s, clock
        self.losses: dict[str, list[float]] = defaultdict(list)
        self.progress, self.work = progress, work
        self._behind = 0  # work that was done by the process before this one
        self._bar: Any = None
        self._ticks: Iterator[None] = iter(())

    def __enter__(self) -> "Resumable":
        """Raises TrainingError if another process trains in this folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = (self.folder / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            raise TrainingError(
                "another process trains the same", found=f"its lock on {self.folder}", remedy="wait for it or stop it"
            ) from None
        for left in self.folder.glob(".*.pt"):  # half of a file, by a process that was killed while it saved
            left.unlink()
        return self

    def __exit__(self, *_: object) -> None:
        if hasattr(self._bar, "close"):
            self._bar.close()
        self._lock.close()

    def steps(
        self, phase: str, count: int, rng: np.random.Generator, cost: int = 1, **parts: Stateful
    ) -> Iterator[int]:
        """The numbers of the steps of a phase that are still to be made; the loop's body makes one.

        parts: all that a step changes, put back as it was saved. rng and torch's own random numbers are too: after a
        phase they are what they were at its end, whichever process made it. cost: of one step.
        """
        file = self.folder / f"{phase}.pt"
        done = self._restore(file, phase, rng, parts) if file.exists() else 0
        if not self.work:
            self._bar = None
            self._behind = 0
        self._behind += done * cost
        saved_s, took_s = self.clock(), 0.0
        for step in range(done, count):
            yield step
            self._advance(phase, cost, self.work or count * cost)
            now_s = self.clock()
            if step + 1 == count or now_s - saved_s >= max(self.every_s, took_s / SAVING_SHARE):
                self._save(file, phase, step + 1, rng, parts)
                saved_s = self.clock()
                took_s = saved_s - now_s

    def _advance(self, phase: str, cost: int, total: int) -> None:
        desc = f"training, {phase}"
        if self._bar is None:  # only now it is known how much had been done before
            left = max(0, total - self._behind)
            self._bar = self.progress(repeat(None, left), desc=desc, total=total, initial=self._behind)
            self._ticks = iter(self._bar)
        elif hasattr(self._bar, "set_description"):
            self._bar.set_description(desc, refresh=False)
        for _ in range(cost):
            next(self._ticks, None)

    def _save(self, file: Path, phase: str, step: int, rng: np.random.Generator, parts: dict[str, Stateful]) -> None:
        content = {
            "step": step,
            "parts": {name: part.state_dict() for name, part in parts.items()},
            "numpy": rng.bit_generator.state,
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
            "losses": self.losses[phase],
        }
        with atomic_path(file) as temporary:
            torch.save(content, temporary)

    def _restore(self, file: Path, phase: str, rng: np.random.Generator, parts: dict[str, Stateful]) -> int:
        try:
            content = torch.load(file, map_location="cpu", weights_only=True)
            for name, part in parts.items():
                part.load_state_dict(content["parts"][name])
        except TrainingError:
            raise
        except Exception as error:  # whatever a damaged file makes torch say
            raise TrainingError(
                f"{file}: cannot go on from it", found=error, remedy=f"remove {file.parent} to train from the beginning"
            ) from error
        rng.bit_generator.state = content["numpy"]
        torch.set_rng_state(content["torch"])
        if content["cuda"]:
            torch.cuda.set_rng_state_all(content["cuda"])
        self.losses[phase] = content["losses"]
        return content["step"]


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """torch's random numbers follow from the seed inside, and are as before outside."""
    devices = list(range(torch.cuda.device_count()))
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        yield


@contextmanager
def threads(count: int) -> Iterator[None]:
    """torch computes with that many inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def batch_of(data: Frames, rows: np.ndarray, rng: np.random.Generator, device: torch.device) -> dict[str, Tensor]:
    """What a policy trains on: light changed, half of the drives mirrored, half of the states swapped."""
    flipped = rng.random(len(rows)) < 0.5
    images, states, chunks = data.images[rows], swapped_states(data, rows, rng), data.chunks[rows].copy()
    images[flipped] = images[flipped, :, ::-1]
    states[flipped, 0] *= -1
    chunks[flipped, :, 0] *= -1
    gain = rng.uniform(0.8, 1.25, (len(rows), 1, 1, 1)).astype(np.float32)
    return {
        IMAGE: torch.from_numpy(normalise(np.minimum(images * gain, 255))).to(device),
        STATE: torch.from_numpy(states).to(device),
        ACTION: torch.from_numpy(chunks).to(device),
        IS_PAD: torch.from_numpy(data.is_pad[rows]).to(device),
    }


def swapped_states(data: Frames, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, 2) float32: these rows' states, half of those in motion replaced by another frame's."""
    states = data.states[rows].copy()
    moving = np.flatnonzero(data.states[:, 1] >= STANDING_THROTTLE)
    if len(moving):
        swap = (rng.random(len(rows)) < SWAPPED_STATES) & (states[:, 1] >= STANDING_THROTTLE)
        states[swap] = data.states[rng.choice(moving, swap.sum())]
    return states


def recorded_spread(data: Frames) -> np.ndarray:
    """(2,) float32, each action's standard deviation: errors count in it, for throttle's is a tenth of steering's."""
    return np.maximum(data.chunks[~data.is_pad].std(axis=0), 1e-3)


def error_of(predicted: Tensor, batch: dict[str, Tensor], loss_weights: Tensor) -> Tensor:
    """Mean absolute error of the actions that were recorded, each in its own unit.

    predicted: (n, chunk, 2). loss_weights: (2,), one over each action's spread.
    """
    recorded = ~batch[IS_PAD][..., None]
    error = (predicted - batch[ACTION]).abs() * loss_weights * recorded
    return error.sum() / (recorded.sum() * loss_weights.numel())


def policy_loss(policy: "ACTPolicy", batch: dict[str, Tensor], loss_weights: Tensor) -> Tensor:
    """ACT's loss, as LeRobot's forward has it, with each action in its own unit."""
    actions, (mean, log_variance) = policy.model({**batch, "observation.images": [batch[IMAGE]]})
    divergence = -0.5 * (1 + log_variance - mean.pow(2) - log_variance.exp()).sum(-1).mean()
    return error_of(actions, batch, loss_weights) + KL_WEIGHT * divergence


def optimiser(
    parameters: Iterable[nn.Parameter], rate: float, steps: int, warmup: int = 0
) -> tuple[torch.optim.AdamW, torch.optim.lr_scheduler.LRScheduler]:
    """AdamW whose rate warms up over `warmup` steps, a twentieth of all for 0, and falls to 1/100 along a cosine."""
    optimizer = torch.optim.AdamW(parameters, lr=rate, betas=BETAS, weight_decay=WEIGHT_DECAY)
    warmup = warmup or max(1, steps // 20)

    def share(step: int) -> float:
        return min(1.0, (step + 1) / warmup) * (0.01 + 0.99 * (1 + math.cos(math.pi * min(1, step / steps))) / 2)

    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, share)
    return optimizer, scheduler


def descend(loss: Tensor, module: nn.Module, optimizer: torch.optim.Optimizer, scheduler: Any) -> float:
    """One step down. Returns the loss before it. Raises TrainingError if that is not finite."""
    value = loss.item()
    if not math.isfinite(value):
        raise TrainingError("training went wrong: the loss is not finite", found=value, remedy="try another seed")
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(module.parameters(), GRAD_CLIP)
    optimizer.step()
    scheduler.step()
    return value


class Given(nn.Module):
    """Stands in for the backbone while the transformer trains: its 'image' is the feature map already."""

    def forward(self, features: Tensor) -> dict[str, Tensor]:
        return {"feature_map": features}


def driving_error(policy: "ACTPolicy", data: Frames, rows: np.ndarray) -> float:
    """Mean absolute error, in action units, of what the policy would drive on these rows (no latent sampled)."""
    policy.eval()
    device = next(policy.parameters()).device
    chunks = policy.predict_action_chunk(
        {
            IMAGE: torch.from_numpy(normalise(data.images[rows])).to(device),
            STATE: torch.from_numpy(data.states[rows]).to(device),
        }
    )
    return float(np.abs(chunks.cpu().numpy() - data.chunks[rows])[~data.is_pad[rows]].mean())


def trainer_config(size: ActConfig, **known: Any) -> dict[str, Any]:
    """The config of the user's trainer, a plain dict, key for key.

    known: learning_rate, batch_size, data_dir, output_dir, device and seed. Folders by name only: a checkpoint is
    shown to others.
    """
    ((height, width),) = size.image_sizes
    return {
        "image_width": width,
        "image_height": height,
        "n_obs_steps": 1,
        "chunk_size": size.chunk,
        "n_action_steps": size.chunk,
        "hidden_size": size.dim,
        "n_encoder_layers": size.encoder_layers,
        "n_decoder_layers": size.decoder_layers,
        "n_heads": size.heads,
        "feedforward_dim": size.feedforward,
        "dropout": DROPOUT,
        "kl_weight": KL_WEIGHT,
        "vision_encoder": size.backbone,
        "pretrained_backbone": True,  # as the trainer writes it, whatever the weights came from
        "learning_rate": known["learning_rate"],
        "weight_decay": WEIGHT_DECAY,
        "betas": BETAS,
        "grad_clip": GRAD_CLIP,
        "num_epochs": 1,
        "batch_size": known["batch_size"],
        "train_split": 0.75,
        "data_dir": known["data_dir"],
        "output_dir": known["output_dir"],
        "device": known["device"],
        "seed": known["seed"],
        "log_freq": 1,
        "save_freq": 1,
        "num_workers": 0,
    }


def to_cpu(value: Any) -> Any:
    """A state dict, or anything nested of lists, tuples and dicts, with all its tensors on the processor."""
    if isinstance(value, Tensor):
        return value.cpu()
    if isinstance(value, dict):
        return {k: to_cpu(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(to_cpu(v) for v in value)
    return value
