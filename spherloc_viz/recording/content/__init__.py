"""What a recording holds: how it is written and read, and how it looks in the Rerun viewer."""
