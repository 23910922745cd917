"""What every training on recordings needs: frames, batches, the loss, and a way to go on after it was killed.

with Resumable(folder, Machine.of("cuda")) as saved:
    saved.train(Phase("backbone", 200, 1e-3), model, rng, batch, loss)

Pictures go to the device as bytes; light and normalisation follow there. A thread draws batches ahead, in their order,
and others read its pictures, so that no number of them changes a weight.
"""

import ctypes
import math
import os
import statistics
import time
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from filelock import Timeout
from torch import Tensor, nn

from rover_learn.augment import Augmentation, vary
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD, prepare_frame
from rover_lib.onboard.stage import private_lock
from rover_lib.workshop.checkpoint.files import save_torch
from rover_lib.workshop.checkpoint.trainer import BETAS, GRAD_CLIP, KL_WEIGHT, WEIGHT_DECAY
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample, stack_chunks
from rover_lib.workshop.run.session import training_device

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

T = TypeVar("T")
M = TypeVar("M", bound=nn.Module)
Batch = dict[str, Tensor]
IMAGE, STATE, ACTION, IS_PAD = "observation.images.cam_front", "observation.state", "action", "action_is_pad"
SOFTENED = "softened"  # of a batch, beside LeRobot's keys: the plans that squared errors count from, (B, C, A)
SWAPPED_STATES = 0.5  # the share of samples that get another's state, so that the state does not give the action away
STANDING_THROTTLE = 0.01  # below it the car stands, which no frame shows, so such a state is never swapped
SAVE_EVERY_S = 60.0
JUDGE_EVERY = 50  # steps
PATIENCE, PATIENT_SHARE = 8, 0.2  # judgements, or this share of all, without a better one: then it learns by heart
SAVING_SHARE = 0.05  # saving takes at most this share of the time, however slow the disk
AHEAD = 3  # batches
WIDE, SMALL_MAP = 512, 24  # channels and places from and to which a convolution is unfolded
# mallopt's M_MMAP_THRESHOLD and M_TRIM_THRESHOLD. Left alone, glibc gives a large tensor's memory back after each use,
# and the kernel clears it for the next: a tenth of the time.
KEPT_MEMORY = {-3: 32 * 2**20, -1: 2**31 - 1}
MEMORY_SHARE = 1 / 8  # of the machine's memory: pictures that need more are read anew each time


