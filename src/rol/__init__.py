"""Radar-on-lidar: the reusable functions of the book, one topic per file."""

__version__ = "0.1.0"
