"""A balloon world to record, train and drive in. Stands on rover_lib and rover_learn."""
