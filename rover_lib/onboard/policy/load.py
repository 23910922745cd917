"""Run an artifact, with whichever engine it needs: it turns a frame and a state into a chunk of actions."""

import ctypes
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rover_lib.onboard.artifact.archive import refused
from rover_lib.onboard.artifact.manifest import ONNXRUNTIME, PACKAGES, TORCH, Artifact, car_of
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import ArtifactError, PolicyError
from rover_lib.onboard.policy.confine import refuse_root
from rover_lib.onboard.policy.familiar import TOLERANCE, Familiar
from rover_lib.onboard.policy.preprocess import prepare_frame

# Each module has load(artifact, threads) -> Engine, which raises ArtifactError if it cannot run the open Artifact here.
# threads: None lets the engine choose.
MODULES = {TORCH: "rover_lib.onboard.policy.torch_engine", ONNXRUNTIME: "rover_lib.onboard.policy.onnx_engine"}


class Engine(Protocol):
    """An artifact's graph in one engine. threads: how many compute."""

    threads: int

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(S,) float32 and one (height, width, 3) uint8 per camera in. Raises RuntimeError.

        Returns (1, chunk, A), and (1, D) if the artifact gives an embedding.
        """

    def give_back(self) -> bool:
        """Free the memory that only loading needed, after a first run; return whether to check predictions again."""
        return False


def action_limits(names: Sequence[str], car: Car) -> np.ndarray:
    """Return (2, A) float32: the least and the greatest action of the car's pulses; infinite for other actions."""
    limits = dict(zip(("steering", "throttle"), car.limits.T.tolist(), strict=True))
    return np.array([limits.get(name, (-np.inf, np.inf)) for name in names], np.float32).T


class Policy:
    """A loaded artifact, as `load_policy` returns it. car: the car for which it plans.

    strange: how unfamiliar the newest prediction's picture is, as a share of the artifact's threshold, NaN if that
    cannot be told; None for an artifact without one. familiar: what tells it.
    """

    def __init__(self, path: Path, engine: Engine, manifest: dict[str, Any], familiar: Familiar | None = None):
        self.path = path
        self.manifest = manifest
        self.action_names: tuple[str, ...] = tuple(manifest["action_names"])
        self.state_names: tuple[str, ...] = tuple(manifest["state_names"])
        self.cameras: tuple[str, ...] = tuple(c["name"] for c in manifest["cameras"])
        self.chunk: int = manifest["chunk"]
        self.rate_hz = float(manifest["rate_hz"])
        self._engine = engine
        self.familiar = familiar
        self.strange: float | None = None
        self.car = car_of(manifest)
        self._low, self._high = action_limits(self.action_names, self.car)

    def predict_chunk(self, frame_bgr: np.ndarray | Mapping[str, np.ndarray], state: np.ndarray) -> np.ndarray:
        """Predict the next actions for one observation.

        Args:
            frame_bgr: (h, w, 3) uint8 of any size, as OpenCV gives it; a mapping by camera name if there are several.
            state: (S,) float, for the rover [steering, throttle] as last commanded.

        Returns:
            (chunk, A) float32; steering in [-1, 1], throttle in [0, 1] (from -1 if its car has reverse), other actions
            as predicted.

        Raises:
            PolicyError: for frames and states that are none of this policy's, and a prediction that is not finite.
        """
        return np.clip(self.predict_unclipped(frame_bgr, state), self._low, self._high)

    def predict_unclipped(self, frame_bgr: np.ndarray | Mapping[str, np.ndarray], state: np.ndarray) -> np.ndarray:
        """Predict like predict_chunk(), but without clipping.

        Raises PolicyError for frames and states that are none of this policy's, and a prediction that is not finite.
        """
        cameras = self.manifest["cameras"]
        frames = frame_bgr if isinstance(frame_bgr, Mapping) else {self.cameras[0]: frame_bgr}
        if set(frames) != set(self.cameras):
            raise PolicyError(f"the policy looks through {list(self.cameras)}", found=f"frames of {sorted(frames)}")
        state = np.asarray(state, np.float32)
        if state.shape != (len(self.state_names),):
            raise PolicyError(f"the state must have shape ({len(self.state_names)},)", found=state.shape)
        if not np.isfinite(state).all():
            raise PolicyError("the state is not finite", found=state.tolist(), remedy="send what was last commanded")
        chunk = self.run(state, [prepare_frame(frames[c["name"]], c["height"], c["width"]) for c in cameras])
        if not np.isfinite(chunk).all():
            raise PolicyError(f"{self.path}: the policy predicted NaN or Inf", remedy="stop the car and quantize again")
        return chunk

    def run(self, state: np.ndarray, frames_rgb: list[np.ndarray]) -> np.ndarray:
        """Run the bare graph on a state, (S,) float32, and prepared frames. Return (chunk, A) float32, not clipped."""
        y, *embeddings = self._engine.run(state, frames_rgb)
        if y.dtype != np.float32 or y.shape != (1, self.chunk, len(self.action_names)):
            problem = f"{self.path}: the policy must give {self.chunk} times {len(self.action_names)} float32"
            raise PolicyError(problem, found=f"{tuple(y.shape)} {y.dtype}", remedy="do not drive with it")
        shapes = [embedding.shape for embedding in embeddings]
        if shapes != ([(1, *self.familiar.mean.shape)] if self.familiar else []):
            raise PolicyError(f"{self.path}: gives another embedding than its manifest says", found=shapes)
        if self.familiar:
            self.strange = float(self.familiar.strange(embeddings[0])[0])
        return y[0].copy()

    @property
    def threads(self) -> int:
        """The number of threads that compute an inference."""
        return self._engine.threads