@dataclass(frozen=True)
class Machine:
    """What a training computes on. workers: threads that read pictures ahead. amp: mixed precision, in bfloat16."""

    device: torch.device
    workers: int = 0
    amp: bool = False

    @classmethod
    def of(cls, device: str | None = None, workers: int | None = None, amp: bool = False) -> "Machine":
        """Choose a device, and workers for it: a thread for each core if it is a GPU. Raises TrainingError."""
        torch_device = training_device(device, TrainingError)
        if workers is None:
            workers = (os.cpu_count() or 1) if torch_device.type == "cuda" else 0
        return cls(torch_device, workers, amp)

    def seconds(self) -> float:
        """Return the time that a budget counts: of the processor, or, if a GPU computes, as it passes."""
        return time.monotonic() if self.device.type == "cuda" else time.process_time()

    def words(self) -> str:
        if self.device.type == "cuda":
            return f"{self.device}, {torch.cuda.get_device_name(self.device)}"
        return f"{self.device}, {torch.get_num_threads()} threads" + ("" if torch.cuda.is_available() else ", no GPU")

    def taking(self, module: M) -> M:
        """Move a module to the device, channels last, as pictures are, with the layers that compute best there.

        A GPU's pooling becomes a RepeatablePool, and a processor's widest convolutions become UnfoldedConv.
        """
        module.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload] # torch's gap
        for part in module.modules():
            if self.device.type == "cuda" and isinstance(getattr(part, "maxpool", None), nn.MaxPool2d):
                part.maxpool = RepeatablePool()
            if self.device.type == "cpu" and isinstance(part, nn.Conv2d) and part.in_channels >= WIDE:
                part.__class__ = UnfoldedConv
                part.weight.data = part.weight.data.contiguous()
        return module

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Compute as repeatably as a GPU can, and keep memory. Raises TrainingError if a GPU is full or lost."""
        repeatable = torch.are_deterministic_algorithms_enabled()
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):
            for option, value in KEPT_MEMORY.items():
                libc.mallopt(option, value)
        if self.device.type == "cuda":
            os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS reads it when it starts
            torch.use_deterministic_algorithms(True, warn_only=True)
            torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined] # slow
        try:
            yield
        except RuntimeError as error:
            is_full = isinstance(error, torch.OutOfMemoryError)
            message = str(error).partition("\n")[0]
            if not is_full and "CUDA error" not in message and "cuDNN error" not in message:
                raise
            problem = f"{self.device}: {'its memory is full' if is_full else 'lost'}"
            remedy = "run again to resume: nvidia-smi shows what else uses it; or begin anew with a smaller --batch"
            raise TrainingError(problem, found=message, remedy=remedy) from error
        finally:
            torch.use_deterministic_algorithms(repeatable)


@dataclass
class Frames:
    """Samples as arrays with a row for each, and their pictures at one size.

    size: (height, width). states: (n, 2) float32. chunks: (n, chunk, 2) float32. is_pad: (n, chunk) bool. pool:
    reads pictures, if there is one. cache: by row, those that were read, unless all of them need too much memory.
    """

    samples: tuple[Sample, ...]
    size: tuple[int, int]
    states: np.ndarray
    chunks: np.ndarray
    is_pad: np.ndarray
    pool: ThreadPoolExecutor | None
    cache: dict[int, np.ndarray] | None

    @classmethod
    def of(cls, samples: tuple[Sample, ...], size: tuple[int, int], workers: int = 0) -> "Frames":
        """Return the samples; no picture is read yet."""
        states = np.stack([s.state for s in samples]).astype(np.float32)
        chunks, is_pad = stack_chunks(samples)
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        fits = 3 * len(samples) * math.prod(size) <= memory * MEMORY_SHARE
        pool = ThreadPoolExecutor(workers) if workers else None  # decoders and OpenCV release the interpreter's lock
        return cls(samples, size, states, chunks.astype(np.float32), is_pad, pool, {} if fits else None)

    def __len__(self) -> int:
        return len(self.samples)

    def pictures(self, rows: np.ndarray) -> np.ndarray:
        """Return these rows' pictures, (n, height, width, 3) uint8 RGB. Raises EpisodeError if one is gone."""
        read = self.pool.map if self.pool else map
        return np.stack(list(read(self._picture, rows.tolist())))

    def _picture(self, row: int) -> np.ndarray:
        if self.cache is not None and row in self.cache:
            return self.cache[row]
        picture = prepare_frame(self.samples[row].frame_bgr(), *self.size)
        if self.cache is not None:
            self.cache[row] = picture
        return picture


