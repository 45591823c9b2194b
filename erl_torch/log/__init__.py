"""TensorBoard's event files, and the boards on them."""
