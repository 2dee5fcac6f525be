"""Kernels of the field: encoding, decoder, gradients."""
