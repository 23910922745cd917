"""Figures of teaching: students beside their teacher, and a sweep."""
# ruff: noqa: F401, these are the names that notebooks use

from rover_learn.plots.students import frontier, losses
