"""What compiled code is made with: kernels, vectors, sparse voxels, and threads."""
