"""Run artifacts on a Hailo chip: it runs a compiled network (HEF), and ONNX Runtime runs the rest on the processor.

HailoRT's Python package `hailo_platform` drives the chip; Hailo's packages install it beside the driver. Its
`create_infer_model` works with the Hailo-8, 8L and 10H. A network that was right in the compiler's emulator may compute
something else on the chip, so the parity vectors of every artifact are checked on the device itself.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hailo_platform
import numpy as np

from rover_lib.onboard.artifact.archive import HEF, ONNX
from rover_lib.onboard.artifact.engines import SessionEngine
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.errors import ArtifactError

TIMEOUT_MS = 1000  # for one inference: about thirty times what it should take
LARGEST_SIDE = 8192  # of an output's shape


class HailoEngine(SessionEngine):
    """A network on the chip, and the rest of the policy on the processor. Make it with `load`.

    _runs: the manifest's "hailo", see `_check_manifest`.
    """

    def __init__(self, artifact: Artifact, threads: int | None):
        path, manifest = artifact.path, artifact.manifest
        self._path, self._runs = path, _check_manifest(manifest, path)
        cameras = manifest["cameras"]
        self._frames = [f"frame_{c['name']}" for c in cameras]
        shapes = {f"frame_{c['name']}": [c["height"], c["width"], 3] for c in cameras}
        if self._runs["network"] == "whole":
            shapes["state"] = [1, 1, len(manifest["state_names"])]
        hef = artifact.record(HEF)
        self._rest_model = artifact.record(ONNX) if ONNX in artifact.names else None
        if (self._rest_model is None) != (self._runs["network"] == "whole"):
            raise ArtifactError(f"{path}: its parts are not those of its network", remedy="pack it again")
        formats = hailo_platform.FormatType
        self._device = hailo_platform.VDevice()
        model = self._device.create_infer_model(hef)
        self._inputs = self._matched(model, model.inputs, shapes)
        self._outputs = self._matched(model, model.outputs, self._runs["outputs"])
        for name, stream in self._inputs.items():
            model.input(stream).set_format_type(formats.UINT8 if name in self._frames else formats.FLOAT32)
        for stream in self._outputs.values():
            model.output(stream).set_format_type(formats.FLOAT32)
        self._model, self._network = model, model.configure()
        self._bindings = self._network.create_bindings()
        self._answers = {name: np.empty(shape, np.float32) for name, shape in self._runs["outputs"].items()}
        for name, buffer in self._answers.items():
            self._bindings.output(self._outputs[name]).set_buffer(buffer)
        self.set_threads(threads or usable_cores())

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> np.ndarray:
        """As Engine.run()."""
        given = dict(zip(self._frames, frames_rgb, strict=True))
        if "state" in self._inputs:
            given["state"] = _affine(state, self._runs["state"]).reshape(1, 1, -1)
        try:
            for name, value in given.items():
                self._bindings.input(self._inputs[name]).set_buffer(np.ascontiguousarray(value))
            self._network.run([self._bindings], TIMEOUT_MS)
            if self._rest is None:
                return _affine(self._answers["actions"], self._runs["actions"])
            (y,) = self._rest.run(None, {"state": state[None], **self._answers})
        except Exception as e:  # HailoRT raises a dozen types, and so does ONNX Runtime
            raise RuntimeError(f"{type(e).__name__}: {e}") from None
        return y

    def _make_session(self, threads: int) -> None:
        if self._rest_model is None:
            self._rest = None
            return
        from rover_lib.onboard.policy.onnx_engine import (
            session_of,  # here: a whole network on the chip does not need it
        )

        self._rest = session_of(self._rest_model, threads, self._path)

    def _matched(self, model: Any, streams: list[Any], shapes: dict[str, list[int]]) -> dict[str, str]:
        """Return HailoRT's name of the stream for each of our names.

        A stream is found by its size and, if several have that size, by its original name. Raises ArtifactError unless
        exactly one stream matches each name, and no stream is left over.
        """
        matched = {}
        for name, shape in shapes.items():
            alike = [s.name for s in streams if math.prod(s.shape) == math.prod(shape)]
            if len(alike) > 1:
                wanted = {name, self._runs["original_names"].get(name, name)}
                alike = [s for s in alike if wanted & set(model.hef.get_original_names_from_vstream_name(s))]
            if len(alike) != 1:
                raise ArtifactError(
                    f"{self._path}: its HEF has no stream of {shape} for {name}",
                    found=", ".join(f"{s.name} {list(s.shape)}" for s in streams),
                    remedy="compile the kit's network again",
                )
            matched[name] = alike[0]
        if len(set(matched.values())) != len(streams):
            raise ArtifactError(
                f"{self._path}: its HEF has other streams than the policy", found=", ".join(s.name for s in streams)
            )
        return matched


def load(artifact: Artifact, threads: int | None) -> HailoEngine:
    """Load an artifact for the chip. Raises ArtifactError if there is no chip, or HailoRT refuses the network."""
    try:
        return HailoEngine(artifact, threads)
    except ArtifactError:
        raise
    except Exception as e:
        why = " ".join(f"{type(e).__name__}: {e}".split())[:200]
        raise ArtifactError(
            f"{artifact.path}: the Hailo chip does not run it here ({why})",
            remedy="is the card in, its driver loaded, and the HEF for this chip? ('hailortcli fw-control identify')",
        ) from None


def _check_manifest(manifest: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the manifest's "hailo". Raises ArtifactError if it does not say how the network runs.

    It has network ("backbone" or "whole"), outputs (name: shape), original_names, and state and actions, each None or
    a scale and a shift.
    """
    runs: Any = manifest.get("hailo")
    expected = {f"features_{c['name']}" for c in manifest["cameras"]}
    try:
        _require(isinstance(runs, dict) and runs["network"] in ("backbone", "whole"))
        _require(runs["outputs"].keys() == ({"actions"} if runs["network"] == "whole" else expected))
        for shape in runs["outputs"].values():
            _require(len(shape) == 3 and all(type(n) is int and 0 < n <= LARGEST_SIDE for n in shape))
        _require(all(isinstance(name, str) for name in runs["original_names"].values()))
        for affine, size in (("state", len(manifest["state_names"])), ("actions", len(manifest["action_names"]))):
            if runs[affine] is not None:
                _require(all(np.array(runs[affine][k], np.float32).shape == (size,) for k in ("scale", "shift")))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ArtifactError(
            f"{path}: its manifest does not say how its network runs", remedy="pack it again with the kit's compile.py"
        ) from None
    return runs


def _require(fact: bool) -> None:
    """Raise ValueError unless `fact` holds. Not an assert: Python leaves those out when it is told to optimise."""
    if not fact:
        raise ValueError


def _affine(x: np.ndarray, by: dict[str, list[float]] | None) -> np.ndarray:
    return x if by is None else x * np.array(by["scale"], np.float32) + np.array(by["shift"], np.float32)
