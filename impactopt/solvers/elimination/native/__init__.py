"""C kernels of the elimination."""
