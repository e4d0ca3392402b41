"""Where a robot can be: stances, independent coordinates, inverse kinematics, splines, support polygon,
wrench cone."""
