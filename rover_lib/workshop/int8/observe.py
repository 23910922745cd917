"""What flows through a policy: observers in its graph, and the calibration that fills them.

    calibration = calibrate(checkpoint, samples)

One calibration serves every scheme with the same `smooth`. This module and `quantize`, and no other, touch
torch.ao.quantization (its last version is torch 2.8's): here the graph gets its observers, there it becomes INT8.
"""

import re
import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.ao.quantization import PerChannelMinMaxObserver, QConfig, QConfigMapping
from torch.ao.quantization.backend_config import get_qnnpack_backend_config
from torch.ao.quantization.fx.custom_config import PrepareCustomConfig
from torch.ao.quantization.observer import UniformQuantizationObserverBase
from torch.ao.quantization.quantize_fx import prepare_fx
from torch.fx import GraphModule, Node

from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.stage import open_plain
from rover_lib.workshop.act import ACT, Columns, blocks, example_inputs, inputs_of
from rover_lib.workshop.act_config import ActConfig
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.checkpoint.files import save_torch
from rover_lib.workshop.hooks import watched
from rover_lib.workshop.int8.frames import Frame, range_over, usual
from rover_lib.workshop.int8.scales import Maxima, apply_channel_scales, channel_maxima
from rover_lib.workshop.int8.scheme import ENGINE, HIGH, LOW, OBSERVERS, SMALLEST_SCALE, Scheme
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample

AGAIN = "calibrate again"
BROKEN_INPUT = "check the checkpoint and the recordings"
OBSERVER = "activation_post_process"  # in FX's names of observers
SHOWN_PCT = 95.0  # of the frames, whose extremes the observer `frames` takes where its ranges are only shown


class RangeObserver(UniformQuantizationObserverBase):
    """Sees a tensor's values during calibration; the range is chosen afterwards, in any of three ways.

    Keeps the exact minimum and maximum and a histogram over [-limit, limit]; when it is outgrown, two neighbouring bins
    merge into one. frames: each frame's least and largest value, (2,). of_frames: the range of the choice `frames`.
    """

    BINS = 4096

    def __init__(self, *, choice: str):
        super().__init__(
            dtype=torch.qint8, qscheme=torch.per_tensor_affine, quant_min=LOW, quant_max=HIGH, eps=SMALLEST_SCALE
        )
        self.choice = choice
        self.observing = True
        self.frames: list[Tensor] = []
        self.of_frames: tuple[float, float] | None = None
        self.min_val = nn.Buffer(torch.tensor(torch.inf))
        self.max_val = nn.Buffer(torch.tensor(-torch.inf))
        self.limit = nn.Buffer(torch.tensor(0.0))
        self.histogram = nn.Buffer(torch.zeros(self.BINS))

    def forward(self, x: Tensor) -> Tensor:
        if not self.observing:
            return x
        v = x.detach().flatten()
        low, high = torch.aminmax(v)
        if not (torch.isfinite(low) and torch.isfinite(high)):
            raise ArtifactError("calibration met NaN or Inf in an activation", remedy=BROKEN_INPUT)
        self.frames.append(torch.stack((low, high)))
        self.min_val.copy_(torch.minimum(self.min_val, low))
        self.max_val.copy_(torch.maximum(self.max_val, high))
        largest = max(abs(low.item()), abs(high.item()), 1e-6)
        if self.limit == 0:
            self.limit.fill_(largest)
        while largest > self.limit:
            merged = self.histogram.view(-1, 2).sum(1)
            quarter = self.BINS // 4
            self.histogram.zero_()[quarter : 3 * quarter] = merged
            self.limit.mul_(2)
        limit = self.limit.item()
        # A feature map has millions of values: every 17th draws the same histogram.
        self.histogram.add_(torch.histc(v[::17] if v.numel() > 1 << 18 else v, self.BINS, -limit, limit))
        return x

    def range(self) -> tuple[float, float]:
        """The range [low, high] to represent, containing 0. Raises ArtifactError if it saw nothing."""
        low = self.min_val.item()
        high = self.max_val.item()
        if low > high:
            raise ArtifactError("an observer saw nothing: calibration did not reach its layer", remedy=AGAIN)
        if self.choice == "histogram":
            low, high = self._least_squares(low, high)
        elif self.choice == "frames":
            low, high = self.of_frames or (low, high)
        return min(low, 0.0), max(high, 0.0)

    def _centres(self) -> Tensor:
        limit = self.limit.item()
        return (torch.arange(self.BINS) + 0.5) * (2 * limit / self.BINS) - limit

    def _least_squares(self, low: float, high: float) -> tuple[float, float]:
        """The range whose rounding plus clipping has the least squared error over the histogram."""
        shrink = torch.linspace(1.0, 0.1, 31)
        lows = low * shrink
        highs = high * shrink
        used = self.histogram > 0
        weight = self.histogram[used] / self.histogram.sum()
        x = self._centres()[used]
        step = (highs.clamp(min=0) - lows[:, None].clamp(max=0)).clamp(min=1e-12) / 255
        below = torch.relu(lows[:, None] - x) ** 2 @ weight
        above = torch.relu(x - highs[:, None]) ** 2 @ weight
        best = divmod(int((step**2 / 12 + below[:, None] + above).argmin()), len(shrink))
        return lows[best[0]].item(), highs[best[1]].item()

    def calculate_qparams(self, **_: object) -> tuple[Tensor, Tensor]:
        low, high = self.range()
        return self._calculate_qparams(torch.tensor(low), torch.tensor(high))


