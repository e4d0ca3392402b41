"""From a problem to a `Solution`: starts, rounds that refine, strikes, series of blows, the baseline."""
