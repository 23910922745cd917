"""Errors that a user can act on: one sentence with what was wrong, what was found and what to do.

The command line prints the sentence and exits with 1; a traceback comes only with --debug.
"""


class RoverError(Exception):
    """Base of every error that is the input's fault, not the program's."""


def sentence_of(error: BaseException) -> str:
    """What to say of any error: a RoverError's own words; of what the program did not foresee also its name."""
    return str(error) if isinstance(error, RoverError) else f"{type(error).__name__}: {error}"


class CheckpointError(RoverError):
    """A checkpoint that cannot be read, or whose config and weights do not agree."""


class EpisodeError(RoverError):
    """A recording, or a set of recordings, that cannot be used at all."""


class PwmError(RoverError):
    """A value that must not become a servo pulse."""


class FrameError(RoverError):
    """A camera frame of a shape or type that is no picture."""


class QuantizeError(RoverError):
    """A quantization that changed nothing, or that made a value which cannot be used."""


class ArtifactError(RoverError):
    """A policy file that is damaged, of another format, or that this machine cannot run."""


class PolicyError(RoverError):
    """A policy that was given, or gave, something that must not drive a car."""


class ParamsError(RoverError):
    """params.yml or a parameter that makes no sense."""


class WorldError(RoverError):
    """A playground run that cannot be made."""


class DriveFault(RoverError):
    """What stopped the car."""


class TakenOver(RoverError):
    """The human moved a stick."""
