"""Runs: one, many at once, over the disk, between their samples; and what they say about themselves."""
