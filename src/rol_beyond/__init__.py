"""Methods beyond the paper: detectors, U-Net, adaptation, motion model, global search, recovery."""
