"""ACT for inference only: LeRobot's Action Chunking Transformer without what only training needs.

It computes the same function as `lerobot.policies.act` in eval mode. What depends on no observation is computed once:
batch norm is folded into convolutions, the latent's projection is a bias, positions are constants, as are the first
decoder layer's self-attention and the query that follows from it.

    frame (height, width, 3)      state (S,)                            name here, and in the checkpoint
             |                         |
      Pixels or Columns            Normalise                            image_input, state_norm
             |                         |
          Backbone                     |        latent of zeros         backbone.*
             | h x w features          |               |
         1x1 convolution             Linear          its bias           image_project: encoder_img_feat_input_proj
             |                         |               |                state_project: encoder_robot_state_input_proj
             +------- T tokens (1, T, D) --------------+                latent: encoder_latent_input_proj
                            |                                           pos: encoder_1d_feature_pos_embed, sinusoids
                  EncoderLayer, N times                                 encoder: encoder.layers
                            |
          Memory: keys and values of all decoder layers                 memory
                            |
        DecoderLayer, M times <- C queries                              decoder: decoder.layers
                            |                                           q_pos: decoder_pos_embed
               LayerNorm, Linear, Normalise                             norm, head: decoder.norm, action_head
                            |
                     chunk (1, C, A)

Letters: B batch = 1, T tokens, D model width, H heads, S state size, A actions, C chunk, h and w of the feature map.
"""

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.workshop.act_config import ACTIVATIONS, BACKBONES, ActConfig, Affine
from rover_lib.workshop.hooks import watched
from rover_lib.workshop.recordings.samples import Sample, by_camera

Projection = nn.Linear | nn.Conv2d
Pair = tuple[Tensor, Tensor]  # weight and bias
Layer = TypeVar("Layer", nn.Linear, nn.Conv2d, nn.LayerNorm)


