"""Fuzz tests: damaged files for every reader; each must be read, or refused in one line.

python -m tests.fuzz --inputs 2000
"""
