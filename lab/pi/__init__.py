"""Emulated Pis: the same Debian arm64 in a container (real systemd and sshd, in seconds) and as a whole machine."""
