"""A prediction in parts against the prediction as a whole, on the emulated core and without it."""

from dataclasses import asdict
from itertools import pairwise
from types import SimpleNamespace

import needs
import pytest
import torch
from policies import memory_samples

from lab.a76 import count as arm
from lab.a76 import parts
from lab.a76.count import ArmError, count_artifact, prepare
from lab.a76.parts import FRAME, REST, count_parts, count_pieces, cut, graph_of, part_of_nodes
from rover_lib.onboard.artifact import content_hash
from rover_lib.onboard.stage import read_stage, sha256_of, write_stage
from rover_lib.workshop import act
from rover_lib.workshop import quantize as q

pytestmark = pytest.mark.emulated


@pytest.fixture(scope="module")
def static(tiny, calibration) -> q.QuantizedPolicy:
    return q.quantize(tiny, q.Scheme("static"), calibration)


@pytest.fixture(scope="module")
def graph_inputs(static) -> tuple[torch.Tensor, ...]:
    return parts.graph_inputs(static, memory_samples(1, seed=1)[0])


def test_every_layer_is_in_the_part_of_its_name(static, tiny):
    found = part_of_nodes(graph_of(static.module).graph, act.blocks(tiny.config))
    assert {*found.values()} == {*act.blocks(tiny.config), FRAME, REST}
    for node, part in found.items():
        if node.op == "call_module" and str(node.target) in {row["name"] for row in static.report["layers"]}:
            assert part == act.block_of(str(node.target)), node
    assert {part for n, part in found.items() if "layer_norm" in n.name or ".norm" in str(n.target)} == {REST}


def test_pieces_give_what_the_graph_gives(static, tiny, graph_inputs):
    graph = graph_of(static.module)
    pieces, values = cut(graph, graph_inputs, part_of_nodes(graph.graph, act.blocks(tiny.config)))
    assert all(a.part != b.part for a, b in pairwise(pieces))
    other = parts.graph_inputs(static, memory_samples(1, seed=2)[0])
    assert not all(torch.equal(a, b) for a, b in zip(other, graph_inputs, strict=True))
    for inputs in (graph_inputs, other):
        values = parts._inputs_by_name(graph, inputs)
        with torch.inference_mode():
            for piece in pieces:
                values |= zip(piece.gives, piece.module(*(values[t] for t in piece.takes)), strict=True)
            assert torch.equal(values[pieces[-1].gives[-1]], graph(*inputs))


def test_a_graph_can_be_cut_at_every_node(static, graph_inputs):
    graph = graph_of(static.module)
    nodes = [n for n in graph.graph.nodes if n.op.startswith("call")]
    pieces, _ = cut(graph, graph_inputs, {n: n.name for n in nodes})
    assert [p.part for p in pieces] == [n.name for n in nodes]


def test_what_has_no_quantized_graph_has_no_parts(tiny, calibration):
    dynamic = q.quantize(tiny, q.Scheme("dynamic"), calibration)
    with pytest.raises(ArmError, match="only a static or mixed policy has parts"):
        graph_of(dynamic.module)


@pytest.fixture(scope="module")
def run(tiny, calibration, artifacts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    for name in ("static", "dynamic"):
        (folder / f"policy_{name}.pt").write_bytes(artifacts[name].read_bytes())
    calibration.save(folder / "calibration.pt")
    modes = {
        "static": {"scheme": asdict(q.Scheme("static")), "content_hash": content_hash(folder / "policy_static.pt")}
    }
    inputs = {"calibration.pt": sha256_of(folder / "calibration.pt")}
    write_stage(folder / "quantize.json", "quantize", params={}, metrics={"modes": modes}, inputs=inputs)
    held_out = memory_samples(1, seed=1)
    again = SimpleNamespace(checkpoint=tiny, parts=SimpleNamespace(held_out=held_out))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "opened", lambda run_dir: again)
        yield folder, held_out


@needs.qemu
def test_parts_sum_up_to_the_whole(run, tiny):
    folder, held_out = run
    content = count_parts(folder)
    assert read_stage(folder / "parts.json", "parts") == content
    found = content["metrics"]
    assert found["sum_g"] == pytest.approx(found["whole"]["instructions_g"], rel=0.02)
    assert set(found["parts"]) == {*act.blocks(tiny.config), FRAME, REST}
    for what in ("instructions_g", "simd_g", "sdot_g", "floor_g"):
        assert sum(row[what] for row in found["parts"].values()) == pytest.approx(found["whole"][what], rel=0.02)
    steady = count_artifact(prepare(), folder / "policy_static.pt", held_out, counted=arm.STEADY).steady
    assert found["whole"]["instructions_g"] == pytest.approx(steady / 1e9, rel=0.005)
    for name in ("backbone.layer1", "backbone.layer4", "decoder.0.feed_forward"):
        row = found["parts"][name]
        assert row["floor_g"] <= row["sdot_g"] <= 1.1 * row["floor_g"] < row["instructions_g"]
        assert row["sdot_g"] < row["simd_g"] < row["instructions_g"]
    assert "decoder.1.cross_attention" in parts.table(content)


@needs.qemu
def test_pieces_of_another_policy_are_refused(run, tiny, calibration):
    folder, held_out = run
    other = q.quantize(tiny, q.Scheme("static", observer="minmax"), calibration)
    with pytest.raises(ArmError, match=r"policy_static\.pt: is not what these pieces were cut from"):
        count_pieces(prepare(), folder / "policy_static.pt", other, held_out[0])


def test_only_a_static_artifact_has_parts(run):
    with pytest.raises(ArmError, match="only a static or mixed artifact has parts to count, found dynamic"):
        count_parts(run[0], artifact="policy_dynamic")
