"""Replay: rays that are kept, the distances that they teach, and samples drawn on them."""
