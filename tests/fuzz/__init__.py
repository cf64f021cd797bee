"""Damaged files for every reader: each is read, or refused in one line.

python -m tests.fuzz --inputs 2000
"""
