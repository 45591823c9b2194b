"""EfficientS1: the same fixed point at the limit of the data, by streaming."""
