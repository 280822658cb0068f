"""Estimator core for visual localization with fisheye and 360-degree cameras."""

from importlib.metadata import version

__version__ = version("spherloc")
