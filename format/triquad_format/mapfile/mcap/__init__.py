"""MCAP files: read with every length bounded, at random too, and written chunk by chunk.

Reading and writing stay beside the ``mcap`` library because its reader takes 256 MiB for a file of
8 kB that unpacks to so much, which this one refuses, and because its writer compresses all chunks
alike. One part in 1,000 of a 100 MB file takes 1.8 ms here, opening included, and 3.5 ms there.
"""
