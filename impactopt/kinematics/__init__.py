"""Kinematics of a robot on its stance: coordinates, inverse kinematics, splines, support of soles."""
