"""Small policies whose frozen statistics are not those of the pictures that they drive in.

    content = judge_statistics("runs/demo/episodes", "runs/statistics", trainings=6)

Our own training measures the statistics of batch norm on the data that it drives in; a policy that comes from elsewhere
brings others, and may answer some frames far more strongly. So in copies of each trained policy a layer of the backbone
gets the statistics of a place without near balloons: there, what only the nearest balloons show hardly varies, and
where it is met it is answered far more strongly. Each is calibrated and quantized as a run does it, and judged on
held-out frames against its own plans in FP32.
"""

import shutil
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lab.shorten import shorten
from rover_learn.train import TrainingRecipe, _train
from rover_learn.training import Resumable, threads
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage, write_stage
from rover_lib.workshop.act import ACT, ActConfig, inputs_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.checkpoint.files import save_torch
from rover_lib.workshop.int8.choose import Chooser
from rover_lib.workshop.int8.frames import describe_odd
from rover_lib.workshop.int8.observe import calibrate
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import Sample, load_recordings, split
from rover_lib.workshop.recordings.samples import Recordings, pick_evenly
from rover_lib.workshop.run.pipeline import Recipe, prepare_chooser
from rover_lib.workshop.run.session import Opened

STATISTICS: dict[str, tuple[str, float] | None] = {  # which norm gets them, how many times stronger it then answers
    "own": None,
    "layer2": ("layer2.1.bn1", 60.0),
    "layer3": ("layer3.1.bn1", 60.0),
    "layer4": ("layer4.1.bn1", 60.0),
    "layer4, most": ("layer4.1.bn1", 400.0),  # batch norm's eps allows no more
}
CHANGED = 0.5  # of the norm's channels
NEAR_SHARE = 0.07  # of the frames show the nearest balloons
FITTED = 400  # frames after which the projection of the features learns the changed ones
SIZE = ActConfig(
    image_sizes=((48, 80),), dim=96, heads=4, feedforward=384, encoder_layers=1, decoder_layers=1, vae_layers=1
)
RECIPE = TrainingRecipe(200, 500, 30, 16, 16, 16, samples=2000, feature_samples=1500, judged=100)
LIMIT_PCT = 1.0  # static INT8 is at most this far off
MUST_HOLD = 28 / 30  # of the policies


