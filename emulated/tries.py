"""Runs inside the emulated Pi: single operations of the full policy, in the ways that were tried, each counted.

    tries.py FOLDER

Each is called three times; the third is between marks, section i for the i-th of TRIES. Leaves `maps` in FOLDER. The
workstation's side, which imports TRIES for the names, is rover_lib/workshop/tries.py.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import torch
import torch.ao.nn.quantized as int8
import torch.nn.functional as F
from torch import Tensor

HEIGHT, WIDTH = 360, 640
TOKENS, DIM, HEADS = 242, 512, 8

Op = Callable[[], Tensor]


def frame_as(channels: int, kernel: tuple[int, int], stride: tuple[int, int], rows: int) -> Op:
    """The first convolution over a frame of (rows, 320, channels), 64 channels and 180x320 positions out."""
    weight = torch.quantize_per_channel(
        torch.randn(64, channels, *kernel) * 0.05,
        torch.full((64,), 0.01),
        torch.zeros(64, dtype=torch.long),
        0,
        torch.qint8,
    )
    conv = int8.Conv2d(channels, 64, kernel, stride, padding=(3, 3) if channels == 3 else 0)
    conv.set_weight_bias(weight, torch.randn(64))
    conv.scale, conv.zero_point = 0.2, -128
    pixels = torch.randint(-128, 128, (rows, WIDTH if channels == 3 else WIDTH // 2, channels), dtype=torch.int8)
    x = torch._make_per_tensor_quantized_tensor(pixels, 0.017, -14).permute(2, 0, 1)[None]
    return lambda: conv(x)


def windows(rows: int, taps: int, step: int) -> Op:
    """Copying a padded frame so that the window of each position lies together: 24 bytes, or 24 for each of 7 rows."""
    pitch = 3 * (WIDTH + 6)
    padded = torch.zeros(HEIGHT + 6, pitch, dtype=torch.int8)
    shape, strides = (rows, WIDTH // 2, taps, 24), (step * pitch, 6, pitch, 1)
    return lambda: padded.as_strided(shape, strides).contiguous()


def attention(how: str) -> Op:
    """One encoder attention, from Q, K and V in INT8 to the output projection's INT8 input."""
    projected = torch.randn(3, 1, TOKENS, DIM).transpose(2, 3).unsqueeze(3)
    q, k, v = (torch.quantize_per_tensor(x, 0.04, 0, torch.qint8) for x in projected)
    q_out, v_out = torch.rand(DIM) + 0.5, torch.rand(DIM) + 0.5

    def tokens(x: Tensor) -> Tensor:
        return x.squeeze(2).transpose(1, 2)

    def heads(x: Tensor) -> Tensor:
        return x.unflatten(2, (HEADS, -1)).transpose(1, 2)

    def quantized(x: Tensor) -> Tensor:
        return torch.quantize_per_tensor(x.flatten(2).transpose(1, 2).unsqueeze(2), 0.01, 0, torch.qint8)

    def grouped(x: Tensor, weight: Tensor, scale: float) -> Tensor:
        """A product with an operand that is known only now, as a convolution whose weights are packed now."""
        packed = torch.ops.quantized.conv2d_prepack(weight, None, [1, 1], [0, 0], [1, 1], HEADS)
        return torch.ops.quantized.conv2d(x, packed, scale, 0)

    def scores() -> Tensor:  # (1, T, H, T)
        by_head = tokens(k)[0].reshape(TOKENS, HEADS, -1).permute(1, 0, 2).reshape(HEADS * TOKENS, -1, 1, 1)
        return tokens(grouped(q, by_head, 0.06).dequantize()).unflatten(2, (HEADS, -1))

    def mixed(p: Tensor, scale: float) -> Tensor:
        by_head = tokens(v)[0].t().contiguous().reshape(DIM, TOKENS, 1, 1)
        return grouped(p.reshape(1, TOKENS, HEADS * TOKENS).transpose(1, 2).unsqueeze(2), by_head, scale)

    def in_float() -> Tensor:
        a, b, c = tokens(q.dequantize()) * q_out, tokens(k.dequantize()), tokens(v.dequantize()) * v_out
        return quantized(F.scaled_dot_product_attention(heads(a), heads(b), heads(c)).transpose(1, 2))

    def by_parts() -> Tensor:
        a, b, c = tokens(q.dequantize()) * q_out, tokens(k.dequantize()), tokens(v.dequantize()) * v_out
        return quantized(((heads(a) @ heads(b).transpose(2, 3)).softmax(-1) @ heads(c)).transpose(1, 2))

    def in_int8() -> Tensor:
        s = scores()
        w = (s - s.amax(-1, keepdim=True)).exp_()
        p = torch.quantize_per_tensor(w, 1 / 255, -128, torch.qint8)
        return quantized(tokens(mixed(p, 0.5).dequantize()).unflatten(2, (HEADS, -1)) / w.sum(-1, keepdim=True))

    def half() -> Tensor:
        a, b, c = (heads(tokens(x.dequantize()).to(torch.float16)) for x in (q, k, v))
        return quantized(F.scaled_dot_product_attention(a, b, c).float().transpose(1, 2))

    return {"sdpa": in_float, "parts": by_parts, "int8": in_int8, "half": half}[how]


