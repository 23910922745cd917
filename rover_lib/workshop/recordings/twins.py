"""Leave out drives that are there twice: copies, mirrored ones, as of donkeycar's flop_tub, and backward ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rover_lib.workshop.recordings import copies
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import Episode

MIRRORED, BACKWARDS = ", mirrored", ", backwards"  # ways in which a drive is another's twin


def leave_out_copies(episodes: Sequence[Episode], faults: Faults) -> tuple[Episode, ...]:
    """Return the episodes without copies of others, of which the longest is kept, nor mirrored or backward ones.

    Held out, such a drive is judged by a policy that was calibrated, or trained, on its twin.
    """
    turned = {_mirror(episode): (episode, MIRRORED) for episode in episodes}
    turned |= {replace(episode, samples=episode.samples[::-1]): (episode, BACKWARDS) for episode in episodes}
    left_out = set[Episode]()
    pairs = copies.find_copies((*episodes, *turned))
    for pair in sorted(pairs, key=lambda pair: (not turned.keys().isdisjoint(pair), pair[0].place.as_posix())):
        (one, one_way), (other, other_way) = (turned.get(episode, (episode, "")) for episode in pair)
        first, second = sorted((one, other), key=lambda e: (-len(e.samples), episodes.index(e)))
        if first is second or left_out & {first, second} or (one_way and other_way):
            continue
        way = one_way or other_way
        if way == MIRRORED and _is_symmetric(first):
            continue
        if way == BACKWARDS and not copies.pictures_change(first):
            continue  # of a picture that stands still nothing says which way it goes
        left_out.add(second)
        faults.add(second.place, "copy", f"the same drive as {first.id}{way}, as its actions and pictures show")
    return tuple(episode for episode in episodes if episode not in left_out)


def _is_symmetric(episode: Episode) -> bool:
    """Whether its pictures look the same turned over, so that a mirrored drive cannot be told from another one."""
    rows = [(k, k) for k in range(len(episode.samples))]
    return copies.look_alike(episode, _mirror(episode), rows, copies.scaled_down)


def _mirror(episode: Episode) -> Episode:
    """Return an episode whose pictures are turned over, and which steers to the other side."""
    other = np.array([-1, *[1] * (episode.samples[0].chunk.shape[1] - 1)], np.float32)
    samples = tuple(replace(s, chunk=s.chunk * other, mirrored=not s.mirrored) for s in episode.samples)
    return replace(episode, id=f"{episode.id} mirrored", samples=samples)
