"""Figures of teaching: students beside their teacher, and a sweep."""
