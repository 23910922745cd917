"""Look at a drive afterwards: its figure, its film, its replay, its MCAP file."""
