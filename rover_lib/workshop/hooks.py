"""Watch what flows through a network's modules."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from torch import nn


@contextmanager
def watched(modules: Mapping[str, nn.Module], watch: Callable[..., Any], *, before: bool = False) -> Iterator[None]:
    """Inside the block, call watch(name, module, inputs, output) after each of the modules, by name, has run.

    before: call watch(name, module, inputs) before it runs.
    """
    with ExitStack() as hooks:
        for name, module in modules.items():
            register = module.register_forward_pre_hook if before else module.register_forward_hook
            hooks.enter_context(register(partial(watch, name)))
        yield
