"""Recordings on the rover: write episodes, and read them again."""
