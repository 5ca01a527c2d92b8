"""Radar-on-lidar: the method of the paper, one module per step."""

__version__ = "0.2.0"
