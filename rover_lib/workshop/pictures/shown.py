"""Find pictures that show nothing, or not what the car saw.

A camera that stood still, black, white or grey pictures, a missing colour, a covered lens, pictures in no order or of
noise, colours or sides that are not those of the other drives.

    recordings = with_faults(recordings)     # its faults name them; `rover inspect` and notebook 01 do so

All are well-formed files, and a policy that learned from them is only known to be bad. Some pictures are looked at,
evenly chosen, each beside the next one; so 14,000 take seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np

from rover_lib.onboard.errors import EpisodeError
from rover_lib.workshop.pictures.beside import LEAST_DRIVES, find_swapped, find_upside_down
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Episode, Recordings, Sample, by_camera, pick_evenly

PLACES, LEAST_PLACES, MOST_DRIVES = 600, 6, 150  # looked at in all, and in a drive; drives
ENCODED = 3  # a PNG's or a video's picture costs some times more than a JPEG's, whose small version is decoded
SEEN = (96, 72)  # width and height to which pictures are scaled down
EQUAL = 0.05  # grey levels between two pictures, on average; a real camera's noise alone is 0.2
FROZEN = 10  # equal pictures in a row; a car that has just been started may stand for some
REPEATED, OF_ONE = 0.2, 0.22  # the share of equal neighbours; of public tubs at most 0.13, of one drive 0.19
MOVES = 0.01  # of throttle; a simulated car that stands sees equal pictures
FLAT = 8.0  # grey levels between the darkest and the brightest part; of real pictures 37 and more
BLANK = 0.05  # the share of a drive's pictures
DARK, BRIGHT = 24.0, 231.0
COVERED, DARK_PLACE = 0.2, 0.05  # the share of a picture that is always dark; beside drives with hardly any
CLIPPED, DAZZLED = 250, 0.5  # a white pixel, and their share in half of the pictures
COMPARED = 30  # samples of a drive; fewer show what the car stood before, or who carried it
COLOURLESS, COLOURED = 0.5, 4.0  # grey levels between a picture's colours, on average
LEAST_COMPARED = 12  # pairs of pictures
# From one picture to the next, the share of what changes between distant ones: at most 0.53 in 14 public tubs, of which
# one has 4 pictures a second; 1 if they are in no order. Less than DIFFER grey levels between distant ones say nothing.
UNRELATED, DIFFER = 0.8, 4.0
LEAST_STEPS = 6


@dataclass(frozen=True)
class _Drive:
    """What a drive's pictures show. pictures: (n, 72, 96, 3) float32, those that were looked at.

    changes: (m,), grey levels on average from a picture to the next one, of those at which the car moved. longest: the
    most equal ones in a row.
    """

    episode: Episode
    pictures: np.ndarray
    changes: np.ndarray
    longest: int

    @property
    def compared(self) -> int:
        """How many pictures were compared with the next one."""
        return len(self.changes)

    @property
    def equal(self) -> int:
        """How many of them equal it."""
        return int((self.changes < EQUAL).sum())

    @property
    def frozen(self) -> bool:
        return self.longest >= FROZEN

    @cached_property
    def _blocks(self) -> np.ndarray:
        return self.pictures.reshape(len(self.pictures), 8, SEEN[1] // 8, 12, SEEN[0] // 12, 3).mean((2, 4))

    @cached_property
    def flat(self) -> np.ndarray:
        """Whether each picture is of one colour, (n,) bool."""
        return np.ptp(self._blocks, axis=(1, 2)).max(1) < FLAT

    @property
    def shows_nothing(self) -> bool:
        return self.flat.mean() >= BLANK or self.white > DAZZLED or self.missing != "" or self.without_order

    @property
    def without_order(self) -> bool:
        """Whether a picture is as far from the next one as from any other, although the car moves."""
        if self.compared < LEAST_STEPS:
            return False
        distant = np.roll(self.pictures, len(self.pictures) // 2, axis=0)
        apart = float(np.median(_difference(self.pictures, distant)))
        return apart >= DIFFER and float(np.median(self.changes)) > UNRELATED * apart

    @cached_property
    def covered(self) -> float:
        """The share of a picture that is dark in all."""
        return float((self._blocks.max((0, 3)) < DARK).mean())

    @property
    def white(self) -> float:
        """The share of white pixels in the middle one of the pictures."""
        return float(np.median((self.pictures.min(3) >= CLIPPED).mean((1, 2))))

    @cached_property
    def missing(self) -> str:
        """The colour that no picture has beside the others, or ""."""
        most = np.quantile(self.pictures, 0.99, axis=(0, 1, 2))
        dark = most < DARK
        return ("blue", "green", "red")[int(dark.argmax())] if dark.sum() == 1 else ""


def with_faults(recordings: Recordings, progress: Progress = silent) -> Recordings:
    """Return the recordings with a fault for each drive whose pictures do not show what the car saw."""
    faults = Faults(recordings.root)
    episodes = pick_evenly(recordings.episodes, MOST_DRIVES)
    for name in recordings.layout.cameras:
        of_camera = f" of '{name}'" if len(recordings.layout.cameras) > 1 else ""
        drives = []
        for episode in progress(episodes, desc="what its pictures show", total=len(episodes)):
            drive = _look(episode, name, recordings, len(episodes))
            if drive is not None:
                drives.append(drive)
                _note_nothing(drive, of_camera, faults)
        _note_repeated(drives, of_camera, faults)
        _note_others([drive for drive in drives if not drive.shows_nothing], of_camera, faults)
    return replace(
        recordings, faults=tuple(sorted((*recordings.faults, *faults.listed()), key=lambda f: (f.file, f.kind)))
    )


def _look(episode: Episode, camera: str, recordings: Recordings, drives: int) -> _Drive | None:
    """Look at some pictures of a drive, each beside the next one; None if one cannot be read, as its fault says."""
    samples = episode.samples
    cheap = samples[0].frame_path.suffix.lower() in (".jpg", ".jpeg")
    count = max(PLACES // (1 if cheap else ENCODED) // drives, LEAST_PLACES)
    small = lru_cache(4)(lambda k: _scaled(samples[k], camera))
    moving = _moving(samples, recordings)
    pictures = []
    changes = []
    longest = 0
    try:
        for k in pick_evenly(range(len(samples)), count):
            pictures.append(small(k))
            if k + 1 == len(samples) or samples[k + 1].row != samples[k].row + 1 or not moving[k]:
                continue
            changes.append(float(_difference(small(k), small(k + 1))))
            if changes[-1] < EQUAL:
                longest = max(longest, _count_equal(samples, k, small, moving))
    except EpisodeError:
        return None
    return _Drive(episode, np.stack(pictures), np.array(changes), longest)


def _moving(samples: Sequence[Sample], recordings: Recordings) -> np.ndarray:
    """Whether the car moves at each sample, (n,) bool: by its throttle, or where that says nothing by any action."""
    actions = np.array([sample.chunk[0] for sample in samples], float)
    if recordings.layout.action_names == ACTION_NAMES and np.ptp(actions[:, 1]) > MOVES:
        return np.abs(actions[:, 1]) > MOVES
    return np.full(len(samples), bool(np.ptp(actions, axis=0).max() > MOVES))


def _count_equal(samples: Sequence[Sample], k: int, small: Any, moving: np.ndarray) -> int:
    """How many pictures around sample `k` equal their neighbours without a break, while an action changes."""
    first = last = k
    while first and moving[first - 1] and _difference(small(first - 1), small(k)) < EQUAL:
        first -= 1
    while last + 1 < len(samples) and moving[last] and _difference(small(last + 1), small(k)) < EQUAL:
        last += 1
    changed = np.ptp([sample.chunk[0] for sample in samples[first : last + 1]], axis=0).max()
    return last + 1 - first if changed > 0 else 1


def _note_nothing(drive: _Drive, of_camera: str, faults: Faults) -> None:
    """Add a fault for a camera that stood still, and for pictures of a single colour."""
    frames = drive.episode.frames
    means = drive.pictures.mean((1, 2, 3))
    flat = drive.flat
    if flat.mean() >= BLANK:
        mean = float(means[flat].mean())
        word = "of one colour"
        if mean < DARK:
            word = "black"
        elif mean > BRIGHT:
            word = "white"
        note = f"{flat.mean():.0%} of its pictures{of_camera} are {word}, and show nothing: leave them out"
        faults.add(drive.episode.place, "blank_pictures", note, max(round(flat.mean() * frames), 1))
    elif drive.white > DAZZLED:
        note = f"{drive.white:.0%} of its pictures{of_camera} are white: less light, or a shorter exposure"
        faults.add(drive.episode.place, "blank_pictures", note, frames)
    elif drive.missing:
        note = (
            f"its pictures{of_camera} have no {drive.missing}: leave it out, and look at the camera's cable and driver"
        )
        faults.add(drive.episode.place, "without_colours", note, frames)
    elif drive.frozen:
        count = max(round(drive.equal / drive.compared * frames), drive.longest)
        note = f"the picture{of_camera} stood still for {drive.longest} frames while actions changed: leave it out"
        faults.add(drive.episode.place, "frozen_camera", note, count)
    elif drive.without_order:
        note = (
            f"each picture{of_camera} differs from the next one as from any other: are they in another order, or noise?"
        )
        faults.add(drive.episode.place, "unordered_pictures", f"{note} Leave it out", frames)


def _note_repeated(drives: Sequence[_Drive], of_camera: str, faults: Faults) -> None:
    """Add a fault if all drives together, or one that was looked at often, have each picture several times."""
    rest = [drive for drive in drives if not drive.frozen]
    often = [drive for drive in rest if drive.compared >= LEAST_COMPARED and not drive.shows_nothing]
    groups = [[drive] for drive in often if drive.equal >= OF_ONE * drive.compared]
    compared = sum(drive.compared for drive in rest)
    equal = sum(drive.equal for drive in rest)
    if compared >= LEAST_COMPARED and equal >= REPEATED * compared:
        groups = [rest]
    for repeated in groups:
        share = sum(drive.equal for drive in repeated) / sum(drive.compared for drive in repeated)
        note = f"{share:.0%} of the pictures{of_camera} equal the next one, though the car moves"
        files = round(share * sum(drive.episode.frames for drive in repeated))
        place = faults.root if repeated is rest else repeated[0].episode.place
        faults.add(place, "repeated_pictures", f"{note}: is the camera slower, or does it stop now and then?", files)


def _note_others(drives: Sequence[_Drive], of_camera: str, faults: Faults) -> None:
    """Add a fault for each drive whose pictures beside the others' have no or other colours, or are upside down.

    The pieces of a session are one drive: its camera stays as it is while it lasts.
    """
    sessions: dict[str, list[_Drive]] = {}
    for drive in drives:
        if len(drive.episode.samples) >= COMPARED:
            sessions.setdefault(drive.episode.session or drive.episode.id, []).append(drive)
    long = list(sessions.values())
    if len(long) < LEAST_DRIVES:
        return
    covered = np.array([min(piece.covered for piece in pieces) for pieces in long])
    covered *= (covered < DARK_PLACE).mean() >= 0.5  # else the place is dark
    uncovered = []
    for pieces, share in zip(long, covered.tolist(), strict=True):
        if share <= COVERED:
            uncovered.append(pieces)
            continue
        note = f"{share:.0%} of each picture{of_camera} is black, and not of the other drives': leave it out"
        for drive in pieces:
            faults.add(drive.episode.place, "covered_lens", f"{note}, and look at the lens", drive.episode.frames)
    long = uncovered
    if len(long) < LEAST_DRIVES:
        return
    pictures = [np.concatenate([piece.pictures for piece in pieces]) for pieces in long]
    colours = np.array([float(np.ptp(image, axis=-1).mean()) for image in pictures])
    coloured = colours[colours >= COLOURLESS]
    grey = (colours < COLOURLESS) & bool(len(coloured) >= LEAST_DRIVES and np.median(coloured) > COLOURED)
    for kind, words, odd in (
        ("without_colours", "have no colours", grey),
        ("swapped_colours", "have red and blue swapped", find_swapped(pictures)),
        ("upside_down", "are upside down", find_upside_down(pictures)),
    ):
        reference = f"beside those of {len(long) - odd.sum()} other drives"
        if 2 * odd.sum() == len(long):
            reference += ", or these are"  # nobody can tell which half is right
        note = f"its pictures{of_camera} {words}, {reference}: turn them or leave them out"
        for pieces, is_odd in zip(long, odd, strict=True):
            for drive in pieces if is_odd else ():
                faults.add(drive.episode.place, kind, note, drive.episode.frames)


def _scaled(sample: Sample, camera: str) -> np.ndarray:
    frame = by_camera(sample.frame_bgr(SEEN[0]), camera)[camera]
    return cv2.resize(frame, SEEN, interpolation=cv2.INTER_AREA).astype(np.float32)


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the grey levels between pictures, (..., 72, 96, 3), on average: (...)."""
    return np.abs(a - b).mean((-3, -2, -1))
