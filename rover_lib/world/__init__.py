"""A balloon world to record, train and drive in. This package may import onboard and workshop."""
