"""A run: from a checkpoint and recordings to artifacts, reports and a verdict, in one folder."""
