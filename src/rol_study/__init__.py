"""Long experiments of the book: the real route with sampled and rendered points, radar statistics,
two-sample tests."""
