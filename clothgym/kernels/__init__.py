"""Compiled functions on bare arrays: one file per algorithm, no classes."""
