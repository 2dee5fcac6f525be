"""The MCAP container: records, chunk index and writer."""
