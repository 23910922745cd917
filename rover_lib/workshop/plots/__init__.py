"""One function for each figure or table. Each returns what a cell shows, and changes nothing else.

    plots.save(plots.action_error(report), run_dir, "04_action_error")  # a figure, or a sentence if it would be empty
    plots.gates(rows)                                                   # a table

`style` has what all figures share.
"""
# ruff: noqa: F401, these are the names that notebooks use

from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.plots.costs import kernels, latencies, students
from rover_lib.workshop.plots.drives import hits_by_round, hits_over_lateness, paths, pushed_paths
from rover_lib.workshop.plots.figures import (
    action_against,
    action_error,
    episode_overview,
    familiarity,
    sensitivity,
    used_frames,
    worst_frames,
)
from rover_lib.workshop.plots.minutes import minutes
from rover_lib.workshop.plots.numbers import bytes_by_part, odd_frames, ranges_by_layer, weights_rounded
from rover_lib.workshop.plots.style import Note, save
from rover_lib.workshop.plots.tables import check_gates, gates
