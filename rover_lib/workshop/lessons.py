"""What a student learns from: recorded frames, and what its teacher sees and plans on them, on disk.

    lessons = Lessons.open(folder, samples, config, channels, rng)
    lessons.ask(saved, teacher, rng, device)          # or go on where that was interrupted
    frames = lessons.pictures(rows, views)

Every sample is there twice, as it is and mirrored with steering negated, and the teacher is asked both times. Half of
the states are another sample's, and the teacher is asked with those: a plan is the answer to a picture and a state.

Letters: B batch, C chunk, A actions, D channels of the feature map, h and w of it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rover_lib.onboard.policy import action_limits
from rover_lib.onboard.preprocess import prepare_frame
from rover_lib.workshop.act import ActConfig, Affine, lerobot_act
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.samples import Sample, car_of
from rover_lib.workshop.training import Frames, Given, Resumable, RowFile, frames_of, swapped_states

BLOCK = 8  # samples that a policy is asked about at once
VIEWS = PLAIN, MIRRORED = 0, 1
MIRROR = np.array([-1, 1], np.float32)  # of steering and throttle
LIGHT, COLOUR = (0.8, 1.25), (0.9, 1.1)  # what pictures are multiplied by: all of one, and each of its colours
SMALLEST_RANGE = 0.02  # of an action that hardly changes: errors are a share of its range, which must not be nothing
STRANGER = 2.0  # times the error of one action for all frames: a policy that is worse was not trained for this car


class BatchedPolicy(nn.Module):
    """LeRobot's own policy for many observations at once: raw states in, raw actions out, no dropout, no latent."""

    def __init__(self, config: ActConfig, weights: dict[str, Tensor]):
        super().__init__()
        self.config = config
        self.model = lerobot_act(replace(config, vae_layers=0)).model
        self.model.load_state_dict({k: v.float() for k, v in weights.items() if not k.startswith("vae_")})
        self.backbone = self.model.backbone
        self.model.backbone = Given()
        self.eval()
        self.image_scale: Tensor
        self.image_shift: Tensor
        self.state_scale: Tensor
        self.state_shift: Tensor
        self.action_scale: Tensor
        self.action_shift: Tensor
        norms = {"image": config.image_norm[0], "state": config.state_norm, "action": config.action_unnorm}
        for name, norm in norms.items():
            norm = norm or Affine((1.0,), (0.0,))
            self.register_buffer(f"{name}_scale", torch.tensor(norm.scale), persistent=False)
            self.register_buffer(f"{name}_shift", torch.tensor(norm.shift), persistent=False)

    def thaw(self) -> None:
        """Make what LeRobot freezes trainable: scale and shift of the batch norms; their statistics stay."""
        from torchvision.ops.misc import FrozenBatchNorm2d  # importing it takes three seconds

        for norm in self.backbone.modules():
            if isinstance(norm, FrozenBatchNorm2d):
                for name in ("weight", "bias"):
                    value = getattr(norm, name)
                    delattr(norm, name)
                    norm.register_parameter(name, nn.Parameter(value))

    def named_weights(self) -> dict[str, Tensor]:
        """By LeRobot's names without the leading `model.`, as they are trained."""
        of_model, of_backbone = (m.state_dict(keep_vars=True) for m in (self.model, self.backbone))
        return {**of_model, **{f"backbone.{name}": value for name, value in of_backbone.items()}}

    def weights(self) -> dict[str, Tensor]:
        """The same on the processor, each with its own memory."""
        return {name: value.detach().cpu().clone() for name, value in self.named_weights().items()}

    def features(self, frames: Tensor) -> Tensor:
        """frames: (B, height, width, 3) uint8 RGB -> (B, D, h, w)."""
        x = frames.float() / 255 * self.image_scale + self.image_shift
        return self.backbone(x.permute(0, 3, 1, 2))["feature_map"]

    def plan(self, features: Tensor, states: Tensor) -> Tensor:
        """features: from `features`; states: (B, 2) float32 -> (B, C, A) raw actions."""
        states = states * self.state_scale + self.state_shift
        actions, _ = self.model({"observation.images": [features], "observation.state": states})
        return actions * self.action_scale + self.action_shift

    def forward(self, frames: Tensor, states: Tensor) -> Tensor:
        return self.plan(self.features(frames), states)


