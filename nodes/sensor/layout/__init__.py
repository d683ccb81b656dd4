"""The layout of a source: what is stated of it, and how its numbers become stamped frames."""
