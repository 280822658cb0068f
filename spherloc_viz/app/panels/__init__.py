"""Comparing, sweeping, opening and exporting."""
