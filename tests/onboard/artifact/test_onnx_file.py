"""Models that somebody made to harm: what an .onnx can say beside a graph of known operators is refused, unrun."""

from collections.abc import Callable
from pathlib import Path

import onnx
import pytest
from archives import rewritten
from onnx import TensorProto, helper

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.archive import ONNX
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.artifact.onnx_file import NODES, OPERATORS
from rover_lib.onboard.errors import ArtifactError

Change = Callable[[onnx.ModelProto], object]


def changed(source: Path, target: Path, change: Change) -> Path:
    def edit(raw: bytes) -> bytes:
        model = onnx.ModelProto.FromString(raw)
        change(model)
        return model.SerializeToString()

    return rewritten(source, target, {"model.onnx": edit})


def outside(model: onnx.ModelProto) -> None:
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="/etc/passwd")


def branch(model: onnx.ModelProto) -> None:
    inner = helper.make_graph([], "inner", [], [])
    model.graph.node.append(helper.make_node("If", ["state"], ["y"], then_branch=inner, else_branch=inner))


def function(model: onnx.ModelProto) -> None:
    model.functions.append(helper.make_function("rover", "f", ["x"], ["y"], [], [helper.make_opsetid("", 17)]))


def larger(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].dims[0] *= 1000


def far_away(model: onnx.ModelProto) -> None:
    model.graph.node[0].attribute.append(helper.make_attribute("axis", -(2**40)))


HOSTILE: dict[str, tuple[Change, str]] = {
    "weights in another file": (outside, "a tensor with field 1[34]"),
    "a branch": (branch, "the attribute 'else_branch'"),
    "an operator that draws": (lambda m: m.graph.node.add(op_type="RandomNormal", output=["y"]), "'RandomNormal'"),
    "another domain": (lambda m: m.graph.node.add(op_type="Add", domain="rover"), "a node with field 7"),
    "another domain's operators": (lambda m: m.opset_import.add(domain="com.microsoft", version=1), "com.microsoft"),
    "a function": (function, "a model with field 25"),
    "properties": (lambda m: m.metadata_props.add(key="k", value="v"), "a model with field 14"),
    "a text": (lambda m: m.graph.node[0].attribute.append(helper.make_attribute("axis", "x")), "field 4"),
    "an attribute of others": (
        lambda m: m.graph.node[0].attribute.append(helper.make_attribute("body", 1)),
        "the attribute 'body'",
    ),
    "a number beyond all": (far_away, "the number -1099511627776"),
    "a tensor without its bytes": (larger, "a tensor of"),
    "sparse weights": (lambda m: m.graph.sparse_initializer.add(), "a graph with field 15"),
    "many nodes": (lambda m: [m.graph.node.add(op_type="Relu") for _ in range(NODES)], "nodes"),
    "another opset": (lambda m: setattr(m.opset_import[0], "version", 21), "operator sets"),
    "no graph": (lambda m: m.ClearField("graph"), "0 graphs"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_model_is_refused(name, onnx_static, tmp_path):
    change, message = HOSTILE[name]
    path = changed(onnx_static, tmp_path / "hostile.zip", change)
    with pytest.raises(ArtifactError, match=message) as e:
        Artifact(path).prove()
    assert "do not load it" in str(e.value) and "\n" not in str(e.value)


@pytest.mark.parametrize("raw", [b"\xff" * 40, b"\x3a\xff\xff\x01", b"\x3b", b"\x38\x01"])
def test_no_protobuf_is_refused(raw, onnx_static, tmp_path):
    path = rewritten(onnx_static, tmp_path / "hostile.zip", {"model.onnx": lambda _: raw})
    with pytest.raises(ArtifactError, match="do not load it"):
        load_policy(path)


def test_policy_for_two_engines_is_refused(artifacts, tmp_path):
    path = rewritten(artifacts["static"], tmp_path / "two.pt", {}, {ONNX: b"x"})
    with pytest.raises(ArtifactError, match="two engines"):
        Artifact(path).prove()


def test_every_operator_of_the_list_has_a_use():
    """Of those that the writer knows; erf and division are gelu's."""
    source = (Path(__file__).parents[3] / "rover_lib/workshop/int8/onnx_graph.py").read_text()
    assert not [o for o in OPERATORS if f'"{o}"' not in source]
