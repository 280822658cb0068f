"""Runs on their way to the disk: beside the work, safe from crashes, and pruned."""
