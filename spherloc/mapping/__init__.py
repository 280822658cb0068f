"""From a folder of photographs to a map: structure from motion by COLMAP, level, to scale, as a scene that opens."""
