"""What a trained policy could do without, as a report: nothing here changes an artifact.

    rows = leave_out(checkpoint, samples, action_range)          # layers, their halves, single heads, in float
    rows = int8_attention(checkpoint, quantized, calibration_samples, samples, action_range)

The first says what each layer and each head of the transformer costs, and how far the actions move when it is left out.
The second says how much further INT8 products in attention would move a static policy's actions, layer by layer.
"""

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, fx, nn

from rover_lib.onboard.errors import QuantizeError
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import act
from rover_lib.workshop import quantize as q
from rover_lib.workshop.act import ACT
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.compare import thinned
from rover_lib.workshop.session import opened

PRODUCTS = ("softmax", "exponential")

Progress = Callable[..., Iterable] | None


# --- leaving out ------------------------------------------------------------------------------------------------------


class Remembered(nn.Module):
    """In place of the backbone's last layer: what it gave for the observation at hand, (1, D, h, w)."""

    features: Tensor

    def forward(self, _: Tensor) -> Tensor:
        return self.features


class Transformer:
    """The float policy on a few observations whose image features are computed once."""

    def __init__(self, checkpoint: Checkpoint, samples: Sequence[Any]):
        if not samples:
            raise QuantizeError("leaving out needs held-out samples to judge by, found none; record more episodes")
        self.config = checkpoint.config
        self.model = ACT(checkpoint.config, checkpoint.weights)
        self.macs = act.multiply_accumulates(self.model)
        self._states: list[Tensor] = []
        self._features: list[Tensor] = []
        hook = self.model.image_project.register_forward_hook(lambda _, __, out: self._features.append(out.clone()))
        found = []
        with torch.inference_mode():
            for sample in samples:
                state, frame = q.inputs_of(sample, self.config)
                self._states.append(state)
                found.append(self.model(state, frame))
        hook.remove()
        self.full = torch.cat(found)  # (n, C, A)
        self._remembered = Remembered()
        self.model.image_project = self._remembered
        self.model.backbone = nn.Identity()
        self.model.image_input = nn.ModuleList(nn.Identity() for _ in self.config.cameras)

    @torch.inference_mode()
    def predictions(self) -> Tensor:
        """(n, C, A) of raw, unclipped actions, with whatever is left out now."""
        found = []
        for state, features in zip(self._states, self._features, strict=True):
            self._remembered.features = features
            found.append(self.model(state, features))
        return torch.cat(found)


def omissible(config: act.ActConfig) -> list[str]:
    """What can be left out, by name: layers, their halves, and single heads (`<attention>.head.<i>`).

    The first decoder layer's self-attention is a constant and costs nothing: it is in no list.
    """
    names = [f"encoder.{i}" for i in range(config.encoder_layers)]
    names += [f"decoder.{i}" for i in range(config.decoder_layers)]
    blocks = [b for b in act.blocks(config) if b.startswith(("encoder.", "decoder."))]
    heads = [f"{b}.head.{i}" for b in blocks if b.endswith("attention") for i in range(config.heads)]
    return names + blocks + heads


@contextmanager
def without(model: ACT, name: str) -> Iterator[None]:
    """Leave one layer, half or head (see `omissible`) out of a float policy while the block lasts.

    The residual stream passes where it was; the first decoder layer then gives what it was given, zeros. Norms behind
    a half that is left out stay. Raises QuantizeError for a name that is not of this policy.
    """
    if name not in omissible(model.config):
        raise QuantizeError(f"{name} cannot be left out of this policy; see ablation.omissible")
    block, _, head = name.partition(".head.")
    part = model.get_submodule(block)
    if head:
        width = model.config.dim // model.config.heads
        columns = part.o.weight.data[:, int(head) * width : (int(head) + 1) * width]
        kept = columns.clone()
        columns.zero_()
        try:
            yield
        finally:
            columns.copy_(kept)
        return
    start = torch.zeros_like(model.q_pos)
    part.forward = lambda x, *_: start if x is None else x
    try:
        yield
    finally:
        del part.forward  # the class's again


