"""Maps made of recordings within this process, without a network."""
