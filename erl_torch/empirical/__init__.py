"""From counts of tuples: the empirical model, the error of theta, reservations."""
