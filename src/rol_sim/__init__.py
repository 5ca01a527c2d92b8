"""Simulated sessions: a town, a path through it, two lidars and a radar, as files of the data set."""
