"""The workstation: checkpoint and recordings in, quantized and compared artifacts out. May import onboard."""
