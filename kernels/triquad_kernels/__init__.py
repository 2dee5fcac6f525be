"""Compiled code: the field's arithmetic, the evidence of rays, and searches in it.

It needs numba and no torch: the server trains and answers with it, and a client that has numba
answers with it from files.
"""
