"""Figures of drives through the balloon world, one function each."""
# ruff: noqa: F401, these are the names that notebooks use

from balloon_world.plots.late_plans import hits_by_latency
from balloon_world.plots.learning import hits_by_round
