"""C for constant maps."""
