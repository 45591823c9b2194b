"""What counts of tuples say: the empirical model, the error of theta, reservations."""
