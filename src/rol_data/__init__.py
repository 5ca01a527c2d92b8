"""Readers of public data other than Oxford's sessions (RaLL, MulRan, RADIATE), and their download."""
