"""Which artifacts a rover accepts, by their manifest and their code. Nothing in them is run."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rover_lib.onboard.artifact.archive import ONNX, refused
from rover_lib.onboard.artifact.manifest import PACKAGES, TORCH, Artifact
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.stage import version_of

# What can be allowed to differ. Torch, engine and actions cannot: this rover could not drive with others.
MAY_DIFFER = ("mode", "chunk", "camera", "aspect")
CODE_OF_MODE = {"static": b"ops.quantized.conv2d", "mixed": b"ops.quantized.conv2d", "dynamic": b"linear_dynamic"}
ONNX_OF_MODE = {"static": b"QuantizeLinear", "mixed": b"QuantizeLinear"}
OF_MODE: dict[str, dict[str, bytes]] = {"torch": CODE_OF_MODE, "onnxruntime": ONNX_OF_MODE}


@dataclass(frozen=True)
class Expected:
    """The artifacts that a rover accepts. camera: its name in the manifest. aspect: width / height of its frames."""

    chunk: int = 32
    camera: str = "cam_front"
    aspect: float = 16 / 9
    modes: tuple[str, ...] = ("static", "mixed")

    def refusals(self, manifest: dict[str, Any]) -> dict[str, str]:
        """Return reasons to refuse an artifact, by kind: MAY_DIFFER, and "torch", "engine", "actions" and "state"."""
        refusals = {}
        if manifest["mode"] not in self.modes:
            refusals["mode"] = f"its mode is {manifest['mode']}, which is several times slower than {self.modes[0]}"
        if manifest["chunk"] != self.chunk:
            refusals["chunk"] = f"it plans {manifest['chunk']} actions, this rover takes {self.chunk}"
        cameras = ", ".join(f"{c['name']} {c['width']}x{c['height']}" for c in manifest["cameras"])
        if [c["name"] for c in manifest["cameras"]] != [self.camera]:
            refusals["camera"] = f"it looks through {cameras}, this rover has {self.camera}"
        if any(round(c["width"] / c["height"], 1) != round(self.aspect, 1) for c in manifest["cameras"]):
            refusals["aspect"] = f"it looks through {cameras}, this rover's pictures are {self.aspect:.2f} to 1"
        for kind, key, does in (("actions", "action_names", "gives"), ("state", "state_names", "is told")):
            if manifest[key] != ["steering", "throttle"]:
                refusals[kind] = f"it {does} {', '.join(manifest[key])}, this car has steering and throttle"
        return refusals | _refuse_engine(manifest)


def _refuse_engine(manifest: dict[str, Any]) -> dict[str, str]:
    engine = manifest["engine"]
    made_with = str(manifest["versions"].get("torch", "?"))
    if engine not in PACKAGES:
        return {"engine": f"it needs the engine '{engine}', rovers have {' or '.join(PACKAGES)}"}
    here = version_of(PACKAGES[engine])
    if here is None:
        return {"engine": f"it needs {PACKAGES[engine]}, which is not installed here"}
    if engine == TORCH and made_with.split(".")[:2] != here.split(".")[:2]:
        return {"torch": f"it was made with torch {made_with}, rovers have {here}"}
    return {}


THIS_CAR = Expected()


def inspect_artifact(path: Path | str, expected: Expected = THIS_CAR, allow: Iterable[str] = ()) -> Artifact:
    """Check that an artifact may be deployed, without running it; return it, closed. Raises ArtifactError.

    allow: kinds of refusal to ignore, of those in MAY_DIFFER.
    """
    allow = set(allow)
    if unknown := allow - set(MAY_DIFFER):
        raise ArtifactError(f"only {', '.join(MAY_DIFFER)} can be allowed", found=", ".join(sorted(unknown)))
    with Artifact(path) as artifact:
        artifact.prove()
        manifest = artifact.manifest
        code = b"".join(artifact.record(n) for n in artifact.names if n.endswith(".py") or n == ONNX)
        if (needed := OF_MODE[artifact.kind].get(manifest["mode"])) and needed not in code:
            raise refused(path, f"its manifest says {manifest['mode']}, its code is not")
        for kind, why in expected.refusals(manifest).items():
            if kind not in allow:
                remedy = f"deploy another, or allow it: {kind}" if kind in MAY_DIFFER else "deploy another"
                raise ArtifactError(f"{path}: {why}", remedy=remedy)
        _ = artifact.parity  # has the shapes that the manifest says
    return artifact
