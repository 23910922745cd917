"""What maintains this repository: stored outputs, and the pages' tables."""
