"""Programs that make published figures again; see README.md here."""
