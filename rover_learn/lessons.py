"""Keep on disk what a student learns from: recorded frames, and what its teacher sees and plans on them.

    lessons = Lessons.open(folder, samples, config, teacher, rng)
    lessons.ask(saved, teacher, rng, device)          # or go on where that was interrupted
    frames = lessons.pictures(rows, views)

Every sample is there twice, as it is and mirrored with its steering negated, and the teacher plans on both. Half of the
states in motion are replaced by another sample's.

Letters: B batch, C chunk, A actions, D channels of the feature map, h and w of it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rover_learn.training import Frames, Given, Resumable, RowFile, swap_states
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.workshop.act import ActConfig, Affine
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample, car_of

BLOCK = 8  # a policy plans on this many samples at once
VIEWS = PLAIN, MIRRORED = 0, 1
MIRROR = np.array([-1, 1], np.float32)  # a mirrored view multiplies steering and throttle by this
LIGHT, COLOUR = (0.8, 1.25), (0.9, 1.1)  # a picture is multiplied by the first as a whole, by the second per colour
FADED = (0.1, 1.0)  # the state of a new recording keeps a share of its steering, drawn from this range


class BatchedPolicy(nn.Module):
    """LeRobot's own policy for many observations at once: raw states in, raw actions out, no dropout, latent zero."""

    image_scale: Tensor
    image_shift: Tensor
    state_scale: Tensor
    state_shift: Tensor
    action_scale: Tensor
    action_shift: Tensor

    def __init__(self, config: ActConfig, weights: dict[str, Tensor]):
        super().__init__()
        self.config = config
        acting = {name: weight for name, weight in weights.items() if not name.startswith("vae_")}
        self.model = lerobot_act(replace(config, vae_layers=0), acting).model
        self.backbone = self.model.backbone
        self.model.backbone = Given()
        self.eval()
        norms = {"image": config.image_norm[0], "state": config.state_norm, "action": config.action_unnorm}
        for name, norm in norms.items():
            norm = norm or Affine((1.0,), (0.0,))
            self.register_buffer(f"{name}_scale", torch.tensor(norm.scale), persistent=False)
            self.register_buffer(f"{name}_shift", torch.tensor(norm.shift), persistent=False)

    def thaw(self) -> None:
        """Make the scale and shift of the batch norms trainable, which LeRobot freezes; the statistics stay frozen."""
        from torchvision.ops.misc import FrozenBatchNorm2d  # importing it takes three seconds

        for norm in self.backbone.modules():
            if isinstance(norm, FrozenBatchNorm2d):
                for name in ("weight", "bias"):
                    value = getattr(norm, name)
                    delattr(norm, name)
                    norm.register_parameter(name, nn.Parameter(value))

    def weights(self) -> dict[str, Tensor]:
        """Return a copy of the weights, on the CPU, by LeRobot's names without the leading `model.`."""
        backbone = {f"backbone.{name}": value for name, value in self.backbone.state_dict().items()}
        return {name: value.cpu().clone() for name, value in {**self.model.state_dict(), **backbone}.items()}

    def features(self, frames: Tensor) -> Tensor:
        """Return the feature maps, (B, D, h, w), of frames, (B, height, width, 3) uint8 RGB."""
        x = frames.float() / 255 * self.image_scale + self.image_shift
        return self.backbone(x.permute(0, 3, 1, 2))["feature_map"]

    def plan(self, features: Tensor, states: Tensor) -> Tensor:
        """Return raw actions, (B, C, A), for feature maps as `features` gives them and states, (B, 2) float32."""
        states = states * self.state_scale + self.state_shift
        actions, _ = self.model({"observation.images": [features], "observation.state": states})
        return actions * self.action_scale + self.action_shift

    def forward(self, frames: Tensor, states: Tensor) -> Tensor:
        return self.plan(self.features(frames), states)


@torch.inference_mode()
def plans_of(policy: BatchedPolicy, samples: Sequence[Sample], progress: Progress = silent) -> np.ndarray:
    """Return what a policy would drive on the samples, (n, C, A) float32, clipped to their car's limits."""
    device, (size,) = policy.image_scale.device, policy.config.image_sizes
    plans = []
    firsts = range(0, len(samples), BLOCK)
    for first in progress(firsts, desc="judging", total=len(firsts)):
        block = samples[first : first + BLOCK]
        frames = torch.from_numpy(np.stack([prepare_frame(s.frame_bgr(), *size) for s in block]))
        states = torch.from_numpy(np.stack([s.state for s in block]).astype(np.float32))
        plans.append(policy(frames.to(device), states.to(device)).cpu().numpy())
    limits = action_limits(policy.config.action_names, car_of(samples))
    return np.concatenate(plans).clip(*limits)


