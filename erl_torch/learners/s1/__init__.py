"""Published Algorithm S1: one stream, or many side by side."""
