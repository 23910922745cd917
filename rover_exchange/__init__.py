"""What other programs read: LeRobotDatasets, ONNX, films and figures of drives."""
