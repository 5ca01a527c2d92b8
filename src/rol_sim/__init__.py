"""Simulated sessions: a town, a drive through it, two lidars and a radar, written in Oxford's own files."""
