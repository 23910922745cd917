"""A slider over frames or ticks, for who has a notebook open in JupyterLab. Elsewhere there is nobody to move it."""

import os
from collections.abc import Callable
from typing import Any

from rover_lib.workshop.progress import TTY_VARIABLE


def browse(count: int, draw: Callable[[int], Any], what: str = "frame") -> Any:
    """A slider from 0 to count - 1 with what draw(index) gives below it, a figure or a table.

    None without a JupyterLab session, so that what is stored of a notebook does not depend on who executed it.
    """
    if not count or "JPY_SESSION_NAME" not in os.environ or TTY_VARIABLE in os.environ:
        return None
    import ipywidgets
    from IPython.display import display

    slider = ipywidgets.IntSlider(0, 0, count - 1, description=what, continuous_update=False)
    shown = ipywidgets.interactive_output(lambda index: display(draw(index)), {"index": slider})
    return ipywidgets.VBox([slider, shown])
