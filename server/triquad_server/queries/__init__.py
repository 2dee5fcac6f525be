"""The answers to queries of what changed in a map, and of the sources of its scans."""
