"""The shape of one ACT policy, and LeRobot's own policy of that shape."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

# (block, convolutions per block, blocks per stage, channels out of layer4), from torchvision.models.resnet
BACKBONES = {
    "resnet18": ("basic", (2, 2, 2, 2), 512),
    "resnet34": ("basic", (3, 4, 6, 3), 512),
    "resnet50": ("bottleneck", (3, 4, 6, 3), 2048),
}
ACTIVATIONS = {"relu": nn.ReLU, "gelu": nn.GELU}
LEROBOTS = {  # fields of ActConfig by which LeRobot means the same, and its names of them
    "dim": "dim_model", "heads": "n_heads", "feedforward": "dim_feedforward", "encoder_layers": "n_encoder_layers",
    "decoder_layers": "n_decoder_layers", "latent": "latent_dim", "pre_norm": "pre_norm",
    "activation": "feedforward_activation",
}  # fmt: skip


def backbone_blocks(backbone: str) -> list[str]:
    """Return LeRobot's names of a backbone's residual blocks, in the order in which data passes them."""
    _, depths, _ = BACKBONES[backbone]
    names = []
    for stage, depth in enumerate(depths, 1):
        names += [f"backbone.layer{stage}.{block}" for block in range(depth)]
    return names


@dataclass(frozen=True)
class Affine:
    """x * scale + shift, per channel. All of LeRobot's normalisation modes have this form."""

    scale: tuple[float, ...]
    shift: tuple[float, ...]


def imagenet() -> Affine:
    """Return the normalisation of pixels in [0, 1] that torchvision's weights were trained with."""
    shift = tuple(-m / s for m, s in zip(IMAGENET_MEAN, IMAGENET_STD, strict=True))
    return Affine(tuple(1 / s for s in IMAGENET_STD), shift)


@dataclass(frozen=True)
class ActConfig:
    """The shape of one policy. `checkpoint` makes it, and checks it against the weights."""

    cameras: tuple[str, ...] = ("cam_front",)
    image_sizes: tuple[tuple[int, int], ...] = ((360, 640),)  # (height, width), one per camera
    state_names: tuple[str, ...] = ("steering", "throttle")
    action_names: tuple[str, ...] = ("steering", "throttle")
    chunk: int = 32
    dim: int = 512
    heads: int = 8
    feedforward: int = 3200
    encoder_layers: int = 4
    decoder_layers: int = 7
    latent: int = 32
    vae_layers: int = 4  # 0 if it was trained without a VAE
    backbone: str = "resnet18"
    dilation: bool = False
    pre_norm: bool = False
    activation: str = "relu"
    rate_hz: float = 30.0  # steps of a plan in a second
    image_norm: tuple[Affine, ...] = field(default_factory=lambda: (imagenet(),))  # of pixels in [0, 1]
    state_norm: Affine | None = None
    sees_state: bool = True  # False: it was trained without a state; what is given as one is not looked at
    action_unnorm: Affine | None = None

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return (h, w) of the feature map for a picture of this size."""
        stride = 16 if self.dilation else 32
        return -(-height // stride), -(-width // stride)


def check_shapes(c: ActConfig, weights: Mapping[str, Tensor]) -> None:
    """Raise LeRobot's own error, RuntimeError mostly, unless its ACT of this config has just these weights.

    It is imported where shapes differ, or where the backbone is dilated, as not each may be: that takes seconds.
    """
    shapes = {name: tuple(weight.shape) for name, weight in weights.items()}
    if c.dilation or shapes != weight_shapes(c):
        lerobot_act(c, {}).model.load_state_dict(dict(weights), assign=True)


def weight_shapes(c: ActConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of LeRobot's ACT, by name without the leading `model.`."""
    _, _, features = BACKBONES[c.backbone]
    with torch.device("meta"):
        parts = _backbone_parts(c.backbone) | {
            "encoder": _encoder(c, c.encoder_layers),
            "decoder": nn.TransformerDecoder(
                nn.TransformerDecoderLayer(c.dim, c.heads, c.feedforward), c.decoder_layers, nn.LayerNorm(c.dim)
            ),
            "encoder_latent_input_proj": nn.Linear(c.latent, c.dim),
            "encoder_img_feat_input_proj": nn.Conv2d(features, c.dim, 1),
            "encoder_1d_feature_pos_embed": nn.Embedding(1 + c.sees_state, c.dim),
            "decoder_pos_embed": nn.Embedding(c.chunk, c.dim),
            "action_head": nn.Linear(c.dim, len(c.action_names)),
        }
        if c.vae_layers:
            parts |= {
                "vae_encoder": _encoder(c, c.vae_layers),
                "vae_encoder_cls_embed": nn.Embedding(1, c.dim),
                "vae_encoder_action_input_proj": nn.Linear(len(c.action_names), c.dim),
                "vae_encoder_latent_output_proj": nn.Linear(c.dim, 2 * c.latent),
            }
        if c.sees_state:
            for encoder in {"encoder", "vae_encoder"} & parts.keys():
                parts[f"{encoder}_robot_state_input_proj"] = nn.Linear(len(c.state_names), c.dim)
    shapes: dict[str, tuple[int, ...]] = {}
    for part, module in parts.items():
        shapes |= {f"{part}.{name}": tuple(weight.shape) for name, weight in module.state_dict().items()}
    if c.vae_layers:
        shapes["vae_encoder_pos_enc"] = (1, 1 + c.sees_state + c.chunk, c.dim)
    # LeRobot's batch norms are frozen ones
    return {name: shape for name, shape in shapes.items() if not name.endswith("num_batches_tracked")}


