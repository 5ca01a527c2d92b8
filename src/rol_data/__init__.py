"""Readers of public data other than Oxford's sessions (RaLL, RADIATE), and their download."""
