"""Parts of a page that need the checkpoints of a store: their slider, and what changed."""
