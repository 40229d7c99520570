"""Stage 1: recordings of an action -> its representation."""