@dataclass(frozen=True)
class Calibration:
    """What flowed through the policy: enough for every scheme with the same `smooth`, without the recordings."""

    samples: int
    smooth: float | None
    checkpoint: str  # its identity
    image_sizes: tuple[tuple[int, int], ...]  # (height, width), one per camera
    channels: Maxima = field(repr=False)
    observers: dict[str, Tensor] = field(repr=False)  # state of the prepared graph's observers
    seconds: float
    seen: tuple[Frame, ...] = field(repr=False)  # (episode, row) of each sample
    frames: dict[str, Tensor] = field(repr=False)  # (samples, 2) extremes on each, by place

    def save(self, path: Path | str) -> None:
        save_torch(Path(path), self.__dict__)

    @classmethod
    def load(cls, path: Path | str) -> "Calibration":
        """Read what save() wrote. Raises ArtifactError if the file is missing or not a calibration."""
        try:
            with open_plain(path, OSError("not a plain file")) as file:
                return cls(**torch.load(file, weights_only=True))
        except FileNotFoundError:
            raise ArtifactError(f"{path}: not found", remedy="run notebook 02_calibrate first") from None
        except Exception:  # torch wraps what it meets in many types
            raise ArtifactError(f"{path}: not a calibration", remedy=AGAIN) from None


def calibrate(
    checkpoint: Checkpoint, samples: Sequence[Sample], *, smooth: float | None = 0.5, progress: Progress = silent
) -> Calibration:
    """Run the float policy over the samples, twice: for the channel scales, then for the observers behind them.

    Args:
        checkpoint: the policy.
        samples: pictures and states that it will meet on the road.
        smooth: as in Scheme.
        progress: shows which sample is observed.

    Returns:
        What a scheme needs to quantize the checkpoint, and no other one.

    Raises:
        ArtifactError: no samples, or activations that are not finite.
    """
    if not samples:
        raise ArtifactError("calibration needs samples", found="none", remedy="give other recordings")
    torch.backends.quantized.engine = ENGINE
    start = time.monotonic()
    config = checkpoint.config

    def inputs(what: str) -> Iterable[tuple[Tensor, ...]]:
        return (inputs_of(s, config) for s in progress(samples, desc=what))

    model = ACT(config, checkpoint.weights, for_int8=True)
    channels = channel_maxima(model, inputs("channel maxima"))
    if bad := [n for n, s in channels.items() if not all(torch.isfinite(t).all() for t in s.values())]:
        raise ArtifactError(f"calibration met NaN or Inf at {bad[:3]}", remedy=BROKEN_INPUT)
    if smooth is not None:
        apply_channel_scales(model, channels, smooth)
    prepared = _prepare(model, Scheme(smooth=smooth))
    with torch.inference_mode():
        for x in inputs("observers"):
            prepared(*x)
    frames = {}
    for place, observer in _places(prepared).items():
        ranges = torch.stack(observer.frames).view(len(samples), -1, 2)  # some run once for each camera
        frames[place] = torch.stack((ranges[..., 0].amin(1), ranges[..., 1].amax(1)), 1)
    return Calibration(
        samples=len(samples),
        smooth=smooth,
        checkpoint=checkpoint.identity,
        image_sizes=config.image_sizes,
        channels=channels,
        observers={k: v.clone() for k, v in prepared.state_dict().items() if OBSERVER in k},
        seconds=time.monotonic() - start,
        seen=tuple((s.episode, s.row) for s in samples),
        frames=frames,
    )