def positions_2d(dim: int, h: int, w: int) -> Tensor:
    """Return LeRobot's 2-d sinusoidal positions of an (h, w) feature map: (h * w, dim)."""
    half = dim // 2
    frequency = 10000 ** (2 * (torch.arange(half, dtype=torch.float32) // 2) / half)

    def axis(n: int) -> Tensor:  # (n, half), in LeRobot's order of operations, to the last bit
        p = torch.arange(1, n + 1, dtype=torch.float32)
        p = (p / (p[-1:] + 1e-6) * (2 * math.pi))[:, None] / frequency
        return torch.stack((p[:, 0::2].sin(), p[:, 1::2].cos()), -1).flatten(1)

    y = axis(h)[:, None].expand(h, w, half)
    x = axis(w)[None].expand(h, w, half)
    return torch.cat((y, x), -1).reshape(h * w, dim)


class Weights:
    """The tensors of a checkpoint whose names begin with one prefix, as float32."""

    def __init__(self, tensors: dict[str, Tensor], prefix: str = ""):
        self.tensors = tensors
        self.prefix = prefix

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[self.prefix + name].float()

    def __contains__(self, name: str) -> bool:
        return any(k.startswith(self.prefix + name) for k in self.tensors)

    def at(self, name: str) -> "Weights":
        return Weights(self.tensors, f"{self.prefix}{name}.")


def _load(module: Layer, weight: Tensor, bias: Tensor) -> Layer:
    module.weight = nn.Parameter(weight.clone(), requires_grad=False)
    module.bias = nn.Parameter(bias.clone(), requires_grad=False)
    return module


def linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    """Return a linear layer with this weight, (outputs, inputs), and bias."""
    return _load(nn.Linear(weight.shape[1], weight.shape[0], device="meta"), weight, bias)


def layer_norm(w: Weights) -> nn.LayerNorm:
    """Return the layer norm of a checkpoint."""
    return _load(nn.LayerNorm(w["weight"].shape[0], device="meta"), w["weight"], w["bias"])


def conv(weight: Tensor, bias: Tensor, stride: Any, padding: int, dilation: int = 1) -> nn.Conv2d:
    """Return a convolution with this weight, (outputs, inputs, height, width), and bias."""
    outputs, inputs, height, width = weight.shape
    size = height, width
    return _load(nn.Conv2d(inputs, outputs, size, stride, padding, dilation, device="meta"), weight, bias)


def norm_gain(bn: Weights) -> Tensor:
    """Return the factor by which a frozen batch norm multiplies each channel, (channels,)."""
    return bn["weight"] * (bn["running_var"] + 1e-5).rsqrt()  # eps of torchvision's FrozenBatchNorm2d


def fold(w: Weights, bn: Weights) -> Pair:
    """Return the weight and bias of a convolution and the frozen batch norm behind it, merged."""
    gain = norm_gain(bn)
    return w["weight"] * gain[:, None, None, None], bn["bias"] - bn["running_mean"] * gain


def fold_block(w: Weights, kind: str) -> list[Pair]:
    """Return weight and bias of a ResNet block's convolutions, without the channels inside it that are always zero."""
    pairs = [fold(w.at(f"conv{i}"), w.at(f"bn{i}")) for i in range(1, (2 if kind == "basic" else 3) + 1)]
    for i, (weight, bias) in enumerate(pairs[:-1]):
        alive = (weight != 0).flatten(1).any(1) | (bias > 0)
        alive[0] |= not alive.any()  # a convolution needs at least one channel
        if not alive.all():
            reader, reader_bias = pairs[i + 1]
            pairs[i : i + 2] = [(weight[alive], bias[alive]), (reader[:, alive], reader_bias)]
    return pairs


class Pixels(nn.Module):
    """Turns a frame, (height, width, 3) uint8 RGB, into the stem's float input: (1, 3, height, width), normalised."""

    def __init__(self, norm: Affine):
        super().__init__()
        self.norm = Normalise(Affine(tuple(s / 255 for s in norm.scale), norm.shift), (1, 3, 1, 1))

    def forward(self, frame: Tensor) -> Tensor:
        return self.norm(frame.permute(2, 0, 1)[None].float())  # channels-last in memory


class Columns(nn.Module):
    """Turns a frame, (height, width, 3) uint8 RGB, into the INT8 input of a stem over columns: the pixels themselves.

    The result has, for each second pixel, the 8 pixels around it in its row: (1, 24, rows, width / 2), padded with the
    colour that normalises to zero. The stem's 7x7 convolution over 3 channels becomes a 7x1 convolution over these 24
    (`of_columns`), with half the instructions. Normalisation is in its weights, so a pixel is its own quantized value.
    """

    WINDOW = 8  # pixels: the kernel's 7, and one with weight 0 that fills the kernel's lanes

    def __init__(self, norm: Affine, height: int, width: int):
        super().__init__()
        self.scale, self.zero_pixel = column_scale(norm)
        self.quantized = False  # the output; else it is float
        self.out_width = (width - 1) // 2 + 1
        self.rows = 2 * ((height - 1) // 2) + 7
        self.pitch = 2 * (self.out_width - 1) + self.WINDOW  # padded pixels in a row
        colour = torch.tensor(zero_colour(norm)).round().to(torch.uint8)
        self.left = nn.Buffer(colour.repeat(height, 3))
        self.right = nn.Buffer(colour.repeat(height, self.pitch - width - 3))
        self.top = nn.Buffer(colour.repeat(3, self.pitch))
        self.bottom = nn.Buffer(colour.repeat(self.rows - height - 3, self.pitch))

    def forward(self, frame: Tensor) -> Tensor:
        x = torch.cat([self.left, frame.flatten(1), self.right], 1)
        x = torch.cat([self.top, x, self.bottom], 0)
        if self.quantized:
            x = torch.bitwise_xor(x, 128).to(torch.int8)  # pixel - 128: the conversion keeps the bits
        shape = (self.rows, self.out_width, 3 * self.WINDOW)
        strides = (3 * self.pitch, 6, 1)
        x = x.as_strided(shape, strides).contiguous()
        if self.quantized:
            x = torch._make_per_tensor_quantized_tensor(x, self.scale, self.zero_pixel - 128)
        else:
            x = (x.float() - self.zero_pixel) * self.scale
        return x.permute(2, 0, 1)[None]  # channels-last in memory


def zero_colour(norm: Affine) -> tuple[float, ...]:
    """Return the pixel, 0..255 per channel, that normalises to zero. The stem pads with it."""
    return tuple(-255 * shift / scale for scale, shift in zip(norm.scale, norm.shift, strict=True))


def column_scale(norm: Affine) -> tuple[float, int]:
    """Return (scale, zero pixel) of columns: the mean of the channels' normalisation. The rest is in `of_columns`."""
    return sum(norm.scale) / len(norm.scale) / 255, round(sum(zero_colour(norm)) / len(norm.scale))


def of_columns(weight: Tensor, bias: Tensor, norm: Affine) -> Pair:
    """Return the weight and bias of the stem's convolution over `Columns`, from those over normalised pixels."""
    scale, zero_pixel = column_scale(norm)
    pixel_scale = torch.tensor(norm.scale) / 255
    offset = pixel_scale * zero_pixel + torch.tensor(norm.shift)
    of_pixels = weight * (pixel_scale / scale).to(weight.device)[None, :, None, None]  # (out, 3, 7, 7)
    windows = F.pad(of_pixels.permute(0, 2, 3, 1), (0, 0, 0, 1)).flatten(2)  # (out, 7, 24): as pixels lie in a row
    return windows.transpose(1, 2)[..., None], bias + (weight.sum((2, 3)) * offset.to(weight.device)).sum(1)


def fits_columns(config: ActConfig) -> bool:
    """Whether frames can be columns: all cameras have one normalisation, and there is a colour that becomes zero."""
    norm = config.image_norm[0]
    return all(n == norm for n in config.image_norm) and all(-0.5 < c < 255.5 for c in zero_colour(norm))


class Residual(nn.Module):
    """One ResNet block: two (basic) or three (bottleneck) convolutions beside a shortcut."""

    def __init__(self, w: Weights, kind: str, stride: int, dilation: int):
        super().__init__()
        plans = {  # stride, padding and dilation of each convolution
            "basic": [(stride, 1, 1), (1, 1, 1)],
            "bottleneck": [(1, 0, 1), (stride, dilation, dilation), (1, 0, 1)],
        }
        layers: list[nn.Module] = []
        for (weight, bias), geometry in zip(fold_block(w, kind), plans[kind], strict=True):
            layers += [conv(weight, bias, *geometry), nn.ReLU()]
        self.body = nn.Sequential(*layers[:-1])
        down = w.at("downsample")
        self.shortcut = conv(*fold(down.at("0"), down.at("1")), stride, 0) if "downsample" in w else nn.Identity()
        self.relu = nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        return self.relu(self.body(x) + self.shortcut(x))


class Backbone(nn.Module):
    """ResNet up to its last feature map: (1, channels, h, w) from what Pixels or Columns make of a frame."""

    def __init__(self, w: Weights, config: ActConfig, columns: bool):
        super().__init__()
        kind, depths, _ = BACKBONES[config.backbone]
        folded = fold(w.at("conv1"), w.at("bn1"))
        stem = conv(*of_columns(*folded, config.image_norm[0]), (2, 1), 0) if columns else conv(*folded, 2, 3)
        self.stem = nn.Sequential(stem, nn.ReLU(), nn.MaxPool2d(3, 2, 1))

        def stage(i: int) -> nn.Sequential:
            # torchvision's replace_stride_with_dilation: in the last stage all blocks but the first dilate
            dilated = config.dilation and i == 4
            stride = 1 if i == 1 or dilated else 2
            dilation = 2 if dilated else 1
            geometry = [(stride, 1), *[(1, dilation)] * (depths[i - 1] - 1)]
            return nn.Sequential(*(Residual(w.at(f"layer{i}.{j}"), kind, *g) for j, g in enumerate(geometry)))

        self.layer1, self.layer2, self.layer3, self.layer4 = map(stage, (1, 2, 3, 4))

    def forward(self, x: Tensor) -> Tensor:
        return self.layer4(self.layer3(self.layer2(self.layer1(self.stem(x)))))


class Pointwise(nn.Module):
    """A module with token projections, which are linears over (1, T, D) or 1x1 convolutions over (1, D, 1, T).

    XNNPACK runs the same GEMM, but only a convolution may have a weight scale per channel with qint8 activations.
    """

    def __init__(self, as_conv: bool):
        super().__init__()
        self.as_conv = as_conv

    def project(self, weight: Tensor, bias: Tensor) -> Projection:
        return conv(weight[:, :, None, None], bias, 1, 0) if self.as_conv else linear(weight, bias)

    def enter(self, x: Tensor) -> Tensor:
        return x.transpose(1, 2).unsqueeze(2) if self.as_conv else x

    def leave(self, x: Tensor) -> Tensor:
        return x.squeeze(2).transpose(1, 2) if self.as_conv else x


class Attention(Pointwise):
    """Multi-head attention added to the residual stream.

    Channel scales (buffers, None until they are set) cancel exactly: q_in, k_in and v_in multiply the inputs, q_out,
    v_out and o_out the outputs. The scale of the keys' output is merged into q_out, and that of the output projection's
    input into v_out. In cross-attention `Memory` has applied k_in and v_in already, once for all layers.
    """

    def __init__(self, w: Weights, config: ActConfig, as_conv: bool, *, cross: bool = False):
        super().__init__(as_conv)
        self.heads = config.heads
        self.cross = cross
        inputs = zip(w["in_proj_weight"].split(config.dim), w["in_proj_bias"].split(config.dim), strict=True)
        self.q, self.k, self.v = (self.project(weight, bias) for weight, bias in inputs)
        self.o = self.project(w["out_proj.weight"], w["out_proj.bias"])
        for name in ("constant_q", "q_in", "k_in", "v_in", "q_out", "v_out", "o_out"):
            self.register_buffer(name, None)

    def fix_query(self, query: Tensor) -> None:
        """Replace the query's projection by a constant. query: (1, T, D), the same for every observation."""
        self.constant_q = self.leave(self.q(self.enter(query)))
        del self.q

    def forward(self, residual: Tensor, query: Tensor | None, key: Tensor, value: Tensor) -> Tensor:
        """residual, query: (1, T, D); key, value: (1, M, D), or from `Memory`. Returns residual + attention."""
        k = key if self.cross else self.enter(_times(key, self.k_in))
        v = value if self.cross else self.enter(_times(value, self.v_in))
        if self.constant_q is not None:
            q = self.constant_q
        else:
            assert query is not None
            # In self-attention query and key are one tensor, so Q and K share one scale and one quantized input.
            q = k if query is key else self.enter(_times(query, self.q_in))
            q = _times(self.leave(self.q(q)), self.q_out)
        k = self.leave(self.k(k))
        v = _times(self.leave(self.v(v)), self.v_out)
        q, k, v = (t.unflatten(2, (self.heads, -1)).transpose(1, 2) for t in (q, k, v))  # (1, H, T, D / H)
        y = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return _plus_scaled(residual, self.leave(self.o(self.enter(y))), self.o_out)


class Memory(Pointwise):
    """Turns the encoder's output, (1, T, D), into the inputs of keys and values, shared by all cross-attentions."""

    def __init__(self, as_conv: bool):
        super().__init__(as_conv)
        for name in ("k_in", "v_in"):  # channel scales, as in Attention
            self.register_buffer(name, None)

    def forward(self, memory: Tensor, pos: Tensor) -> tuple[Tensor, Tensor]:
        return self.enter(_times(memory + pos, self.k_in)), self.enter(_times(memory, self.v_in))


class FeedForward(Pointwise):
    """Two projections with an activation between, added to the residual stream. Scales as in Attention."""

    def __init__(self, w: Weights, config: ActConfig, as_conv: bool):
        super().__init__(as_conv)
        self.up = self.project(w["linear1.weight"], w["linear1.bias"])
        self.act = ACTIVATIONS[config.activation]()
        self.down = self.project(w["linear2.weight"], w["linear2.bias"])
        for name in ("up_in", "down_in", "down_out"):
            self.register_buffer(name, None)

    def forward(self, residual: Tensor, x: Tensor) -> Tensor:
        h = self.act(self.up(self.enter(_times(x, self.up_in))))
        if self.down_in is not None:  # only if a scale cannot be moved through the activation, as it can through ReLU
            h = self.enter(_times(self.leave(h), self.down_in))
        return _plus_scaled(residual, self.leave(self.down(h)), self.down_out)


def _times(x: Tensor, scale: Any) -> Tensor:  # an optional buffer, as below: mypy takes it for a Module
    return x if scale is None else x * scale


def _plus_scaled(x: Tensor, y: Tensor, scale: Any) -> Tensor:
    return x + y if scale is None else torch.addcmul(x, y, scale)


class EncoderLayer(nn.Module):
    """LeRobot's ACTEncoderLayer."""

    def __init__(self, w: Weights, config: ActConfig, as_conv: bool):
        super().__init__()
        self.pre_norm = config.pre_norm
        self.attention = Attention(w.at("self_attn"), config, as_conv)
        self.feed_forward = FeedForward(w, config, as_conv)
        self.norm1, self.norm2 = (layer_norm(w.at(f"norm{i}")) for i in (1, 2))

    def forward(self, x: Tensor, pos: Tensor) -> Tensor:  # (1, T, D) each
        if self.pre_norm:
            y = self.norm1(x)
            y_pos = y + pos
            x = self.attention(x, y_pos, y_pos, y)
            return self.feed_forward(x, self.norm2(x))
        x_pos = x + pos
        x = self.norm1(self.attention(x, x_pos, x_pos, x))
        return self.norm2(self.feed_forward(x, x))


class DecoderLayer(nn.Module):
    """Self-attention, cross-attention and feed-forward. The first layer's self-attention, on zeros, is a constant."""

    def __init__(self, w: Weights, config: ActConfig, as_conv: bool, q_pos: Tensor, first: bool):
        super().__init__()
        self.pre_norm = config.pre_norm
        self.first = first
        self.norm1, self.norm2, self.norm3 = (layer_norm(w.at(f"norm{i}")) for i in (1, 2, 3))
        self.attention = Attention(w.at("self_attn"), config, as_conv)
        self.cross_attention = Attention(w.at("multihead_attn"), config, as_conv, cross=True)
        self.feed_forward = FeedForward(w, config, as_conv)
        if first:
            with torch.no_grad():
                self.start = nn.Buffer(self._self_attend(torch.zeros_like(q_pos), q_pos))
                self.cross_attention.fix_query((self.norm2(self.start) if self.pre_norm else self.start) + q_pos)
            del self.attention, self.norm1

    def _self_attend(self, x: Tensor, q_pos: Tensor) -> Tensor:
        y = self.norm1(x) if self.pre_norm else x
        y_pos = y + q_pos
        x = self.attention(x, y_pos, y_pos, y)
        return x if self.pre_norm else self.norm1(x)

    def forward(self, x: Tensor | None, q_pos: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """x, q_pos: (1, C, D); x is None for the first layer. key, value: from `Memory`. Returns (1, C, D)."""
        x = self.start if x is None else self._self_attend(x, q_pos)
        y = self.norm2(x) if self.pre_norm else x
        x = self.cross_attention(x, None if self.first else y + q_pos, key, value)
        if self.pre_norm:
            return self.feed_forward(x, self.norm3(x))
        x = self.norm2(x)
        return self.norm3(self.feed_forward(x, x))


class Normalise(nn.Module):
    """Computes x * scale + shift with constants in the graph, or returns x if there is no normalisation."""

    def __init__(self, affine: Affine | None, shape: tuple[int, ...]):
        super().__init__()
        self.acts = affine is not None
        if affine is not None:
            self.scale = nn.Buffer(torch.tensor(affine.scale, dtype=torch.float32).reshape(shape))
            self.shift = nn.Buffer(torch.tensor(affine.shift, dtype=torch.float32).reshape(shape))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale + self.shift if self.acts else x


class ACT(nn.Module):
    """The policy, for one observation at a time.

    weights: by LeRobot's names without the leading `model.`. for_int8: as static INT8 needs it, with token projections
    as 1x1 convolutions, and frames as Columns if their normalisation allows it.
    forward(raw state (1, S) float32, *frames (height, width, 3) uint8 RGB, one per camera) -> raw actions (1, C, A).
    """

    def __init__(self, config: ActConfig, weights: dict[str, Tensor], *, for_int8: bool = False):
        super().__init__()
        self.config = config
        w = Weights(weights)
        columns = for_int8 and fits_columns(config)
        cameras = zip(config.image_norm, config.image_sizes, strict=True)
        self.image_input = nn.ModuleList(Columns(norm, *size) if columns else Pixels(norm) for norm, size in cameras)
        self.state_norm = Normalise(config.state_norm, (1, -1))
        self.action_unnorm = Normalise(config.action_unnorm, (1, 1, -1))
        self.backbone = Backbone(w.at("backbone"), config, columns)
        project = w.at("encoder_img_feat_input_proj")
        self.image_project = conv(project["weight"], project["bias"], 1, 0)
        self.sees_state = config.sees_state
        if config.sees_state:
            state = w.at("encoder_robot_state_input_proj")
            self.state_project = linear(state["weight"], state["bias"])
        self.latent = nn.Buffer(w["encoder_latent_input_proj.bias"][None, None])
        pos = [w["encoder_1d_feature_pos_embed.weight"]]
        pos += [positions_2d(config.dim, *config.grid(*size)) for size in config.image_sizes]
        self.pos = nn.Buffer(torch.cat(pos)[None])  # (1, T, D)
        self.q_pos = nn.Buffer(w["decoder_pos_embed.weight"][None])  # (1, C, D)
        self.encoder = nn.ModuleList(
            EncoderLayer(w.at(f"encoder.layers.{i}"), config, for_int8) for i in range(config.encoder_layers)
        )
        self.encoder_norm = layer_norm(w.at("encoder.norm")) if config.pre_norm else nn.Identity()
        self.memory = Memory(for_int8)
        self.decoder = nn.ModuleList(
            DecoderLayer(w.at(f"decoder.layers.{i}"), config, for_int8, self.q_pos, first=i == 0)
            for i in range(config.decoder_layers)
        )
        self.norm = layer_norm(w.at("decoder.norm"))
        self.head = linear(w["action_head.weight"], w["action_head.bias"])
        self.eval().requires_grad_(False)

    def forward(self, state: Tensor, *frames: Tensor) -> Tensor:
        tokens: list[Tensor] = [self.latent]
        if self.sees_state:
            tokens.append(self.state_project(self.state_norm(state))[:, None])
        for i, image_input in enumerate(self.image_input):  # frames by index, because FX cannot trace an iteration
            x = self.image_project(self.backbone(image_input(frames[i])))  # (1, D, h, w)
            tokens.append(x.flatten(2).transpose(1, 2))  # (1, h * w, D)
        return self.action_unnorm(transform(self, torch.cat(tokens, 1)))


def transform(parts: Any, x: Tensor) -> Tensor:
    """Run the transformer of an ACT, or of what has its parts: tokens (1, T, D) -> actions (1, C, A), normalised."""
    for layer in parts.encoder:
        x = layer(x, parts.pos)
    key, value = parts.memory(parts.encoder_norm(x), parts.pos)
    y = None
    for layer in parts.decoder:
        y = layer(y, parts.q_pos, key, value)
    return parts.head(parts.norm(y))


def blocks(config: ActConfig) -> list[str]:
    """Return the names of the parts that are INT8 or float as a whole, in the order in which data passes them."""
    names = ["backbone.stem", *(f"backbone.layer{i}" for i in (1, 2, 3, 4)), "image_project"]
    for i in range(config.encoder_layers):
        names += [f"encoder.{i}.attention", f"encoder.{i}.feed_forward"]
    for i in range(config.decoder_layers):
        names += [f"decoder.{i}.{part}" for part in ("attention", "cross_attention", "feed_forward")[i == 0 :]]
    return names


def block_of(module_name: str) -> str:
    """Return the block that a module belongs to, or its own name if it stays float (head, state_project)."""
    parts = module_name.split(".")
    return ".".join(parts[: {"backbone": 2, "encoder": 3, "decoder": 3}.get(parts[0], 1)])


def multiply_accumulates(model: ACT) -> dict[str, int]:
    """Count the multiply-accumulates of one inference by block. Attention's two products count for its block."""
    counts: Counter[str] = Counter()

    def watch(name: str, module: nn.Module, inputs: tuple, output: Tensor) -> None:
        if isinstance(module, Attention):
            residual, _, key, _ = inputs
            counts[block_of(name)] += 2 * residual.shape[1] * key.numel()  # queries x tokens x width
        elif isinstance(module, Projection):
            counts[block_of(name)] += output.numel() * module.weight[0].numel()

    with watched(dict(model.named_modules()), watch), torch.inference_mode():
        model(*example_inputs(model.config))
    return dict(counts)


def example_inputs(config: ActConfig) -> tuple[Tensor, ...]:
    """Return an observation of the right shapes: a state of zeros and grey frames."""
    frames = (torch.full((h, w, 3), 128, dtype=torch.uint8) for h, w in config.image_sizes)
    return torch.zeros(1, len(config.state_names)), *frames


def inputs_of(sample: Sample, config: ActConfig) -> tuple[Tensor, ...]:
    """Return a sample as the graph's inputs: state (1, S) float32, then (height, width, 3) uint8 RGB of each camera."""
    frames = by_camera(sample.frame_bgr(), config.cameras[0])
    prepared = (prepare_frame(frames[n], *size) for n, size in zip(config.cameras, config.image_sizes, strict=True))
    state = torch.from_numpy(np.asarray(sample.state, np.float32))[None]
    return state, *map(torch.from_numpy, prepared)


@torch.inference_mode()
def predictions(module: nn.Module, inputs: Iterable[tuple[Tensor, ...]]) -> Tensor:
    """Return the raw, unclipped actions for n inputs, (n, C, A)."""
    return torch.cat([module(*x) for x in inputs])
