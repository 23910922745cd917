"""Run artifacts on a Hailo chip: it runs a compiled network (HEF), and ONNX Runtime runs the rest on the processor.

Nobody here could run this: it was written by HailoRT's documentation, and parity vectors are checked on the device.
"""

import math
from collections.abc import Sequence
from typing import Any

import hailo_platform
import numpy as np

from rover_lib.onboard.artifact.archive import HEF, ONNX
from rover_lib.onboard.artifact.engines import Engine
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.onnx_engine import session_of

UNCONFINED = "HailoRT talks to the chip through its driver"
TIMEOUT_MS = 1000  # for one inference: about thirty times what it should take


class HailoEngine(Engine):
    """A network on the chip, and the rest of the policy on the processor. Make it with `load`."""

    def __init__(self, artifact: Artifact, threads: int | None):
        self._path, cameras = artifact.path, artifact.manifest["cameras"]
        answers = artifact.manifest["hailo"]["outputs"]  # name: shape
        shapes = {f"frame_{c['name']}": [c["height"], c["width"], 3] for c in cameras}
        formats = hailo_platform.FormatType
        self._device = hailo_platform.VDevice()
        self._model = self._device.create_infer_model(artifact.record(HEF))
        self._inputs = self._match(self._model.inputs, shapes)
        outputs = self._match(self._model.outputs, answers)
        for stream in self._inputs.values():
            self._model.input(stream).set_format_type(formats.UINT8)
        for stream in outputs.values():
            self._model.output(stream).set_format_type(formats.FLOAT32)
        self._network = self._model.configure()
        self._bindings = self._network.create_bindings()
        self._answers = {name: np.empty(shape, np.float32) for name, shape in answers.items()}
        for name, buffer in self._answers.items():
            self._bindings.output(outputs[name]).set_buffer(buffer)
        self.threads = threads or usable_cores()
        self._rest = session_of(artifact.record(ONNX), self.threads, self._path)

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> list[np.ndarray]:
        """As Engine.run()."""
        try:
            for stream, frame in zip(self._inputs.values(), frames_rgb, strict=True):
                self._bindings.input(stream).set_buffer(np.ascontiguousarray(frame))
            self._network.run([self._bindings], TIMEOUT_MS)
            return self._rest.run(None, {"state": state[None], **self._answers})
        except Exception as e:  # HailoRT raises a dozen types, and so does ONNX Runtime
            raise RuntimeError(f"{type(e).__name__}: {e}") from None

    def _match(self, streams: list[Any], shapes: dict[str, list[int]]) -> dict[str, str]:
        """Return HailoRT's name of the stream for each of our names, by size. ArtifactError if two have the same."""
        names = {math.prod(s.shape): s.name for s in streams}
        matched = {name: names.get(math.prod(shape), "") for name, shape in shapes.items()}
        if sorted(matched.values()) != sorted(s.name for s in streams):
            found = ", ".join(f"{s.name} {list(s.shape)}" for s in streams)
            raise ArtifactError(f"{self._path}: its HEF has other streams than {shapes}", found=found)
        return matched


def load(artifact: Artifact, threads: int | None) -> HailoEngine:
    """Load an artifact. Raises ArtifactError without a chip, or if HailoRT or the manifest's "hailo" is not for it."""
    try:
        return HailoEngine(artifact, threads)
    except ArtifactError:
        raise
    except Exception as e:
        why = " ".join(f"{type(e).__name__}: {e}".split())[:200]
        remedy = "is the card in, its driver loaded, and the HEF for this chip? ('hailortcli fw-control identify')"
        raise ArtifactError(f"{artifact.path}: the Hailo chip does not run it here ({why})", remedy=remedy) from None
