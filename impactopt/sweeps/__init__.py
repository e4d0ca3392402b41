"""Many cases of one problem."""
