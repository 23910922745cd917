"""Checkpoints in files: what both formats hold, and the trainer's best_model.pth, read without running its code.

Pickles are read with weights_only=True, and what that refuses is refused by name.
"""

import re
import zipfile
from collections.abc import Container, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CheckpointError, printable
from rover_lib.onboard.kinds import read_head, refuse_pointer
from rover_lib.onboard.stage import atomic_path, plain, read_plain
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.act_config import imagenet
from rover_lib.workshop.checkpoint.facts import USER, Facts
from rover_lib.workshop.recordings.samples import ACTION_NAMES
from rover_lib.workshop.untrusted import quote, quote_all

Weights = dict[str, Tensor]
# Config, weights by LeRobot's names without the leading `model.`, and more for the report.
Contents = tuple[ActConfig, Weights, dict[str, Any]]

MOST = 8192  # pixels a side, or numbers of a state or an action, before `check_limits` has seen them all
COPY_AGAIN = "copy it again, the whole folder if it is one"
CORRECT_IT = "correct the config to what the policy was trained with"
IS_IT_WHOLE = "is it an ACTPolicy of LeRobot, and whole? If its weights hold statistics, remove policy_p*processor.json"
# Parts of names that torch.compile, DataParallel, FSDP and checkpointing put anywhere, which change nothing.
WRAPPERS = r"(?<![^.])(module|_orig_mod|_(fsdp|checkpoint)_wrapped_module)\."
COUNTS = r"(.*\.)?(num_batches_tracked|n_averaged)"  # a batch norm's, and AveragedModel's; LeRobot's norms are frozen
OF_ACT = "action_head.weight"  # every ACT has one: what stands before it stands before all its names
TORN, TORN_ROW = 1024, 64  # zeros that no training leaves in a matrix: one after the other, and in one of its rows
RATE_HZ = 30.0  # steps of a plan in a second if nothing says it: the rate of the trainer's recordings
JSON_BYTES = 1_000_000  # settings take some kB
TRAINER_CAMERA, OF_TRAINER = "cam_front", "the trainer's format"
DROPOUT = 0.1  # LeRobot's default, as the user's trainer has it; its checkpoints name what follows, too
KL_WEIGHT = 10.0
WEIGHT_DECAY = 1e-4
BETAS = (0.9, 0.999)
GRAD_CLIP = 1.0
# In a config that we wrote, as no trainer of theirs has them together.
OURS = {"num_epochs": 1, "train_split": 0.75, "log_freq": 1, "save_freq": 1, "num_workers": 0}
KNOWN = {"epoch", "model_state_dict", "optimizer_state_dict", "scheduler_state_dict", "best_val_loss", "config"}
OF_POLICY = {"image_height", "image_width", "rate_hz"}  # of them, what no other file must deny
# Files beside a checkpoint that may say how it was trained: those that are read, and those that are not.
BESIDE = re.compile(r"([^.].*_)?(config|cfg|hparams|args|hyperparameters|settings|metadata)\.(json|ya?ml)", re.I)
STATISTICS = re.compile(
    r"([^.].*_)?(stats|statistics|mean_std|norm|normali[sz]er|normali[sz]ation|scaler)"
    r"\.(pth?|json|ya?ml|pkl|joblib|np[yz]|safetensors)",
    re.I,
)
AVERAGED = re.compile(r"([^.].*[_.-])?(ema|swa|averaged?|shadow|polyak)([_.-].*)?\.(safetensors|pth?|ckpt|bin)", re.I)
# best_val_loss is np.mean's float64; older numpys pickled it as numpy.core, newer ones as numpy._core.
SCALAR = np.float64(0).__reduce__()[0]
NUMPY: list[Any] = [(SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
NUMPY += [np.dtype, *(type(np.dtype(t)) for t in (np.float64, np.float32, np.int64, np.int32))]
SAVE_AGAIN = """python -c "import torch; f = {path!r}; torch.save(torch.load(f, weights_only=False), f)\""""
UNPACK = "unpack it, or give the file that the training saved"
OTHERS = (  # how other files begin, what they are, and what to do
    (rb"$", "an empty file", COPY_AGAIN),
    (rb"\s*<", "a web page", "download the file itself"),
    (rb"\s*\{|.{6}\0\0\{", "JSON or safetensors", "give the whole folder, with config.json and model.safetensors"),
    (rb"\x1f\x8b|BZh|7z|Rar|.{257}ustar", "an archive", UNPACK),
    (rb"[^P\x80]", "an unknown kind of file", f"docs/data.md names those read here; or is it damaged? {COPY_AGAIN}"),
)


def name_weights(path: Path, state: Mapping[Any, Any], ignored: Container[str] = ()) -> Weights:
    """Return the weights by LeRobot's names, which begin with `model.`, without what others put before that.

    ignored: prefixes of networks in it that the user does not want. Raises CheckpointError if there is no ACT in it, or
    several that differ.
    """
    named: dict[str, Any] = {}
    for key, weight in state.items():
        name = re.sub(WRAPPERS, "", str(key))
        if not _is_same(named.setdefault(name, weight), weight):
            raise CheckpointError(f"{path}: has two '{name}', which differ", remedy="save one policy.state_dict()")
    prefixes = sorted(name.removesuffix(OF_ACT) for name in named if re.fullmatch(rf"(.*\.)?{OF_ACT}", name))
    kept = [prefix for prefix in prefixes if not prefix or prefix.rstrip(".") not in ignored]
    if not kept:
        remedy = "give an ACTPolicy of LeRobot's; of another network, nothing can be used"
        raise CheckpointError(f"{path}: no ACT, which has an '{OF_ACT}'", found=quote_all(named), remedy=remedy)

    def network(prefix: str) -> dict[str, Any]:
        others = tuple(each for each in prefixes if each.startswith(prefix) and each != prefix)
        inside = [name for name in named if name.startswith(prefix) and not name.startswith(others or ("\0",))]
        return {name.removeprefix(prefix): named[name] for name in inside}

    own = network(kept[0])
    for each in kept[1:]:
        if not all(_is_same(own.get(name), weight) for name, weight in network(each).items()):
            option = " or ".join(f"{USER} ignore={prefix.rstrip('.')}" for prefix in kept if prefix)
            what = f"{path}: several networks are in it, that differ: which one drives?"
            raise CheckpointError(what, found=f"names with {quote_all(kept)}", remedy=f"say which does not: {option}")
    around = kept[0].removesuffix("model.")  # before the names of the policy's other parts, such as statistics
    known = tuple(prefix for prefix in prefixes if prefix) or ("\0",)
    rest = {name.removeprefix(around): named[name] for name in named if kept[0] and not name.startswith(known)}
    return {f"model.{name}": weight for name, weight in own.items()} | rest


def _is_same(a: Any, b: Any) -> bool:
    return a is b or (isinstance(a, Tensor) and isinstance(b, Tensor) and torch.equal(a, b))


def check_weights_are_whole(path: Path, weights: Mapping[str, Any]) -> Weights:
    """Return a network's weights without `model.`.

    Raises CheckpointError for other names, what is no dense tensor of floats with values, and for matrices with a long
    row of zeros, as in files that were not copied to their end.
    """
    weights = {name: weight for name, weight in weights.items() if not re.fullmatch(COUNTS, name)}
    odd, torn = [], []
    for name, weight in weights.items():
        dense = isinstance(weight, Tensor) and weight.layout == torch.strided and weight.device.type == "cpu"
        if not dense or not weight.is_floating_point():  # as a quantized tensor is not
            odd.append(name)
        elif weight.dim() > 1 and "state_input" not in name and _is_torn(weight, ".backbone." in name):
            torn.append(name)
    if odd:
        what = f"{path}: these weights are not dense tensors of floats: {quote_all(odd)}"
        raise CheckpointError(what, remedy="save policy.state_dict() as it was trained")
    if outside := [name for name in weights if not name.startswith("model.")]:
        raise CheckpointError(f"{path}: names outside 'model.': {quote_all(outside)}", remedy=IS_IT_WHOLE)
    if torn:
        what = f"{path}: damaged, its weights are zeros where a training leaves none: {quote_all(torn)}"
        raise CheckpointError(what, remedy=f"was it copied to its end? {COPY_AGAIN}")
    return {name.removeprefix("model."): weight for name, weight in weights.items()}


def _is_torn(weight: Tensor, backbone: bool) -> bool:
    """Whether a matrix has TORN zeros in a row, or only zeros.

    In the backbone, channels may be left out: rows of zeros, and the same columns of all others.
    """
    zero = (weight.detach().flatten(1) == 0).numpy()
    if backbone or zero.size < TORN:
        left = zero[~zero.all(1)]
        return not len(left) or int((left & ~left.all(0)).sum(1).max()) >= TORN_ROW
    whole = zero.ravel()
    blocks = whole[: whole.size // TORN * TORN].reshape(-1, TORN).all(1)
    return bool(blocks.any() or whole[-TORN:].all())


def name_numbers(count: int, stem: str) -> tuple[str, ...]:
    """Return names for `count` numbers of which nothing but their count is known: two are a car's."""
    return ACTION_NAMES if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


@contextmanager
def as_checkpoint_error(path: Path, remedy: str = COPY_AGAIN) -> Iterator[None]:
    """Turn whatever LeRobot, or a reader below it, raises into a CheckpointError of one sentence."""
    try:
        yield
    except CheckpointError:
        raise
    except Exception as e:  # each library raises types of its own
        refuse_pointer(path, CheckpointError)
        said = e.__cause__ or e  # draccus wraps what a config's own check says
        reason = printable(" ".join(f"{type(said).__name__}: {said}".split())[:200])
        raise CheckpointError(f"{path}: LeRobot cannot use it ({reason})", remedy=remedy) from None


def tensor_bytes(value: Any) -> int:
    """Return the bytes of all tensors in nested dicts, lists and tuples."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, (dict, list, tuple)):
        return sum(map(tensor_bytes, value.values() if isinstance(value, dict) else value))
    return 0


def read_trainer(path: Path, facts: Facts) -> Contents:
    """facts: what its keys and the files beside it say is added.

    Raises CheckpointError for a file that is damaged, would run code, or lacks something.
    """
    content = _read_pickle(path)
    for key in ("config", "model_state_dict"):
        if not isinstance(content, dict) or not isinstance(content.get(key), dict):
            found = quote_all(content) if isinstance(content, dict) else type(content).__name__
            remedy = "is it the trainer's, or only weights? those of the first ACT, ALOHA's, are of another network"
            raise CheckpointError(f"{path}: no '{key}' in it", found=found, remedy=remedy)
    raw = {k: v.item() if isinstance(v, np.generic) else v for k, v in content["config"].items()}
    weights = check_weights_are_whole(path, name_weights(path, content["model_state_dict"], facts.ignored))
    loss = content.get("best_val_loss")  # NaN if the training had diverged
    with as_checkpoint_error(path, "save best_val_loss as a number, or leave it out"):
        loss = None if loss is None else float(loss)
    facts.default("size", (raw.get("image_height"), raw.get("image_width")), "config.image_height")
    facts.default("chunk", raw.get("chunk_size"), "config.chunk_size")
    with as_checkpoint_error(path):
        facts.read({k: v for k, v in content.items() if k not in KNOWN}, "")
        facts.read({k: v for k, v in raw.items() if k not in KNOWN_CONFIG - OF_POLICY}, "config.")
        for file in check_beside(path.parent, facts):
            said = yaml.safe_load(read_plain(file, JSON_BYTES)) if BESIDE.fullmatch(file.name) else None
            if isinstance(said, dict) and "input_features" not in said:  # that is LeRobot's, of another format
                facts.read({k: v for k, v in said.items() if k not in KNOWN_CONFIG - OF_POLICY}, f"{file.name}:")
    extra = {
        "written_here": "origin" in raw or OURS.items() <= raw.items(),
        "epoch": plain(content.get("epoch")),
        "best_val_loss": loss,
        "optimizer_mb": tensor_bytes(content.get("optimizer_state_dict")) / 1e6,
        "trainer_config": plain(raw),
    }
    return _config(path, raw, weights, facts), weights, extra


def check_beside(folder: Path, facts: Facts) -> list[Path]:
    """Return a folder's files. Raises CheckpointError for one whose name says statistics or averaged weights."""
    found = sorted(folder.iterdir())
    named = b"".join(read_plain(path, JSON_BYTES) for path in folder.glob("policy_p*processor.json"))  # LeRobot's own
    for pattern, meaning in (
        (STATISTICS, "which may mean how its numbers are normalised"),
        (AVERAGED, "which may be the weights that should drive"),
    ):
        for file in found:
            ours = file.name in facts.ignored or file.name.encode() in named
            if pattern.fullmatch(file.name) and not ours:
                raise facts.refusal(file.name, "beside it", meaning)
    return found


def _config(path: Path, raw: dict[str, Any], weights: Weights, facts: Facts) -> ActConfig:
    """Make the config from the trainer's, from what only the shapes of the weights say, and from the facts."""

    def whole(key: str, default: int | None = None) -> int:
        if not is_whole(value := raw.get(key, default), 1, 1_000_000):
            what = f"{path}: config '{key}' must be a whole number from 1 to a million"
            raise CheckpointError(what, found=quote(value), remedy=CORRECT_IT)
        return value

    def last(name: str) -> int:
        shape = tuple(weights[name].shape) if name in weights else ()
        if not shape or not 1 <= shape[-1] <= MOST:
            raise CheckpointError(f"{path}: no weight '{name}' of a known shape", found=shape, remedy=IS_IT_WHOLE)
        return shape[-1]

    if raw.get("n_obs_steps", 1) != 1:
        what = f"{path}: n_obs_steps is {quote(raw['n_obs_steps'])}"
        raise CheckpointError(what, remedy="ACT acts on one observation, train with 1")
    size = whole("image_height"), whole("image_width")
    if not is_number(rate_hz := raw.get("rate_hz", RATE_HZ)):
        raise CheckpointError(f"{path}: config 'rate_hz' must be a number", found=quote(rate_hz), remedy=CORRECT_IT)
    actions = facts.default("actions", name_numbers(last("action_head.bias"), "action"), OF_TRAINER)
    if (states := facts.value("state")) not in (None, actions):
        raise facts.refusal(facts.source("state"), states, f"and its actions are {quote_all(actions)}")
    return ActConfig(
        cameras=(TRAINER_CAMERA,),
        image_sizes=(facts.default("size", size, "config.image_height"),),
        backbone=facts.default("backbone", raw.get("vision_encoder", ""), "config.vision_encoder"),
        rate_hz=facts.default("rate", RATE_HZ, OF_TRAINER),
        image_norm=(imagenet(),),  # the trainer scales to [0, 1] and normalises with ImageNet's statistics
        state_names=name_numbers(last("encoder_robot_state_input_proj.weight"), "state"),
        action_names=actions,
        latent=last("encoder_latent_input_proj.weight"),
        vae_layers=len({m[1] for k in weights if (m := re.match(r"vae_encoder\.layers\.(\d+)\.", k))}),
        chunk=whole("chunk_size"),
        dim=whole("hidden_size"),
        heads=whole("n_heads"),
        feedforward=whole("feedforward_dim"),
        encoder_layers=whole("n_encoder_layers"),
        decoder_layers=whole("n_decoder_layers"),
    )


def _read_pickle(path: Path) -> Any:
    refuse_pointer(path, CheckpointError)
    head = read_head(path)
    for begins, kind, remedy in OTHERS:
        if re.match(begins, head, re.S):
            raise CheckpointError(f"{path}: {kind}, not a checkpoint of a training", remedy=remedy)
    try:
        with zipfile.ZipFile(path) as z:
            if not any(name.endswith("data.pkl") for name in z.namelist()) or any("/code/" in n for n in z.namelist()):
                what = f"{path}: an archive or a TorchScript program, not a checkpoint of a training"
                raise CheckpointError(what, found=quote_all(z.namelist()[:3]), remedy=UNPACK)
            # torch.load accepts overwritten weight bytes; the zip's CRC does not. torch compresses nothing.
            stored = all(e.compress_type == zipfile.ZIP_STORED for e in z.infolist())
            damaged = z.testzip() if stored else "compressed entries"
        if damaged:
            raise CheckpointError(f"{path}: damaged, the checksum of {damaged} does not match", remedy=COPY_AGAIN)
        with torch.serialization.safe_globals(NUMPY):
            # mmap: the optimizer's two thirds of the file are counted, never read
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except CheckpointError:
        raise
    except Exception as e:  # zipfile and torch say in many types that a file is damaged
        if wanted := re.search(r"GLOBAL ([\w.]+)", str(e)):
            what = f"{path}: refused, reading it would run code (it asks for '{wanted[1]}')"
            raise CheckpointError(what, remedy="save only tensors, numbers and strings in a checkpoint") from None
        # torch puts advice before it, to read it unsafely
        reason = (str(e).rpartition("WeightsUnpickler error: ")[2].splitlines() or [type(e).__name__])[0]
        what = f"{path}: not a checkpoint as torch.save writes it since 1.6, or damaged ({reason[:160]})"
        older = f"; of an older torch: {SAVE_AGAIN.format(path=str(path))}" if head.startswith(b"\x80") else ""
        raise CheckpointError(what, remedy=COPY_AGAIN + older) from None


def save_torch(path: Path, content: Any) -> None:
    """Write what torch.load reads, the same bytes for the same content: torch would name it by the file.

    Atomically; raises as `atomic_path`.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def trainer_config(size: ActConfig, **known: Any) -> dict[str, Any]:
    """Return the config of the user's trainer as a plain dict, key for key.

    known: learning_rate, batch_size, data_dir and output_dir (by name only: a checkpoint is shown to others), device,
    seed, and rate_hz, written if it is not the trainer's 30.
    """
    ((height, width),) = size.image_sizes
    rate_hz = known.pop("rate_hz", RATE_HZ)
    shape = {
        "image_width": width, "image_height": height, "n_obs_steps": 1, "chunk_size": size.chunk,
        "n_action_steps": size.chunk, "hidden_size": size.dim, "n_encoder_layers": size.encoder_layers,
        "n_decoder_layers": size.decoder_layers, "n_heads": size.heads, "feedforward_dim": size.feedforward,
        "dropout": DROPOUT, "kl_weight": KL_WEIGHT, "vision_encoder": size.backbone,
        "pretrained_backbone": True,  # as the trainer writes it, whatever the weights came from
    }  # fmt: skip
    training = {"weight_decay": WEIGHT_DECAY, "betas": BETAS, "grad_clip": GRAD_CLIP} | OURS
    return shape | training | known | ({} if rate_hz == RATE_HZ else {"rate_hz": rate_hz})


KNOWN_CONFIG = {*trainer_config(ActConfig()), "learning_rate", "batch_size", "data_dir", "output_dir", "device", "seed"}
KNOWN_CONFIG |= {"rate_hz", "use_vae", "origin"}
