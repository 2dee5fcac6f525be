"""The evidence: what rays have shown of each voxel, and what is believed of it."""
