"""The intake of scans, from the network to rays."""
