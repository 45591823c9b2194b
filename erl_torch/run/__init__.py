"""A run in a directory: built from a configuration, looped, checkpointed, reported."""
