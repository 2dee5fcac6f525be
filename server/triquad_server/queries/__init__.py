"""What clients ask of the map: which operations there are, and what answers them."""