@torch.inference_mode()
def plans_of(policy: BatchedPolicy, samples: Sequence[Sample], progress: Progress = silent) -> np.ndarray:
    """(n, C, A) float32 of what a policy would drive on the samples: clipped to what a pulse can express."""
    device, (size,) = policy.image_scale.device, policy.config.image_sizes
    plans = []
    firsts = range(0, len(samples), BLOCK)
    for first in progress(firsts, desc="judging", total=len(firsts)):
        block = samples[first : first + BLOCK]
        frames = torch.from_numpy(np.stack([prepare_frame(s.frame_bgr(), *size) for s in block]))
        states = torch.from_numpy(np.stack([s.state for s in block]).astype(np.float32))
        plans.append(policy(frames.to(device), states.to(device)).cpu().numpy())
    return as_driven(np.concatenate(plans), policy.config.action_names, samples)


def as_driven(plans: np.ndarray, action_names: Sequence[str], samples: Sequence[Sample]) -> np.ndarray:
    """Plans, (n, C, A), clipped to what a pulse of the samples' car can express. Raises EpisodeError as car_of()."""
    return plans.clip(*action_limits(action_names, car_of(samples)))


def judged_ranges(action_range: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """(A,) float32: each action's recorded range, in which errors are counted."""
    ends = np.array(list(action_range.values()), np.float32)
    return np.maximum(ends[:, 1] - ends[:, 0], SMALLEST_RANGE)


def in_another_light(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """frames: (B, height, width, 3) uint8. The same, each lighter or darker, and tinted."""
    gain = rng.uniform(*LIGHT, (len(frames), 1, 1, 1)) * rng.uniform(*COLOUR, (len(frames), 1, 1, 3))
    return np.minimum(frames * gain.astype(np.float32) + 0.5, 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Lessons:
    """n samples, each seen in two views. Files have a row per sample, or two: 2 * sample + view.

    data: what was recorded of them. asked: (2 n, 2) float32, the states that the teacher is asked with. frames: rows of
    (height, width, 3) uint8 RGB at the student's size, one per sample, as they are. maps: two rows of (D, h, w)
    float16, the teacher's feature map pooled to the student's grid. plans: two rows of (C, A) float32. tokens: two rows
    of (D, h, w) float16, the student's own map; empty until `see`.
    """

    samples: tuple[Sample, ...]
    data: Frames
    asked: np.ndarray
    frames: RowFile
    maps: RowFile
    plans: RowFile
    tokens: RowFile

    @classmethod
    def open(
        cls, folder: Path, samples: tuple[Sample, ...], config: ActConfig, channels: int, rng: np.random.Generator
    ) -> "Lessons":
        """folder: of these very arguments alone. config: the student's. channels: D. rng: draws the states."""
        folder.mkdir(parents=True, exist_ok=True)
        (size,) = config.image_sizes
        data = frames_of(samples, *size)
        grid = config.grid(*size)
        rows = np.arange(len(data))
        asked = np.stack([swapped_states(data, rows, rng) for _ in VIEWS], 1)
        asked[:, MIRRORED] *= MIRROR
        return cls(
            samples,
            data,
            asked.reshape(-1, 2),
            RowFile(folder / "frames", (*size, 3), np.uint8),
            RowFile(folder / "maps", (channels, *grid), np.float16),
            RowFile(folder / "plans", data.chunks.shape[1:]),
            RowFile(folder / "tokens", (channels, *grid), np.float16),
        )

    def __len__(self) -> int:
        return len(self.data)

    def pictures(self, rows: np.ndarray, views: np.ndarray) -> np.ndarray:
        """(B, height, width, 3) uint8 of these samples, mirrored where views, (B,), says so."""
        frames = self.frames[rows]
        return np.where((views == MIRRORED)[:, None, None, None], frames[:, :, ::-1], frames)

    @property
    def blocks(self) -> int:
        """How often a policy is asked about all of them, a few at once."""
        return _blocks(len(self))

    def each_once(self) -> Iterator[np.ndarray]:
        """(B, height, width, 3) uint8: every sample's picture, each second one mirrored, a few at once."""
        for block in range(self.blocks):
            rows = _rows(block, len(self))
            yield self.pictures(rows, rows % len(VIEWS))

    def apart(self, folder: Path) -> "Lessons":
        """The same with tokens of their own, still empty, in a folder: of a student that sees like no other."""
        return replace(self, tokens=RowFile(folder / "tokens", self.tokens.shape, np.float16))

    def recorded(self, rows: np.ndarray, views: np.ndarray) -> np.ndarray:
        """(B, C, A) float32, what the driver did next, mirrored where views says so."""
        return self.data.chunks[rows] * np.where((views == MIRRORED)[:, None], MIRROR, 1)[:, None].astype(np.float32)

    @torch.inference_mode()
    def ask(self, saved: Resumable, teacher: Checkpoint, rng: np.random.Generator, device: torch.device) -> None:
        """Ask the teacher about every sample, or about those that are left. Raises EpisodeError for a lost picture."""
        policy: BatchedPolicy | None = None
        blocks = saved.steps("teacher", self.blocks, rng, frames=self.frames, maps=self.maps, plans=self.plans)
        for block in blocks:
            policy = policy or BatchedPolicy(teacher.config, teacher.weights).to(device)
            rows, grid = _rows(block, len(self)), (self.maps.shape[1], self.maps.shape[2])
            pictures = [self.samples[i].frame_bgr() for i in rows]
            self.frames.append(np.stack([prepare_frame(p, *self.frames.shape[:2]) for p in pictures]))
            (size,) = teacher.config.image_sizes
            frames = torch.from_numpy(np.stack([prepare_frame(p, *size) for p in pictures])).to(device)
            seen = policy.features(torch.stack([frames, frames.flip(2)], 1).flatten(0, 1))
            states = torch.from_numpy(self.asked[2 * rows[0] : 2 * rows[-1] + 2]).to(device)
            self.maps.append(F.adaptive_avg_pool2d(seen, grid).half().cpu())
            self.plans.append(policy.plan(seen, states).cpu())

    def stranger(self, ranges: np.ndarray, action_names: Sequence[str]) -> str | None:
        """How far off a teacher's plans are that knows nothing of what was driven, None if it does know.

        ranges: (A,), as of `judged_ranges`. Such a teacher is another car's, or another camera's.
        """
        actions, driven = self.data.chunks, ~self.data.is_pad
        constant = (np.abs(actions - np.median(actions[driven], axis=0)) / ranges)[driven].mean(0)
        as_recorded = (self.asked[::2] == self.data.states).all(1)  # not with another sample's state
        plans = self.plans[2 * np.arange(len(self))]
        planned = (np.abs(plans - actions) / ranges)[driven & as_recorded[:, None]].mean(0)
        if not (planned > STRANGER * constant).all():
            return None
        pairs = zip(action_names, planned, constant, strict=True)
        return " and ".join(f"{a} {100 * p:.0f} % off instead of {100 * c:.0f} %" for a, p, c in pairs)

    @torch.inference_mode()
    def see(self, saved: Resumable, student: BatchedPolicy, rng: np.random.Generator) -> None:
        """The student's own feature maps, of every sample in both views."""
        device = student.image_scale.device
        for block in saved.steps("tokens", self.blocks, rng, tokens=self.tokens):
            frames = torch.from_numpy(self.frames[_rows(block, len(self))]).to(device)
            self.tokens.append(student.features(torch.stack([frames, frames.flip(2)], 1).flatten(0, 1)).half().cpu())


def _blocks(count: int) -> int:
    return -(-count // BLOCK)


def _rows(block: int, count: int) -> np.ndarray:
    return np.arange(block * BLOCK, min((block + 1) * BLOCK, count))