def macs_of(name: str, macs: dict[str, int], heads: int) -> int:
    """Multiply-accumulates of a layer, half or head; a head is its share of all four projections and both products."""
    block, _, head = name.partition(".head.")
    found = sum(n for b, n in macs.items() if b == block or b.startswith(f"{block}."))
    return found // heads if head else found


def leave_out(
    checkpoint: Checkpoint,
    samples: Sequence[Any],
    action_range: dict[str, tuple[float, float]],
    progress: Progress = None,
) -> list[dict[str, Any]]:
    """Per layer, half and head of the transformer: what it costs and what leaving it out does, everything in float.

    samples: held out, with frame_bgr() and state. Rows in the order of `omissible`: name, macs_g (10**9), share_pct of
    the whole policy, and <action>_mae_pct: mean difference to the full policy in percent of the recorded range.
    Raises QuantizeError without samples.
    """
    transformer = Transformer(checkpoint, samples)
    total = sum(transformer.macs.values())
    names = omissible(checkpoint.config)
    rows = []
    for name in progress(names, desc="leaving out", total=len(names)) if progress else names:
        with without(transformer.model, name):
            found = transformer.predictions()
        n = macs_of(name, transformer.macs, checkpoint.config.heads)
        error = q.mae_pct(found, transformer.full, action_range)
        rows.append({"name": name, "macs_g": n / 1e9, "share_pct": 100 * n / total, **error})
    return rows


def report(run_dir: Path | str, frames: int, progress: Progress = None) -> dict[str, Any]:
    """`leave_out` on a run's own policy and held-out frames: write its leave_out.json and return what is in it."""
    again = opened(run_dir)
    samples = thinned(again.parts.held_out, frames)
    rows = leave_out(again.checkpoint, samples, again.recordings.action_range(), progress)
    inputs = {again.checkpoint.path.name: again.checkpoint.sha256}
    given = {"frames": len(samples)}
    return write_stage(
        Path(run_dir) / "leave_out.json", "leave_out", params=given, metrics={"rows": rows}, inputs=inputs
    )


def table(content: dict[str, Any]) -> str:
    """leave_out.json for people: what moves the actions least first."""
    rows = sorted(content["metrics"]["rows"], key=lambda r: max(v for k, v in r.items() if k.endswith("_mae_pct")))
    errors = [k for k in rows[0] if k.endswith("_mae_pct")]
    head = " ".join(f"{k.removesuffix('_mae_pct'):>9}" for k in errors)
    lines = [
        f"left out of the float policy, {content['params']['frames']} held-out frames: percent of all",
        "multiply-accumulates, and the actions' mean change in percent of the recorded range",
        f"{'':36} {'share':>7} {head}",
    ]
    lines += [f"{r['name']:36} {r['share_pct']:7.2f} " + " ".join(f"{r[k]:9.3f}" for k in errors) for r in rows]
    return "\n".join(lines)


# --- INT8 products in attention ---------------------------------------------------------------------------------------


