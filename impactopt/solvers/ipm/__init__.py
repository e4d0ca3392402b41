"""Primal-dual interior-point method of our own: one Newton step on each quadratic model."""
