"""Look after a rover: its releases, its health, its speed."""
