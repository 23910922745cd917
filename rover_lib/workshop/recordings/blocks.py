"""Part long drives into blocks, so that a recording of minutes has parts to learn from and parts that judge.

Our own drives take seconds, and whole ones are parted. A tub is a few drives of many laps: its samples, in their order,
are cut into blocks of about half a minute with equally many samples each. Between blocks of different parts lies a gap
of one plan, so that no part has another's actions. What all blocks share is the track and the hour.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rover_lib.workshop.recordings.samples import Episode, Sample, frame_rate_hz

BLOCK_S, SHORTER_S = 30.0, 20.0  # seconds; the shorter where there would be fewer than
WANTED = 32  # blocks, a quarter of which are eight that are held out
FEWEST = 12, 8  # blocks of a short drive, where they are at least two plans long, and else
MANY_DRIVES, LONG_S = 20, 60.0  # drives stay whole from that many on, or if all are that short
SAME_PLACE = "the same track and hour"
PARTS = ("calibration", "choosing", "held_out")  # each may take the gap from those before it


def usual_rate_hz(episodes: Sequence[Episode]) -> float:
    """The median of the episodes' frames per second; 0 if none has two frames."""
    rates = [rate_hz for e in episodes if (rate_hz := frame_rate_hz(e.samples)) is not None]
    return float(np.median(rates)) if rates else 0.0


def name_blocks(episodes: Sequence[Episode], place: str = "") -> tuple[tuple[Episode, ...], tuple[str, ...]]:
    """Return the episodes of one place with each sample's block named, and the names; as they are if all is too short.

    place: its name, which the blocks' names begin with.
    """
    rate_hz = usual_rate_hz(episodes)
    total = sum(len(e.samples) for e in episodes)
    count = _count(total / rate_hz, len(episodes[0].samples[0].chunk) / rate_hz) if rate_hz else 0
    if not count:
        return tuple(episodes), ()
    names = tuple(f"{place} block {i + 1} of {count}".strip() for i in range(count))
    named = list[Episode]()
    done = 0
    for e in episodes:
        samples = [replace(s, block=names[(done + k) * count // total]) for k, s in enumerate(e.samples)]
        named.append(replace(e, samples=tuple(samples)))
        done += len(samples)
    return tuple(named), names


def name_long_drives(episodes: Sequence[Episode]) -> tuple[tuple[Episode, ...], tuple[tuple[str, ...], ...]]:
    """The same of recordings whose whole episodes are parted, unless they are few, and some of them long."""
    if len(episodes) >= MANY_DRIVES or max(e.duration_s for e in episodes) <= LONG_S:
        return tuple(episodes), ()
    episodes, names = name_blocks(episodes)
    return episodes, (names,) if names else ()


def _count(length_s: float, plan_s: float) -> int:
    """How many blocks a place of that length has; 0 if even the fewest would be shorter than a plan."""
    maximum, minimum = FEWEST
    if length_s < 2 * plan_s * maximum:
        return minimum if length_s >= plan_s * minimum else 0
    return max(maximum, round(length_s / min(BLOCK_S, max(SHORTER_S, length_s / WANTED))))


def draw_blocks(places: Sequence[Sequence[str]], share: float, rng: np.random.Generator) -> dict[str, str]:
    """Draw the blocks of choosing and held_out, and return their part by the block's name.

    places: the names of the blocks of each place, in their order. Of each, `share` is drawn, evenly over the place:
    one block of each piece of it, in turn for judging and for choosing.
    """
    drawn = {}
    for names in places:
        count = min(max(int(len(names) * share), 2), len(names) - 1)
        for i, piece in enumerate(np.array_split(np.arange(len(names)), count)):
            drawn[names[int(rng.choice(piece))]] = PARTS[1] if i % 2 else PARTS[2]
    return drawn


def part_by_blocks(episodes: Sequence[Episode], drawn: Mapping[str, str]) -> dict[str, tuple[Sample, ...]]:
    """Return the samples of each part, without those of the gaps. drawn: what draw_blocks returned."""
    pairs: list[tuple[Episode, Sample]] = []
    for episode in episodes:
        pairs += [(episode, sample) for sample in episode.samples]
    ranks = np.array([PARTS.index(drawn.get(s.block, PARTS[0])) for _, s in pairs])
    usable = np.ones(len(pairs), bool)
    chunk = len(pairs[0][1].chunk)
    plan_s = chunk / (usual_rate_hz(episodes) or 1.0)

    def is_near(e: Episode, s: Sample, other: Episode, o: Sample) -> bool:
        """Whether two samples lie less than a plan apart."""
        if e is other:
            return abs(s.row - o.row) < chunk
        apart_s = abs(e.begin_s + s.time_s - other.begin_s - o.time_s)
        return e.session != "" and e.session == other.session and apart_s < plan_s

    for at in (np.flatnonzero(np.diff(ranks)) + 1).tolist():
        for border, step in ((at - 1, 1), (at, -1)):  # the last sample before, and the first one after
            i = border + step
            while 0 <= i < len(pairs) and is_near(*pairs[border], *pairs[i]):
                usable[i] &= ranks[i] >= ranks[border]
                i += step
    return {part: tuple(pairs[i][1] for i in np.flatnonzero(usable & (ranks == k))) for k, part in enumerate(PARTS)}
