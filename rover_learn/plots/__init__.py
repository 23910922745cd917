"""Figures of teaching: students beside their teacher."""
# ruff: noqa: F401, these are the names that notebooks use

from rover_learn.plots.students import frontier
