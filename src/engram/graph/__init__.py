"""Nodes, edges, paths: the experience graph in memory. Knows nothing of files."""
