"""From a folder of photographs to a map: structure from motion by COLMAP, level, to scale, as a scene that opens.

``make`` puts the steps in their order: photographs with cameras (``images``), matches and relative poses of two of them
(``two_view``), gravity, scale and positions (``alignment``), models of many (``models``), and what is written
(``scenes``).
"""
