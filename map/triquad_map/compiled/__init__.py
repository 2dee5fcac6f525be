"""What is compiled: the evidence, field and surfels of a region, learnt and queried."""
