"""What is sparse in space: rows that grow, found by the voxel that they belong to."""
