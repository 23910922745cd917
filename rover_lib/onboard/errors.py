"""Errors that a user can act on, as values: what was wrong, what was found, what to do.

    raise CameraError("the camera delivers no frames", found=source, remedy="is it plugged in?")

The command line prints them as one sentence and exits with 1; a traceback comes only with --debug. Whoever wants a part
of one reads its field, and never takes its text apart.
"""


class RoverError(Exception):
    """Base of every error that is the input's fault, not the program's.

    what: was wrong, a clause without a full stop. found: instead of what was expected, None if `what` says all.
    remedy: what to do about it, "" if there is nothing to say.
    """

    def __init__(self, what: str, *, found: object = None, remedy: str = ""):
        super().__init__(what)
        self.what, self.found, self.remedy = what, found, remedy

    def __str__(self) -> str:
        text = self.what if self.found is None else f"{self.what}, found {self.found}"
        return f"{text}; {self.remedy}" if self.remedy else text


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


class DistillError(RoverError):
    """A student that its teacher or the recordings cannot make."""


class FinetuneError(RoverError):
    """A policy, or recordings, of which nothing can be learned on."""


class ArtifactError(RoverError):
    """A policy file that is damaged, of another format, or that this machine cannot run."""


class PolicyError(RoverError):
    """A policy that was given, or gave, something that must not drive a car."""


class ParamsError(RoverError):
    """params.yml or a parameter that makes no sense."""


class CarError(RoverError):
    """A car.yml that describes no car, or none that may be driven."""


class TrainingError(RoverError):
    """A training that went wrong, or that cannot go on from what was saved of it."""


class WorldError(RoverError):
    """A run in the balloon world that cannot be made."""


class DriveFault(RoverError):
    """What stopped the car."""


class TakenOver(RoverError):
    """The human moved a stick."""
