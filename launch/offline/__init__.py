"""Recordings through other settings, offline: whole, or in slices on many workers."""
