"""Run an artifact: load it, confine its process, and let an engine predict."""
