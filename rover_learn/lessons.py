"""Keep on disk what a student learns from: recorded frames, and what its teacher sees and plans on them.

    lessons = Lessons.open(folder, samples, config, teacher, rng)
    lessons.ask(saved, teacher, rng)          # or go on where that was interrupted
    batch = Pool([(lessons, False)]).batch(16, rng, device, "frames")

Every sample is there twice, as it is and mirrored with its steering negated, and the teacher plans on both. Half of the
states in motion are replaced by another sample's.

Letters: B batch, C chunk, A actions, D channels of the feature map, h and w of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rover_learn import training
from rover_learn.augment import GAIN
from rover_learn.training import ACTION, IMAGE, IS_PAD, STATE, Batch, FeatureInput, Frames, Resumable, RowFile
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.workshop.act import Normalise
from rover_lib.workshop.act_config import ActConfig, lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample, car_of

BLOCK = 8  # a policy plans on this many samples at once
VIEWS = PLAIN, MIRRORED = 0, 1
MIRROR = np.array([-1, 1], np.float32)  # a mirrored view multiplies steering and throttle by this
LIGHT, COLOUR = (0.8, 1.25), (0.9, 1.1)  # a picture is multiplied by the first as a whole, by the second per colour
PLANNED, OLD = "planned", "old"  # of a batch, beside LeRobot's keys
FADED = (0.1, 1.0)  # the state of a new recording keeps a share of its steering, drawn from this range


class BatchedPolicy(nn.Module):
    """LeRobot's own policy for many observations at once: raw states in, raw actions out, no dropout, latent zero."""

    def __init__(self, config: ActConfig, weights: dict[str, Tensor]):
        super().__init__()
        self.config = config
        acting = {name: weight for name, weight in weights.items() if not name.startswith("vae_")}
        self.model = lerobot_act(replace(config, vae_layers=0), acting).model
        self.backbone = self.model.backbone
        self.model.backbone = FeatureInput()
        self.eval()
        self.image_norm = Normalise(config.image_norm[0], (1, 1, 1, -1))
        self.state_norm = Normalise(config.state_norm, (1, -1))
        self.action_unnorm = Normalise(config.action_unnorm, (1, 1, -1))

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
        values = self.model.state_dict() | self.backbone.state_dict(prefix="backbone.")
        return {name: value.cpu().clone().contiguous() for name, value in values.items()}

    def features(self, frames: Tensor) -> Tensor:
        """Return the feature maps, (B, D, h, w), of frames, (B, height, width, 3) uint8 RGB."""
        x = self.image_norm(frames.float() / 255)
        return self.backbone(x.permute(0, 3, 1, 2))["feature_map"]

    def plan(self, features: Tensor, states: Tensor) -> Tensor:
        """Return raw actions, (B, C, A), for feature maps as `features` gives them and states, (B, 2) float32."""
        actions, _ = self.model({"observation.images": [features], "observation.state": self.state_norm(states)})
        return self.action_unnorm(actions)

    def forward(self, frames: Tensor, states: Tensor) -> Tensor:
        return self.plan(self.features(frames), states)


