"""Emulate Pis: the same Debian arm64 in a container (real systemd and sshd, up in seconds) and as a whole machine."""
