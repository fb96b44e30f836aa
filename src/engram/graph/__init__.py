"""Nodes, edges, paths: the experience graph in memory, independent of files."""
