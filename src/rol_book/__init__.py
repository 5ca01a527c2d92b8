"""Figures, animations, progress bars and checks of parameters for the notebooks."""
