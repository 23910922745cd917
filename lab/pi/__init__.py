"""Emulate Pis: Debian arm64 in a container, with real systemd and sshd, up in seconds."""
