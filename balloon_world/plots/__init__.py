"""Figures of drives through the balloon world."""
