"""What other programs read and write: LeRobotDatasets, donkeycar tubs, MCAP, films and figures of drives."""