def import_engine(artifact: Artifact) -> Any:
    """Import the module of the engine that an artifact needs. Raises ArtifactError if it is not installed."""
    path = artifact.path
    name = artifact.manifest["engine"]
    try:
        return importlib.import_module(MODULES[name])
    except KeyError:
        names = f"this rover_lib knows {', '.join(PACKAGES)}"
        raise ArtifactError(f"{path}: needs the engine '{name[:80]}'", remedy=names) from None
    except ImportError as e:
        problem = f"{path}: needs {PACKAGES[name]}, which cannot be imported here ({e})"
        raise ArtifactError(problem, remedy=f"install {PACKAGES[name]}, or use an artifact of another engine") from None


def load_policy(source: Path | str | Artifact, *, threads: int | None = None) -> Policy:
    """Load an artifact, and prove that it computes the same here as where it was made.

    Args:
        source: a file, or an open artifact.
        threads: for the engine's kernels (with torch, of the whole process); None leaves their number unchanged.

    Returns:
        The policy, whose parity vectors have also warmed the kernels.

    Raises:
        ArtifactError: if checksums, manifest, engine or parity vectors fail, and for root.
    """
    refuse_root()
    if not isinstance(source, Artifact):
        with Artifact(source) as artifact:
            return load_policy(artifact, threads=threads)
    source.prove()
    engine = import_engine(source).load(source, threads)
    path = source.path
    vectors = source.parity
    policy = Policy(path, engine, source.manifest, Familiar.of(vectors))
    chunks, strange = _predict(policy, vectors)
    _check(policy, chunks, strange, vectors)
    if engine.give_back() and not np.array_equal(_predict(policy, vectors)[0], chunks):
        raise ArtifactError(f"{path}: predicts differently without its original weights", remedy="do not drive")
    give_back_freed()
    return policy


def give_back_freed() -> None:
    """Give the kernel the memory that malloc keeps for later. After loading an artifact, that is tens of MB."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):  # glibc has it
        libc.malloc_trim(0)


def _predict(policy: Policy, vectors: Mapping[str, np.ndarray]) -> tuple[np.ndarray, list[float | None]]:
    """Return the policy's answers to the parity vectors: (n, chunk, A) float32, and n times Policy.strange."""
    frames = [vectors[f"frame_{c}"] for c in policy.cameras]
    chunks = []
    strange = []
    try:
        for i, state in enumerate(vectors["state"]):
            chunks.append(policy.run(state, [f[i] for f in frames]))
            strange.append(policy.strange)
        return np.stack(chunks), strange
    except PolicyError as e:
        raise ArtifactError(e.what, found=e.found, remedy=e.remedy) from None
    except (IndexError, RuntimeError) as e:
        why = " ".join(str(e).split())[-200:]
        raise refused(policy.path, f"its parity vectors do not run ({why})") from None


def _check(policy: Policy, chunks: np.ndarray, strange: list[float | None], vectors: Mapping[str, np.ndarray]) -> None:
    """Raise ArtifactError if the answers, those of _predict, differ more from the vectors' than is tolerated."""
    differences = dict(zip(policy.action_names, np.abs(chunks - vectors["chunk"]).max((0, 1)).tolist(), strict=True))
    tolerance = dict(policy.manifest["parity"]["tolerance"])
    if policy.familiar:
        policy.familiar.check_limits(vectors["embedding"], policy.path)
        measure = "how unfamiliar a picture is, of the threshold,"
        differences[measure] = np.abs(policy.familiar.strange(vectors["embedding"]) - np.array(strange)).max()
        tolerance[measure] = TOLERANCE[policy.manifest["mode"] != "fp32"]
    for name, d in differences.items():
        if not d <= tolerance[name]:  # so that NaN fails too
            problem = f"{policy.path}: computes something else here than where it was made: {name} differs by {d:.3g}"
            raise ArtifactError(problem, remedy="do not drive with it")