class RowFile:
    """Arrays of one shape in a file, by row, such as features that would not fit into memory.

    Like a module it is a part of a training's saved state: after a restart it has the rows that it had when saved.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: type = np.float32):
        self.path = path
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.row_bytes = math.prod(shape) * self.dtype.itemsize
        self._rows = 0  # although a process that was killed may have left rows in the file
        path.touch()
        self._file = path.open("r+b", buffering=0)

    def __len__(self) -> int:
        return self._rows

    def append(self, rows: np.ndarray | Tensor) -> None:
        """Append rows, (n, *shape)."""
        array = np.ascontiguousarray(rows, self.dtype)
        self._file.seek(self._rows * self.row_bytes)
        array.tofile(self._file)
        self._rows += len(array)

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        """Return these rows, (n, *shape). They are read, because mapped pages would count as this process's memory."""
        array = np.empty((len(rows), *self.shape), self.dtype)
        for i, row in enumerate(rows):
            data = os.pread(self._file.fileno(), self.row_bytes, int(row) * self.row_bytes)
            array[i] = np.frombuffer(data, self.dtype).reshape(self.shape)
        return array

    def state_dict(self) -> dict[str, Any]:
        os.fsync(self._file.fileno())
        return {"rows": len(self)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if (there := self.path.stat().st_size // self.row_bytes) < state["rows"]:
            raise TrainingError(f"{self.path}: rows are missing", found=f"{there} of {state['rows']}")
        self._rows = state["rows"]


@dataclass(frozen=True)
class Phase:
    """A part of a training: its name, number of steps, learning rate, and steps of warm-up, 0 for a twentieth."""

    name: str
    steps: int
    rate: float
    warmup: int = 0


@dataclass
class Best:
    """The best weights so far. judge: returns the module's errors now, by action. overall: one error of them.

    stale: how often they were not beaten since. seen: [step, *errors] of each judgement.
    """

    judge: Callable[[], Sequence[float] | np.ndarray]
    overall: Callable[[Sequence[float] | np.ndarray], float] = statistics.fmean
    error: float = math.inf
    stale: int = 0
    weights: dict[str, Tensor] = field(default_factory=dict)
    seen: list[list[float]] = field(default_factory=list)

    def see(self, module: nn.Module, step: int) -> None:
        """Judge the module, and keep its weights if they are better than all before."""
        errors = [float(error) for error in self.judge()]
        error = self.overall(errors)
        self.seen.append([step, *errors])
        self.stale += 1
        if error < self.error:
            self.error = error
            self.stale = 0
            self.weights = {k: v.detach().clone() for k, v in module.state_dict().items()}

    def state_dict(self) -> dict[str, Any]:
        return {"error": self.error, "stale": self.stale, "weights": self.weights, "seen": self.seen}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


@dataclass
class Resumable:
    """A training in phases, in a folder, that resumes to the last bit after a power cut at any moment.

    every_s: seconds between two saves, more if saving is slow. losses: of each step, by phase. judged: [step, *errors]
    of each judgement, by phase. earlier_s: spent before this process, by the clock of a budget.
    """

    folder: Path
    machine: Machine
    progress: Progress = silent
    every_s: float = SAVE_EVERY_S
    clock: Callable[[], float] = time.monotonic
    losses: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    judged: dict[str, list[list[float]]] = field(default_factory=dict)
    earlier_s: float = 0.0

    def __enter__(self) -> "Resumable":
        """Make the folder and lock it. Raises TrainingError if another process trains in it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = private_lock(self.folder / "lock")
        try:
            self._lock.acquire()
        except Timeout:
            raise TrainingError("another process trains the same", found=self.folder, remedy="wait for it") from None
        for unfinished in self.folder.glob(".*.pt"):  # of a process that was killed while it saved
            unfinished.unlink()
        self._began_s = self.machine.seconds()
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def spent_s(self) -> float:
        """Return the seconds that this training has taken, those of interrupted processes included."""
        return self.earlier_s + self.machine.seconds() - self._began_s

    def may_begin(self, phase: str, rounds: int, budget_s: float) -> bool:
        """Whether a further round fits into the budget, after `rounds` of it; one that has begun is always ended."""
        if (self.folder / f"{phase}.pt").exists():
            return True
        spent_s = self.spent_s()
        return spent_s + spent_s / rounds <= budget_s

    def steps(
        self,
        phase: str,
        count: int,
        rng: np.random.Generator,
        batch: Callable[[int], T],
        enough: Callable[[], bool] = lambda: False,
        **parts: Any,
    ) -> Iterator[tuple[int, T]]:
        """Yield the steps of a phase that are still to be done, each with its batch; the loop's body does one of them.

        batch: draws a step's from rng, maybe in another thread, before earlier steps are done. enough: whether the
        phase ends after this step. parts: everything that a step changes, each with state_dict() and load_state_dict().
        They, rng and torch's own random numbers are restored as they were saved.
        """
        file = self.folder / f"{phase}.pt"
        done = self._restore(file, phase, rng, parts) if file.exists() else 0
        saved_s = self.clock()
        took_s = 0.0

        def draw(step: int) -> tuple[int, T, Any]:
            return step, batch(step), rng.bit_generator.state

        drawn = ahead(draw, range(done, count), AHEAD if self.machine.workers else 0)
        for step, drawn_batch, state in self.progress(drawn, desc=f"training, {phase}", total=count, initial=done):
            yield step, drawn_batch
            now_s = self.clock()
            last = step + 1 == count or enough()
            if last or now_s - saved_s >= max(self.every_s, took_s / SAVING_SHARE):
                self._save(file, phase, count if last else step + 1, state, parts)
                saved_s = self.clock()
                took_s = saved_s - now_s
            if last and step + 1 < count:
                drawn.close()  # else it might still draw
                rng.bit_generator.state = state
                return

    def train(
        self,
        phase: Phase,
        module: nn.Module,
        rng: np.random.Generator,
        batch: Callable[[int], T],
        loss: Callable[[T], Tensor],
        best: Best | None = None,
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        """Train a module for the steps of a phase that are still to be done; return the optimiser and its scheduler.

        batch: as of `steps`. loss: of such a batch. best: if given, the module ends with the weights that it judged
        best, and learns no longer once they are not beaten.
        """
        optimizer, scheduler = optimiser(phase, list(module.parameters()))
        parts: dict[str, Any] = {"module": module, "optimizer": optimizer, "scheduler": scheduler}
        if best:
            parts["best"] = best
        patience = max(PATIENCE, PATIENT_SHARE * phase.steps / JUDGE_EVERY)

        def learns_by_heart() -> bool:
            return best is not None and best.stale >= patience

        for step, drawn in self.steps(phase.name, phase.steps, rng, batch, learns_by_heart, **parts):
            with torch.autocast(self.machine.device.type, torch.bfloat16, enabled=self.machine.amp):
                value = loss(drawn)
            self.losses[phase.name].append(descend(value, module, optimizer, scheduler))
            if best and (step + 1) % JUDGE_EVERY == 0:
                best.see(module, step + 1)
        if best and best.weights:
            module.load_state_dict(best.weights)
            self.judged[phase.name] = best.seen
        return optimizer, scheduler

    def _save(self, file: Path, phase: str, step: int, drawn: Any, parts: dict[str, Any]) -> None:
        content = {"step": step, "parts": {name: part.state_dict() for name, part in parts.items()}}
        content |= {"numpy": drawn, "torch": torch.get_rng_state(), "losses": self.losses[phase]}
        content["spent_s"] = self.spent_s()
        save_torch(file, content | {"cuda": torch.cuda.get_rng_state_all()})

    def _restore(self, file: Path, phase: str, rng: np.random.Generator, parts: dict[str, Any]) -> int:
        try:
            content = torch.load(file, map_location="cpu", weights_only=True)
            for name, part in parts.items():
                part.load_state_dict(content["parts"][name])
        except Exception as error:  # rows that are missing, or whatever a damaged file makes torch say
            cause = error if isinstance(error, TrainingError) else type(error).__name__
            remedy = f"remove {file.parent} to train from the beginning"
            raise TrainingError(f"{file}: cannot resume from it", found=cause, remedy=remedy) from error
        rng.bit_generator.state = content["numpy"]
        torch.set_rng_state(content["torch"])
        if len(content["cuda"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(content["cuda"])
        self.losses[phase] = content["losses"]
        self.earlier_s = max(self.earlier_s, content["spent_s"])
        return content["step"]


def ahead(make: Callable[[int], T], items: Iterable[int], count: int) -> Generator[T, None, None]:
    """Yield make(item) of each in their order; a thread, if count is not 0, makes as many before they are asked for."""
    if not count:
        yield from map(make, items)
        return
    pool = ThreadPoolExecutor(1)
    waiting = deque[Future[T]]()
    try:
        for item in items:
            waiting.append(pool.submit(make, item))
            if len(waiting) > count:
                yield waiting.popleft().result()
        for future in waiting:
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def blocks_of(count: int, at_once: int) -> list[np.ndarray]:
    """Return the numbers below `count` in blocks of at most `at_once`, (m,) each."""
    return np.split(np.arange(count), range(at_once, count, at_once))


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch compute with this number of threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def batch_of(
    data: Frames,
    rows: np.ndarray,
    rng: np.random.Generator,
    device: torch.device,
    augmentation: Augmentation,
    mirrored: float,
) -> Batch:
    """Return a batch to learn from: half of the states swapped, its pictures' variation, a share of all mirrored."""
    flipped = rng.random(len(rows)) < mirrored
    images = data.pictures(rows)
    states = swap_states(data, rows, rng)
    chunks = data.chunks[rows].copy()
    images[flipped] = images[flipped, :, ::-1]
    states[flipped, 0] *= -1
    chunks[flipped, :, 0] *= -1
    arrays = {IMAGE: augmentation.shifted(images, rng), STATE: states, ACTION: chunks, IS_PAD: data.is_pad[rows]}
    return on_device(arrays | augmentation.draw(len(rows), rng), device)


def on_device(arrays: dict[str, np.ndarray], device: torch.device) -> Batch:
    """Return arrays by name as tensors on the device; a GPU copies from pinned memory while it computes."""
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if device.type == "cuda":
        return {name: tensor.pin_memory().to(device, non_blocking=True) for name, tensor in tensors.items()}
    return tensors


def normalised(images: Tensor, variation: Mapping[str, Tensor] | None = None) -> Tensor:
    """Return pictures, (B, height, width, 3) uint8, as LeRobot's forward expects them; feature maps as they are.

    variation: as `vary` takes it; None: pictures are as they were taken.
    """
    if images.dtype != torch.uint8:
        return images
    x = vary(images, variation or {})
    mean = torch.tensor(IMAGENET_MEAN, device=x.device)[:, None, None]
    std = torch.tensor(IMAGENET_STD, device=x.device)[:, None, None]
    return (x / 255 - mean) / std


def swap_states(data: Frames, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return these rows' states, (n, 2) float32, with half of those in motion replaced by another moving frame's."""
    states = data.states[rows].copy()
    moving = np.flatnonzero(data.states[:, 1] >= STANDING_THROTTLE)
    if len(moving):
        swap = (rng.random(len(rows)) < SWAPPED_STATES) & (states[:, 1] >= STANDING_THROTTLE)
        states[swap] = data.states[rng.choice(moving, swap.sum())]
    return states


def error_of(predicted: Tensor, batch: Batch, loss_weights: Tensor) -> Tensor:
    """Return the mean error over the recorded actions, without padding, times loss_weights, (2,).

    Absolute and squared errors are added. Absolute ones alone, LeRobot's, let plans rest on the action that is usual:
    a driver steers straight half of the time. Squared ones alone plan the mean of left and right. They count from
    softened plans if the batch has some, as a driver's noise weighs most in them.
    """
    recorded = ~batch[IS_PAD][..., None]
    error = (predicted - batch[ACTION]).abs() * loss_weights * recorded
    far = error
    if SOFTENED in batch:
        far = (predicted - batch[SOFTENED]) * loss_weights * recorded
    return (error + far.square()).sum() / (recorded.sum() * loss_weights.numel())


def policy_loss(policy: "ACTPolicy", batch: Batch, loss_weights: Tensor) -> Tensor:
    """Return ACT's loss as LeRobot's forward computes it, but with `error_of`, each action in its own unit."""
    actions, (mean, log_variance) = policy.model({**batch, "observation.images": [batch[IMAGE]]})
    divergence = -0.5 * (1 + log_variance - mean.pow(2) - log_variance.exp()).sum(-1).mean()
    return error_of(actions, batch, loss_weights) + KL_WEIGHT * divergence


def optimiser(
    phase: Phase, parameters: list[nn.Parameter]
) -> tuple[torch.optim.AdamW, torch.optim.lr_scheduler.LRScheduler]:
    """Make AdamW, fused as loops are slow, with a rate that warms up and then falls to 1/100 along a cosine."""
    optimizer = torch.optim.AdamW(parameters, lr=phase.rate, betas=BETAS, weight_decay=WEIGHT_DECAY, fused=True)
    steps = max(phase.steps, 1)
    warmup = phase.warmup or max(1, steps // 20)

    def share(step: int) -> float:
        return min(1.0, (step + 1) / warmup) * (0.01 + 0.99 * (1 + math.cos(math.pi * min(1, step / steps))) / 2)

    return optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, share)


def descend(loss: Tensor, module: nn.Module, optimizer: torch.optim.Optimizer, scheduler: Any) -> float:
    """Do one step of the optimiser, and return the loss before it. Raises TrainingError if that is not finite."""
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(module.parameters(), GRAD_CLIP)
    optimizer.step()
    scheduler.step()
    value = loss.item()  # last, because the processor waits here for a GPU
    if not math.isfinite(value):
        raise TrainingError("training went wrong: the loss is not finite", found=value, remedy="try another seed")
    return value


class RepeatablePool(nn.Module):
    """ResNet's pooling, 3x3 at every second place. CUDA's own adds its gradient up in any order, which changes bits."""

    def forward(self, x: Tensor) -> Tensor:
        return F.pad(x, (1, 1, 1, 1), value=-math.inf).unfold(2, 3, 2).amax(-1).unfold(3, 3, 2).amax(-1)


class UnfoldedConv(nn.Conv2d):
    """A convolution as one product of matrices, if its map is small.

    Over the few places of ResNet's last stage, oneDNN's gradients take twice the time: a fifth of a step.
    """

    def forward(self, x: Tensor) -> Tensor:
        if x.shape[2] * x.shape[3] > SMALL_MAP:
            return super().forward(x)
        padding = int(self.padding[0])
        columns = F.unfold(x, self.kernel_size, padding=padding, stride=self.stride)  # (B, in x kernel, places)
        places = F.linear(columns.transpose(1, 2), self.weight.flatten(1), self.bias)
        height = (x.shape[2] + 2 * padding - self.kernel_size[0]) // self.stride[0] + 1
        return places.transpose(1, 2).unflatten(2, (height, -1))


class FeatureInput(nn.Module):
    """Takes the backbone's place while the transformer trains: its input is already the feature map."""

    def forward(self, features: Tensor) -> Batch:
        return {"feature_map": features}


def plans_on(policy: "ACTPolicy", data: Frames, rows: np.ndarray, maps: RowFile | None) -> np.ndarray:
    """Return the policy's plans, (n, C, A), on these rows, as it drives: no latent is sampled.

    maps: feature maps to take instead of the pictures.
    """
    policy.eval()
    images = data.pictures(rows) if maps is None else maps[rows]
    batch = on_device({IMAGE: images, STATE: data.states[rows]}, next(policy.parameters()).device)
    batch[IMAGE] = normalised(batch[IMAGE])
    return policy.predict_action_chunk(batch).cpu().numpy()


def to_cpu(value: Any) -> Any:
    """Return a state dict with all its tensors on the CPU."""
    if isinstance(value, dict):
        return {k: to_cpu(v) for k, v in value.items()}
    return value.cpu() if isinstance(value, Tensor) else value
