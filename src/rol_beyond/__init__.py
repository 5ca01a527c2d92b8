"""What goes beyond the paper and is compared with it: detectors, U-Net, adaptation, motion model,
global search, recovery."""
