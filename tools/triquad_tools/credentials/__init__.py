"""Permissions on a server: a certificate authority, and configurations of Zenoh for roles."""
