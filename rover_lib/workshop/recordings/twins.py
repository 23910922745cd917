"""Leave out drives that are there twice: copies, and mirrored copies, as donkeycar's flop_tub makes them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rover_lib.workshop.recordings import copies
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import Episode


def leave_out_copies(episodes: Sequence[Episode], faults: Faults) -> tuple[Episode, ...]:
    """Return the episodes without copies of others, of which the longest is kept, and without mirrored ones.

    Held out, a mirrored drive is judged by a policy that was calibrated, or trained, on its twin.
    """
    unique = list(episodes)
    for episode, same in copies.find_copies(episodes):
        faults.add(episode.place, "copy", f"the same drive as {same.id}, as its actions and pictures show")
        unique.remove(episode)
    originals = {_mirror(episode): episode for episode in unique}
    twins = set[Episode]()
    for pair in sorted(copies.find_copies((*unique, *originals)), key=lambda pair: pair[0].place.as_posix()):
        pieces = [originals.get(episode, episode) for episode in pair]
        first, second = sorted(pieces, key=lambda e: (-len(e.samples), unique.index(e)))
        if first is not second and not twins & {first, second} and not _is_symmetric(first):
            twins.add(second)
            note = f"the same drive as {first.id}, mirrored, as its actions and pictures show"
            faults.add(second.place, "copy", note)
    return tuple(episode for episode in unique if episode not in twins)


def _is_symmetric(episode: Episode) -> bool:
    """Whether its pictures look the same turned over, so that a mirrored drive cannot be told from another one."""
    rows = [(k, k) for k in range(len(episode.samples))]
    return copies.look_alike(episode, _mirror(episode), rows, copies.scaled_down)


def _mirror(episode: Episode) -> Episode:
    """Return an episode whose pictures are turned over, and which steers to the other side."""
    other = np.array([-1, *[1] * (episode.samples[0].chunk.shape[1] - 1)], np.float32)
    samples = tuple(replace(s, chunk=s.chunk * other, mirrored=not s.mirrored) for s in episode.samples)
    return replace(episode, id=f"{episode.id} mirrored", samples=samples)
