"""Leave out drives that are there twice: copies, and mirrored copies, as donkeycar's flop_tub makes them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rover_lib.workshop.recordings import copies
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import Episode

MIRRORED, OF = " mirrored", "the same drive as "  # the latter as copies.py begins its notes


def leave_out_copies(episodes: Sequence[Episode], faults: Faults) -> tuple[Episode, ...]:
    """Return the episodes without copies of others, of which the longest is kept, and without mirrored ones.

    Held out, a mirrored drive is judged by a policy that was calibrated, or trained, on its twin.
    """
    unique = copies.leave_out_copies(episodes, faults)
    twins = Faults(faults.root)
    twin_names = set[str]()
    copies.leave_out_copies((*unique, *map(_mirror, unique)), twins)
    by_name = {f"{episode.id}{MIRRORED}": episode for episode in unique} | {episode.id: episode for episode in unique}
    for fault in twins.listed():  # of a mirrored one and another
        names = Path(fault.file).name, fault.note.partition(OF)[2].partition(", as ")[0]
        pair = sorted((by_name[n] for n in names if n in by_name), key=lambda e: (-len(e.samples), unique.index(e)))
        first = pair[0]
        second = pair[-1]
        if first is not second and not twin_names & {first.id, second.id} and not _is_symmetric(first):
            twin_names.add(second.id)
            faults.add(second.place, "copy", f"{OF}{first.id}, mirrored, as its actions and pictures show")
    return tuple(episode for episode in unique if episode.id not in twin_names)


def _is_symmetric(episode: Episode) -> bool:
    """Whether its pictures look the same turned over, so that a mirrored drive cannot be told from another one."""
    rows = [(k, k) for k in range(len(episode.samples))]
    return copies.look_alike(episode, _mirror(episode), rows, copies.scaled_down)


def _mirror(episode: Episode) -> Episode:
    """Return an episode whose pictures are turned over, and which steers to the other side."""
    other = np.array([-1, *[1] * (episode.samples[0].chunk.shape[1] - 1)], np.float32)
    samples = tuple(replace(s, chunk=s.chunk * other, mirrored=not s.mirrored) for s in episode.samples)
    return replace(episode, id=f"{episode.id}{MIRRORED}", samples=samples)
