"""A recorded run as a scene that can be opened, changed and repeated."""
