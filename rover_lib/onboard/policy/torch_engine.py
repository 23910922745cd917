"""Run artifacts in torch: TorchScript, whose INT8 operators run in the engine that the manifest names."""

from collections.abc import Sequence

import numpy as np
import torch

from rover_lib.onboard.artifact.archive import refused
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.memory import give_back_packed_weights


class TorchEngine:
    """A TorchScript archive. Make it with `load`."""

    def __init__(self, module: torch.jit.ScriptModule):
        self._module = module

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> list[np.ndarray]:
        # TorchScript re-optimises in its second call (0.37 G instructions on a Cortex-A76); the switch is thread-local.
        with torch.inference_mode(), torch.jit.optimized_execution(False):
            y = self._module(torch.from_numpy(state)[None], *(torch.from_numpy(f) for f in frames_rgb))
        return [each.numpy() for each in (y if isinstance(y, tuple) else (y,))]

    def give_back(self) -> bool:
        return give_back_packed_weights(self._module) > 0

    @property
    def threads(self) -> int:
        return torch.get_num_threads()


def load(artifact: Artifact, threads: int | None) -> TorchEngine:
    """Load an artifact. Raises ArtifactError if it was made with another torch, or cannot be loaded."""
    path, manifest = artifact.path, artifact.manifest
    made_with, here = str(manifest["versions"].get("torch", "?")), torch.__version__
    if made_with.split(".")[:2] != here.split(".")[:2]:
        remedy = "make it again where this torch is: rover run CHECKPOINT EPISODES"
        raise ArtifactError(f"{path}: made with torch {made_with}", found=here, remedy=remedy)
    torch.backends.quantized.engine = manifest["engine"]
    if threads:
        torch.set_num_threads(threads)
    try:
        module = torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, UnicodeEncodeError) as e:  # torch cannot open any name
        raise refused(path, f"TorchScript cannot load it ({str(e).splitlines()[0][:200]})") from None
    return TorchEngine(module)
