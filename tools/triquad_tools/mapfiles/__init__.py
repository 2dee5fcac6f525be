"""Operations on map files: summaries, differences, packing, export."""
