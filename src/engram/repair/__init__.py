"""A map that finds its own wrong edges, and takes them out."""
