"""Hailo's chips, and how long a network takes on one, computed from the figures of Hailo's model zoo."""

from dataclasses import dataclass

from rover_hailo.networks import Network


@dataclass(frozen=True)
class Chip:
    """A chip, and the rates that Hailo's model zoo measured on it at batch 1, in frames a second.

    detr: of detr_resnet_v1_18_bn, 61.87 GOP. resnet: of resnet_v1_18, 3.64 GOP. They are from docs/public_models in
    hailo_model_zoo v5.2.0, where a multiply-accumulate counts as two operations.
    """

    name: str
    compiler: str  # the major version of its Dataflow Compiler
    detr: float
    resnet: float


CHIPS = {
    c.name: c
    for c in (
        Chip("hailo8", "3", detr=30, resnet=2718),
        Chip("hailo8l", "3", detr=19, resnet=915),
        Chip("hailo10h", "5", detr=40.7, resnet=2709),
    )
}
DETR_GOP, RESNET_GOP = 61.87, 3.64


@dataclass(frozen=True)
class Estimate:
    """Milliseconds on a chip. slow_ms: at the rate of the zoo's DETR. fast_ms: at that of its ResNet-18, or slow_ms for
    a network with attention. arithmetic: how they were computed.
    """

    slow_ms: float
    fast_ms: float
    arithmetic: str


def estimate(network: Network, chip: Chip) -> Estimate:
    """Estimate the time of one inference on a chip from the zoo's rates of similar networks. Nobody has measured it."""
    gop = 2 * network.macs / 1e9
    slow = DETR_GOP * chip.detr
    words = f"{gop:.1f} GOP / ({DETR_GOP} GOP x {chip.detr:g}/s) = {1000 * gop / slow:.1f} ms"
    if network.sixteen_bit:
        return Estimate(1000 * gop / slow, 1000 * gop / slow, words)
    fast = RESNET_GOP * chip.resnet
    words += f"; at ResNet-18's {RESNET_GOP} GOP x {chip.resnet:g}/s: {1000 * gop / fast:.1f} ms"
    return Estimate(1000 * gop / slow, 1000 * gop / fast, words)
