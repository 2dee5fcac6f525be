"""Campaigns: a server and its files under attack, for minutes or for hours."""
