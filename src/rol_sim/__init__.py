"""Simulated sessions: a town, a path through it, two lidars and a radar, written in Oxford's own files."""
