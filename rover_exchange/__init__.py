"""What other programs read and write: LeRobotDatasets, donkeycar tubs, ONNX, films and figures of drives."""
