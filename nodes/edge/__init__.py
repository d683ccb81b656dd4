"""A compressor outside the graph: its program in C, and the node that reads its frames."""
