"""The canvas: painting primitives, picking, the viewer's places."""