def _places(prepared: GraphModule) -> dict[str, RangeObserver]:
    """The observers by the tensor that they see: named after the layer that gives it, or that takes it as input."""
    places: dict[RangeObserver, str] = {}
    for node in prepared.graph.nodes:
        if (observer := _observer(prepared, node)) is None:
            continue
        (source,) = node.all_input_nodes
        takes = next((user for user in node.users if user.op == "call_module"), None)
        name = str(source.target) if source.op == "call_module" or takes is None else f"{takes.target}.input"
        places.setdefault(observer, name)
    return {name: observer for observer, name in places.items()}


@torch.inference_mode()
def times_of(prepared: GraphModule, calibration: Calibration, inputs: Sequence[tuple[Tensor, ...]]) -> Tensor:
    """(frames,) of each frame's oddness, as `frames.oddest`, against the frames that calibrated."""
    times = torch.zeros(len(inputs))
    usually = {place: extreme.abs().amax(1).median().clamp(min=1e-12) for place, extreme in calibration.frames.items()}

    def watch(place: str, _: nn.Module, inputs: tuple[Tensor], __: Tensor) -> None:
        times[i] = torch.maximum(times[i], inputs[0].abs().max() / usually[place])

    with watched(_places(prepared), watch):
        for i, x in enumerate(inputs):  # noqa: B007 watch reads it
            prepared(*x)
    return times


def set_ranges(prepared: GraphModule, scheme: Scheme, calibration: Calibration) -> None:
    """Let the observers of a restored graph choose their ranges by this scheme."""
    usual_frames = usual(calibration.frames, scheme.usual_pct)
    wider = dict(scheme.wider)
    for place, observer in _places(prepared).items():
        observer.choice = scheme.observer
        observer.of_frames = range_over(calibration.frames[place], usual_frames, wider.get(place, 0.0))


def ranges_of(checkpoint: Checkpoint, calibration: Calibration) -> dict[str, dict[str, tuple[float, float, float]]]:
    """What each observer would keep of each tensor: {place: {observer: (low, high, values clipped in %)}}.

    Raises as `restore_observed`.
    """
    ranges: dict[str, dict[str, tuple[float, float, float]]] = {}
    scheme = Scheme(smooth=calibration.smooth)
    prepared = restore_observed(checkpoint, scheme, calibration)
    for choice in OBSERVERS:
        set_ranges(prepared, replace(scheme, observer=choice, usual_pct=SHOWN_PCT), calibration)
        for place, observer in _places(prepared).items():
            low, high = observer.range()
            centres = observer._centres()
            counts = observer.histogram
            clipped = float(counts[(centres < low) | (centres > high)].sum() / counts.sum().clamp(min=1))
            if choice == "minmax":
                clipped = 0.0  # its ends lie within the histogram's last bins
            ranges.setdefault(place, {})[choice] = (low, high, 100 * clipped)
    return ranges


def _observer(prepared: nn.Module, node: Node) -> RangeObserver | None:
    """The observer that a node calls, None if it calls something else."""
    called = prepared.get_submodule(str(node.target)) if node.op == "call_module" else None
    return called if isinstance(called, RangeObserver) else None


def _pattern(block: str, relu: bool) -> str:
    """FX's regex of what is INT8 in a block: not the attention's own functions, whose products must stay float."""
    name = re.escape(block)
    if block.endswith("attention"):
        return rf"{name}\.(q|k|v|o)$"
    if block.endswith("feed_forward"):
        return rf"{name}\.(up|act|down)$" if relu else rf"{name}\.(up|down)$"
    return rf"{name}(\..*)?$"


