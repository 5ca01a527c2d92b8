"""Readers of public data other than Oxford's radar sessions, RaLL and RADIATE; and fetching of public files."""
