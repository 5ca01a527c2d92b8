"""What the notebooks show: figures, animations, progress bars, checks of their parameters."""
