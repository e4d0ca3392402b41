"""Live pages on this machine: a plan or a collision in 3D, with sliders that change it at once."""