@torch.inference_mode()
def plans_of(policy: BatchedPolicy, samples: Sequence[Sample], progress: Progress = silent) -> np.ndarray:
    """Return what a policy would drive on the samples, (n, C, A) float32, clipped to their car's limits."""
    device = next(policy.parameters()).device
    (size,) = policy.config.image_sizes
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

    teacher_states: (2 n, 2) float32 with which the teacher plans. frames: for each sample, (height, width, 3) uint8
    RGB at the student's size, not mirrored. maps: for each view, (D, h, w) float16, the teacher's feature map pooled to
    the student's grid. plans: for each view, (C, A) float32, the teacher's. tokens: as maps, the student's own.
    """

    data: Frames
    teacher_states: np.ndarray
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
        shape = teacher.weights["encoder_img_feat_input_proj.weight"].shape[1], *config.grid(*size)
        rows = np.arange(len(data))
        states = np.stack([training.swap_states(data, rows, rng) for _ in VIEWS], 1)
        states[:, MIRRORED] *= MIRROR
        return cls(
            data,
            states.reshape(-1, 2),
            RowFile(folder / "frames", (*size, 3), np.uint8),
            RowFile(folder / "maps", shape, np.float16),
            RowFile(folder / "plans", data.chunks.shape[1:]),
            RowFile(folder / "tokens", shape, np.float16),
        )

    def __len__(self) -> int:
        return len(self.data)

    def apart(self, folder: Path) -> "Lessons":
        """Return the same lessons for a student whose backbone differs, with tokens of its own, still to be seen."""
        return replace(self, tokens=RowFile(folder / "tokens", self.tokens.shape, np.float16))

    @property
    def blocks(self) -> list[np.ndarray]:
        """The numbers of all samples, in blocks of BLOCK, on which a policy plans at once."""
        return training.blocks_of(len(self), BLOCK)

    def pictures(self, rows: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Return the pictures of these samples, (B, height, width, 3) uint8, mirrored where views, (B,), says so."""
        frames = self.frames[rows]
        return np.where((views == MIRRORED)[:, None, None, None], frames[:, :, ::-1], frames)

    def show(
        self, rows: np.ndarray, views: np.ndarray, new: bool, rng: np.random.Generator, *shown: str
    ) -> dict[str, np.ndarray]:
        """Return these samples in these views as arrays with a row for each, as `Pool.batch` joins them.

        With the state of new recordings goes a random share of the steering, because if nothing to steer to is in
        sight, only the state says on which side it was.
        """
        both = 2 * rows + views
        mirror = np.where((views == MIRRORED)[:, None], MIRROR, 1).astype(np.float32)
        states = self.teacher_states[both]
        if new:
            states = self.data.states[rows] * mirror
            states[:, 0] *= rng.uniform(*FADED, len(rows))
        arrays = {STATE: states, PLANNED: self.plans[both], ACTION: self.data.chunks[rows] * mirror[:, None]}
        arrays |= {IS_PAD: self.data.is_pad[rows], OLD: np.full((len(rows), 1, 1), not new, np.float32)}
        if "frames" in shown:
            arrays[IMAGE] = self.pictures(rows, views)
        return arrays | {name: getattr(self, name)[both] for name in shown if name != "frames"}

    @torch.inference_mode()
    def ask(self, saved: Resumable, teacher: Checkpoint, rng: np.random.Generator) -> None:
        """Let the teacher see and plan on every sample that is missing. Raises EpisodeError if a picture is lost."""
        policy = None
        blocks = self.blocks
        grid = (self.maps.shape[1], self.maps.shape[2])
        parts: dict[str, Any] = {"frames": self.frames, "maps": self.maps, "plans": self.plans}
        (size,) = teacher.config.image_sizes
        device = saved.machine.device

        def read(block: int) -> list[np.ndarray]:
            pictures = [self.data.samples[i].frame_bgr() for i in blocks[block]]
            return [np.stack([prepare_frame(p, *at) for p in pictures]) for at in (self.data.size, size)]

        for block, (own, teachers) in saved.steps("teacher", len(blocks), rng, read, **parts):
            policy = policy or saved.machine.taking(BatchedPolicy(teacher.config, teacher.weights))
            rows = blocks[block]
            self.frames.append(own)
            features = policy.features(_in_both_views(teachers, device))
            states = torch.from_numpy(self.teacher_states[2 * rows[0] : 2 * rows[-1] + 2]).to(device)
            self.maps.append(F.adaptive_avg_pool2d(features, grid).half().cpu())
            self.plans.append(policy.plan(features, states).cpu())

    @torch.inference_mode()
    def see(self, saved: Resumable, student: BatchedPolicy, rng: np.random.Generator) -> None:
        """Compute the student's own feature maps of every sample in both views, as far as they are missing."""
        blocks = self.blocks
        steps = saved.steps("tokens", len(blocks), rng, lambda block: self.frames[blocks[block]], tokens=self.tokens)
        for _, frames in steps:
            self.tokens.append(student.features(_in_both_views(frames, saved.machine.device)).half().cpu())


def _in_both_views(frames: np.ndarray, device: torch.device) -> Tensor:
    """Return frames, (B, height, width, 3), each followed by itself mirrored, (2 B, height, width, 3)."""
    plain = torch.from_numpy(frames).to(device)
    return torch.stack([plain, plain.flip(2)], 1).flatten(0, 1)


class Pool:
    """All lessons of a training, each with whether it was recorded after the teacher was trained.

    weights: how often each sample is drawn, (n of all lessons,); None: all alike.
    """

    def __init__(self, lessons: Sequence[tuple[Lessons, bool]], weights: np.ndarray | None = None):
        self.lessons = lessons
        counts = [len(lessons_of) for lessons_of, _ in lessons]
        self._places = np.repeat(np.arange(len(lessons)), counts)
        self._rows = np.concatenate(list(map(np.arange, counts)))
        self._shares = None if weights is None else weights / weights.sum()

    def batch(self, count: int, rng: np.random.Generator, device: torch.device, *shown: str) -> Batch:
        """Draw samples, each at most once and in one of its views, as tensors with a row for each.

        STATE: (B, 2), with which the teacher planned. PLANNED: (B, C, A), the teacher's. ACTION: (B, C, A), driven.
        IS_PAD: (B, C). OLD: (B, 1, 1), 0 for new recordings, else 1. shown: `frames` become IMAGE and GAIN, its light
        and tint, for `lit`; `maps` and `tokens` stay what they are.
        """
        count_all = len(self._rows)
        drawn = rng.choice(count_all, min(count, count_all), replace=False, p=self._shares)
        views = rng.integers(len(VIEWS), size=len(drawn))
        arrays = {}
        if "frames" in shown:
            gain = rng.uniform(*LIGHT, (len(drawn), 1, 1, 1)) * rng.uniform(*COLOUR, (len(drawn), 1, 1, 3))
            arrays[GAIN] = gain.astype(np.float32)
        parts = []
        for place, (lessons, new) in enumerate(self.lessons):
            own = self._places[drawn] == place
            if own.any():
                parts.append(lessons.show(self._rows[drawn][own], views[own], new, rng, *shown))
        arrays |= {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return training.on_device(arrays, device)


def lit(batch: Batch) -> Tensor:
    """Return a batch's pictures in their light and tint, (B, height, width, 3) uint8 RGB."""
    return (batch[IMAGE] * batch[GAIN] + 0.5).clamp_(max=255).byte()
