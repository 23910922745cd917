"""The backbone's own phase: with live batch norm it learns to see what decides a plan, before the transformer does.

    source = Pretrained.of("imagenet", say)        # or a file of torchvision's weights; None: random weights
    model = PlanFromFeatures(live_backbone(source), spread, mean)

From random weights and with the batch norm that LeRobot freezes, a ResNet learns nothing. The head averages the
features over the picture and is thrown away. Its output is centred on the mean action and counted in the actions'
spreads: a real throttle lies several spreads from zero, and a steering that is straight half of the time is where other
starts stay.
"""

import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torchvision
from torch import Tensor, nn

from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.stage import sha256_of

FEATURES = 512  # of ResNet18's last stage
PLAN_STEPS = 5  # of a plan that the head predicts: neighbours hardly differ
IMAGENET = "imagenet"  # torchvision's own weights, from the internet
CONNECTS_S = 10.0  # at most: without internet, training begins soon


@dataclass(frozen=True)
class Pretrained:
    """Weights of torchvision's ResNet18 to begin with. origin: where they are from, for the checkpoint."""

    weights: dict[str, Tensor]
    origin: dict[str, str]

    @classmethod
    def of(cls, source: Path | str, say: Callable[[str], object]) -> "Pretrained | None":
        """Read a file of weights, or take IMAGENET's; None, and a sentence, if those cannot be had.

        source: IMAGENET, or a .pth that torchvision's resnet18 can load; its classifier is left out. Raises
        TrainingError for a file that is none.
        """
        if str(source) != IMAGENET:
            return cls._read(Path(source))
        weights = torchvision.models.ResNet18_Weights.IMAGENET1K_V1
        before_s = socket.getdefaulttimeout()
        socket.setdefaulttimeout(CONNECTS_S)
        try:
            content = weights.get_state_dict(progress=False, check_hash=True)
        except (OSError, RuntimeError) as error:  # no internet, or another file than expected
            say(f"the backbone begins with random weights: ImageNet's cannot be fetched ({error})")
            return None
        finally:
            socket.setdefaulttimeout(before_s)
        return cls(_of_backbone(content, weights.url), {"backbone": str(weights)})

    @classmethod
    def _read(cls, file: Path) -> "Pretrained":
        try:
            content = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # whatever another file makes torch say
            problem = f"{file}: not a file of weights that torch can read"
            raise TrainingError(problem, found=type(error).__name__, remedy="save resnet18's state_dict()") from error
        return cls(_of_backbone(content, str(file)), {"backbone": file.name, "backbone_sha256": sha256_of(file)})


def _of_backbone(content: Any, where: str) -> dict[str, Tensor]:
    """Return the weights below the classifier. Raises TrainingError if they are not ResNet18's."""
    expected = live_backbone(None).state_dict()
    entries = content if isinstance(content, dict) else {}
    for name, own in expected.items():
        value = entries.get(name)
        if not isinstance(value, Tensor) or value.shape != own.shape:
            actual = list(value.shape) if isinstance(value, Tensor) else sorted(map(str, entries))[:3] or None
            problem = f"{where}: not ResNet18's weights: {name} is missing or differs"
            raise TrainingError(problem, found=actual, remedy="save the state_dict() of torchvision's resnet18")
        if not torch.isfinite(value).all():
            raise TrainingError(f"{where}: {name} has values that are not finite", remedy="take another file")
    return {name: entries[name] for name in expected}


def live_backbone(pretrained: Pretrained | None) -> nn.Module:
    """Return ResNet18 up to its last stage, with live batch norm: (B, 3, H, W) -> {"feature_map": (B, 512, h, w)}."""
    resnet = torchvision.models.resnet18(weights=None)
    if pretrained:
        resnet.load_state_dict(pretrained.weights, strict=False)
    return torchvision.models._utils.IntermediateLayerGetter(resnet, {"layer4": "feature_map"})


class PlanFromFeatures(nn.Module):
    """The backbone with a head for some steps of the plan. mean, spread: (A,) of the actions to learn from."""

    def __init__(self, backbone: nn.Module, mean: np.ndarray, spread: np.ndarray, chunk: int):
        super().__init__()
        self.backbone = backbone
        self.steps = np.unique(np.linspace(0, chunk - 1, PLAN_STEPS).round().astype(int))
        self.last = nn.Linear(FEATURES, len(self.steps) * len(mean))
        self.register_buffer("mean", torch.from_numpy(mean))
        self.register_buffer("spread", torch.from_numpy(spread))

    mean: Tensor
    spread: Tensor

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, len(steps), A), in the actions' units."""
        features = self.backbone(image)["feature_map"].mean((2, 3))
        return self.last(features).unflatten(1, (len(self.steps), len(self.mean))) * self.spread + self.mean


def measure_statistics(backbone: nn.Module) -> None:
    """Let the batch norms begin anew, and take the plain mean over the batches that follow."""
    for norm in backbone.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.reset_running_stats()
            norm.momentum = None
