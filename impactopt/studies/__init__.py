"""Studies of the package itself: `impactopt bench` and `impactopt reproduce`, on the public API."""
