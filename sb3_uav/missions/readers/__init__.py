"""Readers of the files that operators have."""
