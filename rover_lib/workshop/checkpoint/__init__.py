"""Checkpoints, the user's trainer's and LeRobot's: read, check and write them."""