def scaled(how: str) -> Op:
    """A channel scale on the way into a projection, or none."""
    x, scale, pos = torch.randn(1, TOKENS, DIM), torch.rand(DIM) + 0.5, torch.randn(1, TOKENS, DIM)

    def into_int8(y: Tensor) -> Tensor:
        return torch.quantize_per_tensor(y.transpose(1, 2).unsqueeze(2), 0.05, 0, torch.qint8)

    return {
        "none": lambda: into_int8(x + pos),
        "product": lambda: into_int8((x + pos) * scale),
        "addcmul": lambda: into_int8(torch.addcmul(pos, x, scale)),
    }[how]


def norm(how: str) -> Op:
    x, weight, bias = torch.randn(1, TOKENS, DIM), torch.ones(DIM), torch.zeros(DIM)
    if how == "float":
        return lambda: F.layer_norm(x, (DIM,), weight, bias)
    z = torch.quantize_per_tensor(x, 0.05, 0, torch.qint8)
    return lambda: torch.ops.quantized.layer_norm(z, (DIM,), weight, bias, 1e-5, 0.05, 0)


# (what, how, kept, made by)
TRIES = (
    ("first convolution", "7x7 over 3 channels", False, lambda: frame_as(3, (7, 7), (2, 2), HEIGHT)),
    ("first convolution", "7x1 over 24 channels", True, lambda: frame_as(24, (7, 1), (2, 1), HEIGHT + 6)),
    ("first convolution", "7x1 over 32 channels, 8 idle", False, lambda: frame_as(32, (7, 1), (2, 1), HEIGHT + 6)),
    ("first convolution", "4x1 over two rows each, an eighth idle", False, lambda: frame_as(48, (4, 1), (1, 1), 183)),
    ("first convolution", "2x1 over four rows each, an eighth idle", False, lambda: frame_as(96, (2, 1), (1, 1), 181)),
    ("first convolution", "1x1 over whole windows, 168 channels", False, lambda: frame_as(168, (1, 1), (1, 1), 180)),
    ("frame's windows", "rows of 8 pixels (for 7x1 over 24)", True, lambda: windows(HEIGHT + 5, 1, 1)),
    ("frame's windows", "7 rows of 8 pixels (for 1x1 over 168)", False, lambda: windows(180, 7, 2)),
    ("encoder attention", "float, sdpa", True, lambda: attention("sdpa")),
    ("encoder attention", "float, two products and a softmax", False, lambda: attention("parts")),
    ("encoder attention", "INT8 products, weights packed each time", False, lambda: attention("int8")),
    ("encoder attention", "float16, sdpa", False, lambda: attention("half")),
    ("a projection's input", "x + pos, quantized, without channel scales", False, lambda: scaled("none")),
    ("a projection's input", "(x + pos) * scale", True, lambda: scaled("product")),
    ("a projection's input", "addcmul with a scaled position", False, lambda: scaled("addcmul")),
    ("LayerNorm", "float", True, lambda: norm("float")),
    ("LayerNorm", "quantized.layer_norm", False, lambda: norm("int8")),
)  # fmt: skip


def main(folder: str) -> None:
    from mark import mark  # here, because the workstation imports this file for TRIES

    torch.manual_seed(0)
    torch.set_num_threads(1)
    torch.backends.quantized.engine = "qnnpack"
    with torch.inference_mode():
        for i, (what, how, _, make) in enumerate(TRIES):
            print(what, how, flush=True)
            op = make()
            op()
            op()
            mark(True, i)
            op()
            mark(False, i)
    (Path(folder) / "maps").write_text(Path("/proc/self/maps").read_text())


if __name__ == "__main__":
    main(*sys.argv[1:])
