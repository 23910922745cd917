"""What other programs read and write: LeRobotDatasets, donkeycar tubs, films and figures of drives."""
