"""Recordings in, as samples: episode folders, LeRobotDatasets and donkeycar tubs."""
