"""Recordings through other settings, offline; short recordings of scenes."""