class Int8Products(nn.Module):
    """Scaled dot-product attention whose two products are as SDOT kernels would give them, simulated in float.

    Queries, keys, values and scores get one scale each, from what was seen while `seeing`; keys and values are packed
    like a layer's weights, and so symmetric. The attention weights have 1/255 as their scale: products "softmax" rounds
    the softmax itself, so that of 242 equal weights each is one step; "exponential" rounds exp(score - largest), whose
    largest is 1 in every row, and divides by the sum of the unrounded afterwards.
    """

    def __init__(self, products: str, observer: str):
        super().__init__()
        if products not in PRODUCTS:
            raise QuantizeError(f"products {products!r} are not known; known are {list(PRODUCTS)}")
        self.products, self.seeing, self.acts = products, True, True
        how = {"dtype": torch.qint8, "quant_min": -128, "quant_max": 127}
        observe = {name: q.RangeObserver(**how, choice=observer, percentile=99.99) for name in ("q", "k", "v", "s")}
        self.observers = nn.ModuleDict(observe)
        self.scales: dict[str, tuple[float, int]] = {}

    def freeze(self) -> None:
        """Seeing ends; from now on everything is rounded."""
        self.seeing = False
        for name, observer in self.observers.items():
            scale, zero_point = observer.calculate_qparams()
            self.scales[name] = scale.item(), int(zero_point)
            if name in "kv":
                self.scales[name] = max(abs(end) for end in observer.range()) / 127, 0

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """(1, H, T, d), (1, H, M, d) twice -> (1, H, T, d)."""
        if self.seeing:
            scores = query @ key.transpose(-2, -1) * query.shape[-1] ** -0.5
            for name, x in zip(self.observers, (query, key, value, scores), strict=True):
                self.observers[name](x)
        if self.seeing or not self.acts:
            return F.scaled_dot_product_attention(query, key, value)
        query, key, value = (self._rounded(name, x) for name, x in zip("qkv", (query, key, value), strict=True))
        scores = self._rounded("s", query @ key.transpose(-2, -1) * query.shape[-1] ** -0.5)
        if self.products == "softmax":
            return _at_255(scores.softmax(-1)) @ value
        weights = (scores - scores.amax(-1, keepdim=True)).exp()
        return _at_255(weights) @ value / weights.sum(-1, keepdim=True)

    def _rounded(self, name: str, x: Tensor) -> Tensor:
        return torch.fake_quantize_per_tensor_affine(x, *self.scales[name], -127 if name in "kv" else -128, 127)


def _at_255(x: Tensor) -> Tensor:
    return (x * 255).round() / 255


def _with_int8_products(graph: fx.GraphModule, products: str, observer: str) -> tuple[fx.GraphModule, dict[str, str]]:
    """A copy whose attention can be INT8 too: its modules by the block that they are in."""
    graph = copy.deepcopy(graph)
    found: dict[str, str] = {}
    for node in graph.graph.nodes:
        if node.op == "call_function" and node.target is F.scaled_dot_product_attention:
            block = act.block_of(list(node.meta["nn_module_stack"].values())[-1][0])
            found[block] = f"int8_products_{len(found)}"
            graph.add_submodule(found[block], Int8Products(products, observer))
            node.op, node.target = "call_module", found[block]
    graph.recompile()
    return graph, found


def int8_attention(
    checkpoint: Checkpoint,
    quantized: q.QuantizedPolicy,
    calibration_samples: Sequence[Any],
    samples: Sequence[Any],
    action_range: dict[str, tuple[float, float]],
    *,
    products: str = "softmax",
    progress: Progress = None,
) -> list[dict[str, Any]]:
    """How far a static policy's actions are from FP32 when attention's products are INT8 as well.

    quantized: by a static scheme, whose observer also chooses the ranges inside attention, as seen on
    calibration_samples. products: how the attention weights are rounded, see Int8Products. Rows: name ("none": as
    quantized; each attention alone; "all"), <action>_mae_pct on `samples`. Raises QuantizeError without samples, and
    for a policy that is not static.
    """
    if not samples or not calibration_samples:
        raise QuantizeError("INT8 attention needs calibration and held-out samples; record more episodes")
    if not isinstance(quantized.module, fx.GraphModule):
        raise QuantizeError(f"INT8 attention is tried on static policies, found a {quantized.scheme.mode} one")
    config = checkpoint.config
    graph, modules = _with_int8_products(quantized.module, products, quantized.scheme.observer)
    seen = [q.inputs_of(s, config) for s in calibration_samples]
    q.predictions(graph, progress(seen, desc="ranges in attention", total=len(seen)) if progress else seen)
    for name in modules.values():
        graph.get_submodule(name).freeze()
    inputs = [q.inputs_of(s, config) for s in samples]
    reference = q.predictions(ACT(config, checkpoint.weights), inputs)
    trials = {"none": [], **{block: [block] for block in modules}, "all": list(modules)}
    rows = []
    for name in progress(trials, desc="INT8 attention", total=len(trials)) if progress else trials:
        for block, module in modules.items():
            graph.get_submodule(module).acts = block in trials[name]
        rows.append({"name": name, **q.mae_pct(q.predictions(graph, inputs), reference, action_range)})
    return rows
