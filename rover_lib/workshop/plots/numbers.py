"""The figures of the numbers in a policy: their ranges (notebook 02), and what rounding does to them (03)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import nn

from rover_lib.workshop.act import block_of
from rover_lib.workshop.int8.frames import ODD, oddest
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.int8.quantize import int8_layers
from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import BLACK, COLOURS, GREY, MIST, OTHERS, RED, SLATE, legend_below, new_figure

MARKS = {"minmax": ("o", GREY), "histogram": ("D", SLATE), "frames": ("s", COLOURS["dynamic"])}
PARTS = {"backbone": SLATE, "encoder": OTHERS[1], "decoder": OTHERS[2], "the rest": MIST}


def ranges_by_layer(ranges: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> Figure:
    """Draw how far each observer's range reaches in each block, and how many values it clips there.

    ranges: of `observe.ranges_of`. A block shows its tensor on which the observers agree least.
    """
    shown: dict[str, tuple[float, Mapping[str, tuple[float, float, float]]]] = {}
    for place, observers in ranges.items():
        reach = [max(-low, high) for low, high, _ in observers.values()]
        apart = max(reach) / max(min(reach), 1e-12)
        if apart > shown.get(block_of(place), (0.0,))[0]:
            shown[block_of(place)] = (apart, observers)
    fig, axes = new_figure(1, 2, height_in=1.4 + 0.27 * len(shown), sharey=True)
    left, right = axes[0]
    for name, (marker, colour) in MARKS.items():
        found = [observers[name] for _, observers in shown.values()]
        reach = [max(-low, high) for low, high, _ in found]
        clipped_pct = [max(pct, 1e-4) for *_, pct in found]
        size = 11 if name == "minmax" else 6  # the others often lie on it
        left.plot(reach, range(len(shown)), marker, color=colour, ms=size, label=name)
        right.plot(clipped_pct, range(len(shown)), marker, color=colour, ms=size)
    left.set_yticks(range(len(shown)), list(shown))
    left.invert_yaxis()
    left.set(xlabel="largest value that is kept", xlim=(0, None))
    right.set(xscale="log", xlabel="values that are clipped (%; at the left: none)", xlim=(7e-5, None))
    for ax in (left, right):
        ax.grid(axis="y", color=MIST, lw=0.5)
    legend_below(fig, left, 3)
    return fig


def odd_frames(calibration: Calibration, samples: Sequence[Any]) -> Figure:
    """Draw each frame's oddness in order, with the two oddest pictures beside two usual ones.

    samples: those that calibrated, in their order.
    """
    times = oddest(calibration.frames)
    order = times.argsort(stable=True)
    fig, axes = new_figure(1, 5, height_in=2.5, width_ratios=(2.2, 1, 1, 1, 1))
    first, *fields = axes[0]
    first.plot(times[order], color=SLATE)
    first.axhline(ODD, color=RED, lw=1.2)
    first.text(0, ODD * 1.06, "odd from here on", color=RED, fontsize=9)
    first.set(yscale="log", xlabel="frames, the oddest last", ylabel="largest value,\nof the median frame's")
    first.set_ylim(1, max(2 * ODD, 1.2 * times.max().item()))
    first.set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    first.minorticks_off()
    middle = len(order) // 2
    chosen = [int(order[i]) for i in (-1, -2 % len(order), middle, middle // 2)]
    for ax, i, kind in zip(fields, chosen, ("oddest", "second", "usual", "usual"), strict=True):
        style.show_picture(ax, samples[i], f"{kind}: {times[i]:.1f}")
    return fig


def bytes_by_part(modules: Mapping[str, nn.Module]) -> Figure:
    """Draw how many megabytes of weights each part of each artifact has. modules: by mode, FP32 among them."""
    fig, axes = new_figure(1, height_in=1.3 + 0.4 * len(modules))
    ax = axes[0, 0]
    left = np.zeros(len(modules))
    sizes = [_bytes_of(module) for module in modules.values()]
    for part, colour in PARTS.items():
        size_mb = np.array([size.get(part, 0) / 1e6 for size in sizes])
        ax.barh(range(len(modules)), size_mb, left=left, color=colour, label=part)
        left += size_mb
    for row, total_mb in enumerate(left):
        ax.text(total_mb, row, f" {total_mb:.1f} MB", va="center", fontsize=9)
    ax.set_yticks(range(len(modules)), [style.line_of(mode)["label"] for mode in modules])
    ax.invert_yaxis()
    ax.set(xlabel="weights (MB, 10^6 bytes)", xlim=(0, 1.12 * left.max()))
    legend_below(fig, ax, 4)
    return fig


def _bytes_of(module: nn.Module) -> dict[str, int]:
    """The bytes of the weights by part of the policy, a key of PARTS."""
    found = dict.fromkeys(PARTS, 0)
    for name, layer in module.named_modules():
        part = next((part for part in PARTS if name.startswith(part)), "the rest")
        tensors = list(layer.parameters(recurse=False))
        if callable(weight := getattr(layer, "weight", None)):  # of a quantized layer
            tensors = [weight(), layer.bias()]
        found[part] += sum(t.numel() * t.element_size() for t in tensors if t is not None)
    return found


def weights_rounded(before: nn.Module, after: nn.Module) -> Figure:
    """Draw one channel's weights before and after, and how much of each layer's weights rounding changes.

    before: the float policy with folded norms and channel scales, `observe.scale_model`; after: the static one.
    The channel is the one that rounding changes most.
    """
    floats = dict(before.named_modules())
    lost_pct: dict[str, float] = {}
    worst = (-1.0, "", torch.zeros(1), torch.zeros(1))
    for name, layer in int8_layers(after).items():
        rounded = layer.weight().dequantize().flatten(1)
        exact = floats[name].weight.detach().flatten(1)
        each = 100 * (rounded - exact).norm(dim=1) / exact.norm(dim=1).clamp(min=1e-12)
        lost_pct[name] = 100 * float((rounded - exact).norm() / exact.norm())
        channel = int(each.argmax())
        if each[channel] > worst[0]:
            worst = (float(each[channel]), f"{name}, channel {channel}", exact[channel], rounded[channel])
    by_block: dict[str, float] = {}
    for name, pct in lost_pct.items():
        by_block[block_of(name)] = max(pct, by_block.get(block_of(name), 0.0))
    fig, axes = new_figure(1, 2, height_in=1.6 + 0.22 * len(by_block))
    left, right = axes[0]
    pct, name, exact, rounded = worst
    near = 8 * rounded[rounded > 0].min().item() if (rounded > 0).any() else 1.0
    order = exact.argsort()
    left.plot(exact[order], exact[order], color=BLACK, lw=1, label="before")
    left.plot(exact[order], rounded[order], color=COLOURS["static"], lw=1.2, label="after")
    left.set(xlabel="weight before", ylabel="weight after", xlim=(-near, near), ylim=(-near, near))
    left.locator_params(nbins=5)
    left.set_title(f"{name}:\n{pct:.1f} % lost; the steps around 0", fontsize=10)
    left.legend()
    right.barh(list(by_block), list(by_block.values()), color=COLOURS["static"])
    right.invert_yaxis()
    right.set(xlabel="changed by rounding (% of the weights)")
    return fig