def _encoder(c: ActConfig, layers: int) -> nn.Module:
    layer = nn.TransformerEncoderLayer(c.dim, c.heads, c.feedforward)
    return nn.TransformerEncoder(layer, layers, nn.LayerNorm(c.dim) if c.pre_norm else None, enable_nested_tensor=False)


def _backbone_parts(backbone: str) -> dict[str, nn.Module]:
    kernels = (3, 3) if BACKBONES[backbone][0] == "basic" else (1, 3, 1)
    parts: dict[str, nn.Module] = {
        "backbone.conv1": nn.Conv2d(3, 64, 7, bias=False),
        "backbone.bn1": nn.BatchNorm2d(64),
    }
    inputs = 64
    for block in backbone_blocks(backbone):
        width = 32 * 2 ** int(block[len("backbone.layer")])
        channels = [inputs, *(width for _ in kernels[1:]), width if len(kernels) == 2 else 4 * width]
        for i, kernel in enumerate(kernels):
            parts[f"{block}.conv{i + 1}"] = nn.Conv2d(channels[i], channels[i + 1], kernel, bias=False)
            parts[f"{block}.bn{i + 1}"] = nn.BatchNorm2d(channels[i + 1])
        if inputs != channels[-1]:
            parts[f"{block}.downsample.0"] = nn.Conv2d(inputs, channels[-1], 1, bias=False)
            parts[f"{block}.downsample.1"] = nn.BatchNorm2d(channels[-1])
        inputs = channels[-1]
    return parts


def lerobot_act(c: ActConfig, weights: Mapping[str, Tensor] | None = None) -> "ACTPolicy":
    """Make LeRobot's own ACTPolicy of this shape, without normalisation. It downloads nothing.

    weights: by LeRobot's names without the leading `model.`; copied, as float32. None: random ones. Empty: none, on
    torch's meta device.
    """
    # Imported here, because it takes seconds.
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    cameras = zip(c.cameras, c.image_sizes, strict=True)
    inputs = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *size)) for name, size in cameras}
    state = PolicyFeature(FeatureType.STATE, (len(c.state_names),))
    config = ACTConfig(
        input_features=inputs | ({"observation.state": state} if c.sees_state else {}),
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(c.action_names),))},
        device="cpu",
        chunk_size=c.chunk,
        n_action_steps=c.chunk,
        vision_backbone=c.backbone,
        pretrained_backbone_weights=None,
        replace_final_stride_with_dilation=c.dilation,
        use_vae=c.vae_layers > 0,
        n_vae_encoder_layers=max(c.vae_layers, 1),
        **{theirs: getattr(c, ours) for ours, theirs in LEROBOTS.items()},
    )
    if weights is None:
        return ACTPolicy(config)
    with torch.device("meta"):
        policy = ACTPolicy(config)
    if weights:
        policy.model.load_state_dict({name: w.to(torch.float32, copy=True) for name, w in weights.items()}, assign=True)
    return policy
