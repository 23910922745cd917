"""Recordings in, as samples: episode folders and LeRobotDatasets; and out again, as a LeRobotDataset."""
