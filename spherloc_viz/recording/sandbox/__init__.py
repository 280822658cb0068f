"""Recordings that may be damaged or hostile are read by another process."""
