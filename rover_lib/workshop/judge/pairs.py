"""Compare two policies that drove the same worlds, by the worlds that only one of them hit.

found = compare_pairs([True] * 39 + [False], [True] * 40)
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

Z = 1.959963984540054  # of 95 %
CHANCE = 0.05  # of the exact test's p: below it, a loss is not chance


def sign_test(only_one: int, only_other: int) -> float:
    """Return the exact two-sided p of worlds that only one of two policies hits (McNemar's exact test)."""
    n = only_one + only_other
    fewer = min(only_one, only_other)
    return min(1.0, 2 * sum(math.comb(n, k) for k in range(fewer + 1)) / 2**n)


def loss_interval(only_first: int, only_second: int, worlds: int) -> tuple[float, float]:
    """Return the 95 % interval of the first policy's share of hits less the second's, from -1 to 1.

    Tango's score interval for paired shares (Statistics in Medicine 17, 1998), which also holds where neither policy
    hits a world that the other misses.
    """

    def score(loss: float) -> float:
        b = -only_first - only_second + (2 * worlds - only_first + only_second) * loss
        root = math.sqrt(b * b + 8 * worlds * only_second * loss * (1 - loss))
        rare = (root - b) / (4 * worlds)
        spread = worlds * (2 * rare + loss * (1 - loss))
        gap = only_first - only_second - worlds * loss
        return gap / math.sqrt(spread) if spread > 0 else math.copysign(math.inf, gap)

    difference = (only_first - only_second) / worlds
    ends = []
    for low, high, target in ((-1.0, difference, Z), (difference, 1.0, -Z)):  # the score falls from end to end
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if score(middle) > target else (low, middle)
        ends.append((low + high) / 2)
    return ends[0], ends[1]


def compare_pairs(first: Sequence[bool], second: Sequence[bool]) -> dict[str, Any]:
    """Return how two policies compare that drove the same worlds. first, second: which worlds each has hit.

    p: of the exact test; small if they differ. loss_low, loss_high: 95 % interval of how many worlds fewer the second
    hits. least_loss: no smaller loss could have been seen in this number of worlds.
    """
    worlds = len(first)
    only_first = sum(a and not b for a, b in zip(first, second, strict=True))
    only_second = sum(b and not a for a, b in zip(first, second, strict=True))
    low, high = loss_interval(only_first, only_second, worlds)
    return {
        "only_first": only_first,
        "only_second": only_second,
        "p": sign_test(only_first, only_second),
        "loss_low": worlds * low,
        "loss_high": worlds * high,
        "least_loss": math.ceil(worlds * Z**2 / (worlds + Z**2)),
    }


def loses(pairs: Mapping[str, Any]) -> bool:
    """Whether the second policy hits fewer worlds than the first, beyond chance. pairs: of `compare_pairs`."""
    return pairs["only_first"] > pairs["only_second"] and pairs["p"] < CHANCE
