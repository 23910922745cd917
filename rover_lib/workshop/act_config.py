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
    return [f"backbone.layer{stage}.{block}" for stage, depth in enumerate(depths, 1) for block in range(depth)]


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


def weight_shapes(c: ActConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of LeRobot's ACT, without the seconds that importing it takes.

    By name without the leading `model.`. Raises AssertionError for a width that the heads do not divide.
    """
    _, _, features = BACKBONES[c.backbone]
    shapes = _backbone_shapes(c.backbone)
    shapes |= {
        "encoder_1d_feature_pos_embed.weight": (1 + c.sees_state, c.dim),
        "decoder_pos_embed.weight": (c.chunk, c.dim),
    }
    linears = {
        "encoder_latent_input_proj": (c.dim, c.latent),
        "encoder_img_feat_input_proj": (c.dim, features, 1, 1),
        "action_head": (len(c.action_names), c.dim),
    }
    layers = {"encoder": c.encoder_layers, "decoder": c.decoder_layers}
    if c.vae_layers:
        shapes |= {
            "vae_encoder_cls_embed.weight": (1, c.dim),
            "vae_encoder_pos_enc": (1, 1 + c.sees_state + c.chunk, c.dim),
        }
        linears["vae_encoder_action_input_proj"] = (c.dim, len(c.action_names))
        linears["vae_encoder_latent_output_proj"] = (2 * c.latent, c.dim)
        layers["vae_encoder"] = c.vae_layers
    if c.sees_state:
        for part in layers.keys() - {"decoder"}:
            linears[f"{part}_robot_state_input_proj"] = (c.dim, len(c.state_names))
    for name, shape in linears.items():
        shapes |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    for part, count in layers.items():
        kind = nn.TransformerDecoderLayer if part == "decoder" else nn.TransformerEncoderLayer
        layer = kind(c.dim, c.heads, c.feedforward, device="meta").state_dict()
        for i in range(count):
            shapes |= {f"{part}.layers.{i}.{name}": tuple(weight.shape) for name, weight in layer.items()}
        if part == "decoder" or c.pre_norm:
            shapes |= {f"{part}.norm.weight": (c.dim,), f"{part}.norm.bias": (c.dim,)}
    return shapes


def _backbone_shapes(backbone: str) -> dict[str, tuple[int, ...]]:
    kernels = (3, 3) if BACKBONES[backbone][0] == "basic" else (1, 3, 1)
    wider = 1 if len(kernels) == 2 else 4  # what leaves a block, in widths of its inner convolutions
    convolutions = {("conv1", "bn1"): (64, 3, 7, 7)}
    inputs = 64
    for place in backbone_blocks(backbone):
        block = place.removeprefix("backbone.")
        width = 32 * 2 ** int(block[len("layer")])
        channels = [inputs, *(width for _ in kernels[1:]), width * wider]
        for i, kernel in enumerate(kernels):
            shape = (channels[i + 1], channels[i], kernel, kernel)
            convolutions[f"{block}.conv{i + 1}", f"{block}.bn{i + 1}"] = shape
        if inputs != channels[-1]:
            convolutions[f"{block}.downsample.0", f"{block}.downsample.1"] = (channels[-1], inputs, 1, 1)
        inputs = channels[-1]
    shapes: dict[str, tuple[int, ...]] = {}
    for (convolution, norm), shape in convolutions.items():
        shapes[f"backbone.{convolution}.weight"] = shape
        shapes |= {f"backbone.{norm}.{name}": shape[:1] for name in ("weight", "bias", "running_mean", "running_var")}
    return shapes


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
