"""Recordings to and from other projects: LeRobotDatasets out, donkeycar's tubs in."""
