"""C sources of scatter-adds and instruction tables."""
