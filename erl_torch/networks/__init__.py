"""Networks: continuous observations and actions, by the same fixed point as the tables.

Numbers of networks are float32; everything else is float64, as in the rest of the package.
"""
