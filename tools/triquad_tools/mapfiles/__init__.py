"""What can be done with map files: summaries, differences, packing, export."""