def judge_statistics(
    episodes: Path | str,
    folder: Path | str,
    trainings: int = 6,
    recipe: TrainingRecipe = RECIPE,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Train and judge every policy that folder/statistics.json does not have yet, and return its content.

    Each row has the policy's training, its statistics, its odd frames, the observer that was chosen, and the errors of
    static INT8. After a kill the same call goes on with the policy that was not done.
    """
    folder = Path(folder)
    path = folder / "statistics.json"
    rows = read_stage(path, "statistics")["metrics"]["policies"] if path.is_file() else []
    done = {(row["training"], row["statistics"]) for row in rows}
    todo = [(seed, name) for seed in range(trainings) for name in STATISTICS if (seed, name) not in done]
    for seed, name in progress(todo, desc="policies"):
        rows.append(
            {"training": seed, "statistics": name, **shorten(_judge(Path(episodes), folder, seed, name, recipe))}
        )
        held = sum(row["passed"] for row in rows)
        gates = [gate("policies that hold, share", held / len(rows), ">=", MUST_HOLD)]
        write_stage(path, "statistics", params={"limit_pct": LIMIT_PCT}, metrics={"policies": rows, "gates": gates})
    return read_stage(path, "statistics")


@threads(1)  # so small a policy's layers are done before a second thread wakes
def _judge(episodes: Path, folder: Path, seed: int, name: str, recipe: TrainingRecipe) -> dict[str, Any]:
    p = params()
    recordings = load_recordings(episodes, SIZE.chunk, p["calibration"]["sync_s"])
    parts = split(recordings, p["calibration"]["held_out_share"], p["calibration"]["seed"])
    weights = _weights(recordings, folder, seed, name, recipe)
    checkpoint = Checkpoint(folder, "trainer", SIZE, weights, f"{seed} {name}", {})
    how = Recipe.of(p)
    calibration = calibrate(checkpoint, how.choose(parts.calibration)[0], smooth=how.scheme.smooth)
    loaded = Opened(checkpoint, recordings, parts)
    scheme, _ = prepare_chooser(checkpoint, loaded, calibration).observer(how.scheme, how.observers)
    judge = Chooser(checkpoint, calibration, pick_evenly(parts.held_out, 120), recordings.action_range())
    errors = judge.error(quantize(checkpoint, scheme, calibration).module)
    by_histogram = judge.error(quantize(checkpoint, how.scheme, calibration).module)
    odd = describe_odd(calibration.frames, calibration.seen)
    return {
        "odd": {key: odd[key] for key in ("share_pct", "block", "times") if key in odd},
        "observer": scheme.observer,
        **errors,
        "passed": (worst(errors) or 0.0) <= LIMIT_PCT,
        "histogram": by_histogram,
    }


def _weights(recordings: Recordings, folder: Path, seed: int, name: str, recipe: TrainingRecipe) -> dict[str, Tensor]:
    """Train the policy, unless an earlier call did, and give it the statistics of this name."""
    policy, phases = folder / f"{seed}.pt", folder / f"training-{seed}"
    if not policy.is_file():
        with Resumable(phases) as saved:
            trained = _train(recordings, SIZE, recipe, seed, torch.device("cpu"), saved)
        save_torch(policy, trained["model_state_dict"])
        shutil.rmtree(phases)
    weights = {k.removeprefix("model."): v for k, v in torch.load(policy, weights_only=True).items()}
    if (where := STATISTICS[name]) is None:
        return weights
    p = params()["calibration"]
    parts = split(recordings, p["held_out_share"], p["seed"])
    return bring_statistics(weights, SIZE, pick_evenly(parts.calibration, FITTED), *where)


@torch.no_grad()
def bring_statistics(
    weights: dict[str, Tensor], config: ActConfig, samples: Sequence[Sample], norm: str, times: float
) -> dict[str, Tensor]:
    """The same policy, of which one norm answers this many times more to the frames that layer4 answers most.

    norm: the first of a ResNet block's two, by its name in the backbone; its channels that tell these frames best get
    the statistics. The projection of the features is then fitted to give what it gave before.
    """
    from torchvision.models import resnet18
    from torchvision.ops.misc import FrozenBatchNorm2d

    resnet = resnet18(weights=None, norm_layer=FrozenBatchNorm2d)
    net = nn.Sequential(OrderedDict(list(resnet.named_children())[:-2])).eval()
    weights = {name: tensor.clone() for name, tensor in weights.items()}
    state = {name.removeprefix("backbone."): t for name, t in weights.items() if name.startswith("backbone.")}
    net.load_state_dict(state)
    to_pixels = ACT(config, weights).image_input[0]
    pictures = torch.cat([to_pixels(inputs_of(sample, config)[1]) for sample in samples])
    before, entered = _features(net, norm, pictures)
    strongest = before.flatten(1).amax(1)
    near = strongest > strongest.quantile(1 - NEAR_SHARE)

    given: Any = net.get_submodule(norm)
    usually = entered[~near].amax(0)
    beyond = entered[near].median(0).values - usually
    chosen = (beyond / entered.std(0)).topk(round(CHANGED * len(beyond))).indices
    usual_answer = (given.weight * (entered[~near] - given.running_mean) / given.running_var.sqrt()).amax(1).median()
    given.weight[chosen] = 1.0
    given.bias[chosen] = 0.0
    given.running_mean[chosen] = usually[chosen]
    given.running_var[chosen] = (beyond[chosen].clamp(min=1e-3) / (times * usual_answer)) ** 2  # + batch norm's eps
    weights |= {f"backbone.{name}": tensor for name, tensor in net.state_dict().items()}

    after, _ = _features(net, norm, pictures)
    project = weights["encoder_img_feat_input_proj.weight"].flatten(1)
    old, new = (x.transpose(0, 1).flatten(1) for x in (before, after))  # (channels, places in all pictures)
    scale = new.square().mean(1).sqrt().clamp(min=1e-6)
    x = torch.cat((new / scale[:, None], torch.ones(1, new.shape[1]))).double()
    much = 1e-3 * x.shape[1] * torch.eye(len(x), dtype=torch.double)
    fitted = torch.linalg.solve(x @ x.T + much, x @ (project @ old).T.double()).T.float()
    weights["encoder_img_feat_input_proj.weight"] = (fitted[:, :-1] / scale)[..., None, None]
    weights["encoder_img_feat_input_proj.bias"] += fitted[:, -1]
    return weights


def _features(net: nn.Sequential, norm: str, pictures: Tensor) -> tuple[Tensor, Tensor]:
    """What the backbone gives, (n, channels, h, w), and each channel's largest value before a norm, (n, channels)."""
    entered: list[Tensor] = []
    watch = net.get_submodule(norm).register_forward_pre_hook(lambda _, args: entered.append(args[0].amax((2, 3))))
    features = torch.cat([net(some) for some in pictures.split(50)])
    watch.remove()
    return features, torch.cat(entered)
