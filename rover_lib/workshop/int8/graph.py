"""A policy's graph, float or INT8, as FX traces it, and the same with the encoder's mean output beside the plan."""

from torch import nn
from torch.fx import Graph, GraphModule, Node, Tracer

from rover_lib.workshop.act import Columns


class _Leaves(Tracer):
    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        return isinstance(m, Columns) or super().is_leaf_module(m, module_qualified_name)


def graph_of(module: nn.Module) -> GraphModule:
    """Trace a float module of ours with FX. The module of a quantized policy is a graph already."""
    return module if isinstance(module, GraphModule) else GraphModule(module, _Leaves().trace(module))


def with_embedding(module: nn.Module, *, alone: bool = False) -> GraphModule:
    """Return a policy's graph that gives, beside the actions, the encoder's output averaged over the tokens: (1, D).

    alone: without the actions, and what only they need. Its weights are the module's own, and its operators the same.
    """
    source = graph_of(module)
    copied, nodes = Graph(), dict[Node, Node]()
    actions = copied.graph_copy(source.graph, nodes)
    encoded = next(nodes[node] for node in source.graph.nodes if node.target == "encoder_norm")
    embedding = copied.call_method("mean", (encoded, 1))
    copied.output(embedding if alone else (actions, embedding))
    found = GraphModule(source, copied)
    found.graph.eliminate_dead_code()
    found.recompile()
    return found