@dataclass(frozen=True, eq=False)
class Lessons:
    """n samples, each seen in two views: a file has a row for each sample, or the row 2 * sample + view.

    asked: (2 n, 2) float32, the states with which the teacher plans. frames: for each sample, (height, width, 3) uint8
    RGB at the student's size, not mirrored. maps: for each view, (D, h, w) float16, the teacher's feature map pooled to
    the student's grid. plans: for each view, (C, A) float32, the teacher's. tokens: as maps, the student's own.
    """

    data: Frames
    asked: np.ndarray
    frames: RowFile
    maps: RowFile
    plans: RowFile
    tokens: RowFile

    @classmethod
    def open(
        cls, folder: Path, samples: tuple[Sample, ...], config: ActConfig, teacher: Checkpoint, rng: np.random.Generator
    ) -> "Lessons":
        """Open the lessons in a folder of these arguments. config: the student's. rng: draws the states."""
        (size,) = config.image_sizes
        data = Frames.of(samples, size)
        seen = teacher.weights["encoder_img_feat_input_proj.weight"].shape[1], *config.grid(*size)
        rows = np.arange(len(data))
        asked = np.stack([swap_states(data, rows, rng) for _ in VIEWS], 1)
        asked[:, MIRRORED] *= MIRROR
        return cls(
            data,
            asked.reshape(-1, 2),
            RowFile(folder / "frames", (*size, 3), np.uint8),
            RowFile(folder / "maps", seen, np.float16),
            RowFile(folder / "plans", data.chunks.shape[1:]),
            RowFile(folder / "tokens", seen, np.float16),
        )

    def __len__(self) -> int:
        return len(self.data)

    def apart(self, folder: Path) -> "Lessons":
        """Return the same lessons for a student whose backbone differs, with tokens of its own, still to be seen."""
        return replace(self, tokens=RowFile(folder / "tokens", self.tokens.shape, np.float16))

    @property
    def blocks(self) -> list[np.ndarray]:
        """The numbers of all samples, in blocks of BLOCK, on which a policy plans at once."""
        return [np.arange(first, min(first + BLOCK, len(self))) for first in range(0, len(self), BLOCK)]

    def pictures(self, rows: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Return the pictures of these samples, (B, height, width, 3) uint8, mirrored where views, (B,), says so."""
        frames = self.frames[rows]
        return np.where((views == MIRRORED)[:, None, None, None], frames[:, :, ::-1], frames)

    def each_once(self) -> Iterator[np.ndarray]:
        """Yield every sample's picture once, each second one mirrored, in blocks of (B, height, width, 3) uint8."""
        for rows in self.blocks:
            yield self.pictures(rows, rows % len(VIEWS))

    @torch.inference_mode()
    def ask(self, saved: Resumable, teacher: Checkpoint, rng: np.random.Generator, device: torch.device) -> None:
        """Let the teacher see and plan on every sample that is missing. Raises EpisodeError if a picture is lost."""
        policy, blocks, grid = None, self.blocks, (self.maps.shape[1], self.maps.shape[2])
        parts = {"frames": self.frames, "maps": self.maps, "plans": self.plans}
        for block in saved.steps("teacher", len(blocks), rng, **parts):
            policy = policy or BatchedPolicy(teacher.config, teacher.weights).to(device)
            rows = blocks[block]
            pictures = [self.data.samples[i].frame_bgr() for i in rows]
            self.frames.append(np.stack([prepare_frame(p, *self.data.size) for p in pictures]))
            (size,) = teacher.config.image_sizes
            seen = policy.features(_in_both_views(np.stack([prepare_frame(p, *size) for p in pictures]), device))
            states = torch.from_numpy(self.asked[2 * rows[0] : 2 * rows[-1] + 2]).to(device)
            self.maps.append(F.adaptive_avg_pool2d(seen, grid).half().cpu())
            self.plans.append(policy.plan(seen, states).cpu())

    @torch.inference_mode()
    def see(self, saved: Resumable, student: BatchedPolicy, rng: np.random.Generator) -> None:
        """Compute the student's own feature maps of every sample in both views, as far as they are missing."""
        blocks = self.blocks
        for block in saved.steps("tokens", len(blocks), rng, tokens=self.tokens):
            frames = _in_both_views(self.frames[blocks[block]], student.image_scale.device)
            self.tokens.append(student.features(frames).half().cpu())


def _in_both_views(frames: np.ndarray, device: torch.device) -> Tensor:
    """Return frames, (B, height, width, 3), each followed by itself mirrored, (2 B, height, width, 3)."""
    plain = torch.from_numpy(frames).to(device)
    return torch.stack([plain, plain.flip(2)], 1).flatten(0, 1)


class Part(NamedTuple):
    """Samples of a batch from the same lessons. rows, views: (b,). new: recorded after the teacher was trained."""

    lessons: Lessons
    rows: np.ndarray
    views: np.ndarray
    new: bool

    @property
    def mirror(self) -> np.ndarray:
        """(b, 2) float32: what the view multiplies steering and throttle by."""
        return np.where((self.views == MIRRORED)[:, None], MIRROR, 1).astype(np.float32)

    def by_view(self, rows: RowFile | np.ndarray) -> np.ndarray:
        """Return these samples' rows of what has a row for each view."""
        return rows[2 * self.rows + self.views]


@dataclass(frozen=True, eq=False)
class Batch:
    """The samples of one step, of one or several lessons."""

    parts: Sequence[Part]
    rng: np.random.Generator
    device: torch.device

    def _join(self, each: Iterable[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.concatenate(list(each))).to(self.device)

    def seen(self, what: str = "maps") -> Tensor:
        """The teacher's feature maps, or the student's own tokens, (B, D, h, w) float32."""
        return self._join(p.by_view(getattr(p.lessons, what)) for p in self.parts).float()

    def pictures(self) -> Tensor:
        """The pictures, each made lighter or darker, and tinted: (B, height, width, 3) uint8 RGB."""
        frames = np.concatenate([p.lessons.pictures(p.rows, p.views) for p in self.parts])
        gain = self.rng.uniform(*LIGHT, (len(frames), 1, 1, 1)) * self.rng.uniform(*COLOUR, (len(frames), 1, 1, 3))
        frames = np.minimum(frames * gain.astype(np.float32) + 0.5, 255).astype(np.uint8)
        return torch.from_numpy(frames).to(self.device)

    def states(self) -> Tensor:
        """The states, (B, 2), with which the teacher planned; of new recordings, with a random share of the steering.

        If nothing to steer to is in sight, only the state says on which side it was.
        """
        each = []
        for p in self.parts:
            states = p.by_view(p.lessons.asked)
            if p.new:
                states = p.lessons.data.states[p.rows] * p.mirror
                states[:, 0] *= self.rng.uniform(*FADED, len(p.rows))
            each.append(states)
        return self._join(each)

    def share_of_old(self, share: float) -> Tensor:
        """The given share for old recordings, 0 for new ones, (B, 1, 1)."""
        return self._join(np.full((len(p.rows), 1, 1), 0.0 if p.new else share, np.float32) for p in self.parts)

    def planned(self) -> Tensor:
        """What the teacher planned, (B, C, A)."""
        return self._join(p.by_view(p.lessons.plans) for p in self.parts)

    def recorded(self) -> Tensor:
        """What was driven, (B, C, A)."""
        return self._join(p.lessons.data.chunks[p.rows] * p.mirror[:, None] for p in self.parts)

    def driven(self) -> Tensor:
        """Whether that was driven and is no padding, (B, C, 1)."""
        return self._join(~p.lessons.data.is_pad[p.rows, :, None] for p in self.parts)


class Pool:
    """All lessons of a training, each with whether it was recorded after the teacher was trained.

    weights: how often each sample is drawn, (n of all lessons,); None: all alike.
    """

    def __init__(self, lessons: Sequence[tuple[Lessons, bool]], weights: np.ndarray | None = None):
        self.lessons = lessons
        counts = [len(each) for each, _ in lessons]
        self._places = np.repeat(np.arange(len(lessons)), counts)
        self._rows = np.concatenate([np.arange(count) for count in counts])
        self._shares = None if weights is None else weights / weights.sum()

    def batch(self, count: int, rng: np.random.Generator, device: torch.device) -> Batch:
        """Draw samples, each at most once and in one of its views."""
        most = len(self._rows)
        chosen = rng.choice(most, min(count, most), replace=False, p=self._shares)
        views = rng.integers(len(VIEWS), size=len(chosen))
        parts = []
        for place, (lessons, new) in enumerate(self.lessons):
            own = self._places[chosen] == place
            if own.any():
                parts.append(Part(lessons, self._rows[chosen][own], views[own], new))
        return Batch(parts, rng, device)
