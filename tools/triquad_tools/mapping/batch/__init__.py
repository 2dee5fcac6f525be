"""Maps made of recordings by many processes, on one machine or on a cluster of Dask."""
