"""What a student learns from: recorded frames, and what its teacher sees and plans on them, on disk.

    lessons = Lessons.open(folder, samples, config, channels, rng)
    lessons.ask(saved, teacher, rng, device)          # or go on where that was interrupted
    frames = lessons.pictures(rows, views)

Every sample is there twice, as it is and mirrored with steering negated, and the teacher is asked both times. Half of
the states are another sample's, and the teacher is asked with those: a plan is the answer to a picture and a state.

Letters: B batch, C chunk, A actions, D channels of the feature map, h and w of it.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rover_lib.onboard.preprocess import prepare_frame
from rover_lib.workshop.act import ActConfig, Affine, lerobot_act
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.episodes import Sample
from rover_lib.workshop.training import Frames, Given, Resumable, RowFile, frames_of, swapped_states

BLOCK = 8  # samples that a policy is asked about at once
VIEWS = PLAIN, MIRRORED = 0, 1
MIRROR = np.array([-1, 1], np.float32)  # of steering and throttle


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

    def recorded(self, rows: np.ndarray, views: np.ndarray) -> np.ndarray:
        """(B, C, A) float32, what the driver did next, mirrored where views says so."""
        return self.data.chunks[rows] * np.where((views == MIRRORED)[:, None], MIRROR, 1)[:, None].astype(np.float32)

    @torch.inference_mode()
    def ask(self, saved: Resumable, teacher: Checkpoint, rng: np.random.Generator, device: torch.device) -> None:
        """Ask the teacher about every sample, or about those that are left. Raises EpisodeError for a lost picture."""
        policy: BatchedPolicy | None = None
        blocks = saved.steps("teacher", _blocks(len(self)), rng, frames=self.frames, maps=self.maps, plans=self.plans)
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

    @torch.inference_mode()
    def see(self, saved: Resumable, student: BatchedPolicy, rng: np.random.Generator) -> None:
        """The student's own feature maps, of every sample in both views."""
        device = student.image_scale.device
        for block in saved.steps("tokens", _blocks(len(self)), rng, tokens=self.tokens):
            frames = torch.from_numpy(self.frames[_rows(block, len(self))]).to(device)
            self.tokens.append(student.features(torch.stack([frames, frames.flip(2)], 1).flatten(0, 1)).half().cpu())


def _blocks(count: int) -> int:
    return -(-count // BLOCK)


def _rows(block: int, count: int) -> np.ndarray:
    return np.arange(block * BLOCK, min((block + 1) * BLOCK, count))
