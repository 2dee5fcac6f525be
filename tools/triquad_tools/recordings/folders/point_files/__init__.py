"""Files of one cloud each: PLY, PCD, LAS and LAZ."""
