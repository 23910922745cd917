"""Teach policies: distill a smaller one, finetune one on takeovers, and try many at once. Stands on rover_lib."""
