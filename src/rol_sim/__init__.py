"""Simulated sessions: a town, a path through it, two lidars and a radar, written in the file formats of the data set."""
