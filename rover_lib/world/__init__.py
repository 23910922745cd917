"""A balloon world to record, train and drive in. May import onboard and workshop."""
