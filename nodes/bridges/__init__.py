"""Bridges: nodes that show a running graph to the tools of others, without slowing it."""
