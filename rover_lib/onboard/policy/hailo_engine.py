"""Run artifacts on a Hailo chip: it runs a compiled network (HEF), and ONNX Runtime runs the rest on the processor.

Nobody here could run this: it was written by HailoRT's documentation, and parity vectors are checked on the device.
"""

import math
from collections.abc import Sequence
from typing import Any

import hailo_platform
import numpy as np

from rover_lib.onboard.artifact.archive import HEF, ONNX
from rover_lib.onboard.artifact.engines import SessionEngine
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.errors import ArtifactError

TIMEOUT_MS = 1000  # for one inference: about thirty times what it should take


class HailoEngine(SessionEngine):
    """A network on the chip, and the rest of the policy on the processor. Make it with `load`.

    _how: the manifest's "hailo": network, outputs (name: shape) and original_names.
    """

    def __init__(self, artifact: Artifact, threads: int | None):
        self._path, self._how = artifact.path, artifact.manifest["hailo"]
        cameras = artifact.manifest["cameras"]
        shapes = {f"frame_{c['name']}": [c["height"], c["width"], 3] for c in cameras}
        self._rest_model = artifact.record(ONNX)
        formats = hailo_platform.FormatType
        self._device = hailo_platform.VDevice()
        self._model = self._device.create_infer_model(artifact.record(HEF))
        self._inputs = self._match(self._model.inputs, shapes)
        outputs = self._match(self._model.outputs, self._how["outputs"])
        for stream in self._inputs.values():
            self._model.input(stream).set_format_type(formats.UINT8)
        for stream in outputs.values():
            self._model.output(stream).set_format_type(formats.FLOAT32)
        self._network = self._model.configure()
        self._bindings = self._network.create_bindings()
        self._answers = {name: np.empty(shape, np.float32) for name, shape in self._how["outputs"].items()}
        for name, buffer in self._answers.items():
            self._bindings.output(outputs[name]).set_buffer(buffer)
        self.set_threads(threads or usable_cores())

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> np.ndarray:
        """As Engine.run()."""
        try:
            for stream, frame in zip(self._inputs.values(), frames_rgb, strict=True):
                self._bindings.input(stream).set_buffer(np.ascontiguousarray(frame))
            self._network.run([self._bindings], TIMEOUT_MS)
            return self._rest.run(None, {"state": state[None], **self._answers})[0]
        except Exception as e:  # HailoRT raises a dozen types, and so does ONNX Runtime
            raise RuntimeError(f"{type(e).__name__}: {e}") from None

    def _make_session(self, threads: int) -> None:
        from rover_lib.onboard.policy.onnx_engine import session_of

        self._rest = session_of(self._rest_model, threads, self._path)

    def _match(self, streams: list[Any], shapes: dict[str, list[int]]) -> dict[str, str]:
        """Return HailoRT's name of the stream for each of our names: by its size and, if several have it, by name."""
        matched = {}
        for name, shape in shapes.items():
            alike = [s.name for s in streams if math.prod(s.shape) == math.prod(shape)]
            if len(alike) > 1:
                wanted = {name, self._how["original_names"].get(name, name)}
                alike = [s for s in alike if wanted & set(self._model.hef.get_original_names_from_vstream_name(s))]
            matched[name] = alike[0] if len(alike) == 1 else ""
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
