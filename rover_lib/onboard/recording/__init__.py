"""Recordings on the rover: write episodes, read them again, and note how a drive ended."""
