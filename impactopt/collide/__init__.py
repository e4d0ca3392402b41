"""Single collisions in numbers: states at contact, models, measures. Sweeps take them in batches."""
