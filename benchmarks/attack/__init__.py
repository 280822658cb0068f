"""Attacks on all that spherloc reads and serves: damaged files by seed, and hostile requests to a running page."""