def qconfig_mapping(config: ActConfig, scheme: Scheme, only: Iterable[str] | None = None) -> QConfigMapping:
    """The blocks to quantize: all but the scheme's float blocks, or `only` those. Raises ArtifactError for others."""
    all_blocks = blocks(config)
    if unknown := [b for b in scheme.float_blocks if b not in all_blocks]:
        raise ArtifactError(f"scheme: float blocks {unknown} are not in this policy", remedy=f"known are {all_blocks}")
    quantized = set(all_blocks) - set(scheme.float_blocks) if only is None else set(only)
    activation = RangeObserver.with_args(choice=scheme.observer)
    weight = PerChannelMinMaxObserver.with_args(
        dtype=torch.qint8, qscheme=torch.per_channel_symmetric, quant_min=-127, quant_max=127, eps=SMALLEST_SCALE
    )
    mapping = QConfigMapping().set_global(None)
    for block in all_blocks:
        qconfig = QConfig(activation, weight) if block in quantized else None
        mapping.set_module_name_regex(_pattern(block, config.activation == "relu"), qconfig)
    return mapping


def _prepare(model: ACT, scheme: Scheme) -> GraphModule:
    full = replace(scheme, float_blocks=())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecation: known, and the reason why only two modules touch it
        prepared = prepare_fx(
            model,
            qconfig_mapping(model.config, full),
            example_inputs(model.config),
            PrepareCustomConfig().set_non_traceable_module_classes([Columns]),
            backend_config=get_qnnpack_backend_config(),
        )
    return _one_scale_for_all_cameras(prepared) if len(model.config.cameras) > 1 else prepared


def _one_scale_for_all_cameras(prepared: GraphModule) -> GraphModule:
    """Let a layer that runs once for each camera see all through the same observers, as its weights are packed once."""
    calls: dict[str, list[Node]] = {}
    for node in prepared.graph.nodes:
        if node.op == "call_module" and _observer(prepared, node) is None:
            calls.setdefault(str(node.target), []).append(node)
    for nodes in calls.values():
        for sides in ([node.all_input_nodes for node in nodes], [node.users for node in nodes]):
            shared, *rest = (next((n for n in side if _observer(prepared, n)), None) for side in sides)
            for other in rest:
                if shared is not None and other is not None:
                    other.target = shared.target
    prepared.delete_all_unused_submodules()
    prepared.recompile()
    return prepared


def restore_observed(checkpoint: Checkpoint, scheme: Scheme, calibration: Calibration) -> GraphModule:
    """The observed graph as calibration left it. Raises ArtifactError for a calibration of another checkpoint."""
    for subject, stored, now in (
        ("image sizes", calibration.image_sizes, checkpoint.config.image_sizes),
        ("checkpoint", calibration.checkpoint, checkpoint.identity),
        ("smooth", calibration.smooth, scheme.smooth),
    ):
        if stored != now:
            raise ArtifactError(f"the calibration was made with {subject} {stored}, not {now}", remedy=AGAIN)
    torch.backends.quantized.engine = ENGINE
    prepared = _prepare(scale_model(checkpoint, calibration, for_int8=True), scheme)
    state = prepared.state_dict()
    if {k for k in state if OBSERVER in k} != set(calibration.observers):
        raise ArtifactError("the calibration's observers do not fit this graph", remedy=AGAIN)
    prepared.load_state_dict(state | calibration.observers)
    for m in prepared.modules():
        if isinstance(m, RangeObserver):
            m.observing = False
    set_ranges(prepared, scheme, calibration)
    return prepared


def scale_model(checkpoint: Checkpoint, calibration: Calibration, *, for_int8: bool) -> ACT:
    """The float policy with the calibration's channel scales, if it has some. for_int8: as of ACT."""
    model = ACT(checkpoint.config, checkpoint.weights, for_int8=for_int8)
    if calibration.smooth is not None:
        apply_channel_scales(model, calibration.channels, calibration.smooth)
    return model
