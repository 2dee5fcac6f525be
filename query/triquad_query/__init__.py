"""What a map answers, whoever holds it: a server, or a program that opened its file.

It needs numpy alone.
"""
