"""Methods beyond the paper, for comparison with it: detectors, U-Net, adaptation, motion model,
global search, recovery."""
