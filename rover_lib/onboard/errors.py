"""Errors that a user can act on, as values: what was wrong, what was found, what to do.

    raise CameraError("the camera delivers no frames", found=source, remedy="is it plugged in?")

The command line prints an error as one sentence. Code that needs a part of an error reads that field.
"""

import errno
import os

ELSEWHERE = "name another place, or let this user write there (ls -ld shows whose it is)"
SYSTEM_REMEDIES = {  # what a user can do about an error of the system
    errno.ENOSPC: "make room on that disk (df -h shows it)",
    errno.EACCES: ELSEWHERE,
    errno.EPERM: ELSEWHERE,
    errno.EROFS: "name a place on another disk, this one is read-only",
    errno.ENOENT: "is its name right?",
}


class RoverError(Exception):
    """Base of every error that is caused by the input and not by the program.

    what: what was wrong, a clause without a full stop. found: what was found instead; None if `what` says it. remedy:
    what the user can do, or "". kind: by which code tells it from others: "not armed", "taken over" or "exists".
    """

    def __init__(self, what: str, *, found: object = None, remedy: str = "", kind: str = ""):
        super().__init__(what)
        self.what = what
        self.found = found
        self.remedy = remedy
        self.kind = kind

    def __str__(self) -> str:
        text = self.what
        if self.found is not None:
            text += f", found {self.found}"
        if self.remedy:
            text += f"; {self.remedy}"
        return text


def of_system(error: OSError) -> RoverError:
    """Return a system's error in a sentence with its file, if it names one, and a remedy."""
    reason = os.strerror(error.errno).lower() if error.errno else f"{type(error).__name__}: {error}"
    place = f"{printable(str(error.filename))}: " if error.filename else ""
    return RoverError(f"{place}{reason}", remedy=SYSTEM_REMEDIES.get(error.errno or 0, ""))


def printable(value: object) -> object:
    """Return a text with what could control a terminal escaped; any other value as it is."""
    return value if not isinstance(value, str) or value.isprintable() else repr(value)[1:-1]


def sentence_of(error: BaseException) -> str:
    """One sentence for any error: a RoverError's own text; for an unexpected error, its type and its text."""
    return str(error) if isinstance(error, RoverError) else f"{type(error).__name__}: {error}"


class CheckpointError(RoverError):
    """A checkpoint that cannot be read, or whose config and weights do not agree."""


class EpisodeError(RoverError):
    """A recording, or a set of recordings, that cannot be used at all."""


class ArtifactError(RoverError):
    """A policy file that cannot be made, is damaged or of another format, or cannot run on this machine."""


class PolicyError(RoverError):
    """An input to a policy, such as a frame, or a prediction of it, that must not drive a car."""


class ParamsError(RoverError):
    """A params.yml that cannot be read, or a parameter with an impossible value."""


class CarError(RoverError):
    """A car.yml or a gamepad that must not be driven with, or a value that must not become a servo pulse."""


class TrainingError(RoverError):
    """A training, a student or a trial that is not possible, failed, or cannot continue from its saved state."""


class CameraError(RoverError):
    """A camera that is missing, has stopped, or delivers something different than before, or a damaged picture."""


class DriveFault(RoverError):
    """What stopped the car: a fault, or the human, who moved a stick."""
