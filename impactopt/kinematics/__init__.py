"""Kinematics of a robot on its stance: independent coordinates, inverse kinematics, splines, support
polygon, wrench cone.
"""
