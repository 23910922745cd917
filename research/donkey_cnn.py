"""What does a network like donkeycar's `linear` learn from the same recordings, on the same split, as `rover train`?

    python -m research.donkey_cnn cnn.json TUB...      # or EPISODES; a minute of processor each, half of it training
    VARY='{"light": 0.25}' python -m research.donkey_cnn varied.json TUB...    # as rover_learn.augment varies pictures

KerasLinear's layout: five convolutions, two dense layers, dropout, MSE, Adam, no augmentation, early stopping, and the
picture alone. It looks at 80x60, for which its last two convolutions are padded; its linear outputs are steering now
and later. cnn.json has {name: {"r2": {"0": 0.6, "0.25": ..., "0.5": ..., "1": ...}, ...}}.
"""

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from rover_learn.augment import Augmentation, vary
from rover_lib.onboard.params import params
from rover_lib.workshop.recordings.blocks import usual_rate_hz
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Sample, pick_evenly
from rover_lib.workshop.recordings.source import Source

WIDTH, HEIGHT = 80, 60
AHEAD_S = (0.0, 0.25, 0.5, 1.0)
BATCH, RATE, DROPOUT = 32, 1e-3, 0.2
EPOCHS, PATIENCE = 12, 5  # a fixed count, so that a busy machine gives the same figures
EPOCH, MOST = 4000, 16_000  # pictures of an epoch, and of a part


def linear(outputs: int = len(AHEAD_S)) -> nn.Module:
    """Make the network: (n, 3, 60, 80) float in [0, 1] -> (n, outputs)."""
    layers: list[nn.Module] = []
    for into, out, kernel, stride, pad in ((3, 24, 5, 2, 0), (24, 32, 5, 2, 0), (32, 64, 5, 2, 0), (64, 64, 3, 1, 1),
                                           (64, 64, 3, 1, 1)):  # fmt: skip
        layers += [nn.Conv2d(into, out, kernel, stride, pad), nn.ReLU(), nn.Dropout(DROPOUT)]
    layers += [nn.Flatten()]
    for out in (100, 50):
        layers += [nn.LazyLinear(out), nn.ReLU(), nn.Dropout(DROPOUT)]
    network = nn.Sequential(*layers, nn.LazyLinear(outputs))
    network(torch.zeros(1, 3, HEIGHT, WIDTH))
    for layer in network:
        if isinstance(layer, nn.Conv2d | nn.Linear):  # as Keras begins
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    return network


def tensors(samples: Sequence[Sample], rate_hz: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return pictures, (n, 3, 60, 80) uint8 RGB; steering at AHEAD_S; and whether it was driven, both (n, 4)."""
    steps = [round(s * rate_hz) for s in AHEAD_S]
    pictures = np.empty((len(samples), 3, HEIGHT, WIDTH), np.uint8)
    for i, sample in enumerate(samples):
        small = cv2.resize(sample.frame_bgr(HEIGHT), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        pictures[i] = small[..., ::-1].transpose(2, 0, 1)
    steering = np.array([sample.chunk[steps, 0] for sample in samples], np.float32)
    mask = ~np.array([sample.is_pad[steps] for sample in samples])
    return torch.from_numpy(pictures), torch.from_numpy(steering), torch.from_numpy(mask)


@torch.no_grad()
def predict(network: nn.Module, pictures: Tensor) -> Tensor:
    """Return (n, 4) steering."""
    network.eval()
    return torch.cat([network(part.float() / 255) for part in pictures.split(256)])


def varied(pictures: Tensor, augmentation: Augmentation, rng: np.random.Generator) -> Tensor:
    """Return pictures, (n, 3, 60, 80) uint8, varied, as float32 from 0 to 255."""
    moved = torch.from_numpy(augmentation.shifted(pictures.permute(0, 2, 3, 1).contiguous().numpy(), rng))
    drawn = augmentation.draw(len(moved), rng)
    return vary(moved, {name: torch.from_numpy(values) for name, values in drawn.items()}).contiguous()


def train(
    learning: Sequence[Tensor], choosing: Sequence[Tensor], seed: int, augmentation: Augmentation
) -> tuple[nn.Module, int]:
    """Return the network of the least error on the choosing part, and how many epochs it was trained."""
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    network, (pictures, steering, mask) = linear(), learning
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    best, weights, idle, epochs = float("inf"), network.state_dict(), 0, 0
    while idle < PATIENCE and epochs < EPOCHS:
        network.train()
        for rows in torch.randperm(len(pictures))[:EPOCH].split(BATCH):
            errors = (network(varied(pictures[rows], augmentation, rng) / 255) - steering[rows]) ** 2
            optimizer.zero_grad()
            errors[mask[rows]].mean().backward()
            optimizer.step()
        error = float(((predict(network, choosing[0]) - choosing[1]) ** 2)[choosing[2]].mean())
        idle, epochs = idle + 1, epochs + 1
        if error < best:
            best, idle, weights = error, 0, {k: v.clone() for k, v in network.state_dict().items()}
    network.load_state_dict(weights)
    return network, epochs


def r2(answers: Tensor, wanted: Tensor) -> float:
    """Return the share of the variance that the answers explain: 0 for the mean, 1 for the driver's own actions."""
    return 1 - float(((answers - wanted) ** 2).mean() / wanted.var(correction=0))


def judge(source: Path | str | Source, augmentation: Augmentation) -> dict[str, Any]:
    """Train on recordings, and return R² of steering on the held-out part, by seconds ahead, and how it came about."""
    torch.set_num_threads(1)  # at this size, a second one mostly waits
    p = params()["calibration"]
    recordings = load_recordings(source)
    parts, rate_hz = split(recordings, p["held_out_share"], p["seed"]), usual_rate_hz(recordings.episodes)
    three = (parts.calibration, parts.choosing, parts.held_out)
    learning, choosing, held_out = (tensors(pick_evenly(part, MOST), rate_hz) for part in three)
    network, epochs = train(learning, choosing, p["seed"], augmentation)
    answers, recorded, mask = predict(network, held_out[0]).double(), held_out[1].double(), held_out[2]
    shares = {}
    for i, ahead_s in enumerate(AHEAD_S):
        rows = mask[:, i]
        shares[f"{ahead_s:g}"] = round(r2(answers[rows, i], recorded[rows, i]), 4)
    return {
        "r2": shares,
        "rate_hz": round(rate_hz, 2),
        "epochs": epochs,
        "split": parts.note,
    }


def main(out: str, *sources: str) -> None:
    """Judge one after the other, and write what is known after each."""
    path = Path(out)
    augmentation = Augmentation(**json.loads(os.environ.get("VARY", "{}")))
    results = json.loads(path.read_text()) if path.exists() else {}
    for source in sources:
        name = Path(source).name
        results[name] = judge(source, augmentation)
        print(f"{name}: R² {results[name]['r2']}", flush=True)
        path.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
