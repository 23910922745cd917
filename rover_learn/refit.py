"""Refit a layer that reads fewer inputs than before to the output that all of them gave.

grams = grams_of({"head": layer}, rows_of, run)        # of what each layer reads while run() runs
weight = refit_layer(whole, grams["head"], kept)
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack

import torch
from torch import Tensor, nn

RIDGE = 1e-4  # times an input's mean square: it keeps the weights as they were where the rows say nothing
ROWS = 4096  # rows that are multiplied at once; few, because they become double and memory is small


class Gram:
    """The mean of x x^T over rows that come a few at a time. x is a row with a 1 appended."""

    def __init__(self) -> None:
        self._sum: Tensor | None = None
        self._waiting: list[Tensor] = []
        self._count = 0

    def add(self, rows: Tensor) -> None:
        """Add rows, (n, inputs), on any device."""
        self._waiting.append(rows.cpu().clone())
        if sum(map(len, self._waiting)) >= ROWS:
            self._multiply()

    def mean(self) -> Tensor:
        """Return the mean, (inputs + 1, inputs + 1) float64, once: for 512 channels of 3x3 it has 170 MB."""
        if self._waiting:
            self._multiply()
        assert self._sum is not None
        mean, self._sum = self._sum.div_(self._count), None
        return mean

    def _multiply(self) -> None:
        rows = torch.cat(self._waiting)
        self._waiting = []
        x = torch.ones(len(rows), rows.shape[1] + 1, dtype=torch.float64)
        x[:, :-1] = rows
        if self._sum is None:
            self._sum = x.new_zeros(x.shape[1], x.shape[1])
        self._sum.addmm_(x.T, x)
        self._count += len(x)


@torch.no_grad()
def grams_of(
    layers: Mapping[str, nn.Module], rows_of: Callable[[Tensor], Iterable[Tensor]], run: Callable[[], object]
) -> dict[str, Tensor]:
    """Return `Gram.mean` of what each layer reads in run(). rows_of: rows, (n, inputs) each, of a layer's input."""
    grams = {name: Gram() for name in layers}

    def watch(gram: Gram) -> Callable[[nn.Module, tuple[Tensor]], None]:
        def hook(_: nn.Module, args: tuple[Tensor]) -> None:
            for rows in rows_of(args[0]):
                gram.add(rows)

        return hook

    with ExitStack() as hooks:
        for name, layer in layers.items():
            hooks.enter_context(layer.register_forward_pre_hook(watch(grams[name])))
        run()
    return {name: gram.mean() for name, gram in grams.items()}


def refit_layer(whole: Tensor, gram: Tensor, kept: Tensor) -> Tensor:
    """Compute the weights of the inputs that stay, by least squares.

    whole: (inputs + 1, outputs) float64, the bias last. gram: from `Gram.mean`. kept: (n,), the inputs that stay.
    Returns the weights, (n + 1, outputs) float64.
    """
    rows = torch.cat([kept, torch.tensor([len(gram) - 1])])  # and the 1 that carries the bias
    cut = whole[rows]
    inside = gram[rows][:, rows]
    # The least squares are of what is missing, so that the old weights stay where the rows say nothing.
    ridge = RIDGE * inside.diagonal()[:-1].mean() * torch.eye(len(rows), dtype=gram.dtype)
    return cut + torch.linalg.solve(inside + ridge, gram[rows] @ whole - inside @ cut)
