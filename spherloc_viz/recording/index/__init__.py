"""The list of runs beside their files, and what can be asked of it."""
